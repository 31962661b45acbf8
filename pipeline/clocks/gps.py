"""GPS week and second to UTC, with a dated table of leap seconds."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import numpy.typing as npt

from pipeline.geometry.arrays import Floats, Ints

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
# The first instant of each GPS - UTC difference since 2005, seconds (IERS Bulletin C 30, 36, 43, 49, 52).
LEAP_SECONDS = (
    (datetime(2017, 1, 1, tzinfo=UTC), 18),
    (datetime(2015, 7, 1, tzinfo=UTC), 17),
    (datetime(2012, 7, 1, tzinfo=UTC), 16),
    (datetime(2009, 1, 1, tzinfo=UTC), 15),
    (datetime(2006, 1, 1, tzinfo=UTC), 14),
)
# Until when the table is known to be whole: the expiry date of the IERS list of 2025-07-07 (Bulletin C 70).
TABLE_HOLDS_UNTIL = datetime(2026, 6, 28, tzinfo=UTC)
_WEEK_S = 604_800.0
_ROLL_OVER_WEEKS = 1024
# No drone logged before this; an earlier week has lost a roll-over of the 10-bit week number.
_EARLIEST = datetime(2010, 1, 1, tzinfo=UTC)
_UNIX_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


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


def utc_ns_from_gps(week: Ints, tow_s: Floats) -> npt.NDArray[np.int64]:
    """As `utc_from_gps` for whole streams.

    Args:
        week: (n,) GPS weeks.
        tow_s: (n,) seconds of the week.

    Returns:
        (n,) ns since 1970, UTC; -1 where the numbers are no GPS time.
    """
    week, tow_s = np.asarray(week, np.int64), np.asarray(tow_s, np.float64)
    out = np.full(len(week), -1, np.int64)
    good = (week > 0) & (week < 5000) & (tow_s >= 0.0) & (tow_s < _WEEK_S + 1.0)
    for number in np.unique(week[good]):
        here = good & (week == number)
        # Leap seconds come at the end of a month, so one can fall within a week: both ends are asked.
        begin, end = utc_from_gps(int(number), 0.0), utc_from_gps(int(number), _WEEK_S - 1e-3)
        start = begin + timedelta(seconds=leap_seconds(begin + timedelta(seconds=20)))
        epoch_ns = round((start - _UNIX_EPOCH).total_seconds()) * 1_000_000_000
        ns = epoch_ns + np.rint(tow_s[here] * 1e9).astype(np.int64)
        seconds = np.full(len(ns), leap_seconds(begin + timedelta(seconds=20)), np.int64)
        if leap_seconds(end + timedelta(seconds=20)) != seconds[0]:
            seconds = np.array([_leap_at(value) for value in ns.tolist()], np.int64)
        out[here] = ns - seconds * 1_000_000_000
    return out


def _leap_at(gps_ns: int) -> int:
    return leap_seconds(_UNIX_EPOCH + timedelta(microseconds=gps_ns // 1000))
