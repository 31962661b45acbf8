"""Scores of a shard of frames: what they see of the truth, depths at the same pixels, and the sums."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from pipeline.geometry.arrays import Floats
from pipeline.scoring.depth_rows import AlignedDepths
from pipeline.scoring.frame_sums import FrameSums, Scored
from pipeline.scoring.lines import Lines
from pipeline.scoring.truth import FrameTruth, FrameView, Truth
from schemas import SCORES


@dataclass(frozen=True, slots=True)
class ScoringJob:
    """What is the same for every frame.

    Args:
        truth: What depths are held against.
        lines: The depths.
    """

    truth: Truth
    lines: Lines


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


def score_frames(job: ScoringJob, items: Sequence[FrameView]) -> tuple[pa.Table, list[FrameScore]]:
    """Scores some frames; memory grows with the truth near them, not with the flight.

    Args:
        job: What is the same for every frame.
        items: The frames.

    Returns:
        Rows of the table `pixels`, and one score per frame.

    Raises:
        InputError: The truth is damaged, or the rows of `depths` do not belong together.
        UndeterminedError: A height datum or the geoid between two is not known.
    """
    lines, near = job.lines.near(items), job.truth.near(items)
    tables, scores = [], []
    for item in items:
        seen = near.seen_by(item)
        mine = lines.of(item, seen)
        scored = _scored(item, seen, mine)
        scores.append(FrameScore(item.frame_id, len(mine.pixels), len(seen.depth_m), FrameSums.of(scored)))
        tables.append(_table(scored))
    return pa.concat_tables(tables).combine_chunks() if tables else SCORES.empty(), scores


def _scored(item: FrameView, seen: FrameTruth, mine: AlignedDepths) -> Scored:
    """The pixels that have a reference."""
    reference = seen.reference_at(mine.pixels)
    has = np.flatnonzero(reference.valid)
    lines, found = mine.where(has), reference.where(has)
    camera = item.view.camera
    rays: Floats = camera.rays(lines.pixels) @ item.view.rotation_enu_from_cam.T
    by_pose = seen.pose_sigma(lines.pixels, found)
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
