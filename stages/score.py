"""score: the depths of every method beside what something else measured, on the same pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from pipeline.engine.errors import NothingLeftError
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.lidar.tiles import expand
from pipeline.scoring.believed import Believed, depth_images, survey
from pipeline.scoring.collecting import collect
from pipeline.scoring.frame_scores import FrameScore, ScoringJob
from pipeline.scoring.inputs import DENSE_READS, TilesNamed, dense_lines, sparse_lines, views_of
from pipeline.scoring.lines import frames_in
from pipeline.scoring.summary import metrics_object, sentence, to_json
from pipeline.scoring.truth import FrameView
from pipeline.sources.depth_images import SUFFIXES
from pipeline.sources.files import find, is_url


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
    depth_images: str | None = Field(
        None,
        description="Depth images of the photos, 16 bits along the optical axis, instead of LiDAR: a folder or glob",
        json_schema_extra={"path": True},
    )
    depth_units_per_m: float = Field(
        1000.0, gt=0.0, description="Units of a depth image's values in a metre: 1000 for 7-Scenes, 5000 for TUM (1/m)"
    )
    max_range_m: float = Field(100.0, gt=0.0, description="Largest distance from the camera that is scored (m)")
    correspondence: Literal["sparse", "dense"] = Field(
        "sparse",
        description="Pixels compared: sparse, those of the matches, which are delivered; dense, those where the truth "
        "was measured, matched by optical flow as in the paper",
    )
    dense_matcher: Literal["dis", "raft"] = Field("dis", description="Optical flow of dense")
    dense_points: int = Field(2000, ge=8, description="Most pixels of a frame that dense asks for (1)")

    @model_validator(mode="after")
    def _as_a_whole(self) -> Config:
        if self.lidar is not None and self.depth_images is not None:
            raise ValueError("lidar and depth_images are two truths: score against one, then against the other")
        return self


def run(config: Config, context: Context) -> str:
    """Scores `depths` against the truth; writes `scores/metrics.json` and `scores/pixels.parquet`."""
    depths, folder = context.path("depths"), context.output("scores")
    views = views_of(context, frames_in(depths))
    if not views:
        raise NothingLeftError("E-SCORE-05", "no depth to score", where=str(depths), hint="see what depth masked")
    believed = _believed(config, context, views)
    dense = config.correspondence == "dense"
    lines = dense_lines(context, config.dense_matcher, config.dense_points) if dense else sparse_lines(context)
    shard = _SLOW_FRAMES_PER_SHARD if dense else _FRAMES_PER_SHARD
    job = ScoringJob(believed.truth, lines, config.max_range_m, shard=shard)
    scores = collect(context, job, views, folder)
    _tell(context, scores[0])
    if not any(score.sums.methods[0].n_scored for score in scores[0]):
        raise believed.nothing(scores[0])
    metrics = metrics_object(job.methods, scores[0])
    (folder / "metrics.json").write_text(to_json(metrics), encoding="utf-8")
    return sentence(metrics)


def _believed(config: Config, context: Context, views: Sequence[FrameView]) -> Believed:
    if config.depth_images is not None:
        return depth_images(context, config.depth_images, config.depth_units_per_m, config.max_range_m)
    return survey(context, _tiles(config), views, config.max_range_m, 0.0)


def _tiles(config: Config) -> TilesNamed:
    return TilesNamed(config.lidar, config.lidar_height_datum)


def foresee(config: Config, setting: Callable[[str], Any], facts: Mapping[str, Any]) -> None:
    """Refuses heights that cannot meet LiDAR's, truth that cannot be read or placed, and having none at all."""
    del setting
    if config.depth_images is not None:
        find(config.depth_images, SUFFIXES)
    else:
        _tiles(config).foresee(facts)


def _tell(context: Context, scores: Sequence[FrameScore]) -> None:
    """Records what the figures rest on."""
    blind = [score.frame_id for score in scores if not score.n_visible]
    context.count_items(len(scores), 0)
    context.record("matches", sum(score.n_matches for score in scores))
    context.record("matches_with_reference", sum(score.sums.methods[0].n_scored for score in scores))
    context.record("frames_that_see_no_truth", blind)
    context.record(
        "calibration_sigma",
        "predicted sigma, the reference's spread and what the pose's sigma makes of it, in quadrature",
    )
    if blind:
        context.warn(f"{len(blind)} of {len(scores)} frames see nothing of the truth, {blind[0]} among them")


def sources(config: Config) -> tuple[Path | str, ...]:
    """The truth's files, whose bytes are part of the stage's staleness key; the run's own sweeps are an input."""
    if config.depth_images is not None:
        return tuple(name if is_url(name) else Path(name) for name in find(config.depth_images, SUFFIXES))
    return () if config.lidar is None else expand(config.lidar)


STAGE = Stage(
    "score",
    3,
    Config,
    ("frames", "refined_cameras", "poses", "pairs", "relative_poses", "depths", "images", "sweeps"),
    ("scores",),
    run,
    reads=("ingest.geoid", "depth.methods", *DENSE_READS),
    facts_of=("ingest",),
    sources=sources,
    foresee=foresee,
)
