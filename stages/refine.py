"""refine: the relative pose of each pair and the absolute poses that the points are placed with."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from pipeline.engine.progress import counted
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.engine.tables import parquet_files, read_table
from pipeline.flight import camera_by_frame, cameras_of, poses_of, selected_pairs
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.geometry.poses import Placement
from pipeline.refinement.logged import Log, as_logged
from pipeline.refinement.matched import Matched, by_pair
from pipeline.refinement.near import together
from pipeline.refinement.rows import RefinedFrame, covariances_table, pair_row, poses_table
from schemas import MATCHES, RELATIVE_POSES


class Config(StageConfig):
    """How the poses are refined."""

    mode: Literal["none"] = Field("none", description="none passes the log's poses and their covariance on")


def run(config: Config, context: Context) -> str:
    """Refines the logged poses on the matches; writes `relative_poses`, `poses` and `pose_covariances`."""
    frames = context.read("frames")
    cameras = camera_by_frame(frames, cameras_of(context.read("cameras")))
    pairs = {pair.pair_id: pair for pair in selected_pairs(context.read("pairs"))}
    log = Log(poses_of(frames), cameras, pairs)
    parts = parquet_files(context.path("matches"))
    found: dict[str, dict[str, object]] = {}
    for some in context.map(partial(_logged, log), parts, shard=1, label="parts"):
        found.update(some)
    # A pair without a single match has its row too.
    none = MATCHES.empty()
    rows = [found.get(name) or _row(log, Matched.of(pair, none, cameras)) for name, pair in pairs.items()]
    context.write("relative_poses", RELATIVE_POSES.from_rows(rows))
    near = together(tuple(log.poses), list(pairs.values()))
    errors = PoseErrors.of_log(log.poses, near)
    context.write("poses", poses_table(_frames(log, errors)))
    context.write("pose_covariances", covariances_table(errors, near))
    residuals = {str(row["pair_id"]): row["median_before_px"] for row in rows}
    known = {pair_id: float(str(value)) for pair_id, value in residuals.items() if value is not None}
    if not known:
        return f"{counted(len(rows), 'pair')}, none with a match that agrees with its pose"
    middle, worst = float(np.median(list(known.values()))), max(known, key=lambda pair_id: known[pair_id])
    context.record("median_epipolar_residual_px", round(middle, 4))
    return (
        f"{counted(len(rows), 'pair')}, median epipolar residual under the logged poses {middle:.2f} px, "
        f"worst {known[worst]:.1f} px ({worst})"
    )


def _logged(log: Log, files: Sequence[Path]) -> dict[str, dict[str, object]]:
    out = {}
    for file in files:
        for pair_id, matches in by_pair(read_table(file, "matches")):
            out[pair_id] = _row(log, Matched.of(log.pairs[pair_id], matches, log.cameras))
    return out


def _row(log: Log, matched: Matched) -> dict[str, object]:
    return pair_row(matched.pair.pair_id, matched.n_matches, as_logged(log, matched))


def _frames(log: Log, errors: PoseErrors) -> dict[str, RefinedFrame]:
    return {
        name: RefinedFrame(Placement(pose.rotation, pose.centre), errors.between(name, name))
        for name, pose in log.poses.items()
    }


STAGE = Stage(
    "refine",
    3,
    Config,
    ("frames", "cameras", "pairs", "matches"),
    ("relative_poses", "poses", "pose_covariances"),
    run,
)
