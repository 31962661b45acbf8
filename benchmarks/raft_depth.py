"""Dense flow held against what is known: homographies of a photo, and depths at the pixels that LiDAR returns fall on.

usage: python benchmarks/raft_depth.py EXAMPLE

RAFT-small and DIS side by side. The photo is a real one where $EPITRANSFER_SHARED or ../shared has it. The depths are
those of the example's neighbouring pairs; under the logged poses flow and poses are to blame for what they are off,
under the true ones the flow alone.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.engine.threads import limit_threads

# Before numpy is imported: its thread pools are sized then.
limit_threads()

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from example_truth import MAX_RANGE_M, clipped  # noqa: E402
from flight_truth import LEGS, FlightTruth, TruePose, configured, facts, reprojection_errors  # noqa: E402
from match_sets import Flight, exact_relative, example_run, shared_folder  # noqa: E402

from pipeline.depthing import Limits, MatchedRays, depths_by  # noqa: E402
from pipeline.engine.errors import MissingPartError  # noqa: E402
from pipeline.flight import PairRow  # noqa: E402
from pipeline.geodesy.enu import LocalFrame  # noqa: E402
from pipeline.geodesy.heights import ELLIPSOIDAL  # noqa: E402
from pipeline.geometry.arrays import Bools, Bytes, Floats  # noqa: E402
from pipeline.geometry.cameras import Camera  # noqa: E402
from pipeline.geometry.poses import Pose, RelativePose  # noqa: E402
from pipeline.geometry.transfer import VirtualView  # noqa: E402
from pipeline.lidar.heightfield import HeightField, return_spacing_m  # noqa: E402
from pipeline.lidar.nearby import LocalTiles, returns_near  # noqa: E402
from pipeline.lidar.tiles import expand, read_tile  # noqa: E402
from pipeline.lidar.visibility import View, visible_returns  # noqa: E402
from pipeline.matching.flow.estimators import DisFlow, FlowEstimator  # noqa: E402
from pipeline.matching.flow.field import DenseMatches, FlowSetting, dense_field  # noqa: E402
from pipeline.matching.flow.raft import raft_from_state  # noqa: E402
from pipeline.matching.flow.raft_flow import RaftFlow  # noqa: E402
from pipeline.matching.flow.start import FlowView  # noqa: E402
from pipeline.matching.images import read_colour  # noqa: E402
from pipeline.matching.matcher import SearchLimits  # noqa: E402
from pipeline.matching.matchers import weights_of  # noqa: E402
from pipeline.matching.reach import Band  # noqa: E402
from pipeline.matching.weights.files import load_state  # noqa: E402
from pipeline.scoring.metrics import DELTA_BASE  # noqa: E402
from stages.depth import Config as DepthConfig  # noqa: E402
from stages.match import Config as MatchConfig  # noqa: E402

WIDTH, HEIGHT = 800, 600
MATCHED_PX = {"raft": 800, "dis": 1600}
# Of returns from the flight's start: the whole site.
FAR_M = 400.0
PAIRS_PER_LEG = 2
LOGGED, TRUE = "logged", "true"
METHODS = ("dlt", "epitransfer")
CONSISTENT_PX = 1.0
# Pixels near the border may show what the other photo does not.
_BORDER_PX = 8


def estimators() -> Iterator[tuple[str, FlowEstimator | None]]:
    """RAFT and DIS; None where there are no weights."""
    try:
        (weights,) = weights_of("raft", None)
    except MissingPartError:
        yield "raft", None
    else:
        yield "raft", RaftFlow(raft_from_state(load_state(weights)).eval(), weights.sha256, torch.device("cpu"))
    yield "dis", DisFlow()


def homographies() -> dict[str, Floats]:
    """Known motions, ref px to src px, of a photo of WIDTH x HEIGHT."""
    turn, grow = np.radians(3.0), 1.03
    c, s = grow * np.cos(turn), grow * np.sin(turn)
    middle = np.array([[1.0, 0.0, (WIDTH - 1) / 2], [0.0, 1.0, (HEIGHT - 1) / 2], [0.0, 0.0, 1.0]])
    about_middle = middle @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.linalg.inv(middle)
    tilt = np.array([[1.0, 0.02, 0.0], [-0.01, 1.0, 0.0], [4e-5, -3e-5, 1.0]])
    return {
        "shift by 14.5 px": np.array([[1.0, 0.0, 14.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        "3 deg and 3 %": about_middle,
        "perspective": middle @ tilt @ np.linalg.inv(middle),
    }


def photo(example: Path) -> tuple[str, Bytes]:
    """A photo larger than WIDTH x HEIGHT about its middle, so that its copies have no empty border."""
    shared = shared_folder()
    real = shared / "data" / "truth" / "fountain_p11" / "images" / "0005.jpg" if shared else None
    path = real if real is not None and real.is_file() else example / "photos" / "DJI_0003.JPG"
    image = read_colour(path)
    scale = 1.3 * max(WIDTH / image.shape[1], HEIGHT / image.shape[0])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return str(path.relative_to(path.parents[2])), np.asarray(small, np.uint8)


def end_point_errors(image: Bytes, homography: Floats, estimator: FlowEstimator) -> tuple[Floats, Floats, float]:
    """How far a flow is off a homography.

    Args:
        image: (h, w, 3), with room about the middle WIDTH x HEIGHT.
        homography: Ref px to src px of the middle.
        estimator: Of the flow.

    Returns:
        (n,) px, (n,) px of motion, and CPU seconds.
    """
    top, left = (image.shape[0] - HEIGHT) // 2, (image.shape[1] - WIDTH) // 2
    ref = np.ascontiguousarray(image[top : top + HEIGHT, left : left + WIDTH])
    from_middle = np.array([[1.0, 0.0, left], [0.0, 1.0, top], [0.0, 0.0, 1.0]])
    src_from_image = homography @ np.linalg.inv(from_middle)
    src = np.asarray(cv2.warpPerspective(image, src_from_image, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC), np.uint8)
    if estimator.channels == 1:
        ref, src = (np.asarray(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), np.uint8) for i in (ref, src))
    start = time.process_time()
    (flow,) = estimator.flows([(ref, src)])
    spent = time.process_time() - start
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    moved = np.stack([u, v, np.ones_like(u)], axis=-1) @ homography.T
    true = moved[..., :2] / moved[..., 2:] - np.stack([u, v], axis=-1)
    at = true + np.stack([u, v], axis=-1)
    size = np.array([WIDTH, HEIGHT]) - 1.0 - _BORDER_PX
    seen = np.all((at >= _BORDER_PX) & (at <= size), axis=-1)
    return np.linalg.norm(flow - true, axis=-1)[seen], np.linalg.norm(true, axis=-1)[seen], spent


def homography_table(example: Path, flows: dict[str, FlowEstimator | None]) -> None:
    """Prints the first table."""
    name, image = photo(example)
    print(
        f"End-point error of dense flow on known motions of {name}, {WIDTH} x {HEIGHT} px: mean and 95 % (px), CPU s\n"
    )
    print(f"  {'':20}{'motion px':>10}" + "".join(f"{f'{key} mean':>13}{'95 %':>8}{'s':>7}" for key in flows))
    for title, matrix in homographies().items():
        cells, motion = "", ""
        for estimator in flows.values():
            if estimator is None:
                cells += f"{'no weights':>13}{'':15}"
                continue
            error, moved, spent = end_point_errors(image, matrix, estimator)
            motion = f"{np.mean(moved):10.1f}"
            cells += f"{np.mean(error):13.2f}{np.quantile(error, 0.95):8.2f}{spent:7.1f}"
        print(f"  {title:20}{motion}{cells}", flush=True)


@dataclass(frozen=True, slots=True)
class Scored:
    """Depths at LiDAR pixels whose place in src the flow tells.

    Args:
        lidar_m: (n,) depth of the return in the ref camera.
        depth_m: (n,) by method; not finite where there is none.
        kept: (n,) by method, where the way back agrees as well.
        missed_px: (n,) px of the photo by which the flow misses the true place; NaN where that is not known.
        asked: Pixels that returns fall on.
    """

    lidar_m: Floats
    depth_m: dict[str, Floats]
    kept: dict[str, Bools]
    missed_px: Floats
    asked: int

    @classmethod
    def joined(cls, parts: Sequence[Scored]) -> Scored:
        """Those of several pairs."""
        return cls(
            np.concatenate([part.lidar_m for part in parts]),
            {name: np.concatenate([part.depth_m[name] for part in parts]) for name in METHODS},
            {name: np.concatenate([part.kept[name] for part in parts]) for name in METHODS},
            np.concatenate([part.missed_px for part in parts]),
            sum(part.asked for part in parts),
        )


class LidarPixels:
    """The pixels that visible returns fall on, found as the stage `score` finds them.

    Args:
        example: Folder of the example.
        frame: Of the poses that will be asked with.
        geoid: Undulation, m.
        cameras: By frame_id.
    """

    def __init__(self, example: Path, frame: LocalFrame, geoid: float, cameras: Mapping[str, Camera]) -> None:
        tiles = LocalTiles(tuple(map(read_tile, expand(str(example / "lidar")))), frame, geoid, ELLIPSOIDAL)
        self._cameras = cameras
        self._returns = returns_near(tiles, np.zeros((1, 3)), FAR_M)
        self._spacing_m = return_spacing_m(self._returns)
        self._field = HeightField.of(self._returns, self._spacing_m)

    def seen(self, frame_id: str, pose: TruePose | Pose) -> tuple[Floats, Floats]:
        """Pixels (n, 2) and depths (n,) in m of the returns that a photo sees from a place."""
        view = View(self._cameras[frame_id], pose.centre, pose.rotation)
        visible = visible_returns(view, self._returns, self._field, self._spacing_m, MAX_RANGE_M)
        return visible.pixels, visible.depth_m


class Example:
    """The example's photos, poses and returns, logged and true."""

    def __init__(self, example: Path, run: Path) -> None:
        self.truth, self.flight = FlightTruth.of(example), Flight.of(run)
        site = json.loads((self.truth.folder / "site.json").read_text(encoding="utf-8"))
        origin, true_origin = facts(run, "ingest")["origin"], site["frame_enu"]
        names = ("latitude_deg", "longitude_deg", "height_m")
        frames = [LocalFrame(*(float(where[name]) for name in names)) for where in (origin, true_origin)]
        geoid = float(configured(run, "ingest")["geoid"])
        logged, true = (LidarPixels(example, frame, geoid, self.flight.cameras) for frame in frames)
        self.returns = {LOGGED: logged, TRUE: true}
        self.poses: dict[str, Mapping[str, TruePose | Pose]] = {LOGGED: self.flight.poses, TRUE: self.truth.poses}

    def pairs(self) -> list[PairRow]:
        """A few neighbours of each leg."""
        found: list[PairRow] = []
        for leg in LEGS:
            near = [
                pair
                for pair in self.flight.pairs
                if self.truth.leg(pair.ref, pair.src) == leg and self.truth.neighbours(pair.ref, pair.src)
            ]
            found += [near[round(i)] for i in np.linspace(0, len(near) - 1, PAIRS_PER_LEG + 2)[1:-1]]
        return found

    def scored(self, pair: PairRow, estimator: FlowEstimator, longest_px: int) -> dict[str, Scored]:
        """Depths of one pair's LiDAR pixels, by the poses they are found with; the flow is the same."""
        camera = self.flight.cameras[pair.ref]
        views = [FlowView(read_colour(self.flight.photos[name]), camera) for name in (pair.ref, pair.src)]
        config = MatchConfig.model_validate({})
        limits = SearchLimits(
            Band(config.band_sigmas, config.sigma_px, config.nearest_m), config.consensus_px, longest_px
        )
        logged = self.flight.relative(pair)
        setting = FlowSetting(longest_px, limits.band.nearest_for(logged))
        field = dense_field(views[0], views[1], logged, estimator, setting)
        seen = {name: self.returns[name].seen(pair.ref, self.poses[name][pair.ref]) for name in (LOGGED, TRUE)}
        answer = field.sample(np.concatenate([pixels for pixels, _ in seen.values()]))
        last = len(seen[LOGGED][0])
        relative = {LOGGED: logged, TRUE: exact_relative(self.truth.poses[pair.ref], self.truth.poses[pair.src])}
        rows = {LOGGED: slice(None, last), TRUE: slice(last, None)}
        return {
            name: self._one(pair, _part(answer, rows[name]), seen[name][1], relative[name], limits)
            for name in (LOGGED, TRUE)
        }

    def _one(
        self, pair: PairRow, found: DenseMatches, lidar_m: Floats, pose: RelativePose, limits: SearchLimits
    ) -> Scored:
        camera, there = self.flight.cameras[pair.ref], found.valid
        ref_px, src_px, missed = found.ref_px[there], found.src_px[there], found.discrepancy_px[there]
        # As the dense matcher has it.
        variance = limits.prior_variance(camera, camera) + 0.5 * (missed * limits.shrink(camera)) ** 2
        covariance = np.stack([variance, np.zeros_like(variance), variance], axis=1)
        rays, config = MatchedRays.of(ref_px, src_px, camera, camera, covariance), DepthConfig.model_validate({})
        kept_by = Limits(config.max_relative_sigma, config.max_range_m)
        depths = {
            name: depths_by(name, VirtualView.ADAPTIVE, config.virtual_baseline_m, rays, pose, kept_by)
            for name in METHODS
        }
        true_poses = {"ref": self.truth.poses[pair.ref], "src": self.truth.poses[pair.src]}
        error = reprojection_errors(ref_px, src_px, self.truth.depths(pair.ref, ref_px), camera, **true_poses)
        return Scored(
            lidar_m[there],
            {name: result.depths.depth_m for name, result in depths.items()},
            {name: result.kept & (missed <= CONSISTENT_PX) for name, result in depths.items()},
            np.linalg.norm(error, axis=1),
            len(lidar_m),
        )


def _part(found: DenseMatches, rows: slice) -> DenseMatches:
    return DenseMatches(found.ref_px[rows], found.src_px[rows], found.discrepancy_px[rows], found.valid[rows])


def lidar_table(example: Path, flows: Mapping[str, FlowEstimator | None]) -> None:
    """Prints the second table."""
    with tempfile.TemporaryDirectory(prefix="raft_depth.") as folder:
        scene = Example(example, example_run(example, "workflow.toml", Path(folder)))
        pairs = scene.pairs()
        print(
            f"\nDepths at the pixels of LiDAR returns seen within {MAX_RANGE_M:g} m, {len(pairs)} neighbouring pairs;"
        )
        print(
            "flow found under the logged poses at " + ", ".join(f"{px} px ({name})" for name, px in MATCHED_PX.items())
        )
        print("  in src  of the pixels, whose place the flow puts into src; px: its distance from the true place")
        print("  common  of the pixels, where both methods keep the depth and the way back agrees")
        print(f"  unmasked depths are all in src, clipped to {MAX_RANGE_M:g} m; each: AbsRel and share within 1.25\n")
        print(
            f"  {'':27}{'flow px':>14}{'':8}{'DLT, common':>15}{'adaptive, common':>17}"
            f"{'DLT, unmasked':>15}{'adaptive':>15}"
        )
        print(
            f"  {'':12}{'pixels':>8}{'in src':>7}{'median':>7}{'90 %':>7}{'common':>8}"
            + "".join(f"{'AbsRel':>{width}}{'d1':>7}" for width in (8, 10, 8, 8))
        )
        for name, estimator in flows.items():
            if estimator is None:
                print(f"  {name:12}no weights")
                continue
            found = [scene.scored(pair, estimator, MATCHED_PX[name]) for pair in pairs]
            for poses in (LOGGED, TRUE):
                print(row(f"{name}, {poses}", Scored.joined([part[poses] for part in found])), flush=True)


def row(title: str, some: Scored) -> str:
    """A row of the second table."""
    common = np.logical_and.reduce([some.kept[name] for name in METHODS])
    missed = some.missed_px[np.isfinite(some.missed_px)]
    cells = [some.depth_m[name][common] / some.lidar_m[common] for name in METHODS]
    cells += [clipped(some.depth_m[name]) / some.lidar_m for name in METHODS]
    return (
        f"  {title:12}{some.asked:8,}{len(some.lidar_m) / some.asked:7.1%}{np.median(missed):7.2f}"
        f"{np.quantile(missed, 0.9):7.2f}{common.sum() / some.asked:8.1%}"
        + "".join(
            f"{np.mean(np.abs(ratio - 1.0)):{width}.4f}{np.mean((ratio < DELTA_BASE) & (ratio > 1 / DELTA_BASE)):7.1%}"
            for ratio, width in zip(cells, (8, 10, 8, 8), strict=True)
        )
    )


def main(example: Path) -> None:
    """Prints the tables."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    flows = dict(estimators())
    homography_table(example, flows)
    lidar_table(example, flows)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python benchmarks/raft_depth.py EXAMPLE")
    main(Path(sys.argv[1]))
