"""EXIF, GPS and DJI MakerNotes tags as typed values; NaN, zero denominators and nonsense become None."""

from __future__ import annotations

import io
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from typing import Any, cast

import exifread

# exifread reports odd tags through logging; without a handler Python would print them on stderr for every photo.
logging.getLogger("exifread").addHandler(logging.NullHandler())

Tags = Mapping[str, Any]
# A photo's tags take some thousand reads, its MakerNotes up to 65,536; a damaged count asks for four thousand million.
_MOST_READS = 300_000


@dataclass(frozen=True, slots=True)
class Exif:
    """What an image's EXIF says; None where it says nothing that can be used.

    Args:
        make: Maker's name.
        model: Model's name.
        software: Firmware, or the program that last wrote the file.
        orientation: EXIF orientation, 1 as stored.
        taken: DateTimeOriginal with fractions and, where OffsetTime says it, its zone.
        gps_time: GPS date and time stamp, UTC.
        latitude_deg: Signed latitude.
        longitude_deg: Signed longitude.
        latitude_ref: "N" or "S", empty where absent.
        longitude_ref: "E" or "W", empty where absent.
        altitude_m: Signed GPS altitude, m.
        horizontal_error_m: GPSHPositioningError, m.
        focal_mm: Focal length, mm.
        focal_35mm: Focal length in 35 mm equivalent, mm.
        digital_zoom: Digital zoom ratio, 1 for none.
        pixel_size: Width and height as EXIF says, px; those of the original where a copy was resampled.
        camera_attitude_deg: Yaw, pitch, roll of the gimbal from the MakerNotes, deg.
        aircraft_attitude_deg: Yaw, pitch, roll of the aircraft from the MakerNotes, deg.
    """

    make: str = ""
    model: str = ""
    software: str = ""
    orientation: int = 1
    taken: datetime | None = None
    gps_time: datetime | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    latitude_ref: str = ""
    longitude_ref: str = ""
    altitude_m: float | None = None
    horizontal_error_m: float | None = None
    focal_mm: float | None = None
    focal_35mm: float | None = None
    digital_zoom: float = 1.0
    pixel_size: tuple[int, int] | None = None
    camera_attitude_deg: tuple[float, float, float] | None = None
    aircraft_attitude_deg: tuple[float, float, float] | None = None


def read_exif(data: bytes) -> Exif:
    """Reads the tags of an image file.

    Args:
        data: The file's bytes.

    Returns:
        The tags; an empty record where there are none.

    Raises:
        ValueError: The tags are damaged; the library raises other exceptions, too.

    Source: CIPA DC-008 (EXIF 2.32); DJI MakerNotes tags 3 to 11 as ExifTool's DJI.pm names them.
    """
    tags: Tags = exifread.process_file(_Stream(data), details=True, extract_thumbnail=False)
    latitude_ref, longitude_ref = _text(tags, "GPS GPSLatitudeRef").upper(), _text(tags, "GPS GPSLongitudeRef").upper()
    return Exif(
        make=_text(tags, "Image Make"),
        model=_text(tags, "Image Model"),
        software=_text(tags, "Image Software"),
        orientation=int(_number(tags, "Image Orientation") or 1),
        taken=_taken(tags),
        gps_time=_gps_time(tags),
        latitude_deg=_degrees(tags, "GPS GPSLatitude", latitude_ref),
        longitude_deg=_degrees(tags, "GPS GPSLongitude", longitude_ref),
        latitude_ref=latitude_ref[:1],
        longitude_ref=longitude_ref[:1],
        altitude_m=_altitude(tags),
        horizontal_error_m=_positive(_number(tags, "GPS GPSHPositioningError", "GPS Tag 0x001F")),
        focal_mm=_positive(_number(tags, "EXIF FocalLength")),
        focal_35mm=_positive(_number(tags, "EXIF FocalLengthIn35mmFilm")),
        digital_zoom=max(1.0, _number(tags, "EXIF DigitalZoomRatio") or 1.0),
        pixel_size=_pixel_size(tags),
        camera_attitude_deg=_attitude(tags, ("CameraYaw", "CameraPitch", "CameraRoll")),
        aircraft_attitude_deg=_attitude(tags, ("Yaw", "Pitch", "Roll")),
    )


def utc_offset(text: str) -> timezone | None:
    """The zone of an EXIF offset, "+05:30": the sign belongs to hours and minutes alike.

    Args:
        text: As written.

    Returns:
        The zone, or None where the text is not an offset.

    Source: CIPA DC-008 (EXIF 2.31), OffsetTimeOriginal.
    """
    text = text.strip()
    if text in {"Z", "z"}:
        return UTC
    hours, colon, minutes = text[1:].partition(":")
    if text[:1] not in {"+", "-"} or not colon or not (hours.isdecimal() and minutes.isdecimal()):
        return None
    ahead = timedelta(hours=int(hours), minutes=int(minutes))
    return timezone(ahead if text[0] == "+" else -ahead) if ahead < timedelta(hours=24) else None


class _Stream(io.BytesIO):
    """Bytes that refuse to be read forever."""

    _reads = 0

    def read(self, size: int | None = -1, /) -> bytes:
        """As of any stream, so many times."""
        self._reads += 1
        if self._reads > _MOST_READS:
            raise ValueError("a tag's count is longer than a file can be")
        return super().read(size)


def _numbers(tags: Tags, name: str) -> list[float]:
    """Every value of a tag as a float, NaN where it is none."""
    values = getattr(tags.get(name), "values", None)
    if not isinstance(values, list | tuple):
        return []
    return [_float(value) for value in values]


def _float(value: object) -> float:
    # DJI's float tags come as one-element tuples, rationals with a zero denominator as 0/0.
    if isinstance(value, tuple) and len(value) == 1:
        value = value[0]
    try:
        return float(cast("float", value))
    except (TypeError, ValueError, ArithmeticError):
        return math.nan


def _number(tags: Tags, *names: str) -> float | None:
    for name in names:
        if (values := _numbers(tags, name)) and math.isfinite(values[0]):
            return values[0]
    return None


def _positive(value: float | None) -> float | None:
    return value if value is not None and value > 0.0 else None


def _text(tags: Tags, name: str) -> str:
    values = getattr(tags.get(name), "values", "")
    return values.replace("\x00", "").strip() if isinstance(values, str) else ""


def _degrees(tags: Tags, name: str, reference: str) -> float | None:
    values = _numbers(tags, name)
    if len(values) != 3 or not all(math.isfinite(value) for value in values):
        return None
    magnitude = values[0] + values[1] / 60.0 + values[2] / 3600.0
    return -magnitude if reference[:1] in {"S", "W"} else magnitude


def _altitude(tags: Tags) -> float | None:
    value = _number(tags, "GPS GPSAltitude")
    # EXIF's altitude is unsigned; its reference 1 means below sea level.
    return -value if value is not None and _number(tags, "GPS GPSAltitudeRef") == 1.0 else value


def _attitude(tags: Tags, names: tuple[str, str, str]) -> tuple[float, float, float] | None:
    values = [_number(tags, f"MakerNote {name}") for name in names]
    if any(value is None for value in values):
        return None
    # Single precision in the file, written in tenths of a degree.
    yaw, pitch, roll = (round(value, 4) for value in values if value is not None)
    return yaw, pitch, roll


def _pixel_size(tags: Tags) -> tuple[int, int] | None:
    width, height = _number(tags, "EXIF ExifImageWidth"), _number(tags, "EXIF ExifImageLength")
    return (int(width), int(height)) if width and height else None


def _taken(tags: Tags) -> datetime | None:
    moment = _moment(_text(tags, "EXIF DateTimeOriginal")) or _moment(_text(tags, "Image DateTime"))
    if moment is None:
        return None
    digits = "".join(c for c in _text(tags, "EXIF SubSecTimeOriginal") if c.isdecimal())[:6]
    if digits:
        moment = moment.replace(microsecond=int(digits.ljust(6, "0")))
    zone = utc_offset(_text(tags, "EXIF OffsetTimeOriginal") or _text(tags, "EXIF OffsetTime"))
    return moment.replace(tzinfo=zone) if zone is not None else moment


def _moment(text: str) -> datetime | None:
    try:
        return datetime.strptime(text[:19], "%Y:%m:%d %H:%M:%S")  # noqa: DTZ007 - the zone is another tag
    except ValueError:
        return None


def _gps_time(tags: Tags) -> datetime | None:
    values = _numbers(tags, "GPS GPSTimeStamp")
    if len(values) != 3 or not all(math.isfinite(value) for value in values):
        return None
    date = _text(tags, "GPS GPSDate") or _text(tags, "GPS GPSDateStamp")
    try:
        day = datetime.strptime(date[:10].replace("-", ":"), "%Y:%m:%d").replace(tzinfo=UTC)
        return day + timedelta(hours=values[0], minutes=values[1], seconds=values[2])
    except (ValueError, OverflowError):
        return None
