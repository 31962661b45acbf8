"""What a source holds, as plain values: photos, exposure marks, logs, LiDAR tiles, tables and run folders."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.engine.errors import EpiTransferError, InputError
from pipeline.lidar.tile_crs import tile_crs
from pipeline.lidar.tiles import read_header
from pipeline.log_inspection import describe_clip, describe_log
from pipeline.sources import datums
from pipeline.sources.accuracy import LoggedSigmas, pose_sigmas
from pipeline.sources.files import IMAGE_SUFFIXES, MARK_SUFFIXES, find, is_url, opened
from pipeline.sources.logs import BAG_SUFFIXES, LOG_SUFFIXES, is_log_folder, knows
from pipeline.sources.mrk import read_marks
from pipeline.sources.photos import PhotoRecord, read_photo
from pipeline.sources.video import VIDEO_SUFFIXES

TILE_SUFFIXES = (".las", ".laz")
TABLE_SUFFIXES = (".parquet",)
_MANIFEST = "manifest.json"
_TEXTS = (".csv", ".txt")
# What is something else than a log, whatever is in it.
_NAMED = (*IMAGE_SUFFIXES, *MARK_SUFFIXES, *TILE_SUFFIXES, *TABLE_SUFFIXES, *VIDEO_SUFFIXES)


def describe(source: str) -> list[dict[str, Any]]:
    """Describes a path, folder, glob or URL.

    Args:
        source: What the user names.

    Returns:
        One mapping per kind of thing found (all photos together), with the unit in each key.

    Raises:
        InputError: There is nothing of a known kind, or a file cannot be read.
        ResourceError: It may not be read.
    """
    if not is_url(source) and (Path(source) / _MANIFEST).is_file():
        return [_run_folder(Path(source))]
    if is_log_folder(source):
        return [describe_log(source)]
    files = find(
        source,
        (*IMAGE_SUFFIXES, *MARK_SUFFIXES, *TILE_SUFFIXES, *TABLE_SUFFIXES, *LOG_SUFFIXES, *BAG_SUFFIXES, *_TEXTS,
         *VIDEO_SUFFIXES),
    )  # fmt: skip
    out: list[dict[str, Any]] = []
    if images := _ending(files, IMAGE_SUFFIXES):
        out.append(photos(source, [read_photo(image) for image in sorted(images)]))
    # Of a folder's texts only those that a reader knows; a file that is named itself is a log or an error.
    logs = _ending(files, (*LOG_SUFFIXES, *BAG_SUFFIXES))
    logs += [file for file in _ending(files, _TEXTS) if file == source or knows(file)]
    if not out and files == [source] and not source.lower().endswith(_NAMED):
        logs = [source]
    kinds = (
        (_marks, _ending(files, MARK_SUFFIXES)),
        (_tile, _ending(files, TILE_SUFFIXES)),
        (_table, _ending(files, TABLE_SUFFIXES)),
        (describe_clip, _ending(files, VIDEO_SUFFIXES)),
        (describe_log, logs),
    )
    alone = len(files) == 1
    out += [_described(describe_one, file, alone=alone) for describe_one, named in kinds for file in named]
    if not out:
        raise InputError(
            "E-INSPECT-01",
            "nothing here that can be inspected",
            where=source,
            found="a folder without any of these" if Path(source).is_dir() else Path(source).name,
            expected="photos, .mrk, logs, bags, .srt, trajectories, videos, .las/.laz, .parquet, or a run folder",
            hint="name the file itself if it has another ending",
        )
    return out


def _described(describe_one: Callable[[str], dict[str, Any]], file: str, *, alone: bool) -> dict[str, Any]:
    """One file's description; among others an unreadable one is told beside them."""
    try:
        return describe_one(file)
    except InputError as error:
        if alone:
            raise
        told = "; ".join(text for text in (error.message, error.found, error.hint) if text)
        return {"kind": "unreadable", "source": file, "problem": told}


def photos(source: str, records: Sequence[PhotoRecord]) -> dict[str, Any]:
    """What a set of photos holds: counts, time, cameras, heights, gimbal, accuracy, problems."""
    usable = [record for record in records if not record.problem]
    times = sorted(record.time for record in usable if record.time is not None)
    heights = datums.resolve(usable, datums.AUTO, None)
    known = [height for height in heights.values_m if height is not None]
    return {
        "kind": "photos",
        "source": source,
        "photos": len(records),
        "usable": len(usable),
        "time": _span(times),
        "clock": dict(sorted(Counter(record.time_source or "no time" for record in usable).items())),
        "cameras": _cameras(usable),
        "height_datum": heights.datum,
        "height_datum_why": heights.why,
        "height_m": _range(known),
        "latitude_deg": _range(record.position.latitude_deg for record in usable if record.position),
        "longitude_deg": _range(record.position.longitude_deg for record in usable if record.position),
        "gimbal_pitch_deg": _range(record.attitude.pitch_deg for record in usable if record.attitude),
        "gimbal_roll_deg": _range(record.attitude.roll_deg for record in usable if record.attitude),
        "rtk_flag": dict(sorted(Counter(str(record.fix.rtk_flag or "none") for record in usable).items())),
        "accuracy": _accuracy([pose_sigmas(r.model, r.fix, heights.datum) for r in usable]),
        "problems": _problems(records),
        "notes": _grouped((note, record) for record in usable for note in record.notes),
    }


def _ending(files: Iterable[str], suffixes: tuple[str, ...]) -> list[str]:
    return [file for file in files if file.lower().endswith(suffixes)]


def _cameras(records: Sequence[PhotoRecord]) -> list[dict[str, Any]]:
    counts: Counter[tuple[str, int, int, float, str, str]] = Counter()
    for record in records:
        if record.camera is not None:
            lens = record.camera.camera
            focal_px = round(lens.focal_px, 2)
            counts[(record.model, lens.width, lens.height, focal_px, lens.model, record.camera.source)] += 1
    keys = ("name", "width_px", "height_px", "focal_px", "lens", "intrinsics_from")
    return [{**dict(zip(keys, camera, strict=True)), "photos": count} for camera, count in sorted(counts.items())]


def _accuracy(sigmas: Sequence[LoggedSigmas]) -> dict[str, float]:
    """The worst sigma of each part, over all photos."""
    if not sigmas:
        return {}
    names = ("sigma_east_m", "sigma_north_m", "sigma_up_m", "sigma_yaw_deg", "sigma_pitch_deg", "sigma_roll_deg")
    return {name: max((*s.position_m, *s.attitude_deg)[k] for s in sigmas) for k, name in enumerate(names)}


def _problems(records: Sequence[PhotoRecord]) -> list[dict[str, Any]]:
    return _grouped((record.problem, record) for record in records if record.problem)


def _grouped(items: Iterable[tuple[str, PhotoRecord]]) -> list[dict[str, Any]]:
    """Equal texts once, with a count and an example, most frequent first."""
    examples: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for text, record in items:
        counts[text] += 1
        examples.setdefault(text, record.location)
    return [
        {"photos": count, "reason": text, "example": examples[text]}
        for text, count in sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    ]


def _marks(location: str) -> dict[str, Any]:
    with opened(location) as stream:
        marks = read_marks(stream.read(), location)
    return {
        "kind": "rtk exposure marks",
        "source": location,
        "exposures": len(marks),
        "time": _span(sorted(mark.time for mark in marks)),
        "clock": "GPS week and second, leap seconds applied",
        "fix": dict(sorted(Counter(str(mark.quality) for mark in marks).items())),
        "height_datum": "ellipsoidal",
        "height_m": _range(mark.height_m for mark in marks),
        "latitude_deg": _range(mark.latitude_deg for mark in marks),
        "longitude_deg": _range(mark.longitude_deg for mark in marks),
        "sigma_up_m": _range(mark.sigma_up_m for mark in marks),
    }


def _tile(location: str) -> dict[str, Any]:
    """A tile's header; its points are not read."""
    path = Path(location)
    header = read_header(path)
    problem = ""
    try:
        crs = tile_crs(header, path).name
    except EpiTransferError as error:
        crs, problem = "", f"{error.message}: {error.found}; {error.hint}"
    return {
        "kind": "lidar tile",
        "source": str(path),
        "points": int(header.point_count),
        "las_version": str(header.version),
        "point_format": int(header.point_format.id),
        "crs": crs,
        "lower": [float(value) for value in header.mins],
        "upper": [float(value) for value in header.maxs],
        "problem": problem,
    }


def _table(location: str) -> dict[str, Any]:
    path = Path(location)
    try:
        file = pq.ParquetFile(path, arrow_extensions_enabled=False)
        rows, schema = file.metadata.num_rows, file.schema_arrow
    except (pa.ArrowException, OSError) as error:
        raise InputError(
            "E-INSPECT-03",
            "the table cannot be read",
            where=str(path),
            found=str(error),
            hint="is it a whole Parquet file?",
        ) from error
    metadata = schema.metadata or {}
    return {
        "kind": "table",
        "source": str(path),
        "table": metadata.get(b"epitransfer:table", b"").decode() or "not one of ours",
        "version": metadata.get(b"epitransfer:version", b"").decode(),
        "rows": rows,
        "columns": schema.names,
        "geoparquet": b"geo" in metadata,
    }


def _run_folder(folder: Path) -> dict[str, Any]:
    try:
        stages = json.loads((folder / _MANIFEST).read_text(encoding="utf-8")).get("stages", {})
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(
            "E-INSPECT-04", "the manifest cannot be read", where=str(folder / _MANIFEST), found=str(error)
        ) from error
    tables = [_table(str(file)) for file in sorted(folder.rglob("*.parquet")) if not _hidden(file, folder)]
    rows: Counter[str] = Counter()
    for table in tables:
        rows[str(table["table"])] += int(table["rows"])
    return {"kind": "run folder", "source": str(folder), "stages": sorted(stages), "rows": dict(sorted(rows.items()))}


def _hidden(file: Path, folder: Path) -> bool:
    return any(part.startswith(".") for part in file.relative_to(folder).parts)


def _span(times: Sequence[datetime]) -> list[str]:
    return [times[0].isoformat(), times[-1].isoformat()] if times else []


def _range(values: Iterable[float]) -> list[float]:
    listed = list(values)
    return [min(listed), max(listed)] if listed else []
