"""One matcher on one set of photos, in a process of its own and on one thread; prints one line of JSON.

usage: python benchmarks/matcher_side.py TASK

TASK is JSON with the fields of `Task`. Times are of the processor, so that other work beside it costs little.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pipeline.engine.threads import limit_threads

# Before numpy is imported: its thread pools are sized then.
limit_threads()

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from flight_truth import FlightTruth, reprojection_errors  # noqa: E402
from match_sets import LOGGED, Flight, PhotoSet, exact_relative  # noqa: E402

from pipeline.depthing import Limits, MatchedRays, depths_by  # noqa: E402
from pipeline.engine.errors import EpiTransferError, MissingPartError  # noqa: E402
from pipeline.flight import PairRow  # noqa: E402
from pipeline.geometry.arrays import Bools, Floats, Ints  # noqa: E402
from pipeline.geometry.cameras import Camera  # noqa: E402
from pipeline.geometry.poses import RelativePose  # noqa: E402
from pipeline.geometry.transfer import VirtualView  # noqa: E402
from pipeline.matching.features import Features, extract  # noqa: E402
from pipeline.matching.images import read_colour, read_grey  # noqa: E402
from pipeline.matching.matcher import Matcher, SearchLimits, View  # noqa: E402
from pipeline.matching.matchers import MatcherSetting, weights_of  # noqa: E402
from pipeline.matching.pair import PairMatches, match_pair  # noqa: E402
from pipeline.matching.reach import Band  # noqa: E402
from pipeline.simulation.lawn import HALL, LAWN_M, lawn_site  # noqa: E402
from pipeline.simulation.site import GROUND, place  # noqa: E402
from pipeline.simulation.solids import TOP  # noqa: E402
from stages.depth import Config as DepthConfig  # noqa: E402
from stages.match import Config as MatchConfig  # noqa: E402

RIGHT_PX, NEAR_SHARE = 1.0, 0.1
LAWN, ROOF, REST = "lawn", "roof", "rest"
# What the processes ask of the system beside one another is measured at the end of the matching.
_STATUS = Path("/proc/self/status")
_WARM_PX = 192


@dataclass(frozen=True, slots=True)
class Task:
    """What is to be matched, and how.

    Args:
        matcher: Its name.
        max_image_px: Longest side images are matched at.
        most_pairs: Pairs of the set that are matched.
        name: As all that follows, of the PhotoSet.
    """

    matcher: str
    max_image_px: int
    most_pairs: int
    name: str
    run: str
    truth: str | None
    poses: str
    nearest_m: float
    max_range_m: float

    @classmethod
    def of(cls, photos: PhotoSet, matcher: str, max_image_px: int, most_pairs: int) -> Task:
        """The task of one matcher on a set."""
        truth = str(photos.truth) if photos.truth else None
        named = (photos.name, str(photos.run), truth, photos.poses, photos.nearest_m, photos.max_range_m)
        return cls(matcher, max_image_px, most_pairs, *named)

    @property
    def photos(self) -> PhotoSet:
        """The set."""
        truth = Path(self.truth) if self.truth else None
        return PhotoSet(self.name, Path(self.run), truth, self.poses, self.nearest_m, self.max_range_m)


@dataclass(slots=True)
class Worth:
    """What matches are worth that were kept.

    Args:
        matches: How many.
        judged: Those whose distance from an epipolar line is known.
        right: Those of them within RIGHT_PX, at the size matched at, of that line.
        error_px: Median and 90 % of the distances from the truth, px of the photo as given.
        depths: Kept depths.
        depths_true: Of them, those with a true depth.
        depths_near: Of these, those within NEAR_SHARE of it.
        by_surface: Kept depths on the lawn, the hall's roof and the rest.
    """

    matches: int = 0
    judged: int = 0
    right: int = 0
    error_px: tuple[float, float] | None = None
    depths: int = 0
    depths_true: int = 0
    depths_near: int = 0
    by_surface: dict[str, int] = field(default_factory=dict)


@dataclass(slots=True)
class Outcome:
    """What came of it; empty but for `missing` where the matcher lacks something.

    Args:
        missing: What it lacks.
        pairs: Pairs matched.
        images: Photos that features were found in; 0 for a dense matcher.
        made: Matches, duplicates left out.
        fitted: Those whose patches fit.
        kept: Those that fit, and agree with the pose and with one another.
        image_s: CPU time per photo: its features.
        pair_s: CPU time per pair: candidates, fit of the patches, checks.
        memory_mib: Most memory of the process.
    """

    missing: str = ""
    pairs: int = 0
    images: int = 0
    made: int = 0
    fitted: int = 0
    kept: Worth = field(default_factory=Worth)
    image_s: float = 0.0
    pair_s: float = 0.0
    memory_mib: float = 0.0

    @classmethod
    def of(cls, stored: dict[str, Any]) -> Outcome:
        """As it was before it became JSON."""
        return cls(kept=Worth(**stored.pop("kept")), **stored)


@dataclass(frozen=True, slots=True)
class Found:
    """Matches of a pair, and what they cost.

    Args:
        pair: Which.
        matches: All.
        cpu_s: From views to matches.
    """

    pair: PairRow
    matches: PairMatches
    cpu_s: float


def matched(
    flight: Flight, pairs: list[PairRow], matcher: Matcher, limits: SearchLimits, outcome: Outcome
) -> Iterator[Found]:
    """Matches pairs as the stage does; each photo's features are found once."""
    features: dict[str, Features] = {}

    def view(frame_id: str) -> View:
        extractor = matcher.extractor
        image = (read_colour if matcher.colour else read_grey)(flight.photos[frame_id])
        if extractor is not None and frame_id not in features:
            start = time.process_time()
            features[frame_id] = extract(extractor, [image])[0]
            outcome.image_s += time.process_time() - start
        return View(flight.cameras[frame_id], image, features.get(frame_id, Features.none()))

    for pair in pairs:
        ref, src, pose = view(pair.ref), view(pair.src), flight.relative(pair)
        start = time.process_time()
        found = match_pair(matcher, ref, src, pose, limits, up_in_ref=flight.poses[pair.ref].rotation[2])
        yield Found(pair, found, time.process_time() - start)
    outcome.images = len(features)


def line_distances(ref_px: Floats, src_px: Floats, ref: Camera, src: Camera, pose: RelativePose) -> Floats:
    """Distances of src pixels from the epipolar lines of their ref pixels.

    Args:
        ref_px: (n, 2).
        src_px: (n, 2).
        ref: Camera.
        src: Camera.
        pose: src_from_ref.

    Returns:
        (n,) px of src as given; curved lines are straight at the pixel.
    """
    rays = src.rays(src_px)
    plane = np.cross(pose.translation, ref.rays(ref_px) @ pose.rotation.T)
    # d(residual) / d(pixel): the jacobian is that of the pixel by the image plane.
    slope = np.linalg.solve(np.swapaxes(src.pixel_jacobian(rays), 1, 2), plane[:, :2, None])[..., 0]
    out: Floats = np.abs(np.sum(plane * rays, axis=1)) / np.linalg.norm(slope, axis=1)
    return out


def own_pose(ref_px: Floats, src_px: Floats, ref: Camera, src: Camera, threshold_rad: float) -> RelativePose | None:
    """The pose that matches agree on among themselves, the baseline of length 1; None where they are too few."""
    in_ref, in_src = (camera.rays(pixels)[:, :2].copy() for camera, pixels in ((ref, ref_px), (src, src_px)))
    if len(ref_px) < 8:
        return None
    matrix, mask = cv2.findEssentialMat(in_ref, in_src, np.eye(3), cv2.USAC_MAGSAC, 0.9999, threshold_rad, 10_000)
    if matrix is None or matrix.shape != (3, 3):
        return None
    _, rotation, translation, _ = cv2.recoverPose(matrix, in_ref, in_src, np.eye(3), mask=mask.copy())
    return RelativePose(np.asarray(rotation, np.float64), np.asarray(translation, np.float64).ravel(), np.zeros((6, 6)))


def surfaces(truth: FlightTruth, frame_id: str, rays: Floats) -> Ints:
    """What pixels of the lawn flight show: 0 the lawn, 1 the hall's roof, 2 the rest.

    Args:
        truth: Of that flight.
        frame_id: The photo.
        rays: (n, 3) of its camera.
    """
    seed = json.loads((truth.folder / "site.json").read_text(encoding="utf-8"))["seed"]
    pose, site = truth.poses[frame_id], lawn_site(seed)
    directions = rays @ pose.rotation.T
    hits = site.cast(pose.centre, directions)
    at = (pose.centre + np.where(np.isfinite(hits.distance), hits.distance, 0.0)[:, None] * directions)[:, :2]
    # `place` turns and mirrors: its own inverse but for the order of the axes.
    forward, right = np.linalg.solve(place(np.eye(2)).T, at.T)
    (near, far), (left, end) = LAWN_M
    on_lawn = (hits.thing == GROUND) & (near <= forward) & (forward <= far) & (left <= right) & (right <= end)
    roof = (hits.thing == HALL) & (hits.face == TOP)
    return np.select([on_lawn, roof], [0, 1], 2)


class Judge:
    """Adds up what matches of a set are worth."""

    def __init__(self, photos: PhotoSet, flight: Flight, limits: SearchLimits) -> None:
        self._photos, self._flight, self._limits = photos, flight, limits
        self._truth = FlightTruth(photos.truth) if photos.truth else None
        self._errors: list[Floats] = []

    def add(self, found: Found, out: Outcome) -> None:
        """One more pair."""
        matches, pair = found.matches, found.pair
        # A fit's covariance is never round to the last bit, one that is only assumed is.
        fitted = matches.covariance[:, 1] != 0.0
        out.pairs += 1
        out.pair_s += found.cpu_s
        out.made += len(matches.score)
        out.fitted += int(fitted.sum())
        self._add(out.kept, pair, self._true_pose(pair, matches, matches.inlier), matches, matches.inlier)

    def finish(self, out: Outcome) -> None:
        """The medians of all pairs."""
        errors = np.concatenate([np.empty(0), *self._errors])
        errors = errors[np.isfinite(errors)]
        if len(errors):
            out.kept.error_px = (float(np.median(errors)), float(np.quantile(errors, 0.9)))
        out.pair_s /= max(1, out.pairs)
        out.image_s /= max(1, out.images)

    def _cameras(self, pair: PairRow) -> tuple[Camera, Camera]:
        return self._flight.cameras[pair.ref], self._flight.cameras[pair.src]

    def _true_pose(self, pair: PairRow, matches: PairMatches, surest: Bools) -> RelativePose | None:
        if self._truth is not None:
            return exact_relative(self._truth.poses[pair.ref], self._truth.poses[pair.src])
        if self._photos.poses != LOGGED:
            return exact_relative(self._flight.poses[pair.ref], self._flight.poses[pair.src])
        cameras = self._cameras(pair)
        pixel_rad = RIGHT_PX * self._limits.pixel_rad(cameras[1])
        return own_pose(matches.ref_px[surest], matches.src_px[surest], *cameras, pixel_rad)

    def _add(self, out: Worth, pair: PairRow, pose: RelativePose | None, matches: PairMatches, rows: Bools) -> None:
        cameras = self._cameras(pair)
        ref_px, src_px = matches.ref_px[rows], matches.src_px[rows]
        out.matches += len(ref_px)
        if pose is not None:
            distance = line_distances(ref_px, src_px, *cameras, pose) / self._limits.shrink(cameras[1])
            out.judged += len(distance)
            out.right += int(np.count_nonzero(distance <= RIGHT_PX))
        truth = np.full(len(ref_px), np.nan)
        if self._truth is not None:
            truth = self._truth.depths(pair.ref, ref_px)
            poses = {"ref": self._truth.poses[pair.ref], "src": self._truth.poses[pair.src]}
            error = np.linalg.norm(reprojection_errors(ref_px, src_px, truth, cameras[0], **poses), axis=1)
            self._errors.append(error)
        self._depths(out, pair, (ref_px, src_px, matches.covariance[rows]), truth)

    def _depths(self, out: Worth, pair: PairRow, matches: tuple[Floats, Floats, Floats], truth: Floats) -> None:
        config, cameras = DepthConfig.model_validate({}), self._cameras(pair)
        rays = MatchedRays.of(matches[0], matches[1], *cameras, matches[2])
        limits = Limits(config.max_relative_sigma, self._photos.max_range_m)
        view = VirtualView(config.virtual_view)
        result = depths_by("epitransfer", view, config.virtual_baseline_m, rays, self._flight.relative(pair), limits)
        kept = result.kept
        out.depths += int(kept.sum())
        known = kept & np.isfinite(truth)
        out.depths_true += int(known.sum())
        out.depths_near += int(np.sum(np.abs(result.depths.depth_m[known] / truth[known] - 1.0) <= NEAR_SHARE))
        if self._truth is not None and self._truth.folder.parent.name == LAWN:
            shown = surfaces(self._truth, pair.ref, cameras[0].rays(matches[0][kept]))
            for number, name in enumerate((LAWN, ROOF, REST)):
                out.by_surface[name] = out.by_surface.get(name, 0) + int(np.sum(shown == number))


def warm_up(matcher: Matcher) -> None:
    """Loads the network, and lets libraries settle on their ways, before anything is timed."""
    noise = np.random.default_rng(0).integers(0, 256, (_WARM_PX, _WARM_PX), np.uint8)
    if matcher.extractor is not None:
        extract(matcher.extractor, [noise])


def peak_mib() -> float:
    """Most memory this process has held."""
    for line in _STATUS.read_text(encoding="ascii").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024.0
    return float("nan")


def outcome_of(task: Task) -> Outcome:
    """Matches the task's pairs and judges the matches."""
    cv2.setNumThreads(1)
    try:
        weights = weights_of(task.matcher, None)
    except MissingPartError:
        return Outcome(missing="no weights")
    outcome, photos, config = Outcome(), task.photos, MatchConfig.model_validate({})
    flight = Flight.of(photos.run)
    matcher = MatcherSetting(task.matcher, task.max_image_px, weights=weights).build([])
    band = Band(config.band_sigmas, config.sigma_px, photos.nearest_m)
    limits = SearchLimits(band, config.consensus_px, task.max_image_px)
    warm_up(matcher)
    found = list(matched(flight, flight.some_pairs(task.most_pairs), matcher, limits, outcome))
    outcome.memory_mib = peak_mib()
    judge = Judge(photos, flight, limits)
    for item in found:
        judge.add(item, outcome)
    judge.finish(outcome)
    return outcome


def main(task: Task) -> None:
    """Prints the outcome."""
    try:
        outcome = outcome_of(task)
    except EpiTransferError as error:
        outcome = Outcome(missing=error.code)
    print(json.dumps(asdict(outcome)))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python benchmarks/matcher_side.py TASK")
    main(Task(**json.loads(sys.argv[1])))
