"""What readers of several formats do alike with streams: order, breaks, other instants, heights, angles."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable

import numpy as np

from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints
from pipeline.geometry.rotations import ned_from_frd, quaternion_from_rotation
from pipeline.sources.records import Nanoseconds, Positions, nothing

# Integers of autopilots: 1e-7 deg and mm. They divide, since the quotient is the float nearest to the decimal number.
PER_DEG = 1e7
MM_PER_M = 1e3
# Autopilots number the kinds of fix alike (MAVLink's GPS_FIX_TYPE): below this there is no height, or no fix.
FIX_3D = 3
# Of an exposure that the camera reported by its hot shoe, and of one that was only commanded: the shutter follows by a
# lag that no log holds.
FEEDBACK_SIGMA_S, TRIGGER_SIGMA_S = 0.001, 0.05
# Geoid and ellipsoid are nowhere further apart (EGM 2008: -107 .. 86 m); more is another unit, or damage.
LARGEST_SEPARATION_M = 120.0
# A quaternion in single precision is nearer to a unit one than this; what is not is damaged, or says "unknown".
_NOT_UNIT = 0.05
# Rotations are made of so many samples at a time: as matrices they take ten times the memory of their quaternions.
_AT_ONCE = 1 << 16


def in_order(time_ns: Nanoseconds) -> Bools:
    """Which samples to keep so that time never runs backwards: the longest such run, (n,).

    One flipped bit far in the future would otherwise discard all that follows it.

    Args:
        time_ns: (n,).

    Returns:
        (n,) True for samples to keep; all True for what is in order already.

    Source: Fredman, "On computing the length of longest increasing subsequences" (1975): patience sorting.
    """
    n = len(time_ns)
    kept = np.ones(n, np.bool_)
    if n < 2 or bool(np.all(np.diff(time_ns) >= 0)):
        return kept
    tails: list[int] = []
    ends: list[int] = []
    before = np.full(n, -1, np.int64)
    for index, value in enumerate(time_ns.tolist()):
        place = bisect_right(tails, value)
        before[index] = ends[place - 1] if place else -1
        if place == len(tails):
            tails.append(value)
            ends.append(index)
        else:
            tails[place], ends[place] = value, index
    kept[:] = False
    at = ends[-1]
    while at >= 0:
        kept[at] = True
        at = int(before[at])
    return kept


def segments(time_ns: Nanoseconds, counters: Ints | None = None) -> Ints:
    """Segment numbers, (n,): a new one wherever a reset counter changes.

    Args:
        time_ns: (n,), for its length.
        counters: (n,) reset counter of each sample, or None for one segment.

    Returns:
        (n,).
    """
    out = np.zeros(len(time_ns), np.int64)
    if counters is not None and len(time_ns) > 1:
        out[1:] = np.cumsum(np.diff(counters) != 0)
    return out


def is_place(latitude_deg: Floats, longitude_deg: Floats) -> Bools:
    """Which coordinates are a place on earth, (n,); zeros are logged before there is a position.

    Args:
        latitude_deg: (n,).
        longitude_deg: (n,).
    """
    inside = (np.abs(latitude_deg) <= 90.0) & (np.abs(longitude_deg) <= 180.0)
    out: Bools = inside & ((latitude_deg != 0.0) | (longitude_deg != 0.0))
    return out


def interpolated(time_ns: Nanoseconds, values: Floats, wanted_ns: Nanoseconds, *, ends_hold: bool) -> Floats:
    """Values of one stream at the instants of another.

    Args:
        time_ns: (n,) in order.
        values: (n,); those that are NaN are passed over.
        wanted_ns: (m,).
        ends_hold: Whether the first and last value hold before and after; NaN there otherwise.

    Returns:
        (m,) NaN where there is nothing to interpolate.
    """
    known = np.isfinite(values)
    if not known.any():
        return nothing(len(wanted_ns))
    ends = {} if ends_hold else {"left": np.nan, "right": np.nan}
    return np.asarray(np.interp(wanted_ns, time_ns[known], values[known], **ends), np.float64)


def borrowed(receivers: Iterable[Positions], quantity: Callable[[Positions], Floats], wanted_ns: Nanoseconds) -> Floats:
    """What a filter's message lacks and a receiver's has, by the first receiver that tells it.

    Args:
        receivers: The receivers' positions, the primary first.
        quantity: Takes (n,) values out of a stream, NaN where it does not tell.
        wanted_ns: (m,) instants of the filter.

    Returns:
        (m,) interpolated, its ends held: separations and sigmas change little over a flight; NaN where none tells.
    """
    told = ((receiver.time_ns, quantity(receiver)) for receiver in receivers)
    found = next(((time_ns, values) for time_ns, values in told if np.isfinite(values).any()), None)
    return nothing(len(wanted_ns)) if found is None else interpolated(*found, wanted_ns, ends_hold=True)


def separation_m(receiver: Positions) -> Floats:
    """Height of the receiver's own sea level above the ellipsoid, (n,) m; NaN where it does not tell.

    Whichever geoid it is of: added to a height above sea level of the same vehicle, it undoes what was subtracted.
    """
    apart_m = receiver.ellipsoidal_m - receiver.amsl_m
    return np.where(np.abs(apart_m) <= LARGEST_SEPARATION_M, apart_m, np.nan)


def ned_quaternions(yaw_rad: AnyArray, pitch_rad: AnyArray, roll_rad: AnyArray) -> Floats:
    """Rotations ned_from_frd of yaw, pitch and roll, intrinsic ZYX.

    Args:
        yaw_rad: (n,) clockwise from the first axis of the frame, seen from above.
        pitch_rad: (n,) nose up.
        roll_rad: (n,) right side down.

    Returns:
        (n, 4) unit quaternions, w first; NaN where an angle is no finite number.
    """
    q_wxyz = np.empty((len(yaw_rad), 4))
    for begin in range(0, len(yaw_rad), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        angles = np.stack([angle[part] for angle in (yaw_rad, pitch_rad, roll_rad)]).astype(np.float64)
        angles[~np.isfinite(angles)] = np.nan
        q_wxyz[part] = quaternion_from_rotation(ned_from_frd(*angles))
    return q_wxyz


def is_rotation(q: AnyArray) -> Bools:
    """Which rows of (n, 4) are nearly unit quaternions, (n,)."""
    with np.errstate(over="ignore", invalid="ignore"):
        out: Bools = np.abs(np.linalg.norm(q, axis=-1) - 1.0) <= _NOT_UNIT
    return out


def unit(q: AnyArray) -> Floats:
    """Quaternions of length one, (n, 4), of such that nearly are."""
    q = np.asarray(q, np.float64)
    out: Floats = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return out
