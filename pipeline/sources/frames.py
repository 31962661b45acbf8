"""From photo records to the tables `frames`, `cameras`, `tracks` and `clocks`."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.engine.errors import InputError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import ELLIPSOIDAL, LOCAL, TAKEOFF
from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import enu_from_cam, gimbal_angles, quaternion_from_rotation
from pipeline.sources import datums, exposures
from pipeline.sources.accuracy import LoggedSigmas, pose_sigmas, widened
from pipeline.sources.exposures import Exposures, MarkFile
from pipeline.sources.files import relative_to
from pipeline.sources.photos import PhotoRecord
from schemas import CAMERAS, CLOCKS, FRAMES, TRACKS

# A photo clock is set by hand or by the last GPS fix; without a zone it can be off by the zone, too.
_PHOTO_CLOCK_SIGMA_S = 1.0
# Whether poses are tied to a place on earth, or only to each other.
EARTH, LOCAL_WORLD = "earth", "local"
_AXES = ("east", "north", "up")
_ANGLES = ("yaw", "pitch", "roll")


@dataclass(frozen=True, slots=True)
class Ingested:
    """The tables of a run's photos, and what was found out on the way."""

    frames: pa.Table
    cameras: pa.Table
    tracks: pa.Table
    clocks: pa.Table
    heights: datums.Heights
    exposures: Exposures
    origin: LocalFrame | None
    world: str


def assemble(
    records: Sequence[PhotoRecord],
    marks: Sequence[MarkFile],
    *,
    root: str,
    height_datum: str,
    geoid: float | str | None,
    clock_offset_s: float = 0.0,
    local_sigmas: LoggedSigmas | None = None,
    log_clocks: Sequence[Mapping[str, Any]] = (),
) -> Ingested:
    """Puts photos, their exposure marks and what the logs said of them together.

    Args:
        records: The photos in order.
        marks: The .MRK files beside them.
        root: Folder that images are named relative to.
        height_datum: As `datums.resolve`.
        geoid: As `datums.resolve`.
        clock_offset_s: Added to the photos' own times, s.
        local_sigmas: Sigmas of poses in a local frame.
        log_clocks: Rows of `clocks` from the logs: their own clocks, and the cameras' against them.

    Raises:
        InputError: Two images have the same stem.
        UsageError: No such datum.
        UndeterminedError: A geoid is needed and not known.
    """
    _check_unique(records)
    found = exposures.associate(records, marks, clock_offset_s)
    placed = [exposures.apply(record, found.of_photo.get(record.location)) for record in records]
    world = LOCAL_WORLD if any(r.local_m and r.position is None for r in placed if not r.problem) else EARTH
    heights = _local_heights(placed) if world == LOCAL_WORLD else datums.resolve(placed, height_datum, geoid)
    judged = [_judged(record, value, heights) for record, value in zip(placed, heights.values_m, strict=True)]
    origin = None if world == LOCAL_WORLD else _origin(judged, heights.values_m)
    camera_ids, cameras = _cameras(judged)
    enu = _positions(judged, heights.values_m, origin)
    quaternions, angles = _attitudes(judged, origin)
    rows = [
        {
            **_identity(record, camera_ids[i], root, clock_offset_s),
            "height_m": heights.values_m[i],
            "height_datum": heights.datum,
            **{f"{axis}_m": enu[i, k] for k, axis in enumerate(_AXES) if np.isfinite(enu[i, k])},
            **{f"q{part}": quaternions[i, k] for k, part in enumerate("wxyz") if np.isfinite(quaternions[i, k])},
            **{f"{name}_deg": angles[i, k] for k, name in enumerate(_ANGLES) if np.isfinite(angles[i, k])},
            **_sigmas(record, heights.datum, local_sigmas if record.local_m else None),
        }
        for i, record in enumerate(judged)
    ]
    return Ingested(
        FRAMES.from_rows(rows),
        cameras,
        _tracks(records, marks, root),
        _clocks(records, found, root, clock_offset_s, log_clocks),
        heights,
        found,
        origin,
        world,
    )


def _local_heights(records: Sequence[PhotoRecord]) -> datums.Heights:
    values = tuple(record.local_m[2] if record.local_m else None for record in records)
    return datums.Heights(values, LOCAL, LOCAL, "poses in a frame that is tied to no place on earth")


def _check_unique(records: Sequence[PhotoRecord]) -> None:
    seen: dict[str, str] = {}
    for record in records:
        if record.frame_id in seen:
            raise InputError(
                "E-PHOTOS-02",
                f"two images are both called {record.frame_id}",
                where=f"{seen[record.frame_id]} and {record.location}",
                expected="one image per name: the name is the frame's identity in every table",
                hint="ingest one folder at a time, or rename (DJI numbers start again in each folder)",
            )
        seen[record.frame_id] = record.location


def _judged(record: PhotoRecord, height_m: float | None, heights: datums.Heights) -> PhotoRecord:
    """The record with its last reason to be left out: no height in the run's datum."""
    if record.problem or height_m is not None or record.local_m is not None:
        return record
    own = datums.own_datum(record)
    has = f"its height is {own}" if own else "it has no height"
    remedy = "ingest it in a run of its own, or set ingest.height_datum" if own else "use the original file"
    return replace(record, pose_problem=f"the run's heights are {heights.datum}, {has}: {remedy}")


def _origin(records: Sequence[PhotoRecord], heights_m: Sequence[float | None]) -> LocalFrame | None:
    """The median position, rounded, at the lowest usable photo's whole metre: the same whatever the photos' order."""
    usable = [
        (record.position, height)
        for record, height in zip(records, heights_m, strict=True)
        if not record.problem and record.position is not None and height is not None
    ]
    if not usable:
        return None
    longitudes = np.array([position.longitude_deg for position, _ in usable])
    if np.ptp(longitudes) > 180.0:
        longitudes = np.where(longitudes < 0.0, longitudes + 360.0, longitudes)
    latitude = round(float(np.median([position.latitude_deg for position, _ in usable])), 5)
    longitude = round((float(np.median(longitudes)) + 180.0) % 360.0 - 180.0, 5)
    return LocalFrame(latitude, longitude, float(np.floor(min(height for _, height in usable))))


def _positions(records: Sequence[PhotoRecord], heights_m: Sequence[float | None], origin: LocalFrame | None) -> Floats:
    """Camera centres in ENU, (n, 3), NaN where not known."""
    if origin is None:
        return np.array([record.local_m or (np.nan,) * 3 for record in records]).reshape(-1, 3)
    geodetic = np.full((len(records), 3), np.nan)
    for row, (record, height) in enumerate(zip(records, heights_m, strict=True)):
        if record.position is not None and height is not None:
            geodetic[row] = record.position.latitude_deg, record.position.longitude_deg, height
    return origin.enu_from_geodetic(*geodetic.T)


def _attitudes(records: Sequence[PhotoRecord], origin: LocalFrame | None) -> tuple[Floats, Floats]:
    """Quaternions enu_from_cam at the origin, (n, 4), and angles at the camera, (n, 3) deg; NaN where unknown."""
    logged = np.full((len(records), 3), np.nan)
    for row, record in enumerate(records):
        if record.attitude is not None:
            logged[row] = record.attitude.yaw_deg, record.attitude.pitch_deg, record.attitude.roll_deg
    rotations = enu_from_cam(*np.radians(logged).T)
    known = np.isfinite(logged[:, 0])
    angles = np.full((len(records), 3), np.nan)
    angles[known] = np.degrees(gimbal_angles(rotations[known]))
    if origin is not None:
        # North turns along the flight: the gimbal's is that of the camera's own place.
        for row, record in enumerate(records):
            if known[row] and record.position is not None:
                here = LocalFrame(record.position.latitude_deg, record.position.longitude_deg, 0.0)
                rotations[row] = origin.rotation_ecef_from_enu.T @ here.rotation_ecef_from_enu @ rotations[row]
    quaternions = np.full((len(records), 4), np.nan)
    quaternions[known] = quaternion_from_rotation(rotations[known])
    return quaternions, angles


def _identity(record: PhotoRecord, camera_id: str, root: str, clock_offset_s: float) -> dict[str, Any]:
    # Marks and logs have clocks of their own; the user's offset is for the camera's.
    own_clock = record.time is not None and record.time_source != "mrk" and not record.time_source.startswith("log ")
    sources = [part.source for part in (record.position, record.attitude) if part is not None]
    return {
        "frame_id": record.frame_id,
        "image": relative_to(record.location, root),
        "image_sha256": record.sha256,
        "camera_id": camera_id,
        "time": record.time + timedelta(seconds=clock_offset_s) if own_clock and record.time else record.time,
        "time_source": record.time_source,
        "latitude_deg": record.position.latitude_deg if record.position else None,
        "longitude_deg": record.position.longitude_deg if record.position else None,
        "above_takeoff_m": record.relative_m,
        "pose_source": ", ".join(dict.fromkeys(sources)),
        "usable": not record.problem,
        "problem": record.problem or "; ".join(record.notes),
    }


def _sigmas(record: PhotoRecord, datum: str, stated: LoggedSigmas | None) -> dict[str, float]:
    if record.problem:
        return {}
    sigmas = widened(stated or pose_sigmas(record.model, record.fix, datum), record.timing)
    return {
        **{f"sigma_{axis}_m": sigmas.position_m[k] for k, axis in enumerate(_AXES)},
        **{f"sigma_{angle}_deg": sigmas.attitude_deg[k] for k, angle in enumerate(_ANGLES)},
        **{f"own_sigma_{axis}_m": sigmas.own_position_m[k] for k, axis in enumerate(_AXES)},
        **{f"own_sigma_{angle}_deg": sigmas.own_attitude_deg[k] for k, angle in enumerate(_ANGLES)},
    }


def _cameras(records: Sequence[PhotoRecord]) -> tuple[list[str], pa.Table]:
    """One camera per maker, model, size and intrinsics; its name says the first three, a digest the rest."""
    rows: dict[str, dict[str, Any]] = {}
    names: list[str] = []
    for record in records:
        if record.camera is None:
            names.append("")
            continue
        camera = record.camera.camera
        values = (camera.model, camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
        digest = hashlib.sha256(repr((record.make, *values)).encode()).hexdigest()[:6]
        name = f"{record.model.replace(' ', '-') or 'camera'}-{camera.width}x{camera.height}-{digest}"
        names.append(name)
        rows.setdefault(
            name,
            {
                "camera_id": name,
                "model": camera.model,
                "width": camera.width,
                "height": camera.height,
                "fx": camera.fx,
                "fy": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "distortion": list(camera.distortion),
                "source": record.camera.source,
            },
        )
    return names, CAMERAS.from_rows(rows[name] for name in sorted(rows))


def _tracks(records: Sequence[PhotoRecord], marks: Sequence[MarkFile], root: str) -> pa.Table:
    """What photos and marks logged, untouched."""
    rows: list[dict[str, Any]] = []
    for record in records:
        if record.position is None and record.attitude is None:
            continue
        datum = datums.own_datum(record)
        rows.append(
            {
                "source": relative_to(record.location, root),
                "stream": "photo",
                "what": "camera",
                "time": record.time,
                "latitude_deg": record.position.latitude_deg if record.position else None,
                "longitude_deg": record.position.longitude_deg if record.position else None,
                "height_m": record.relative_m if datum == TAKEOFF else record.absolute_m,
                "height_datum": datum,
                "yaw_deg": record.attitude.yaw_deg if record.attitude else None,
                "pitch_deg": record.attitude.pitch_deg if record.attitude else None,
                "roll_deg": record.attitude.roll_deg if record.attitude else None,
            }
        )
    rows.extend(
        {
            "source": relative_to(file.location, root),
            "stream": "mrk",
            "what": "camera",
            "time": mark.time,
            "latitude_deg": mark.latitude_deg,
            "longitude_deg": mark.longitude_deg,
            "height_m": mark.height_m,
            "height_datum": ELLIPSOIDAL,
        }
        for file in marks
        for mark in file.marks
    )
    return TRACKS.from_rows(rows)


def _clocks(
    records: Sequence[PhotoRecord],
    found: Exposures,
    root: str,
    clock_offset_s: float,
    log_clocks: Sequence[Mapping[str, Any]],
) -> pa.Table:
    """One row for the photos' own clock, one per mark file, and those of the logs."""
    own = [record for record in records if not record.time_source.startswith("log ")]
    kinds = Counter(record.time_source for record in own if record.time is not None)
    source = min(kinds, key=lambda kind: (-kinds[kind], kind)) if kinds else ""
    unknown_zone = kinds["exif (zone unknown)"]
    said = f"{source}, read as UTC" if source == "exif (zone unknown)" else source
    problem = (
        f"{unknown_zone} photos say no time zone: their time is the camera's local time"
        if unknown_zone and not clock_offset_s
        else ""
    )
    rows: list[dict[str, Any]] = [dict(row) for row in log_clocks]
    photos: dict[str, Any] = {
        "clock_id": "photos",
        "source": "photos",
        "method": f"{said}, {clock_offset_s:+g} s stated by the user" if clock_offset_s else said or "no times",
        "offset_s": clock_offset_s,
        "sigma_s": _PHOTO_CLOCK_SIGMA_S if kinds and not unknown_zone else None,
        "drift_ppm": 0.0,
        "residual_s": None,
        "anchors": 0,
        "problem": problem,
    }
    if own or not log_clocks:
        rows.insert(0, photos)
    for location in sorted({*found.used, *found.problems}):
        offset_s = found.offset_s.get(location)
        beside = f"; photos are {-offset_s:+g} s from it" if offset_s is not None else ""
        rows.append(
            {
                "clock_id": relative_to(location, root),
                "source": "mrk",
                "method": f"GPS week and second, leap seconds by date{beside}",
                "offset_s": 0.0,
                "sigma_s": 0.001,
                "drift_ppm": 0.0,
                "residual_s": found.residual_s.get(location),
                "anchors": found.used.get(location, 0),
                "problem": found.problems.get(location, ""),
            }
        )
    return CLOCKS.from_rows(rows)
