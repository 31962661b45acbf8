"""depth: sparse depth of every match by epipolar transfer, with sigma, masked with reasons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import Field

from pipeline.depthing import Limits, MatchedRays, MethodDepths, depths_by
from pipeline.engine.errors import NothingLeftError
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.engine.tables import dataset, parquet_files, read_table
from pipeline.flight import PairRow, camera_by_frame, cameras_of, column, columns, relative_poses_of, selected_pairs
from pipeline.geometry.arrays import AnyArray, Bools, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import RelativePose
from pipeline.geometry.transfer import VirtualView
from schemas import DEPTHS

Method = Literal["epitransfer", "dlt", "epitransfer-lateral", "epitransfer-vertical"]


class Config(StageConfig):
    """Methods and masks."""

    methods: tuple[Method, ...] = Field(
        ("epitransfer", "dlt"), min_length=1, description="Methods; the first is the one whose points are published"
    )
    virtual_view: Literal["adaptive", "lateral", "vertical"] = Field(
        "adaptive", description="Virtual view of epitransfer; adaptive follows each point by its covariance"
    )
    virtual_baseline_m: float = Field(1.0, gt=0.0, description="Distance of a lateral or vertical view from ref (m)")
    max_relative_sigma: float = Field(
        0.25, gt=0.0, le=1.0, description="Largest predicted sigma over depth of a kept depth (1)"
    )
    max_miss_sigmas: float = Field(
        4.0,
        gt=0.0,
        description="How far the two rays of a kept depth may miss each other, in sigmas of pose and pixels (1)",
    )
    max_range_m: float = Field(100.0, gt=0.0, description="Largest distance from the ref camera of a kept depth (m)")


@dataclass(frozen=True, slots=True)
class _Setting:
    config: Config
    pairs: Mapping[str, PairRow]
    cameras: Mapping[str, Camera]
    poses: Mapping[str, RelativePose]
    usual_miss_px: Mapping[str, float]


def run(config: Config, context: Context) -> str:
    """Computes the depths of all inliers, part by part; writes `depths`."""
    relative = context.read("relative_poses")
    setting = _Setting(
        config,
        {pair.pair_id: pair for pair in selected_pairs(context.read("pairs"))},
        camera_by_frame(context.read("frames"), cameras_of(context.read("refined_cameras"))),
        relative_poses_of(relative),
        dict(zip(column(relative, "pair_id"), np.nan_to_num(column(relative, "median_after_px")), strict=True)),
    )
    parts = parquet_files(context.path("matches"))
    context.map_tables("depths", partial(_part, setting), parts, shard=1, label="parts")
    return _summary(context.output("depths"), config)


def _part(setting: _Setting, files: Sequence[Path]) -> pa.Table:
    tables = []
    for file in files:
        matches = read_table(file, "matches")
        matches = matches.filter(matches.column("inlier"))
        ids = matches.column("pair_id").to_numpy(zero_copy_only=False)
        for pair_id in dict.fromkeys(ids):
            tables += _pair(setting, str(pair_id), matches.filter(ids == pair_id))
    return pa.concat_tables(tables).combine_chunks() if tables else DEPTHS.empty()


def _pair(setting: _Setting, pair_id: str, matches: pa.Table) -> list[pa.Table]:
    pair, config = setting.pairs[pair_id], setting.config
    ref_px, src_px = columns(matches, ("ref_u", "ref_v")), columns(matches, ("src_u", "src_v"))
    covariance = columns(matches, ("cov_uu", "cov_uv", "cov_vv"))
    rays = MatchedRays.of(ref_px, src_px, setting.cameras[pair.ref], setting.cameras[pair.src], covariance)
    usual_rad = setting.usual_miss_px[pair_id] / setting.cameras[pair.src].focal_px
    limits = Limits(config.max_relative_sigma, config.max_range_m, config.max_miss_sigmas, usual_rad)
    view = VirtualView(config.virtual_view)
    return [
        _table(
            pair,
            ref_px,
            src_px,
            method,
            depths_by(method, view, config.virtual_baseline_m, rays, setting.poses[pair_id], limits),
        )
        for method in config.methods
    ]


def _table(pair: PairRow, ref_px: Floats, src_px: Floats, method: str, found: MethodDepths) -> pa.Table:
    n = len(ref_px)
    normal = found.depths.normal.astype(np.float32)
    good = np.isfinite(found.depths.depth_m) & np.isfinite(found.depths.variance_m2) & np.isfinite(normal).all(axis=1)

    def known(values: AnyArray, where: Bools = good) -> pa.Array:
        return pa.array(values, mask=~where)

    return DEPTHS.from_columns(
        {
            "pair_id": [pair.pair_id] * n,
            "frame_id": [pair.ref] * n,
            "u": ref_px[:, 0],
            "v": ref_px[:, 1],
            "src_u": src_px[:, 0],
            "src_v": src_px[:, 1],
            "method": [method] * n,
            "depth_m": known(found.depths.depth_m),
            "sigma_depth_m": known(np.sqrt(found.depths.variance_m2)),
            "sigma_pixel_m": known(found.pixel_sigma_m),
            "parallax_deg": np.degrees(found.parallax_rad).astype(np.float32),
            "transfer_angle_deg": known(np.degrees(found.transfer_angle_rad).astype(np.float32)),
            "normal_x": known(normal[:, 0]),
            "normal_y": known(normal[:, 1]),
            "normal_z": known(normal[:, 2]),
            "kept": found.kept & good,
            "reason": found.reason,
        }
    )


def _summary(folder: Path, config: Config) -> str:
    table = dataset(folder).to_table(columns=["method", "kept", "reason"])
    first = table.filter(pc.equal(table.column("method"), config.methods[0]))
    kept = pc.sum(first.column("kept")).as_py() or 0
    if not kept:
        reasons = first.column("reason").value_counts().to_pylist()
        raise NothingLeftError(
            "E-DEPTH-01",
            "no depth may be published",
            found=f"{first.num_rows} matches: " + ", ".join(f"{r['counts']} {r['values']}" for r in reasons),
            expected=f"a predicted sigma within {config.max_relative_sigma:g} of the depth",
            hint="a longer baseline (pair.baseline_m) or better poses; --set depth.max_relative_sigma=0.5 shows more",
        )
    return f"{kept} of {first.num_rows} depths kept ({config.methods[0]}, {config.virtual_view} virtual view)"


STAGE = Stage(
    "depth",
    3,
    Config,
    ("frames", "refined_cameras", "pairs", "matches", "relative_poses"),
    ("depths",),
    run,
)
