"""pair: which two frames can give depth, and why the others cannot."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import Field, model_validator

from pipeline.engine.errors import NothingLeftError
from pipeline.engine.progress import counted
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.flight import cameras_of, column, poses_of
from pipeline.pairing.select import Candidates, Frames, PairRules, select_pairs
from schemas import PAIRS

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
# Height above ground taken where the log does not say it: what mapping flights most often fly at.
ASSUMED_ABOVE_GROUND_M = 50.0


class Config(StageConfig):
    """Limits a pair has to keep."""

    baseline_m: tuple[float, float] = Field((2.0, 20.0), description="Shortest and longest baseline (m)")
    max_view_angle_deg: float = Field(45.0, gt=0.0, le=90.0, description="Largest angle between the optical axes (deg)")
    min_overlap: float = Field(0.4, ge=0.0, le=1.0, description="Least share of ref's ground that src sees (1)")
    roi: Literal["ground", "image"] | tuple[Fraction, Fraction, Fraction, Fraction] = Field(
        "ground",
        description="Part of the ref image that must be free of the epipole: the ground within max_range_m, the whole "
        "image, or left, top, right, bottom as fractions of it",
    )
    epipole_margin_px: float = Field(50.0, description="Least distance of the epipole from that part (px)")
    above_ground_m: Literal["auto"] | float = Field(
        "auto", description="Height above the ground (m); auto takes the log's height above take-off"
    )
    max_range_m: float = Field(100.0, gt=0.0, description="Farthest ground that counts for overlap and roi (m)")

    @model_validator(mode="after")
    def _ordered(self) -> Config:
        if not 0.0 < self.baseline_m[0] < self.baseline_m[1]:
            raise ValueError("baseline_m needs 0 < shortest < longest")
        return self


def run(config: Config, context: Context) -> str:
    """Judges all candidate pairs and writes `pairs`."""
    frames = context.read("frames")
    usable = frames.filter(frames.column("usable"))
    usable = usable.take(pc.sort_indices(usable, sort_keys=[("time", "ascending"), ("frame_id", "ascending")]))
    flight = _flight(usable, context, config)
    rules = PairRules(
        config.baseline_m,
        float(np.radians(config.max_view_angle_deg)),
        config.min_overlap,
        config.epipole_margin_px,
        config.roi,
        config.max_range_m,
    )
    ids = column(usable, "frame_id")
    parts = [_table(block, ids) for block in select_pairs(flight, rules)]
    table = pa.concat_tables(parts).combine_chunks() if parts else PAIRS.empty()
    selected = pc.sum(table.column("selected")).as_py() or 0
    if not selected:
        raise _nothing(table, usable.num_rows, config)
    context.write("pairs", table)
    return (
        f"{counted(selected, 'pair')} of {counted(usable.num_rows, 'frame')} "
        f"({table.num_rows - selected} more candidates rejected, with reasons)"
    )


def _flight(usable: pa.Table, context: Context, config: Config) -> Frames:
    cameras = cameras_of(context.read("cameras"))
    names = list(cameras)
    poses = list(poses_of(usable).values())
    above = column(usable, "above_takeoff_m").astype(np.float64)
    if config.above_ground_m != "auto":
        above = np.full(len(poses), float(config.above_ground_m))
    unknown = ~(above > 0.0)
    if unknown.any():
        context.record("assumed_above_ground_m", ASSUMED_ABOVE_GROUND_M)
        context.warn(
            f"{unknown.sum()} frames do not say their height above the ground; {ASSUMED_ABOVE_GROUND_M:g} m is assumed "
            "to choose pairs (state it: --set pair.above_ground_m=...)"
        )
    return Frames(
        np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3),
        np.array([pose.centre for pose in poses]).reshape(-1, 3),
        np.where(unknown, ASSUMED_ABOVE_GROUND_M, above),
        np.array([names.index(name) for name in usable.column("camera_id").to_pylist()], np.int64),
        tuple(cameras.values()),
    )


def _table(found: Candidates, ids: Any) -> pa.Table:
    finite = np.isfinite(found.epipole_px).all(axis=1)
    ref, src = ids[found.ref], ids[found.src]
    return PAIRS.from_columns(
        {
            "pair_id": [f"{a}~{b}" for a, b in zip(ref, src, strict=True)],
            "ref_frame_id": ref,
            "src_frame_id": src,
            "baseline_m": found.baseline_m,
            "epipole_u": pa.array(found.epipole_px[:, 0], mask=~finite),
            "epipole_v": pa.array(found.epipole_px[:, 1], mask=~finite),
            "epipole_margin_px": pa.array(found.margin_px, mask=np.isnan(found.margin_px)),
            "view_angle_deg": np.degrees(found.view_angle_rad),
            "overlap": pa.array(found.overlap, mask=np.isnan(found.overlap)),
            "selected": found.reason == "",
            "reason": found.reason,
        }
    )


def _nothing(table: pa.Table, n_frames: int, config: Config) -> NothingLeftError:
    rules = [reason.split(" ")[0] for reason in table.column("reason").to_pylist()]
    rejected = ", ".join(f"{rules.count(rule)} by {rule}" for rule in sorted(set(rules)))
    baseline = f"{config.baseline_m[0]:g} .. {config.baseline_m[1]:g} m"
    return NothingLeftError(
        "E-PAIR-01",
        "no pair of frames can give depth",
        found=f"{counted(n_frames, 'usable frame')}; near the limits {table.num_rows} candidates rejected"
        + (f": {rejected}" if rejected else ""),
        expected=f"two frames {baseline} apart that see the same ground, epipole outside the region of interest",
        hint="a single photo has no baseline; why others are not usable stands in frames.problem, and `inspect` tells"
        if n_frames < 2
        else "a hover has no baseline; otherwise see --set pair.baseline_m='[1, 40]', pair.roi, pair.epipole_margin_px",
    )


STAGE = Stage("pair", 1, Config, ("frames", "cameras"), ("pairs",), run)
