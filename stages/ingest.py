"""ingest: photos, logs, bags and videos into frames, cameras, tracks and clocks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from pipeline.engine.errors import EpiTransferError
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.geodesy.heights import height_datum
from pipeline.placing import steps
from pipeline.placing.locate import files_of, find_logs, find_videos, listed
from pipeline.placing.tables import clock_row, track_pieces
from pipeline.placing.telling import record_facts, summary, warn_of
from pipeline.sources.accuracy import local_sigmas
from pipeline.sources.datums import AUTO
from pipeline.sources.files import MARK_SUFFIXES, beside, common_root, find_images, is_url
from pipeline.sources.frames import assemble
from pipeline.sources.video import srt_beside
from stages.mount_config import MountConfig

_Paths = str | tuple[str, ...] | None
_PATH: dict[str, Any] = {"path": True}


class Config(StageConfig):
    """What to read, and what the files do not say of themselves."""

    photos: _Paths = Field(
        None, description="Folder, glob or URL of photos, or a list of these", json_schema_extra=_PATH
    )
    videos: _Paths = Field(None, description="DJI videos with their .SRT beside them", json_schema_extra=_PATH)
    logs: _Paths = Field(
        None,
        description="Logs and trajectories that say where the photos were taken: ArduPilot .BIN/.log, MAVLink .tlog, "
        "PX4 .ulg, ROS and MCAP bags, DJI .SRT/.csv, TUM or CSV trajectories, COLMAP models",
        json_schema_extra=_PATH,
    )
    bags: _Paths = Field(
        None, description="ROS or MCAP bags whose own images are used, with their poses", json_schema_extra=_PATH
    )
    camera: str | None = Field(
        None,
        description="Calibration file of all photos: ROS camera_info or OpenCV YAML; wins over the photos' own tags",
        json_schema_extra=_PATH,
    )
    mount: MountConfig = Field(
        MountConfig(), description="The camera on the vehicle: yaw_deg, pitch_deg, roll_deg, lever_arm_m"
    )
    lidar_mount: MountConfig | None = Field(
        None, description="The LiDAR (axes forward, left, up) on what is posed, where a bag does not say: as mount"
    )
    lidar_clock_offset_s: float = Field(
        0.0, description="Added to the times of a bag's LiDAR sweeps to make them those of camera and poses (s)"
    )
    pose_topic: str | None = Field(
        None, description="Topic of the poses to use in bags with several; none: the longest"
    )
    image_topic: str | None = Field(None, description="Topic of the images to use in bags; none: the longest")
    up_axis: Literal["z", "y"] = Field("z", description="Which axis of a local frame points up: y in motion capture")
    frame_spacing_m: float = Field(1.0, gt=0.0, description="Way between two images taken out of a bag or video (m)")
    pose_sigma_m: float = Field(
        0.003, gt=0.0, description="One sigma of positions in a local frame along each axis, new in each pose (m)"
    )
    pose_sigma_deg: float = Field(
        0.1, gt=0.0, description="One sigma of attitudes in a local frame about each axis, new in each pose (deg)"
    )
    height_datum: str = Field(
        AUTO,
        description="What the absolute heights are measured from: ellipsoidal, egm96, egm2008, navd88, takeoff, "
        "local (no tie to other data); auto: ellipsoidal where the source knows it, else above take-off, else unknown",
    )
    geoid: float | str | None = Field(
        None,
        description="Height of the geoid above the ellipsoid here (m), or a grid file that PROJ reads; used wherever "
        "an orthometric height meets an ellipsoidal one",
        json_schema_extra=_PATH,
    )
    crs: str = Field(
        "auto", description="CRS of the points, any text PROJ takes; auto: the UTM zone, with its vertical part"
    )
    clock_offset_s: float | Literal["auto"] = Field(
        "auto", description="Added to the photos' own times to make them UTC (s); auto: found from the logs, else none"
    )

    @field_validator("height_datum")
    @classmethod
    def _known(cls, value: str) -> str:
        if value.strip().lower() == AUTO:
            return AUTO
        try:
            return height_datum(value)
        except EpiTransferError as error:
            raise ValueError(f"{error.expected}; {error.hint}") from error

    @model_validator(mode="after")
    def _something(self) -> Config:
        if not (self.photos or self.bags or self.videos):
            raise ValueError("name photos, bags or videos: something has to hold the images")
        return self


def run(config: Config, context: Context) -> str:
    """Reads everything and writes the tables; an image that cannot be used is a row with its reason."""
    wishes = _wishes(config)
    root, photos = photo_root(config), _photos(config)
    logs, bags, videos = find_logs(config.logs), find_logs(config.bags), find_videos(config.videos)
    # What is wrong with a log named by itself is an error, not a note beside the others of its folder.
    named = frozenset([*listed(config.logs), *listed(config.bags)])
    sources = steps.read_sources(context, logs, bags, videos, wishes, named)
    images = steps.extract(context, sources, wishes)
    records = steps.read_photos(context, photos, images, sources, wishes)
    placed = steps.placed(records, images, sources, wishes)
    marks, unread = steps.exposure_marks(photos)
    lines = [source.line for source in sources]
    found = assemble(
        placed.records,
        marks,
        root=root,
        height_datum=config.height_datum,
        geoid=config.geoid,
        clock_offset_s=wishes.clock_offset_s or 0.0,
        local_sigmas=local_sigmas(config.pose_sigma_m, config.pose_sigma_deg),
        log_clocks=[*(clock_row(line, root) for line in lines), *placed.clocks],
    )
    context.write("frames", found.frames)
    context.write("cameras", found.cameras)
    context.write_pieces("tracks", chain([found.tracks], *(track_pieces(line, root) for line in lines)))
    context.write("clocks", found.clocks)
    context.record("sweep_points", steps.write_sweeps_of(context, sources, found.origin, wishes))
    record_facts(context, found, placed, root)
    warn_of(context, found, placed, lines, unread, stated=wishes.clock_offset_s is not None)
    return summary(found)


def _wishes(config: Config) -> steps.Wishes:
    return steps.Wishes(
        camera=config.camera,
        mount=config.mount.mount(),
        lidar_mount=config.lidar_mount.mount() if config.lidar_mount else None,
        pose_topic=config.pose_topic,
        image_topic=config.image_topic,
        y_up=config.up_axis == "y",
        spacing_m=config.frame_spacing_m,
        clock_offset_s=None if config.clock_offset_s == "auto" else float(config.clock_offset_s),
        lidar_clock_offset_s=config.lidar_clock_offset_s,
    )


def photo_root(config: Config) -> str:
    """The deepest folder that holds all photos and exposure marks, or without photos all logs and videos.

    The images' paths are relative to it.
    """
    photos = _photos(config)
    named = [*photos, *beside(photos, MARK_SUFFIXES)] or [*find_logs(config.bags), *find_videos(config.videos)]
    return common_root(named)


def sources(config: Config) -> Sequence[Path | str]:
    """The files whose bytes decide: photos, marks, logs, bags, videos and subtitles, calibration, geoid grid."""
    photos, videos = _photos(config), find_videos(config.videos)
    named = [*photos, *beside(photos, MARK_SUFFIXES), *videos]
    named += files_of([*find_logs(config.logs), *find_logs(config.bags)])
    named += [text for text in (config.camera, config.geoid, *map(srt_beside, videos)) if isinstance(text, str)]
    return [name if is_url(name) else Path(name) for name in named]


def _photos(config: Config) -> list[str]:
    return find_images(config.photos) if config.photos else []


STAGE = Stage(
    "ingest",
    2,
    Config,
    (),
    ("frames", "cameras", "tracks", "clocks", "images", "sweeps"),
    run,
    sources=sources,
    place=("photo_root", photo_root),
)
