"""fuse: kept depths of all pairs as georeferenced points, one per physical point, with covariance, tiled."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
from pydantic import Field, model_validator

from pipeline.engine.errors import NothingLeftError
from pipeline.engine.progress import counted
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.engine.tables import parquet_files, read_table
from pipeline.flight import (
    camera_by_frame,
    cameras_of,
    image_locations,
    placed_pairs_of,
    placements_of,
    pose_errors_of,
    selected_pairs,
)
from pipeline.geodesy.crs import local_output, output_crs
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import ELLIPSOIDAL, is_orthometric
from pipeline.geodesy.local_world import EARTH, LOCAL_WORLD
from pipeline.geodesy.transform import FrameTransform
from pipeline.points.fusion import Counts, Limits, fused_tile
from pipeline.points.geoparquet import TileFile, write_dataset
from pipeline.points.observations import Scene, observations, spill
from pipeline.points.stac import item


class Config(StageConfig):
    """How observations become points."""

    voxel_m: float = Field(
        0.0, ge=0.0, description="Edge of the cube of which only the surest point is kept; 0 keeps every point (m)"
    )
    min_observations: int = Field(1, ge=1, description="Least number of pairs that saw a point (1)")
    tile_m: int = Field(250, gt=0, description="Edge of a tile, a multiple of voxel_m (m)")

    @model_validator(mode="after")
    def _whole(self) -> Config:
        if self.voxel_m and abs(self.tile_m / self.voxel_m - round(self.tile_m / self.voxel_m)) > 1e-9:
            raise ValueError("tile_m has to be a multiple of voxel_m")
        return self


def run(config: Config, context: Context) -> str:
    """Places the points and fuses them tile by tile; writes `points`."""
    scene = _scene(context)
    context.record("crs", scene.transform.crs.name)
    context.record("heights", scene.transform.height_note)
    spilled = context.scratch
    parts = parquet_files(context.path("depths"))
    place = partial(_place, scene, spilled, config.tile_m)
    for _ in context.map(place, parts, shard=1, label="parts"):
        pass
    tiles = sorted(folder for folder in spilled.iterdir() if folder.is_dir())
    limits = Limits(config.min_observations, config.voxel_m, config.tile_m)
    fused = list(context.map(partial(_fuse, scene, limits, context.output("points")), tiles, shard=1, label="tiles"))
    written = [tile for files, _ in fused for tile in files]
    counts = Counts.sum(part for _, part in fused)
    for name, number in asdict(counts).items():
        context.record(name, number)
    rows = sum(tile.rows for tile in written)
    if not rows:
        raise NothingLeftError(
            "E-FUSE-01",
            "no point is left",
            found=", ".join(f"{number} {name.replace('_', ' ')}" for name, number in asdict(counts).items()),
            expected=f"points seen by {counted(config.min_observations, 'pair')}",
            hint="--set fuse.min_observations=1",
        )
    described = item(written, scene.transform.crs, "points", "Points by epipolar transfer, with covariance")
    (context.output("points") / "item.json").write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
    return f"{rows} points in {counted(len(written), 'tile')}, {scene.transform.crs.name}; {_left_out(counts)}"


def _left_out(counts: Counts) -> str:
    outliers = counts.isolated + counts.looked_through
    return f"{counted(counts.contradictory, 'contradictory track')} dropped, {counted(outliers, 'outlier')} removed"


def foresee(config: Config, setting: Callable[[str], Any], facts: Mapping[str, Any]) -> None:
    """Refuses a CRS, a height datum or a geoid that the points could not be delivered with."""
    del config
    # On earth there is no origin when no frame is usable, and then nothing to deliver.
    if facts["origin"] is not None or facts.get("world", EARTH) == LOCAL_WORLD:
        _transform(setting, facts)


def _transform(setting: Callable[[str], Any], facts: Mapping[str, Any]) -> FrameTransform:
    if facts.get("world", EARTH) == LOCAL_WORLD:
        return local_output(setting("ingest.crs"))
    source = facts["height_datum"]
    return output_crs(
        setting("ingest.crs"),
        LocalFrame(**facts["origin"]),
        # Ingest makes orthometric heights ellipsoidal.
        ELLIPSOIDAL if is_orthometric(source) else source,
        setting("ingest.geoid"),
        source_datum=source,
    )


def _scene(context: Context) -> Scene:
    frames = context.read("frames")
    facts = context.facts("ingest")
    usable = frames.filter(frames.column("usable"))
    ids = usable.column("frame_id").to_pylist()
    return Scene(
        image_locations(frames, str(facts["photo_root"]), context.path("images")),
        dict(zip(ids, usable.column("time").cast("int64").to_pylist(), strict=True)),
        camera_by_frame(frames, cameras_of(context.read("refined_cameras"))),
        placements_of(context.read("poses")),
        pose_errors_of(context.read("pose_covariances")),
        {pair.pair_id: pair for pair in selected_pairs(context.read("pairs"))},
        placed_pairs_of(context.read("relative_poses")),
        _transform(context.setting, facts),
        context.setting("depth.methods")[0],
    )


def _place(scene: Scene, folder: Path, tile_m: int, files: Sequence[Path]) -> int:
    for file in files:
        spill(observations(scene, read_table(file, "depths")), folder, f"{file.stem}.arrow", tile_m)
    return len(files)


def _fuse(scene: Scene, limits: Limits, output: Path, folders: Sequence[Path]) -> tuple[list[TileFile], Counts]:
    counts = []

    def tables() -> Iterator[pa.Table]:
        for folder in folders:
            table, of_tile = fused_tile(scene, folder, limits)
            counts.append(of_tile)
            if table.num_rows:
                yield table

    return write_dataset(output, tables(), scene.transform.crs), Counts.sum(counts)


STAGE = Stage(
    "fuse",
    3,
    Config,
    ("frames", "refined_cameras", "poses", "pose_covariances", "relative_poses", "pairs", "depths", "images"),
    ("points",),
    run,
    reads=("ingest.crs", "ingest.geoid", "depth.methods"),
    facts_of=("ingest",),
    foresee=foresee,
)
