"""Scores of all frames, shard by shard: pixels go to files as they come, sums are kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.engine.stage import Context
from pipeline.scoring.cloud import CloudSums
from pipeline.scoring.cloud_scores import CloudScore
from pipeline.scoring.control import Control
from pipeline.scoring.frame_scores import FrameScore, ScoringJob, ShardScores, score_frames
from pipeline.scoring.m3c2 import M3C2Sums
from pipeline.scoring.summary import metrics_object
from pipeline.scoring.truth import FrameView
from schemas import SCORES

_FILES = ("pixels", "pixels_without_control")


@dataclass(frozen=True, slots=True)
class Collected:
    """All scores against one placing of the truth.

    Args:
        methods: Names, the published one first.
        frames: One score per frame.
        clouds: One per shard; none where points are not scored.
    """

    methods: tuple[str, ...]
    frames: list[FrameScore] = field(default_factory=list)
    clouds: list[CloudScore] = field(default_factory=list)

    @property
    def n_scored(self) -> int:
        """Pixels with a reference."""
        return sum(score.sums.methods[0].n_scored for score in self.frames)

    def add(self, part: ShardScores) -> None:
        """Adds those of a shard."""
        self.frames.extend(part.frames)
        if part.cloud is not None:
            self.clouds.append(part.cloud)

    def metrics(self) -> dict[str, Any]:
        """`methods`, `calibration`, `map`, `cloud` and `m3c2_ep` of `metrics.json`; null for what is not there."""
        cloud = CloudSums.total(score.cloud for score in self.clouds)
        m3c2 = M3C2Sums.total(score.m3c2 for score in self.clouds if score.m3c2 is not None)
        return {
            **metrics_object(self.methods, self.frames),
            "cloud": None if cloud is None else cloud.metrics(),
            "m3c2_ep": None if m3c2 is None else m3c2.metrics(),
        }


def collect(context: Context, job: ScoringJob, views: Sequence[FrameView], folder: Path) -> list[Collected]:
    """Scores the frames.

    Args:
        context: Lends the processes.
        job: What is the same for every frame.
        views: The frames.
        folder: Where `pixels.parquet` goes, and with a correction `pixels_without_control.parquet`.

    Returns:
        The scores that stand first; with a correction these are the corrected ones, and those without it follow.
    """
    names = _FILES if job.correction is not None else _FILES[:1]
    found = [Collected(job.methods) for _ in names]
    with ExitStack() as stack:
        writers = [stack.enter_context(_writer(folder / f"{name}.parquet")) for name in names]
        shards = context.map(partial(score_frames, job), views, shard=job.shard, label="frames", here=job.here)
        for parts in shards:
            for writer, all_so_far, part in zip(writers, found, parts, strict=True):
                writer.write_table(_checked(part.pixels))
                all_so_far.add(part)
    return found


def all_metrics(found: Sequence[Collected], control: Control | None, truth: Mapping[str, Any]) -> dict[str, Any]:
    """The whole of `metrics.json`.

    Args:
        found: From `collect`.
        control: Where there are control points.
        truth: What is told of the truth.
    """
    with_it = found[0]
    counted = {"n_matches": sum(score.n_matches for score in with_it.frames), "n_with_reference": with_it.n_scored}
    out = {**with_it.metrics(), "truth": {**truth, **counted}, "control_points": None, "checkpoints": None}
    if control is None:
        return out
    without = {**found[1].metrics(), "checkpoints": control.checkpoints_without}
    return out | {
        "control_points": control.metrics, "checkpoints": control.checkpoints, "without_control": without
    }  # fmt: skip


def tell(context: Context, found: Collected) -> None:
    """Records what the figures rest on."""
    blind = [score.frame_id for score in found.frames if not score.n_visible]
    context.count_items(len(found.frames), 0)
    context.record("matches", sum(score.n_matches for score in found.frames))
    context.record("matches_with_reference", found.n_scored)
    context.record("frames_that_see_no_truth", blind)
    context.record(
        "calibration_sigma",
        "predicted sigma, the reference's spread and what the pose's sigma makes of it, in quadrature",
    )
    if blind:
        context.warn(f"{len(blind)} of {len(found.frames)} frames see nothing of the truth, {blind[0]} among them")


def _writer(path: Path) -> pq.ParquetWriter:
    return pq.ParquetWriter(path, SCORES.arrow(), compression="zstd")


def _checked(table: pa.Table) -> pa.Table:
    SCORES.check(table)
    return table
