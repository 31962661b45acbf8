"""From tags to a pose: position, attitude, heights, fix and time of a DJI still, with the traps of its formats.

Source of the tag meanings: DJI user manuals (Mavic 3E/3T, Matrice 4, Zenmuse P1: "XMP" pages) and ExifTool's DJI.pm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from pipeline.sources.exif import Exif, utc_offset
from pipeline.sources.xmp import Xmp

RTK_SINGLE, RTK_FLOAT, RTK_FIXED = 16, 32, 50
# EXIF and XMP of an untouched photo agree to the rounding of both, some 2e-8 deg; further apart one was edited later.
_SAME_POSITION_DEG = 3e-7
_LATITUDE = ("GpsLatitude", "Latitude")
# DJI's own misspelling is in millions of files.
_LONGITUDE = ("GpsLongitude", "GpsLongtitude", "Longitude", "Longtitude")
_GIMBAL = ("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree")
_FLIGHT = ("FlightYawDegree", "FlightPitchDegree", "FlightRollDegree")
# Viewers whose only edit is a turn: what they wrote has pixels turned against the gimbal's attitude.
_ROTATING_VIEWERS = ("windows photo viewer", "windows photo gallery", "windows picture and fax viewer")


@dataclass(frozen=True, slots=True)
class Position:
    """Where the camera was: degrees on WGS 84, which tags say so, and what to distrust."""

    latitude_deg: float
    longitude_deg: float
    source: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class Attitude:
    """The optical axis in degrees, yaw from true north, and which tags say so."""

    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    source: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class Fix:
    """The quality of the position: DJI's RTK flag (None without RTK) and sigmas in m."""

    rtk_flag: int | None = None
    sigma_east_m: float | None = None
    sigma_north_m: float | None = None
    sigma_up_m: float | None = None
    sigma_horizontal_m: float | None = None
    sigma_vertical_m: float | None = None


class Unusable(ValueError):  # noqa: N818 - a verdict on one photo, not an error of the program
    """A photo cannot be placed; the text gives the reason and the remedy."""


def number(xmp: Xmp, *names: str) -> float | None:
    """The first of several spellings of a tag that holds a finite number; "+" and "-" prefixes are allowed."""
    for name in names:
        try:
            value = float(xmp.dji.get(name, ""))
        except ValueError:
            continue
        if math.isfinite(value):
            return value
    return None


def position(exif: Exif, xmp: Xmp) -> Position:
    """The camera's latitude and longitude.

    XMP values may lack their sign: the hemisphere is EXIF's reference where there is one. Without, a bare value is
    positive.

    Raises:
        Unusable: No position, (0, 0), or not on earth.
    """
    latitude = _signed(number(xmp, *_LATITUDE), exif.latitude_ref, "S")
    longitude = _signed(number(xmp, *_LONGITUDE), exif.longitude_ref, "W")
    found, source, note = (latitude, longitude), "xmp position", ""
    if exif.latitude_deg is not None and exif.longitude_deg is not None:
        given = (exif.latitude_deg, exif.longitude_deg)
        apart = max(abs(a - b) if a is not None else math.inf for a, b in zip(found, given, strict=True))
        if apart > _SAME_POSITION_DEG:
            # Whoever corrects positions afterwards (PPK) writes EXIF; XMP then still holds the first one.
            if math.isfinite(apart):
                note = f"EXIF and XMP positions differ by {apart * 111_000:.2f} m: EXIF is used"
            found, source = given, "exif position"
    if found[0] is None or found[1] is None:
        raise Unusable("no GPS position in EXIF or XMP: use the original files, or a log beside them")
    if abs(found[0]) < 1e-9 and abs(found[1]) < 1e-9:
        raise Unusable("the GPS position is (0, 0), the receiver had no fix: leave the photo out")
    if abs(found[0]) > 90.0 or abs(found[1]) > 180.0:
        raise Unusable(f"the GPS position ({found[0]:.6f}, {found[1]:.6f}) is not on earth: use the original file")
    if xmp.dji.get("GpsStatus", "").lower() == "invalid":
        raise Unusable("GpsStatus is Invalid, the receiver had no fix: leave the photo out")
    return Position(found[0], found[1], source, note)


def attitude(exif: Exif, xmp: Xmp) -> Attitude:
    """The gimbal's attitude, against the horizon and true north, rotation order yaw, pitch, roll.

    Roll 180 with yaw turned (a gimbal that looks backwards) is a rotation like any other: nothing is changed.

    Raises:
        Unusable: Only the aircraft's attitude is there, or none. FlightYaw is not the camera's yaw.
    """
    values = [number(xmp, name) for name in _GIMBAL]
    if all(value is not None for value in values):
        yaw, pitch, roll = (value for value in values if value is not None)
        return _checked(yaw, pitch, roll, "xmp gimbal")
    if exif.camera_attitude_deg is not None:
        found = _checked(*exif.camera_attitude_deg, "makernotes camera attitude")
        if found.yaw_deg == found.pitch_deg == found.roll_deg == 0.0:
            return Attitude(0.0, 0.0, 0.0, found.source, "the MakerNotes' camera attitude is exactly 0, 0, 0")
        return found
    aircraft = number(xmp, _FLIGHT[0])
    if aircraft is None and exif.aircraft_attitude_deg is not None:
        aircraft = exif.aircraft_attitude_deg[0]
    if aircraft is not None:
        raise Unusable(
            f"no gimbal attitude: only the aircraft's is known (yaw {aircraft:.1f} deg), which is not the camera's: "
            "use the original files with their XMP"
        )
    raise Unusable("no camera attitude in XMP or MakerNotes: use the original files, exported copies lose it")


def rewritten(exif: Exif, xmp: Xmp) -> str:
    """Why the pixels cannot be trusted to be as the camera stored them; empty when nothing was found."""
    for tool in (xmp.creator_tool, exif.software):
        if any(viewer in tool.lower() for viewer in _ROTATING_VIEWERS):
            return (
                f"rewritten by {tool}, whose only edit is to turn pictures: the pixels no longer fit the gimbal "
                "attitude: use the original file, or turn it back with a tool that leaves the tags as they were"
            )
    return ""


def fix(exif: Exif, xmp: Xmp) -> Fix:
    """Quality flag and sigmas of the position as logged; sigmas that are zero or negative are none."""
    flag = number(xmp, "RtkFlag")
    return Fix(
        int(flag) if flag is not None else None,
        _positive(number(xmp, "RtkStdLon")),
        _positive(number(xmp, "RtkStdLat")),
        _positive(number(xmp, "RtkStdHgt")),
        exif.horizontal_error_m,
    )


def exposure_time(exif: Exif, xmp: Xmp) -> tuple[datetime | None, str]:
    """The exposure in UTC and where it comes from.

    Without a zone the camera's clock is read as UTC, and the source says so; a GPS time stamp tells the zone.
    """
    stated = _iso(xmp.dji.get("UTCAtExposure", ""))
    if stated is not None:
        return stated, "utc_at_exposure"
    if exif.taken is None:
        return (exif.gps_time, "gps") if exif.gps_time is not None else (None, "")
    if exif.taken.tzinfo is not None:
        return exif.taken.astimezone(UTC), "exif+offset"
    local = exif.taken.replace(tzinfo=UTC)
    if exif.gps_time is not None:
        # Zones are whole quarters of an hour; what is left over is the camera clock's own error.
        quarters = round((local - exif.gps_time).total_seconds() / 900.0)
        rest = abs((local - exif.gps_time).total_seconds() - 900.0 * quarters)
        if rest < 120.0 and abs(quarters) <= 56:
            return local - timedelta(seconds=900 * quarters), "exif+gps zone"
    return local, "exif (zone unknown)"


def _signed(value: float | None, reference: str, negative: str) -> float | None:
    if value is None or not reference:
        return value
    return -abs(value) if reference == negative else abs(value)


def _checked(yaw: float, pitch: float, roll: float, source: str) -> Attitude:
    if abs(pitch) > 180.0 or abs(yaw) > 360.0 or abs(roll) > 360.0:
        raise Unusable(f"the gimbal attitude ({yaw:g}, {pitch:g}, {roll:g}) deg is not one: use the original file")
    return Attitude(yaw, pitch, roll, source)


def _positive(value: float | None) -> float | None:
    return value if value is not None and value > 0.0 else None


def _iso(text: str) -> datetime | None:
    text = text.strip()
    if len(text) >= 6 and (zone := utc_offset(text[-6:])) is not None:
        text, stated = text[:-6], zone
    else:
        stated = UTC
        text = text.removesuffix("Z")
    try:
        return datetime.fromisoformat(text).replace(tzinfo=stated).astimezone(UTC)
    except (ValueError, OverflowError):
        return None
