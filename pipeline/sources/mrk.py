"""RTK exposure marks (.MRK): one line per photo with GPS time, position after lever arm, and sigmas."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from pipeline.engine.errors import InputError

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
# The first instant of each GPS - UTC difference since 2005, seconds (IERS Bulletin C 30, 36, 43, 49, 52).
LEAP_SECONDS = (
    (datetime(2017, 1, 1, tzinfo=UTC), 18),
    (datetime(2015, 7, 1, tzinfo=UTC), 17),
    (datetime(2012, 7, 1, tzinfo=UTC), 16),
    (datetime(2009, 1, 1, tzinfo=UTC), 15),
    (datetime(2006, 1, 1, tzinfo=UTC), 14),
)
_WEEK_S = 604_800.0
_ROLL_OVER_WEEKS = 1024
# No drone wrote marks before this; an earlier week has lost a roll-over of the 10-bit week number.
_EARLIEST = datetime(2010, 1, 1, tzinfo=UTC)
_MAX_BYTES = 64 << 20
_NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_LABELLED = re.compile(rf"({_NUMBER})\s*,\s*([A-Za-z]+)\b")
_SIGMAS = re.compile(rf"({_NUMBER})\s*,\s*({_NUMBER})\s*,\s*({_NUMBER})(?![\d.])(?!\s*,\s*[A-Za-z])")
_HEAD = re.compile(rf"^\s*(\d+)\s+({_NUMBER})\s+\[\s*(\d+)\s*\]")


@dataclass(frozen=True, slots=True)
class Mark:
    """One exposure.

    Args:
        index: Number of the photo in its folder, as the file says.
        time: Exposure, UTC.
        latitude_deg: Camera centre, deg, lever arm applied.
        longitude_deg: Camera centre, deg, lever arm applied.
        height_m: Ellipsoidal height of the camera centre, m.
        sigma_north_m: One sigma, m.
        sigma_east_m: One sigma, m.
        sigma_up_m: One sigma, m.
        quality: Fix: 0 none, 16 single, 34 float, 50 fixed.
    """

    index: int
    time: datetime
    latitude_deg: float
    longitude_deg: float
    height_m: float
    sigma_north_m: float
    sigma_east_m: float
    sigma_up_m: float
    quality: int


def utc_from_gps(week: int, tow_s: float) -> datetime:
    """UTC of a GPS week and time of week; a week that lost roll-overs of 1024 weeks gets them back.

    Args:
        week: GPS week, since 1980-01-06.
        tow_s: Seconds of the week.

    Returns:
        UTC to the microsecond.

    Raises:
        ValueError: Not a time of week, or past the year 9999.
    """
    if not 0.0 <= tow_s < _WEEK_S + 1.0:
        raise ValueError(f"{tow_s} is not a time of week")
    if not 0 <= week < 400_000:
        raise ValueError(f"{week} is not a GPS week")
    gps = GPS_EPOCH + timedelta(weeks=week, seconds=tow_s)
    while gps < _EARLIEST:
        gps += timedelta(weeks=_ROLL_OVER_WEEKS)
    return gps - timedelta(seconds=leap_seconds(gps))


def leap_seconds(gps: datetime) -> int:
    """GPS minus UTC at a moment of GPS time, whole seconds."""
    for since, seconds in LEAP_SECONDS:
        if gps >= since + timedelta(seconds=seconds):
            return seconds
    raise ValueError(f"{gps:%Y-%m-%d} is before the table of leap seconds")


def read_marks(data: bytes, where: str = "") -> list[Mark]:
    """Reads a .MRK file. Values are found by their labels: documents differ in the order of latitude and longitude.

    Args:
        data: The file's bytes.
        where: The file's name, for messages.

    Returns:
        The exposures in the file's order.

    Raises:
        InputError: A line is not an exposure, or the file has none.

    Source: DJI Zenmuse P1 user manual, "Timestamp .MRK file".
    """
    if len(data) > _MAX_BYTES:
        raise _wrong(where, f"{len(data)} bytes", f"at most {_MAX_BYTES} bytes")
    lines = data.decode("utf-8-sig", "replace").splitlines()
    marks = [_mark(line, f"{where}:{n}") for n, line in enumerate(lines, 1) if line.strip(" \t\x00")]
    if not marks:
        raise _wrong(where, "an empty file", "one line per exposure")
    return marks


def _mark(line: str, where: str) -> Mark:
    head = _HEAD.match(line)
    rest = line[head.end() :] if head else line
    labelled = {label.lower(): float(value) for value, label in _LABELLED.findall(rest)}
    sigmas = _SIGMAS.search(rest)
    if head is None or sigmas is None or not {"lat", "lon", "ellh"} <= labelled.keys():
        raise _wrong(where, line.strip()[:120], "index, seconds, [week], N, E, V, Lat, Lon, Ellh, three sigmas, Q")
    try:
        time = utc_from_gps(int(head[3]), float(head[2]))
        north, east, up = (float(value) for value in sigmas.groups())
        mark = Mark(
            int(head[1]), time, labelled["lat"], labelled["lon"], labelled["ellh"], north, east, up,
            int(labelled.get("q", 0.0)),
        )  # fmt: skip
    except (ValueError, OverflowError) as error:
        raise _wrong(where, str(error), "a GPS time and finite numbers") from error
    numbers = (mark.latitude_deg, mark.longitude_deg, mark.height_m, north, east, up)
    if (
        not all(math.isfinite(value) for value in numbers)
        or abs(mark.latitude_deg) > 90
        or abs(mark.longitude_deg) > 180
    ):
        raise _wrong(where, line.strip()[:120], "finite coordinates in degrees")
    return mark


def _wrong(where: str, found: str, expected: str) -> InputError:
    return InputError(
        "E-MRK-01", "the RTK mark file cannot be read", where=where, found=found, expected=expected,
        hint="copy it again from the card, or move it out of the photo folder",
    )  # fmt: skip
