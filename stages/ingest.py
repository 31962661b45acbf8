"""ingest: photos and their exposure marks into frames, cameras, tracks and clocks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from pydantic import Field, field_validator

from pipeline.engine.errors import EpiTransferError
from pipeline.engine.progress import counted
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.geodesy.heights import height_datum
from pipeline.sources.calibration import read_calibration
from pipeline.sources.datums import AUTO
from pipeline.sources.exposures import MarkFile
from pipeline.sources.files import MARK_SUFFIXES, beside, common_root, find_images, is_url, opened
from pipeline.sources.frames import Ingested, assemble
from pipeline.sources.intrinsics import SourcedCamera
from pipeline.sources.mrk import read_marks
from pipeline.sources.photos import PhotoRecord, read_photo

_SHARD = 32


class Config(StageConfig):
    """What to read, and what the files do not say of themselves."""

    photos: str | tuple[str, ...] = Field(
        description="Folder, glob or URL of photos, or a list of these", json_schema_extra={"path": True}
    )
    camera: str | None = Field(
        None,
        description="Calibration file of all photos: ROS camera_info or OpenCV YAML; wins over the photos' own tags",
        json_schema_extra={"path": True},
    )
    height_datum: str = Field(
        AUTO,
        description="What the photos' altitudes are measured from: ellipsoidal, egm96, egm2008, navd88, takeoff, "
        "local (no tie to other data); auto: ellipsoidal with RTK, else above take-off, else unknown",
    )
    geoid: float | str | None = Field(
        None,
        description="Height of the geoid above the ellipsoid here (m), or a grid file that PROJ reads; used wherever "
        "an orthometric height meets an ellipsoidal one",
        json_schema_extra={"path": True},
    )
    crs: str = Field(
        "auto", description="CRS of the points, any text PROJ takes; auto: the UTM zone, with its vertical part"
    )
    clock_offset_s: float = Field(0.0, description="Added to the photos' own times to make them UTC (s)")

    @field_validator("height_datum")
    @classmethod
    def _known(cls, value: str) -> str:
        if value.strip().lower() == AUTO:
            return AUTO
        try:
            return height_datum(value)
        except EpiTransferError as error:
            raise ValueError(f"{error.expected}; {error.hint}") from error


def run(config: Config, context: Context) -> str:
    """Reads all photos and writes the four tables; a photo that cannot be used is a row with its reason."""
    locations = find_images(_listed(config.photos))
    marks, unread = _marks(locations)
    calibration = read_calibration(config.camera) if config.camera else None
    records: list[PhotoRecord] = []
    for part in context.map(partial(_read, calibration), locations, shard=_SHARD, label="photos"):
        records.extend(part)
    root = photo_root(config)
    found = assemble(
        records,
        marks,
        root=root,
        height_datum=config.height_datum,
        geoid=config.geoid,
        clock_offset_s=config.clock_offset_s,
    )
    context.write("frames", found.frames)
    context.write("cameras", found.cameras)
    context.write("tracks", found.tracks)
    context.write("clocks", found.clocks)
    _record(context, found, root, records)
    usable = found.frames.column("usable").to_pylist()
    context.count_items(len(usable), usable.count(False))
    for text in [*unread, *(f"{name}: {why}" for name, why in sorted(found.exposures.problems.items()))]:
        context.warn(f"exposure marks not used: {text}")
    _warn_of_unusable(context, found, len(usable))
    zoneless = [record.time_source for record in records].count("exif (zone unknown)")
    if zoneless and not config.clock_offset_s:
        context.warn(
            f"{zoneless} photos do not say their time zone; their local time is read as UTC (state the difference: "
            "--set ingest.clock_offset_s=-36000 for ten hours east)"
        )
    marked = len(found.exposures.of_photo)
    return (
        f"{usable.count(True)} of {len(usable)} photos usable, {counted(found.cameras.num_rows, 'camera')}, heights "
        f"{found.heights.stated}" + (f", {marked} with RTK exposure marks" if marked else "")
    )


def photo_root(config: Config) -> str:
    """The deepest folder that holds all photos and exposure marks: the images' paths are relative to it."""
    locations = find_images(_listed(config.photos))
    return common_root([*locations, *beside(locations, MARK_SUFFIXES)])


def sources(config: Config) -> Sequence[Path | str]:
    """The files whose bytes decide: photos, exposure marks, calibration, geoid grid."""
    locations = find_images(_listed(config.photos))
    named = [*locations, *beside(locations, MARK_SUFFIXES)]
    named += [text for text in (config.camera, config.geoid) if isinstance(text, str)]
    return [name if is_url(name) else Path(name) for name in named]


def _listed(photos: str | tuple[str, ...]) -> Sequence[str]:
    return [photos] if isinstance(photos, str) else list(photos)


def _read(calibration: SourcedCamera | None, locations: Sequence[str]) -> list[PhotoRecord]:
    return [read_photo(location, calibration) for location in locations]


def _marks(locations: Sequence[str]) -> tuple[list[MarkFile], list[str]]:
    """The exposure marks beside the photos. A damaged file stops the run: poses would silently be metres worse."""
    files, empty = [], []
    for location in beside(locations, MARK_SUFFIXES):
        with opened(location) as stream:
            data = stream.read()
        if data.strip(b"\x00 \t\r\n"):
            files.append(MarkFile(location, tuple(read_marks(data, location))))
        else:
            # Drones without a base station write the file and leave it empty.
            empty.append(f"{location} is empty")
    return files, empty


def _record(context: Context, found: Ingested, root: str, records: Sequence[PhotoRecord]) -> None:
    """Facts that later stages and the manifest need."""
    origin = found.origin
    context.record("photo_root", root)
    context.record("height_datum", found.heights.stated)
    context.record("height_datum_why", found.heights.why)
    context.record("files", len(records))
    context.record(
        "origin",
        None
        if origin is None
        else {
            "latitude_deg": origin.latitude_deg,
            "longitude_deg": origin.longitude_deg,
            "height_m": origin.height_m,
        },
    )
    zones = Counter(record.time_source for record in records if record.time_source)
    context.record("time_sources", dict(sorted(zones.items())))


def _warn_of_unusable(context: Context, found: Ingested, total: int) -> None:
    table = found.frames.filter(found.frames.column("usable").to_numpy(zero_copy_only=False) == False)  # noqa: E712
    if table.num_rows:
        first = table.slice(0, 1).to_pylist()[0]
        context.warn(f"{table.num_rows} of {total} photos are not usable, first {first['image']}: {first['problem']}")


STAGE = Stage(
    "ingest",
    1,
    Config,
    (),
    ("frames", "cameras", "tracks", "clocks"),
    run,
    sources=sources,
    place=("photo_root", photo_root),
)
