"""refine: the relative pose of each pair and the absolute poses that the points are placed with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from pydantic import Field, model_validator

from pipeline.engine.progress import counted
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.engine.tables import parquet_files, read_table
from pipeline.flight import camera_by_frame, cameras_of, column, poses_of, selected_pairs
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.refinement.flight.control import Control
from pipeline.refinement.flight.flight import RefinedFlight, refine_flight, trusted_stars
from pipeline.refinement.flight.stars import Stars
from pipeline.refinement.logged import Log, as_logged, logged_frames
from pipeline.refinement.matched import Matched, by_pair
from pipeline.refinement.near import together
from pipeline.refinement.pair import refine_pair, surest_frames
from pipeline.refinement.rows import FLIGHT, PAIR, RefinedPair, cameras_table, covariances_table, pair_row, poses_table
from pipeline.refinement.surveyed import controls, doubts
from pipeline.refinement.telling import facts_of, sentence, warnings_of
from pipeline.sources.control_survey import ControlSurvey, survey
from pipeline.sources.files import is_url
from schemas import MATCHES, RELATIVE_POSES


class Config(StageConfig):
    """How the poses are refined."""

    mode: Literal["none", "pair", "flight"] = Field(
        "flight",
        description="flight refines all frames together, with what they get wrong alike; pair refines every pair by "
        "itself; none passes the log's poses and their covariance on",
    )
    calibrate: bool = Field(
        False,
        description="Whether flight also finds the focal length and two radial terms of each camera, as far as the "
        "images determine them",
    )
    control_points: str | None = Field(
        None,
        description="Surveyed points in the photos, OpenDroneMap's gcp_list.txt, that flight holds on to",
        json_schema_extra={"path": True},
    )
    control_height_datum: str | None = Field(
        None,
        description="What the control points' heights are measured from where their CRS does not say: ellipsoidal, "
        "egm96, egm2008, navd88 (in m), or the code of a vertical CRS, which carries its unit (EPSG:6360)",
    )
    control_sigma_m: float = Field(
        0.05, gt=0.0, description="One sigma of the control points' coordinates along each axis (m)"
    )

    @model_validator(mode="after")
    def _as_a_whole(self) -> Config:
        if self.calibrate and self.mode != FLIGHT:
            raise ValueError('calibrate needs mode = "flight": two frames do not determine a lens')
        if self.control_points is not None and self.mode != FLIGHT:
            raise ValueError('control_points need mode = "flight": they tie the flight as a whole to the ground')
        return self


@dataclass(frozen=True, slots=True)
class _Refiner:
    """What pairs are refined with; `flight` is there in that mode."""

    log: Log
    mode: str
    flight: RefinedFlight | None

    def pair(self, matched: Matched) -> RefinedPair:
        """One pair."""
        if self.flight is not None:
            return self.flight.pair(self.log, matched)
        return refine_pair(self.log, matched) if self.mode == PAIR else as_logged(self.log, matched)

    def part(self, files: Sequence[Path]) -> list[tuple[Matched, RefinedPair]]:
        """The pairs of some parts of `matches`; of the matches only their number is needed any more."""
        return [
            (matched.without_matches(), self.pair(matched)) for file in files for matched in _matched(self.log, file)
        ]


def run(config: Config, context: Context) -> str:
    """Refines the logged poses on the matches; writes poses, their covariances, relative poses and cameras."""
    given, cameras_given = context.read("frames"), context.read("cameras")
    log = _log(context, given, cameras_given)
    near = together(tuple(log.poses), list(log.pairs.values()))
    parts = parquet_files(context.path("matches"))
    flight = _flight(config, context, log, parts, near) if config.mode == FLIGHT else None
    refiner = _Refiner(log, config.mode, flight)
    found = {
        matched.pair.pair_id: (matched, refined)
        for some in context.map(refiner.part, parts, shard=1, label="parts")
        for matched, refined in some
    }
    for pair_id, pair in log.pairs.items():
        if pair_id not in found:
            # A pair without a single match has its row too.
            matched = Matched.of(pair, MATCHES.empty(), log.cameras)
            found[pair_id] = matched, refiner.pair(matched)
    pairs = [found[pair_id] for pair_id in log.pairs]
    context.write("relative_poses", RELATIVE_POSES.from_rows(pair_row(*one) for one in pairs))
    frames = logged_frames(log) if flight is None else flight.frames
    if config.mode == PAIR:
        frames = surest_frames(frames, pairs)
    errors = PoseErrors.of_log(log.poses, near) if flight is None else flight.errors
    context.write("poses", poses_table(frames))
    context.write("pose_covariances", covariances_table(errors, near))
    cameras = log.cameras if flight is None else flight.cameras
    context.write("refined_cameras", cameras_table(cameras_given, given, cameras))
    facts = facts_of([refined for _, refined in pairs], flight)
    for doubt in (*doubts(flight, log, config.control_sigma_m, str(config.control_points)), *warnings_of(facts)):
        context.warn(doubt)
    for name, value in facts.items():
        context.record(name, value)
    return sentence(counted(len(pairs), "pair"), config.mode, facts)


def _log(context: Context, frames: pa.Table, cameras_given: pa.Table) -> Log:
    cameras = camera_by_frame(frames, cameras_of(cameras_given))
    pairs = {pair.pair_id: pair for pair in selected_pairs(context.read("pairs"))}
    usable = frames.filter(frames.column("usable"))
    times = usable.column("time").cast(pa.int64())
    seconds = np.where(times.is_valid(), np.asarray(times.fill_null(0).to_numpy(), np.float64) * 1e-9, np.nan)
    return Log(poses_of(frames), cameras, pairs, dict(zip(column(usable, "frame_id"), seconds.tolist(), strict=True)))


def _flight(
    config: Config, context: Context, log: Log, parts: Sequence[Path], near: Sequence[tuple[str, str]]
) -> RefinedFlight:
    stars: list[Stars] = []
    set_aside: dict[str, str] = {}
    for some, reasons in context.map(partial(_stars, log), parts, shard=1, label="parts"):
        stars += some
        set_aside |= reasons
    control = _control(config, context, log)
    return replace(refine_flight(log, stars, near, calibrate=config.calibrate, control=control), set_aside=set_aside)


def _control(config: Config, context: Context, log: Log) -> list[Control]:
    if config.control_points is None:
        return []
    found = _survey(config, context.setting("ingest.geoid"), context.facts("ingest"))
    names = (column(context.read("frames"), name) for name in ("frame_id", "image"))
    control, left_out = controls(found, dict(zip(*names, strict=True)), log, config.control_sigma_m)
    context.record("control_heights", found.height_note)
    context.record("control_left_out", left_out)
    for named, why in list(left_out.items())[:1]:
        context.warn(f"control points: {counted(len(left_out), 'row')} left out, {named} among them: {why}")
    return control


def _survey(config: Config, geoid: Any, facts: Mapping[str, Any]) -> ControlSurvey:
    return survey(str(config.control_points), config.control_height_datum, facts, geoid, "refine")


def foresee(config: Config, setting: Callable[[str], Any], facts: Mapping[str, Any]) -> None:
    """Refuses control points that cannot be read or brought into the flight's frame."""
    if config.control_points is not None:
        _survey(config, setting("ingest.geoid"), facts)


def sources(config: Config) -> tuple[Path | str, ...]:
    """The control points, whose bytes are part of the stage's staleness key."""
    return () if (named := config.control_points) is None else (named if is_url(named) else Path(named),)


def _stars(log: Log, files: Sequence[Path]) -> tuple[list[Stars], dict[str, str]]:
    return trusted_stars(log, (matched for file in files for matched in _matched(log, file)))


def _matched(log: Log, file: Path) -> list[Matched]:
    matches = by_pair(read_table(file, "matches"))
    return [Matched.of(log.pairs[pair_id], some, log.cameras) for pair_id, some in matches]


STAGE = Stage(
    "refine",
    3,
    Config,
    ("frames", "cameras", "pairs", "matches"),
    ("relative_poses", "poses", "pose_covariances", "refined_cameras"),
    run,
    reads=("ingest.geoid",),
    facts_of=("ingest",),
    sources=sources,
    foresee=foresee,
)
