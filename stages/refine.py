"""refine: the relative pose of each pair and the absolute poses that the points are placed with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
import pyarrow as pa
from pydantic import Field

from pipeline.engine.progress import counted
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.engine.tables import parquet_files, read_table
from pipeline.flight import PairRow, camera_by_frame, cameras_of, columns, poses_of, relative_pose_row, selected_pairs
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Pose, relative_pose
from pipeline.matching.verify import epipolar_residuals
from schemas import MATCHES, POSES, RELATIVE_POSES


class Config(StageConfig):
    """How the poses are refined."""

    mode: Literal["none"] = Field("none", description="none passes the log's poses and their covariance on")


def run(config: Config, context: Context) -> str:
    """Passes the logged poses on and measures what the matches say of them; writes `relative_poses` and `poses`."""
    frames = context.read("frames")
    cameras = camera_by_frame(frames, cameras_of(context.read("cameras")))
    poses = poses_of(frames)
    pairs = {pair.pair_id: pair for pair in selected_pairs(context.read("pairs"))}
    found: dict[str, dict[str, object]] = {}
    for file in parquet_files(context.path("matches")):
        for pair_id, matches in by_pair(read_table(file, "matches")).items():
            found[pair_id] = _row(pairs[pair_id], matches, poses, cameras, config.mode)
    # A pair without a single match has its row too.
    none = MATCHES.empty()
    rows = [found.get(pair_id) or _row(pair, none, poses, cameras, config.mode) for pair_id, pair in pairs.items()]
    context.write("relative_poses", RELATIVE_POSES.from_rows(rows))
    usable = frames.filter(frames.column("usable"))
    context.write("poses", POSES.from_columns({name: usable.column(name) for name in POSES.arrow().names}))
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


def by_pair(matches: pa.Table) -> dict[str, pa.Table]:
    """The rows of each pair, in the table's order."""
    out: dict[str, pa.Table] = {}
    if not matches.num_rows:
        return out
    ids = matches.column("pair_id").combine_chunks().dictionary_encode()
    codes = ids.indices.to_numpy()
    ends = np.flatnonzero(np.diff(codes, append=-1)) + 1
    for start, end in zip(np.concatenate([[0], ends[:-1]]), ends, strict=True):
        out[ids.dictionary[int(codes[start])].as_py()] = matches.slice(start, end - start)
    return out


def _row(
    pair: PairRow,
    matches: pa.Table,
    poses: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    mode: str,
) -> dict[str, object]:
    pose = relative_pose(poses[pair.ref], poses[pair.src])
    kept = matches.filter(matches.column("inlier"))
    residual: Floats = np.empty(0)
    if kept.num_rows:
        focal = cameras[pair.ref].focal_px
        ref = cameras[pair.ref].rays(columns(kept, ("ref_u", "ref_v")))
        src = cameras[pair.src].rays(columns(kept, ("src_u", "src_v")))
        noise = cameras[pair.src].plane_covariance(src, columns(kept, ("cov_uu", "cov_uv", "cov_vv")))
        residual = np.abs(epipolar_residuals(ref, src @ pose.rotation, pose, noise).angle_rad) * focal
    rms = float(np.sqrt(np.mean(residual**2))) if residual.size else None
    return {
        **relative_pose_row(pair.pair_id, pose),
        "n_matches": matches.num_rows,
        "n_inliers": kept.num_rows,
        "rms_before_px": rms,
        "median_before_px": float(np.median(residual)) if residual.size else None,
        "rms_after_px": rms,
        "mode": mode,
        "problem": "" if kept.num_rows else "no match agrees with the logged pose",
    }


STAGE = Stage(
    "refine",
    2,
    Config,
    ("frames", "cameras", "pairs", "matches"),
    ("relative_poses", "poses"),
    run,
)
