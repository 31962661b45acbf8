"""Scores of a shard of frames: the returns they see, reference depths at their matches' pixels, and the sums."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.engine.tables import dataset, explained
from pipeline.geometry.arrays import Floats
from pipeline.lidar.heightfield import HeightField, return_spacing_m
from pipeline.lidar.nearby import LocalTiles, returns_near
from pipeline.lidar.reference import Reference, reference_depth
from pipeline.lidar.spacing import surface_spacing_m
from pipeline.lidar.visibility import View, behind_columns, visible_returns
from pipeline.scoring.calibration import CalibrationSums, MapSums
from pipeline.scoring.depth_rows import AlignedDepths, align
from pipeline.scoring.metrics import MethodSums
from schemas import SCORES

_COLUMNS = ["pair_id", "frame_id", "u", "v", "method", "depth_m", "sigma_depth_m", "kept"]


@dataclass(frozen=True, slots=True)
class FrameView:
    """A frame to be scored.

    Args:
        frame_id: Its name.
        view: Its camera and pose.
        covariance: (6, 6) of that pose: turn (rad) and shift (m), ENU.
    """

    frame_id: str
    view: View
    covariance: Floats


@dataclass(frozen=True, slots=True)
class ScoringJob:
    """What is the same for every frame.

    Args:
        tiles: The LiDAR tiles and the way from their CRS.
        depths: Folder of the dataset `depths`.
        methods: Every method in it, the published one first.
        max_range_m: Largest Euclidean distance from the camera that is scored, m.
    """

    tiles: LocalTiles
    depths: Path
    methods: tuple[str, ...]
    max_range_m: float


@dataclass(frozen=True, slots=True)
class FrameScore:
    """One frame's sums.

    Args:
        frame_id: Its name.
        n_matches: Matches, with a reference or not.
        n_visible: Returns the frame sees.
        methods: One entry per method of the job.
        calibration: Of the published method, against its sigma, the reference's spread and what the pose does to it.
        calibration_alone: The same without what the frame's pose does to the reference.
        map: Of the published method.
    """

    frame_id: str
    n_matches: int
    n_visible: int
    methods: tuple[MethodSums, ...]
    calibration: CalibrationSums
    calibration_alone: CalibrationSums
    map: MapSums


@dataclass(frozen=True, slots=True)
class _Surroundings:
    """The returns near a shard's frames, how far apart they are, and what stands there, if they are from above."""

    returns: Floats
    spacing_m: float
    field: HeightField | None

    @staticmethod
    def of(returns: Floats, from_above: bool) -> _Surroundings:
        if not len(returns):
            return _Surroundings(returns, np.nan, None)
        if not from_above:
            return _Surroundings(returns, surface_spacing_m(returns), None)
        spacing = return_spacing_m(returns)
        return _Surroundings(returns, spacing, HeightField.of(returns, spacing))


def score_frames(job: ScoringJob, items: Sequence[FrameView]) -> tuple[pa.Table, list[FrameScore]]:
    """Scores some frames; memory grows with the returns near them, not with the flight.

    Args:
        job: What is the same for every frame.
        items: The frames.

    Returns:
        Rows of the table `pixels`, and one score per frame.

    Raises:
        InputError: A tile is damaged, or the rows of `depths` do not belong together.
        UndeterminedError: A height datum or the geoid between two is not known.
    """
    ids = pa.array([item.frame_id for item in items])
    with explained(job.depths, "depths"):
        depths = dataset(job.depths).to_table(columns=_COLUMNS, filter=pc.field("frame_id").isin(ids))
    rows = align(depths, job.methods)
    centres = np.array([item.view.centre_in_enu_m for item in items])
    near = _Surroundings.of(returns_near(job.tiles, centres, job.max_range_m), job.tiles.from_above)
    tables, scores = [], []
    for item in items:
        mine = rows.where(np.flatnonzero(rows.frame_id == item.frame_id))
        reference, seen = _reference(item.view, mine.pixels, near, job.max_range_m)
        has = np.flatnonzero(reference.valid)
        scored = mine.where(has)
        found = reference.where(has)
        by_pose = reference_sigma(item.view, scored.pixels, found, item.covariance)
        sums = _sums(item.view, scored, found, by_pose)
        scores.append(FrameScore(item.frame_id, len(mine.pixels), seen, *sums))
        tables.append(_table(scored, found, by_pose))
    return pa.concat_tables(tables).combine_chunks() if tables else SCORES.empty(), scores


def methods_of(depths: Path, published: str) -> tuple[str, ...]:
    """The methods in a dataset `depths`: the published one first where it is there, the others by name."""
    return tuple(sorted(_distinct(depths, "method"), key=lambda name: (name != published, name)))


def frames_in(depths: Path) -> set[str]:
    """The ref frames in a dataset `depths`."""
    return _distinct(depths, "frame_id")


def _distinct(depths: Path, column: str) -> set[str]:
    names: set[str] = set()
    with explained(depths, "depths"):
        for batch in dataset(depths).to_batches(columns=[column]):
            names.update(pc.unique(batch.column(column)).to_pylist())
    return names


def _reference(view: View, pixels: Floats, near: _Surroundings, max_range_m: float) -> tuple[Reference, int]:
    """Reference depths at pixels within range, and how many returns the frame sees."""
    if not len(near.returns) or not len(pixels):
        return Reference.none(len(pixels)), 0
    visible = visible_returns(view, near.returns, near.field, near.spacing_m, max_range_m)
    # The same feature is matched in several pairs: its reference is found once.
    distinct, back = np.unique(pixels, axis=0, return_inverse=True)
    rays, focal = view.camera.rays(distinct), view.camera.focal_px
    found = reference_depth(distinct, focal * rays[:, :2], visible, focal * view.camera.rays(visible.pixels)[:, :2])
    valid = found.valid & (found.depth_m * np.linalg.norm(rays, axis=1) <= max_range_m)
    if near.field is not None:
        # A pixel on a wall or pole with few returns takes its plane from what is seen behind: a column says so.
        points = view.centre_in_enu_m + (found.depth_m[:, None] * rays)[valid] @ view.rotation_enu_from_cam.T
        valid[valid] = ~behind_columns(view.centre_in_enu_m, points, near.field, max_range_m)
    return replace(found, valid=valid).where(back.ravel()), len(visible.depth_m)


def reference_sigma(view: View, pixels: Floats, reference: Reference, covariance: Floats) -> Floats:
    """What an error of the frame's pose does to the reference depths at its pixels.

    The local plane is N . p = 1 in the camera, and the depth on a ray v is s = 1 / (N . v). A shift e of the camera
    changes it by -s N . e, a turn t by s^2 t . (N x v).

    Args:
        view: The frame's camera and pose.
        pixels: (n, 2) px.
        reference: At these pixels.
        covariance: (6, 6) of turn (rad) and shift (m), ENU.

    Returns:
        (n,) one sigma, m.
    """
    v = view.camera.rays(pixels)
    level = reference.slope * view.camera.focal_px
    normal = np.column_stack([level, 1.0 / reference.depth_m - np.sum(level * v[:, :2], axis=1)])
    s = reference.depth_m[:, None]
    in_enu = view.rotation_enu_from_cam.T
    jacobian = np.concatenate([(s**2 * np.cross(normal, v)) @ in_enu, (-s * normal) @ in_enu], axis=1)
    out: Floats = np.sqrt(np.einsum("ni,ij,nj->n", jacobian, covariance, jacobian))
    return out


def _sums(
    view: View, scored: AlignedDepths, found: Reference, by_pose: Floats
) -> tuple[tuple[MethodSums, ...], CalibrationSums, CalibrationSums, MapSums]:
    reference = found.depth_m
    common = np.asarray(scored.kept.all(axis=1))
    methods = tuple(
        MethodSums.of(scored.depth_m[:, m], reference, scored.kept[:, m], common) for m in range(len(scored.methods))
    )
    kept = scored.kept[:, 0]
    rays = view.camera.rays(scored.pixels[kept]) @ view.rotation_enu_from_cam.T
    depth, reference = scored.depth_m[kept, 0], reference[kept]
    return (
        methods,
        CalibrationSums.of(depth, scored.sigma_m[kept, 0], reference, np.hypot(found.spread_m, by_pose)[kept]),
        CalibrationSums.of(depth, scored.sigma_m[kept, 0], reference, found.spread_m[kept]),
        MapSums.of(depth, reference, rays),
    )


def _table(scored: AlignedDepths, reference: Reference, by_pose: Floats) -> pa.Table:
    """One row per pixel and method, the methods of a pixel together."""
    n, count = len(by_pose), len(scored.methods)
    depth, sigma = scored.depth_m.ravel(), scored.sigma_m.ravel()
    return SCORES.from_columns(
        {
            "pair_id": np.repeat(scored.pair_id, count),
            "frame_id": np.repeat(scored.frame_id, count),
            "u": np.repeat(scored.pixels[:, 0], count),
            "v": np.repeat(scored.pixels[:, 1], count),
            "method": list(scored.methods) * n,
            "depth_m": pa.array(depth, mask=~np.isfinite(depth)),
            "sigma_depth_m": pa.array(sigma, mask=~np.isfinite(sigma)),
            "reference_m": np.repeat(reference.depth_m, count),
            "reference_spread_m": np.repeat(reference.spread_m, count).astype(np.float32),
            "reference_sigma_m": np.repeat(by_pose, count).astype(np.float32),
            "kept": scored.kept.ravel(),
        }
    )
