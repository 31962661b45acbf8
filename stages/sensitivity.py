"""sensitivity: what errors of the logged pose do to the depths, with and without refinement."""

from __future__ import annotations

from itertools import chain, groupby
from operator import itemgetter
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
from pydantic import AfterValidator, Field

from pipeline.depthing import Limits
from pipeline.engine.errors import NothingLeftError
from pipeline.engine.progress import counted
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.engine.tables import write_table
from pipeline.flight import (
    camera_by_frame,
    cameras_of,
    column,
    placed_pairs_of,
    placements_of,
    poses_of,
    selected_pairs,
)
from pipeline.geometry.transfer import VirtualView
from pipeline.scoring.summary import to_json
from pipeline.sensitivity.curves import curve_rows, sentence, withstood
from pipeline.sensitivity.injected import ACROSS, ALONG, UP, Injection, injections
from pipeline.sensitivity.pair_errors import Ways
from pipeline.sensitivity.references import OWN, Reference, scored_elsewhere
from pipeline.sensitivity.takes import Take, takes_of
from pipeline.sensitivity.trial import Trial
from schemas import CURVES

_PAIRS_PER_SHARD = 2


def _symmetric(values: tuple[float, ...]) -> tuple[float, ...]:
    tried = sorted(set(values))
    if 0.0 not in tried or tried != sorted(-value for value in tried):
        raise ValueError("the errors have to be symmetric about 0, and 0 among them: [-1, 0, 1]")
    return tuple(tried)


_Errors = Annotated[tuple[float, ...], Field(min_length=3), AfterValidator(_symmetric)]
_TURNS_DEG = (-5.0, -2.0, -1.0, -0.5, -0.2, 0.0, 0.2, 0.5, 1.0, 2.0, 5.0)


class Config(StageConfig):
    """The errors that are tried."""

    translation_m: _Errors = Field(
        (-1.0, -0.5, -0.2, -0.1, 0.0, 0.1, 0.2, 0.5, 1.0),
        description="Errors of src's place along the baseline, level across it, and up; symmetric about 0 (m)",
    )
    yaw_deg: _Errors = Field(_TURNS_DEG, description="Errors of src's yaw; symmetric about 0 (deg)")
    pitch_deg: _Errors = Field(_TURNS_DEG, description="Errors of src's pitch; symmetric about 0 (deg)")
    roll_deg: _Errors = Field(_TURNS_DEG, description="Errors of src's roll; symmetric about 0 (deg)")
    max_pairs_per_take: int = Field(6, ge=1, description="Pairs of each take that are looked at, evenly chosen (1)")
    max_range_m: float | None = Field(
        None,
        gt=0.0,
        description="Distance from the ref camera at which a depth ends that is farther, or none; left out, "
        "depth.max_range_m (m)",
    )

    def values(self) -> dict[str, tuple[float, ...]]:
        """The errors by kind."""
        turns = {"yaw": self.yaw_deg, "pitch": self.pitch_deg, "roll": self.roll_deg}
        return {**dict.fromkeys((ALONG, ACROSS, UP), self.translation_m), **turns}


def run(config: Config, context: Context) -> str:
    """Tries errors on some pairs of each take; writes `sensitivity/curves.parquet` and `sensitivity.json`."""
    ways = _ways(config, context)
    reference = Reference.of(context.path("scores"), context.path("depths"), ways.methods[0])
    if reference.kind == OWN and scored_elsewhere(context.path("scores")):
        context.warn("score compared pixels that are not those of the matches (dense); the run is its own reference")
    takes = _takes(context, reference)
    chosen = [take.sampled(config.max_pairs_per_take) for take in takes]
    values = config.values()
    cases = injections(values)
    trial = _trial(context, reference, ways, cases)
    pairs = [pair for take in chosen for pair in take.pairs]
    found = chain.from_iterable(context.map(trial.part, pairs, shard=_PAIRS_PER_SHARD, label="pairs"))
    take_of = (take.name for take in chosen for _ in take.pairs)
    rows: list[dict[str, Any]] = []
    for name, some in groupby(zip(take_of, found, strict=True), key=itemgetter(0)):
        rows += curve_rows(name, [errors for _, errors in some], values, cases, ways.methods)
    if not any(row["n"] for row in rows):
        raise _nothing(reference, len(pairs))
    context.count_items(len(pairs), 0)
    context.record("reference", reference.kind)
    limits = withstood(rows, ways.methods[0], reference.kind)
    folder = context.output("sensitivity")
    write_table(folder / "curves.parquet", CURVES.from_rows(rows))
    told = {
        "reference": reference.kind,
        "method": ways.methods[0],
        "max_range_m": ways.max_range_m,
        "takes": [_told(take, len(some.pairs)) for take, some in zip(takes, chosen, strict=True)],
        "withstood": limits,
        "curves": rows,
    }
    (folder / "sensitivity.json").write_text(to_json(told), encoding="utf-8")
    return f"{sentence(ways.methods[0], limits)}; {counted(len(takes), 'take')}, beside {reference.kind}"


def _ways(config: Config, context: Context) -> Ways:
    relative, miss, range_m = (
        context.setting(f"depth.{name}") for name in ("max_relative_sigma", "max_miss_sigmas", "max_range_m")
    )
    return Ways(
        tuple(context.setting("depth.methods")),
        VirtualView(context.setting("depth.virtual_view")),
        context.setting("depth.virtual_baseline_m"),
        Limits(relative, range_m, miss),
        config.max_range_m or range_m,
    )


def _takes(context: Context, reference: Reference) -> tuple[Take, ...]:
    """The takes of the pairs that have matches with a reference."""
    frames, with_reference = context.read("frames"), reference.pairs()
    pairs = [pair for pair in selected_pairs(context.read("pairs")) if pair.pair_id in with_reference]
    usable = frames.filter(frames.column("usable"))
    time = usable.column("time").cast(pa.int64()).to_pylist()
    time_s = {
        name: np.nan if ns is None else ns * 1e-9 for name, ns in zip(column(usable, "frame_id"), time, strict=True)
    }
    if not pairs:
        raise _nothing(reference, 0)
    return takes_of(placements_of(context.read("poses")), time_s, pairs)


def _trial(context: Context, reference: Reference, ways: Ways, cases: tuple[Injection, ...]) -> Trial:
    frames = context.read("frames")
    return Trial(
        context.path("matches"),
        reference,
        poses_of(frames),
        camera_by_frame(frames, cameras_of(context.read("refined_cameras"))),
        placed_pairs_of(context.read("relative_poses")),
        ways,
        cases,
    )


def _told(take: Take, n_tried: int) -> dict[str, Any]:
    return {
        "take": take.name,
        "first_frame_id": take.frames[0],
        "last_frame_id": take.frames[-1],
        "n_frames": len(take.frames),
        "heading_deg": take.heading_deg,
        "n_pairs": len(take.pairs),
        "n_pairs_tried": n_tried,
    }


def _nothing(reference: Reference, pairs: int) -> NothingLeftError:
    return NothingLeftError(
        "E-SENS-01",
        "no depth to inject errors into",
        where=str(reference.place),
        found=f"{counted(pairs, 'pair')} with a reference, and none of its pixels is kept",
        expected=f"depths that are kept, beside {reference.kind}",
        hint="see what depth masked",
    )


STAGE = Stage(
    "sensitivity",
    1,
    Config,
    ("frames", "refined_cameras", "pairs", "matches", "relative_poses", "poses", "depths", "scores"),
    ("sensitivity",),
    run,
    reads=(
        "depth.methods",
        "depth.virtual_view",
        "depth.virtual_baseline_m",
        "depth.max_relative_sigma",
        "depth.max_miss_sigmas",
        "depth.max_range_m",
    ),
)
