"""Scores of all frames, shard by shard: pixels to files as they come, sums kept."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.engine.stage import Context
from pipeline.scoring.frame_scores import FrameScore, ScoringJob, score_frames
from pipeline.scoring.truth import FrameView
from schemas import SCORES

_FILES = ("pixels", "pixels_without_control")


def collect(context: Context, job: ScoringJob, views: Sequence[FrameView], folder: Path) -> list[list[FrameScore]]:
    """Scores the frames.

    Args:
        context: Lends the processes.
        job: What is the same for every frame.
        views: The frames.
        folder: Where `pixels.parquet` goes, and with a correction `pixels_without_control.parquet`.

    Returns:
        One score per frame; with a correction those with it, then those without.
    """
    names = _FILES if job.correction is not None else _FILES[:1]
    scores: list[list[FrameScore]] = [[] for _ in names]
    with ExitStack() as stack:
        writers = [stack.enter_context(_writer(folder / f"{name}.parquet")) for name in names]
        shards = context.map(partial(score_frames, job), views, shard=job.shard, label="frames", here=job.here)
        for parts in shards:
            for writer, so_far, part in zip(writers, scores, parts, strict=True):
                writer.write_table(_checked(part.pixels))
                so_far.extend(part.frames)
    return scores


def _writer(path: Path) -> pq.ParquetWriter:
    return pq.ParquetWriter(path, SCORES.arrow(), compression="zstd")


def _checked(table: pa.Table) -> pa.Table:
    SCORES.check(table)
    return table
