"""Positions in MAVLink: the navigation filter's and the bare receivers'.

Source: https://mavlink.io/en/messages/common.html (GLOBAL_POSITION_INT, GPS_RAW_INT, GPS2_RAW).
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.sources.mavlink.clock import (
    UNIX_FROM_US,
    BootClock,
    log_from_utc,
    orderly,
)
from pipeline.sources.mavlink.frames import LATEST_STAMP_US, Rows
from pipeline.sources.records import NS_PER_MS, NS_PER_S, NS_PER_US, Nanoseconds, Positions, TimeBase, nothing
from pipeline.sources.streams import FIX_3D, MM_PER_M, PER_DEG, borrowed, is_place, segments, separation_m

# A receiver's time this far from its message's arrival is of another clock.
_OTHER_CLOCK_NS = 5_000_000_000
# No aircraft climbs like this: ArduPilot tells heights above its start until it knows the place, then above the sea.
_LEAP_M, _LEAP_M_S = 5.0, 50.0


def receiver_positions(
    rows: Rows, name: str, clock: BootClock, base: TimeBase
) -> tuple[Positions | None, tuple[str, ...]]:
    """Positions of a bare GNSS receiver.

    Args:
        rows: GPS_RAW_INT or GPS2_RAW.
        name: Which.
        clock: The autopilot's boot.
        base: Its time base.

    Returns:
        The stream, None without a fix; and what was left out.
    """
    fixed = (rows["fix_type"] >= FIX_3D) & _somewhere(rows)
    lost = len(rows) - int(np.count_nonzero(fixed))
    if lost == len(rows):
        return None, (f"no GPS fix: none of {lost} {name} messages has one",)
    # No interpolation across a lost fix.
    outages = np.cumsum(~fixed, dtype=np.int64)
    time_ns = _receiver_time(rows, clock, base)
    index = np.flatnonzero(fixed)
    index = index[orderly(rows["at"][index], time_ns[index])]
    time_ns = time_ns[index]
    stream = Positions(
        name,
        time_ns,
        rows["lat"][index] / PER_DEG,
        rows["lon"][index] / PER_DEG,
        _known(rows["alt_ellipsoid"][index]),
        rows["alt"][index] / MM_PER_M,
        nothing(len(index)),
        nothing(len(index)),
        _known(rows["h_acc"][index]),
        _known(rows["v_acc"][index]),
        segments(time_ns, outages[index]),
        fused=False,
    )
    return stream, (f"{lost} {name} messages without a 3D fix were left out",) if lost else ()


def fused_positions(rows: Rows, receivers: tuple[Positions, ...]) -> tuple[Positions | None, tuple[str, ...]]:
    """Positions of the autopilot's navigation filter.

    Args:
        rows: GLOBAL_POSITION_INT.
        receivers: The receivers' positions, for the geoid's separation and for sigmas, which the message lacks.

    Returns:
        The stream, None without a position; and what was left out.
    """
    index = np.flatnonzero(_somewhere(rows))
    lost = len(rows) - len(index)
    time_ns = rows["time_boot_ms"].astype(np.int64) * NS_PER_MS
    index = index[orderly(rows["at"][index], time_ns[index])]
    losses = (f"{lost} GLOBAL_POSITION_INT messages without a position (0, 0) were left out",) if lost else ()
    if not len(index):
        return None, losses
    time_ns, amsl_m = time_ns[index], rows["alt"][index] / MM_PER_M
    stream = Positions(
        "GLOBAL_POSITION_INT",
        time_ns,
        rows["lat"][index] / PER_DEG,
        rows["lon"][index] / PER_DEG,
        amsl_m + borrowed(receivers, separation_m, time_ns),
        amsl_m,
        rows["relative_alt"][index] / MM_PER_M,
        nothing(len(index)),
        borrowed(receivers, lambda receiver: receiver.sigma_horizontal_m, time_ns),
        borrowed(receivers, lambda receiver: receiver.sigma_vertical_m, time_ns),
        segments(time_ns, _leaps(time_ns, amsl_m)),
        fused=True,
    )
    return stream, losses


def _leaps(time_ns: Nanoseconds, height_m: Floats) -> Ints:
    """How often the height has leapt so far, (n,)."""
    most_m = _LEAP_M + _LEAP_M_S * np.diff(time_ns, prepend=time_ns[0]) / NS_PER_S
    leapt = np.abs(np.diff(height_m, prepend=height_m[0])) > most_m
    return np.cumsum(leapt, dtype=np.int64)


def _somewhere(rows: Rows) -> Bools:
    """Rows whose position is one: not the (0, 0) of an autopilot that does not know, and on the globe."""
    return is_place(rows["lat"] / PER_DEG, rows["lon"] / PER_DEG)


def _receiver_time(rows: Rows, clock: BootClock, base: TimeBase) -> Nanoseconds:
    """Boot time of a receiver's messages, whose own time counts from 1970 or from boot, or is 0."""
    arrival_ns = clock.of_arrival(rows)
    usec = rows["time_usec"]
    dated = (usec >= UNIX_FROM_US) & (usec < LATEST_STAMP_US)
    since_boot = (usec > 0) & (usec < UNIX_FROM_US)
    time_ns = arrival_ns.copy()
    time_ns[since_boot] = usec[since_boot].astype(np.int64) * NS_PER_US
    time_ns[dated] = log_from_utc(base, usec[dated].astype(np.int64) * NS_PER_US)
    out: Nanoseconds = np.where(np.abs(time_ns - arrival_ns) <= _OTHER_CLOCK_NS, time_ns, arrival_ns)
    return out


def _known(millimetres: np.ndarray) -> Floats:
    """Metres; NaN for 0, by which MAVLink says that it does not know."""
    out: Floats = np.where(millimetres == 0, np.nan, millimetres / MM_PER_M)
    return out
