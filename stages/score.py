"""score: the depths of every method beside LiDAR, on the same pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field

from pipeline.engine.errors import NothingLeftError, UndeterminedError
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.flight import camera_by_frame, cameras_of, poses_of
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import RELATIVE, UNKNOWN
from pipeline.geometry.arrays import Floats
from pipeline.lidar.nearby import LocalTiles
from pipeline.lidar.tiles import expand, read_tile
from pipeline.lidar.visibility import View
from pipeline.scoring.frame_scores import FrameScore, FrameView, ScoringJob, frames_in, methods_of, score_frames
from pipeline.scoring.summary import metrics_object, sentence, to_json
from schemas import SCORES

_FRAMES_PER_SHARD = 8


class Config(StageConfig):
    """The truth and how far it is believed."""

    lidar: str | tuple[str, ...] = Field(
        description="LAS, LAZ or COPC tiles: a file, a folder, a glob, or a list of these",
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
    views = _views(context, frames_in(depths))
    if not views:
        raise NothingLeftError("E-SCORE-05", "no depth to score", where=str(depths), hint="see what depth masked")
    centres = np.array([item.view.centre_in_enu_m for item in views])
    meeting = tiles.meeting(centres, config.max_range_m)
    if not meeting:
        raise _apart(tiles, centres, config.max_range_m)
    job = ScoringJob(
        LocalTiles(meeting, tiles.frame, tiles.geoid, tiles.height_datum),
        depths,
        methods_of(depths, context.setting("depth.methods")[0]),
        config.max_range_m,
    )
    scores: list[FrameScore] = []
    with pq.ParquetWriter(folder / "pixels.parquet", SCORES.arrow(), compression="zstd") as writer:
        shards = context.map(partial(score_frames, job), views, shard=_FRAMES_PER_SHARD, label="frames")
        for table, part in shards:
            writer.write_table(_checked(table))
            scores += part
    metrics = metrics_object(job.methods, scores)
    _tell(context, scores, tiles, meeting)
    if not any(score.methods[0].n_scored for score in scores):
        raise _no_reference(scores, config.max_range_m)
    (folder / "metrics.json").write_text(to_json(metrics), encoding="utf-8")
    return sentence(metrics)


def _checked(table: pa.Table) -> pa.Table:
    SCORES.check(table)
    return table


def _tiles(config: Config, context: Context) -> LocalTiles:
    """The tiles' headers, and the frame they are brought into."""
    frames = context.read("frames")
    datums = sorted(set(frames.filter(frames.column("usable")).column("height_datum").to_pylist()))
    _check_datums(datums)
    origin = context.facts("ingest")["origin"]
    frame = LocalFrame(origin["latitude_deg"], origin["longitude_deg"], origin["height_m"])
    tiles = tuple(read_tile(path, config.lidar_height_datum) for path in expand(config.lidar))
    return LocalTiles(tiles, frame, context.setting("ingest.geoid"), datums[0])


def foresee(config: Config, setting: Callable[[str], Any], facts: Mapping[str, Any]) -> None:
    """Refuses heights that cannot meet LiDAR's, and tiles that cannot be read or do not say their heights."""
    del setting
    _check_datums([facts["height_datum"]])
    for path in expand(config.lidar):
        read_tile(path, config.lidar_height_datum)


def _check_datums(datums: Sequence[str]) -> None:
    if len(datums) != 1 or datums[0] in (*RELATIVE, UNKNOWN):
        raise UndeterminedError(
            "E-SCORE-02", "the flight's heights cannot be brought to those of LiDAR", where="frames, height_datum",
            found=", ".join(datums) or "no usable frame", expected="one datum that a geoid ties to the ellipsoid",
            hint="say what the source's heights are: --set ingest.height_datum=ellipsoidal (or egm96, egm2008, navd88)",
        )  # fmt: skip


def _views(context: Context, wanted: set[str]) -> list[FrameView]:
    """The frames that have depths, in the order of `poses`."""
    cameras = camera_by_frame(context.read("frames"), cameras_of(context.read("cameras")))
    return [
        FrameView(frame_id, View(cameras[frame_id], pose.centre, pose.rotation))
        for frame_id, pose in poses_of(context.read("poses")).items()
        if frame_id in wanted
    ]


def _tell(context: Context, scores: Sequence[FrameScore], tiles: LocalTiles, meeting: Sequence[object]) -> None:
    """Records what the figures rest on."""
    blind = [score.frame_id for score in scores if not score.n_visible]
    context.count_items(len(scores), 0)
    context.record("lidar_tiles", {"given": len(tiles.tiles), "used": len(meeting)})
    context.record("lidar_heights", sorted({tiles.transform(tile).height_note for tile in tiles.tiles}))
    context.record("matches", sum(score.n_matches for score in scores))
    context.record("matches_with_reference", sum(score.methods[0].n_scored for score in scores))
    context.record("frames_that_see_no_lidar", blind)
    context.record("calibration_sigma", "predicted sigma and the reference's spread, in quadrature")
    if blind:
        context.warn(f"{len(blind)} of {len(scores)} frames see no LiDAR return, {blind[0]} among them")


def _apart(tiles: LocalTiles, centres: Floats, max_range_m: float) -> NothingLeftError:
    reach = np.array([[-max_range_m] * 3, [max_range_m] * 3])
    flight = np.stack([centres.min(axis=0), centres.max(axis=0)]) + reach
    boxes = [
        tiles.transform(tile).enu_from(np.array([tile.minimum, tile.maximum]))
        for tile in tiles.tiles
        if tile.point_count
    ]
    corners = np.concatenate(boxes) if boxes else np.zeros((0, 3))
    lidar = _box(tiles.frame, corners) if len(corners) else "no returns"
    return NothingLeftError(
        "E-SCORE-03", "the LiDAR tiles and the flight do not overlap", where=str(tiles.tiles[0].path),
        found=f"LiDAR {lidar}", expected=f"within {max_range_m:g} m of the cameras: {_box(tiles.frame, flight)}",
        hint="name the tiles under the flight (score.lidar), and see that their CRS is right",
    )  # fmt: skip


def _box(frame: LocalFrame, corners_in_enu_m: Floats) -> str:
    latitude, longitude, _ = frame.geodetic_from_enu(corners_in_enu_m)
    return (
        f"latitude {np.min(latitude):.5f} .. {np.max(latitude):.5f}, "
        f"longitude {np.min(longitude):.5f} .. {np.max(longitude):.5f}"
    )


def _no_reference(scores: Sequence[FrameScore], max_range_m: float) -> NothingLeftError:
    seen, matches = sum(score.n_visible for score in scores), sum(score.n_matches for score in scores)
    return NothingLeftError(
        "E-SCORE-04", "no match has a reference depth",
        found=f"{matches:,} matches; the frames see {seen:,} LiDAR returns within {max_range_m:g} m",
        expected="returns on the surfaces that are matched",
        hint="see that heights and positions of LiDAR and flight are of one datum (ingest.height_datum, ingest.geoid), "
        "or raise score.max_range_m",
    )  # fmt: skip


def sources(config: Config) -> tuple[Path, ...]:
    """The tiles, whose bytes are part of the stage's staleness key."""
    return expand(config.lidar)


STAGE = Stage(
    "score",
    1,
    Config,
    ("frames", "cameras", "poses", "depths"),
    ("scores",),
    run,
    reads=("ingest.geoid", "depth.methods"),
    facts_of=("ingest",),
    sources=sources,
    foresee=foresee,
)
