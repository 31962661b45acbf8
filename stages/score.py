"""score: the depths of every method beside LiDAR, on the same pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field

from pipeline.engine.errors import NothingLeftError
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.flight import camera_by_frame, cameras_of, covariances_of, placements_of
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.local_world import EARTH, LOCAL_WORLD
from pipeline.lidar.nearby import LocalTiles
from pipeline.lidar.tiles import expand, read_local_tile, read_tile
from pipeline.lidar.visibility import View
from pipeline.scoring.frame_scores import FrameScore, ScoringJob, score_frames
from pipeline.scoring.lines import SparseLines, frames_in, methods_of
from pipeline.scoring.refusals import apart, check_datums, no_reference, nothing_to_score_against
from pipeline.scoring.summary import metrics_object, sentence, to_json
from pipeline.scoring.truth import FrameView, Survey
from schemas import SCORES

_FRAMES_PER_SHARD = 8


class Config(StageConfig):
    """The truth and how far it is believed."""

    lidar: str | tuple[str, ...] | None = Field(
        None,
        description="LAS, LAZ or COPC tiles: a file, a folder, a glob, or a list of these; left out, the run's own "
        "LiDAR sweeps",
        json_schema_extra={"path": True},
    )
    lidar_height_datum: str | None = Field(
        None,
        description="What the heights are measured from in tiles whose CRS does not say: ellipsoidal, egm96, egm2008, "
        "navd88 (in m), or the code of a vertical CRS, which carries its unit (EPSG:6360)",
    )
    max_range_m: float = Field(100.0, gt=0.0, description="Largest distance from the camera that is scored (m)")
    correspondence: Literal["sparse"] = Field("sparse", description="Pixels compared: sparse, those of the matches")


def run(config: Config, context: Context) -> str:
    """Scores `depths` against the tiles; writes `scores/metrics.json` and `scores/pixels.parquet`."""
    depths, folder = context.path("depths"), context.output("scores")
    tiles = _tiles(config, context)
    context.record("lidar", "the run's own sweeps" if config.lidar is None else "tiles named")
    views = _views(context, frames_in(depths))
    if not views:
        raise NothingLeftError("E-SCORE-05", "no depth to score", where=str(depths), hint="see what depth masked")
    centres = np.array([item.view.centre_in_enu_m for item in views])
    meeting = tiles.meeting(centres, config.max_range_m)
    if not meeting:
        raise apart(tiles, centres, config.max_range_m)
    lines = SparseLines(depths, methods_of(depths, context.setting("depth.methods")[0]))
    job = ScoringJob(Survey(replace(tiles, tiles=meeting), config.max_range_m), lines)
    scores: list[FrameScore] = []
    with pq.ParquetWriter(folder / "pixels.parquet", SCORES.arrow(), compression="zstd") as writer:
        shards = context.map(partial(score_frames, job), views, shard=_FRAMES_PER_SHARD, label="frames")
        for table, part in shards:
            writer.write_table(_checked(table))
            scores += part
    metrics = metrics_object(lines.methods, scores)
    _tell(context, scores, tiles, meeting)
    if not any(score.sums.methods[0].n_scored for score in scores):
        raise no_reference(
            sum(score.n_matches for score in scores),
            sum(score.n_visible for score in scores),
            tiles,
            config.max_range_m,
        )
    (folder / "metrics.json").write_text(to_json(metrics), encoding="utf-8")
    return sentence(metrics)


def _checked(table: pa.Table) -> pa.Table:
    SCORES.check(table)
    return table


def _tiles(config: Config, context: Context) -> LocalTiles:
    """The tiles' headers, and the frame they are brought into."""
    facts = context.facts("ingest")
    if config.lidar is None:
        return LocalTiles(tuple(map(read_local_tile, _sweeps(context.path("sweeps")))))
    if _is_local(facts):
        return LocalTiles(tuple(map(read_local_tile, expand(config.lidar))))
    frames = context.read("frames")
    datums = sorted(set(frames.filter(frames.column("usable")).column("height_datum").to_pylist()))
    check_datums(datums)
    origin = facts["origin"]
    frame = LocalFrame(origin["latitude_deg"], origin["longitude_deg"], origin["height_m"])
    tiles = tuple(read_tile(path, config.lidar_height_datum) for path in expand(config.lidar))
    return LocalTiles(tiles, frame, context.setting("ingest.geoid"), datums[0])


def foresee(config: Config, setting: Callable[[str], Any], facts: Mapping[str, Any]) -> None:
    """Refuses heights that cannot meet LiDAR's, tiles that cannot be read or placed, and having no reference at all."""
    del setting
    if config.lidar is None:
        if not facts.get("sweep_points"):
            raise nothing_to_score_against()
        return
    if not _is_local(facts):
        check_datums([facts["height_datum"]])
    for path in expand(config.lidar):
        read_local_tile(path) if _is_local(facts) else read_tile(path, config.lidar_height_datum)


def _is_local(facts: Mapping[str, Any]) -> bool:
    return bool(facts.get("world", EARTH) == LOCAL_WORLD)


def _sweeps(folder: Path) -> tuple[Path, ...]:
    """The tiles of the run's own sweeps, which are in the run's frame."""
    tiles = tuple(sorted(folder.rglob("*.laz")))
    if not tiles:
        raise nothing_to_score_against()
    return tiles


def _views(context: Context, wanted: set[str]) -> list[FrameView]:
    """The frames that have depths, in the order of `poses`."""
    cameras = camera_by_frame(context.read("frames"), cameras_of(context.read("refined_cameras")))
    poses = context.read("poses")
    covariances = covariances_of(poses)
    return [
        FrameView(frame_id, View(cameras[frame_id], pose.centre, pose.rotation), covariances[frame_id])
        for frame_id, pose in placements_of(poses).items()
        if frame_id in wanted
    ]


def _tell(context: Context, scores: Sequence[FrameScore], tiles: LocalTiles, meeting: Sequence[object]) -> None:
    """Records what the figures rest on."""
    blind = [score.frame_id for score in scores if not score.n_visible]
    context.count_items(len(scores), 0)
    context.record("lidar_tiles", {"given": len(tiles.tiles), "used": len(meeting)})
    context.record("lidar_heights", sorted({tiles.transform(tile).height_note for tile in tiles.tiles}))
    context.record("matches", sum(score.n_matches for score in scores))
    context.record("matches_with_reference", sum(score.sums.methods[0].n_scored for score in scores))
    context.record("frames_that_see_no_lidar", blind)
    context.record(
        "calibration_sigma",
        "predicted sigma, the reference's spread and what the pose's sigma makes of it, in quadrature",
    )
    if blind:
        context.warn(f"{len(blind)} of {len(scores)} frames see no LiDAR return, {blind[0]} among them")


def sources(config: Config) -> tuple[Path, ...]:
    """The tiles, whose bytes are part of the stage's staleness key; the run's own sweeps are an input like others."""
    return () if config.lidar is None else expand(config.lidar)


STAGE = Stage(
    "score",
    3,
    Config,
    ("frames", "refined_cameras", "poses", "depths", "sweeps"),
    ("scores",),
    run,
    reads=("ingest.geoid", "depth.methods"),
    facts_of=("ingest",),
    sources=sources,
    foresee=foresee,
)
