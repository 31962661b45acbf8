"""score: the depths of every method beside what something else measured, on the same pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from pipeline.engine.errors import NothingLeftError
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.lidar.tiles import expand
from pipeline.matching.matchers import weights_of
from pipeline.monodepth.baselines import BaselineSetting
from pipeline.monodepth.found import model_files
from pipeline.scoring.believed import Believed, depth_images, survey
from pipeline.scoring.collecting import all_metrics, collect, tell
from pipeline.scoring.control import Control, ControlNamed, control_of
from pipeline.scoring.frame_scores import ScoringJob
from pipeline.scoring.inputs import (
    DENSE_READS,
    TilesNamed,
    baselines_of,
    cloud_of,
    dense_lines,
    device_of_job,
    sparse_lines,
    views_of,
)
from pipeline.scoring.lines import frames_in
from pipeline.scoring.summary import sentence, to_json
from pipeline.scoring.truth import FrameView
from pipeline.sources.depth_images import SUFFIXES
from pipeline.sources.files import find, is_url

# Frames scored together share the truth about them; where a frame takes long, progress is wanted.
_FEWEST_PER_SHARD, _MOST_PER_SHARD, _SHARDS, _SLOW_PER_SHARD = 4, 20, 8, 2


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
    lidar_sigma_m: float | None = Field(
        None,
        gt=0.0,
        description="One sigma of a return along each axis, for distances of points with their levels of detection; "
        "left out, what tiles carry (m)",
    )
    depth_images: str | None = Field(
        None,
        description="Depth images of the photos, 16 bits along the optical axis, instead of LiDAR: a folder or glob",
        json_schema_extra={"path": True},
    )
    depth_units_per_m: float = Field(
        1000.0, gt=0.0, description="Units of a depth image's values in a metre: 1000 for 7-Scenes, 5000 for TUM (1/m)"
    )
    control_points: str | None = Field(
        None,
        description="Surveyed points in the photos, OpenDroneMap's gcp_list.txt: the one translation that brings the "
        "tiles to the poses is found from them; scores without it stand beside",
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
    max_range_m: float = Field(100.0, gt=0.0, description="Largest distance from the camera that is scored (m)")
    correspondence: Literal["sparse", "dense"] = Field(
        "sparse",
        description="Pixels compared: sparse, those of the matches, which are delivered; dense, those where the truth "
        "was measured, matched by optical flow as in the paper",
    )
    dense_matcher: Literal["dis", "raft"] = Field("dis", description="Optical flow of dense")
    dense_points: int = Field(2000, ge=8, description="Most pixels of a frame that dense asks for (1)")
    baselines: tuple[Literal["zoedepth", "depth-anything-v2"], ...] = Field(
        (), description="Networks that guess depth from one image without its pose, compared on the same pixels"
    )
    models: str | None = Field(
        None,
        description="Where the networks of baselines are looked for first: a folder of one model or of several",
        json_schema_extra={"path": True},
    )

    @model_validator(mode="after")
    def _as_a_whole(self) -> Config:
        if self.lidar is not None and self.depth_images is not None:
            raise ValueError("lidar and depth_images are two truths: score against one, then against the other")
        if self.control_points is not None and self.depth_images is not None:
            raise ValueError("depth images move with their cameras: control points have nothing to shift")
        return self


def run(config: Config, context: Context) -> str:
    """Scores `depths` against the truth; writes `scores/metrics.json` and `scores/pixels.parquet`."""
    depths, folder = context.path("depths"), context.output("scores")
    views = views_of(context, frames_in(depths))
    if not views:
        raise NothingLeftError("E-SCORE-05", "no depth to score", where=str(depths), hint="see what depth masked")
    named = _control(config)
    control = control_of(context, named) if named else None
    believed = _believed(config, context, views, control.margin_m if control else 0.0)
    found = collect(context, _job(config, context, believed, control, len(views)), views, folder)
    tell(context, found[0])
    if not found[0].n_scored:
        raise believed.nothing(found[0].frames)
    truth = {"kind": believed.kind, "correspondence": config.correspondence, "max_range_m": config.max_range_m}
    metrics = all_metrics(found, control, truth)
    (folder / "metrics.json").write_text(to_json(metrics), encoding="utf-8")
    return sentence(metrics)


def _job(config: Config, context: Context, believed: Believed, control: Control | None, frames: int) -> ScoringJob:
    shard = min(max(frames // _SHARDS, _FEWEST_PER_SHARD), _MOST_PER_SHARD)
    dense = config.correspondence == "dense"
    lines = dense_lines(context, config.dense_matcher, config.dense_points) if dense else sparse_lines(context)
    baselines = baselines_of(context, config.baselines, config.models)
    return ScoringJob(
        believed.truth,
        lines,
        config.max_range_m,
        baselines,
        control.correction if control else None,
        cloud_of(context, believed.tiles, config.max_range_m, config.lidar_sigma_m),
        shard=_SLOW_PER_SHARD if dense or config.baselines else shard,
        # One device serves one process.
        here=device_of_job(lines, baselines) != "cpu",
    )


def _believed(config: Config, context: Context, views: Sequence[FrameView], margin_m: float) -> Believed:
    if config.depth_images is not None:
        return depth_images(context, config.depth_images, config.depth_units_per_m, config.max_range_m)
    return survey(context, _tiles(config), views, config.max_range_m, margin_m)


def _tiles(config: Config) -> TilesNamed:
    return TilesNamed(config.lidar, config.lidar_height_datum)


def _control(config: Config) -> ControlNamed | None:
    if config.control_points is None:
        return None
    return ControlNamed(config.control_points, config.control_height_datum, config.control_sigma_m)


def foresee(config: Config, setting: Callable[[str], Any], facts: Mapping[str, Any]) -> None:
    """Refuses heights that cannot meet LiDAR's, truth that cannot be read or placed, and having none at all."""
    BaselineSetting.find(config.baselines, config.models, setting("match.device"))
    if config.correspondence == "dense":
        weights_of(config.dense_matcher, setting("match.weights"))
    if config.depth_images is not None:
        find(config.depth_images, SUFFIXES)
    else:
        _tiles(config).foresee(facts)
    if (named := _control(config)) is not None:
        named.placed(facts, setting("ingest.geoid"))


def sources(config: Config) -> tuple[Path | str, ...]:
    """The truth's files, whose bytes are part of the stage's staleness key; the run's own sweeps are an input."""
    named = [] if config.control_points is None else [config.control_points]
    named += find(config.depth_images, SUFFIXES) if config.depth_images is not None else []
    tiles = () if config.lidar is None else expand(config.lidar)
    models = model_files(config.baselines, config.models)
    return (*tiles, *models, *(name if is_url(name) else Path(name) for name in named))


STAGE = Stage(
    "score",
    3,
    Config,
    ("frames", "refined_cameras", "poses", "pose_covariances", "pairs", "relative_poses", "depths", "points", "images",
     "sweeps"),
    ("scores",),
    run,
    reads=("ingest.geoid", "refine.control_points", "depth.methods", *DENSE_READS),
    facts_of=("ingest",),
    sources=sources,
    foresee=foresee,
    optional=("points",),
)  # fmt: skip
