"""Scores of a shard of frames: what they see of the truth, depths at the same pixels, and the sums."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from pipeline.geometry.arrays import Bools, Floats, Singles
from pipeline.monodepth.sampling import sampled
from pipeline.scoring.cloud_scores import CloudJob, CloudScore, score_cloud
from pipeline.scoring.depth_rows import AlignedDepths
from pipeline.scoring.frame_sums import FrameSums, Scored
from pipeline.scoring.lines import Lines, NearLines
from pipeline.scoring.point_rows import NearPoints
from pipeline.scoring.truth import FrameTruth, FrameView, NearTruth, SurveyNear, SurveySeen, Truth
from schemas import SCORES


@dataclass(frozen=True, slots=True)
class Correction:
    """The one constant translation that control points ask for, and what they must not be scored on.

    Args:
        translation_m: (3,) by which the truth is shifted, ENU.
        covariance: (3, 3) of it, m^2.
        excluded: From pixels (n, 2) and frame_id to whether they lie on a control point.
    """

    translation_m: Floats
    covariance: Floats
    excluded: Callable[[Floats, str], Bools]


@dataclass(frozen=True, slots=True)
class Baselines:
    """Methods that look at one image alone.

    Args:
        names: Of the methods.
        images: Where the frames' images lie.
        depth_maps: From an image's location to depths (h, w) along the optical axis, m, by name.
        device: What their networks run on.
    """

    names: tuple[str, ...]
    images: Mapping[str, str]
    depth_maps: Callable[[str], Mapping[str, Singles]]
    device: str = "cpu"

    def maps(self, frame_id: str) -> Mapping[str, Singles]:
        """What they say of a frame's image."""
        return self.depth_maps(self.images[frame_id])


@dataclass(frozen=True, slots=True)
class ScoringJob:
    """What is the same for every frame.

    Args:
        truth: What depths are held against.
        lines: The depths.
        max_range_m: Largest Euclidean distance from the camera that is scored, m.
        baselines: Further methods.
        correction: Where there are control points.
        cloud: Where fused points are held against returns.
        shard: Frames that are scored together.
        here: Whether a device does the work, and not the cores.
    """

    truth: Truth
    lines: Lines
    max_range_m: float
    baselines: Baselines | None = None
    correction: Correction | None = None
    cloud: CloudJob | None = None
    shard: int = 8
    here: bool = False

    @property
    def methods(self) -> tuple[str, ...]:
        """Every method, the published one first."""
        return self.lines.methods + (self.baselines.names if self.baselines else ())


@dataclass(frozen=True, slots=True)
class FrameScore:
    """One frame's scores.

    Args:
        frame_id: Its name.
        n_matches: Pixels, with a reference or not.
        n_visible: Places of the truth that the frame sees.
        sums: Of the pixels with a reference.
    """

    frame_id: str
    n_matches: int
    n_visible: int
    sums: FrameSums


@dataclass(frozen=True, slots=True)
class ShardScores:
    """Scores of some frames against one placing of the truth.

    Args:
        pixels: Rows of the table `pixels`.
        frames: One score per frame.
        cloud: Of the fused points, where they are scored.
    """

    pixels: pa.Table
    frames: list[FrameScore]
    cloud: CloudScore | None = None


def score_frames(job: ScoringJob, items: Sequence[FrameView]) -> list[ShardScores]:
    """Scores some frames; memory grows with the truth near them, not with the flight.

    Args:
        job: What is the same for every frame.
        items: The frames.

    Returns:
        The scores that stand first; with a correction these are the corrected ones, and those without it follow. Both
        leave out what lies on control points.

    Raises:
        InputError: The truth is damaged, an image cannot be read, or the rows of `depths` do not belong together.
        UndeterminedError: A height datum or the geoid between two is not known.
    """
    near, correction = job.truth.near(items), job.correction
    # A network's look at an image is by far the dearest, and the same against every placing of the truth.
    maps = {item.frame_id: job.baselines.maps(item.frame_id) for item in items} if job.baselines else {}
    held = _Held(job.lines.near(items), job.cloud.near(items) if job.cloud else None, maps)
    if correction is None:
        return [_against(job, near, held, items)]
    corrected = [_corrected(item, correction) for item in items]
    moved = near.moved(correction.translation_m)
    return [_against(job, moved, held, corrected, correction.covariance), _against(job, near, held, items)]


@dataclass(frozen=True, slots=True)
class _Held:
    """What is scored of some frames."""

    lines: NearLines
    points: NearPoints | None
    maps: Mapping[str, Mapping[str, Singles]]


def _against(
    job: ScoringJob,
    near: NearTruth,
    held: _Held,
    items: Sequence[FrameView],
    shift_covariance: Floats | None = None,
) -> ShardScores:
    tables, scores, saw = [], [], []
    for item in items:
        seen = near.seen_by(item)
        mine = held.lines.of(item, seen)
        scored = _scored(job, item, seen, mine, held.maps.get(item.frame_id, {}))
        sums = FrameSums.of(scored, job.max_range_m)
        scores.append(FrameScore(item.frame_id, len(mine.pixels), len(seen.depth_m), sums))
        tables.append(_table(scored))
        saw.append(seen)
    cloud = None
    if job.cloud is not None and held.points is not None and isinstance(near, SurveyNear):
        returns = [seen for seen in saw if isinstance(seen, SurveySeen)]
        cloud = score_cloud(job.cloud, held.points, near, items, returns, shift_covariance)
    return ShardScores(pa.concat_tables(tables).combine_chunks() if tables else SCORES.empty(), scores, cloud)


def _corrected(item: FrameView, correction: Correction) -> FrameView:
    """The frame with the error that its place has once the truth is shifted: that of the shift.

    What all frames' places have in common is gone with it, and it is by far the larger part.
    """
    covariance = np.zeros((6, 6))
    covariance[:3, :3], covariance[3:, 3:] = item.covariance[:3, :3], correction.covariance
    return replace(item, covariance=covariance)


def _scored(
    job: ScoringJob, item: FrameView, seen: FrameTruth, mine: AlignedDepths, maps: Mapping[str, Singles]
) -> Scored:
    """The pixels that have a reference, with every method."""
    reference = seen.reference_at(mine.pixels)
    valid = reference.valid
    if job.correction is not None:
        valid = valid & ~job.correction.excluded(mine.pixels, item.frame_id)
    has = np.flatnonzero(valid)
    lines, found = mine.where(has), reference.where(has)
    by_pose = seen.pose_sigma(lines.pixels, found)
    if job.baselines is not None:
        names = job.baselines.names
        lines = lines.with_methods(names, np.stack([sampled(maps[name], lines.pixels) for name in names], axis=1))
    camera = item.view.camera
    rays: Floats = camera.rays(lines.pixels) @ item.view.rotation_enu_from_cam.T
    return Scored(lines, found, by_pose, rays, (camera.width, camera.height))


def _table(scored: Scored) -> pa.Table:
    """One row per pixel and method, the methods of a pixel together."""
    lines, reference = scored.lines, scored.reference
    n, count = len(lines.pixels), len(lines.methods)
    depth, sigma = lines.depth_m.ravel(), lines.sigma_m.ravel()
    return SCORES.from_columns(
        {
            "pair_id": np.repeat(lines.pair_id, count),
            "frame_id": np.repeat(lines.frame_id, count),
            "u": np.repeat(lines.pixels[:, 0], count),
            "v": np.repeat(lines.pixels[:, 1], count),
            "method": list(lines.methods) * n,
            "depth_m": pa.array(depth, mask=~np.isfinite(depth)),
            "sigma_depth_m": pa.array(sigma, mask=~np.isfinite(sigma)),
            "parallax_deg": np.repeat(lines.parallax_deg, count).astype(np.float32),
            "reference_m": np.repeat(reference.depth_m, count),
            "reference_spread_m": np.repeat(reference.spread_m, count).astype(np.float32),
            "reference_sigma_m": np.repeat(scored.pose_sigma_m, count).astype(np.float32),
            "kept": lines.kept.ravel(),
        }
    )
