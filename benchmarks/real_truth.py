"""What is known of real photos beside their logs: exact poses, measured depths, ground points; errors against it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
from flight_truth import facts, sampled
from pyproj import CRS, Transformer
from scipy.optimize import least_squares

from pipeline.engine.tables import read_table
from pipeline.flight import camera_by_frame, cameras_of, column, columns, placements_of
from pipeline.geodesy.enu import LocalFrame
from pipeline.geometry.arrays import AnyArray, Bools, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement, Pose, RelativePose
from pipeline.geometry.rotations import vector_from_rotation

# How many times larger the photos were that the ground points were clicked in.
CLICKED_AT = 5.0


@dataclass(frozen=True, slots=True)
class Depths:
    """The depths of a run by the published method, all its matches in the table's order.

    Args:
        pair_id: (n,) names.
        frame_id: (n,) names of ref.
        ref_px: (n, 2).
        src_px: (n, 2).
        depth: (n,) m.
        sigma: (n,) m.
        kept: (n,).
    """

    pair_id: AnyArray
    frame_id: AnyArray
    ref_px: Floats
    src_px: Floats
    depth: Floats
    sigma: Floats
    kept: Bools

    @classmethod
    def of(cls, run: Path) -> Depths:
        """What the stage `depth` wrote."""
        table = ds.dataset(run / "depths", format="parquet").to_table()
        table = table.filter(pc.equal(table.column("method"), "epitransfer"))
        return cls(
            column(table, "pair_id"),
            column(table, "frame_id"),
            columns(table, ("u", "v")),
            columns(table, ("src_u", "src_v")),
            np.asarray(column(table, "depth_m"), np.float64),
            np.asarray(column(table, "sigma_depth_m"), np.float64),
            np.asarray(column(table, "kept"), bool),
        )


def cameras(run: Path) -> dict[str, Camera]:
    """By frame, as refined."""
    known = cameras_of(read_table(run / "refined_cameras.parquet", "refined_cameras"))
    return camera_by_frame(read_table(run / "frames.parquet", "frames"), known)


def placed(run: Path) -> dict[str, Placement]:
    """Every frame as refined."""
    return placements_of(read_table(run / "poses.parquet", "poses"))


def measured_depths(folder: Path, frame_id: AnyArray, ref_px: Floats) -> Floats:
    """(n,) m from depth maps of 16 bit millimetres, 0 where none was measured; NaN there and at outlines."""
    out = np.full(len(ref_px), np.nan)
    for name in np.unique(frame_id):
        rows = np.flatnonzero(frame_id == name)
        stored = cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        if stored is not None:
            out[rows] = sampled(np.where(stored > 0, stored / 1000.0, np.nan), ref_px[rows])
    return out


def pose_errors(found: Sequence[RelativePose], exact: Sequence[RelativePose]) -> Floats:
    """(p, 3) of relative poses: turn (deg), direction of the baseline (deg), its length (share)."""
    return np.array([_pose_error(one, true) for one, true in zip(found, exact, strict=True)]).reshape(-1, 3)


def _pose_error(found: RelativePose, true: RelativePose) -> tuple[float, float, float]:
    turn = float(np.linalg.norm(vector_from_rotation(found.rotation @ true.rotation.T)))
    length, true_length = float(np.linalg.norm(found.centre)), float(np.linalg.norm(true.centre))
    across = float(np.linalg.norm(np.cross(found.centre, true.centre)))
    direction = float(np.arctan2(across, float(found.centre @ true.centre)))
    return float(np.degrees(turn)), float(np.degrees(direction)), abs(length / true_length - 1.0)


def unexplained(relative: Floats, sigma: Floats, share: float = 0.68) -> float:
    """The relative error of the truth that, added in quadrature to the sigmas (n,), makes them cover that share."""
    low, high = 0.0, 1.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        covered = float(np.mean(np.abs(relative) <= np.hypot(sigma, middle)))
        low, high = (middle, high) if covered < share else (low, middle)
    return high


def squares(found: Sequence[RelativePose], exact: Sequence[RelativePose]) -> Floats:
    """(p,) of the errors of relative poses in units of their covariances; 6 is to be expected."""
    out = []
    for one, true in zip(found, exact, strict=True):
        turn = vector_from_rotation(one.rotation.T @ true.rotation)
        error = np.concatenate([turn, one.centre - true.centre])
        out.append(float(error @ np.linalg.solve(one.covariance, error)))
    return np.array(out)


@dataclass(frozen=True, slots=True)
class GroundPoints:
    """Ground points clicked in photos.

    Args:
        point: (m,) number of the point of each click.
        frame_id: (m,) names.
        pixels: (m, 2) of the photos at hand.
        enu: (k, 3) m, of the list; off by one shift in all, for the heights are not tied to the photos'.
    """

    point: AnyArray
    frame_id: AnyArray
    pixels: Floats
    enu: Floats

    @classmethod
    def of(cls, file: Path, run: Path) -> GroundPoints:
        """From a list in ODM's form: a CRS, then x y z u v photo.

        Args:
            file: The list.
            run: A run of its photos, whose origin is used.
        """
        head, *lines = file.read_text(encoding="utf-8").splitlines()
        rows = [line.split() for line in lines if line.strip()]
        numbers = np.array([row[:5] for row in rows], np.float64)
        places, point = np.unique(numbers[:, :3], axis=0, return_inverse=True)
        to_degrees = Transformer.from_crs(CRS.from_user_input(head), "EPSG:4326", always_xy=True)
        longitude, latitude = to_degrees.transform(places[:, 0], places[:, 1])
        origin = LocalFrame(**facts(run, "ingest")["origin"])
        enu = origin.enu_from_geodetic(latitude, longitude, places[:, 2])
        # The list's pixels count from the corner of the first, 0.5 before its centre.
        pixels = numbers[:, 3:5] / CLICKED_AT - 0.5
        return cls(point.reshape(-1), np.array([Path(row[5]).stem for row in rows], object), pixels, enu)

    def off(self, poses: Mapping[str, Placement | Pose], lenses: Mapping[str, Camera], enu: Floats) -> Floats:
        """(m, 2) px by which points (k, 3) miss their clicks."""
        out = np.empty((len(self.point), 2))
        for i, (point, name) in enumerate(zip(self.point, self.frame_id, strict=True)):
            pose = poses[name]
            out[i] = lenses[name].project(((enu[point] - pose.centre) @ pose.rotation)[None])[0] - self.pixels[i]
        return out

    def figures(
        self, poses: Mapping[str, Placement | Pose], lenses: Mapping[str, Camera]
    ) -> tuple[float, float, float, Floats]:
        """How well poses fit the clicks.

        Returns:
            Root mean square (px) with the list shifted as a whole; of each point's clicks about their mean in that, so
            that the list's own errors leave no trace; with every point where the clicks themselves put it; and the
            shift (3,) m.
        """
        whole = least_squares(lambda t: self.off(poses, lenses, self.enu + t).ravel(), [0.0, 0.0, -60.0])
        off = whole.fun.reshape(-1, 2)
        about = off - np.stack([off[self.point == i].mean(axis=0) for i in range(len(self.enu))])[self.point]
        start = self.enu + whole.x
        free = least_squares(lambda x: self.off(poses, lenses, x.reshape(-1, 3)).ravel(), start.ravel())
        return _rms(off), _rms(about), _rms(free.fun.reshape(-1, 2)), whole.x


def _rms(off: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def agreement(found: Depths, rows: Bools) -> tuple[int, float, float]:
    """How depths of one ref pixel by different pairs agree.

    Args:
        found: The depths.
        rows: (n,) which of them.

    Returns:
        Pixels seen by several pairs, the median of their depths' spread (standard deviation over mean), and the median
        of the spread in units of what the sigmas promise to the depths one by one.
    """
    frame = pa.array(found.frame_id[rows]).dictionary_encode().indices.to_numpy()
    keys = np.column_stack([frame, found.ref_px[rows]])
    _, pixel = np.unique(keys, axis=0, return_inverse=True)
    pixel = pixel.reshape(-1)
    depth, sigma = found.depth[rows], found.sigma[rows]
    n = np.bincount(pixel)
    mean = np.bincount(pixel, depth) / n
    variance = np.bincount(pixel, (depth - mean[pixel]) ** 2) / np.maximum(n - 1, 1)
    promised = np.bincount(pixel, sigma**2) / n
    several = n > 1
    if not np.any(several):
        return 0, float("nan"), float("nan")
    spread = np.sqrt(variance[several])
    return (
        int(several.sum()),
        float(np.median(spread / mean[several])),
        float(np.median(spread / np.sqrt(promised[several]))),
    )
