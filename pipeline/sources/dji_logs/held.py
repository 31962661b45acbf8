"""Values that a log repeats until the next measurement: steps made into slopes, repeats left out.

Subtitles are written with every frame while the receiver measures once or ten times a second; interpolated as they
stand, such values would stand still and jump.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.sources.records import NS_PER_S, Nanoseconds


def new_values(columns: Floats, segment: Ints) -> Bools:
    """Which samples say something new: the first of each value, and the first and last of each segment.

    Args:
        columns: (n, c) values that are measured together; NaN is a value of its own.
        segment: (n,) changes where nothing may be carried over.

    Returns:
        (n,).
    """
    n = len(segment)
    out = np.zeros(n, np.bool_)
    if not n:
        return out
    before, after = columns[:-1], columns[1:]
    missing = np.isnan(columns)
    differs = np.any((before != after) & ~(missing[:-1] & missing[1:]), axis=1)
    border = segment[1:] != segment[:-1]
    out[1:] = differs | border
    # The last sample before a border or before a value goes missing ends the slope there.
    out[:-1] |= border | np.any(missing[1:] & ~missing[:-1], axis=1)
    out[[0, -1]] = True
    return out


def sloped(time_ns: Nanoseconds, columns: Floats, segment: Ints) -> Floats:
    """The same columns, straight between the instants at which they took a new value.

    Args:
        time_ns: (n,) in order.
        columns: (n, c) values that are measured together.
        segment: (n,).

    Returns:
        (n, c); unchanged wherever `new_values` is True, NaN wherever the input is.
    """
    out = np.array(columns, np.float64)
    new = new_values(columns, segment)
    seconds = (time_ns - time_ns[:1]) / NS_PER_S
    for c in range(out.shape[1]):
        known = new & np.isfinite(columns[:, c])
        between = ~new & np.isfinite(columns[:, c])
        if known.any() and between.any():
            out[between, c] = np.interp(seconds[between], seconds[known], columns[known, c])
    return out


def sloped_longitude(time_ns: Nanoseconds, longitude_deg: Floats, latitude_deg: Floats, segment: Ints) -> Floats:
    """Longitude and latitude as `sloped`, across the antimeridian too.

    Args:
        time_ns: (n,) in order.
        longitude_deg: (n,) none NaN.
        latitude_deg: (n,) none NaN.
        segment: (n,).

    Returns:
        (n, 2) longitude in [-180, 180], latitude.
    """
    pair = sloped(time_ns, np.stack([np.unwrap(longitude_deg, period=360.0), latitude_deg], axis=1), segment)
    turned = np.abs(pair[:, 0]) > 180.0
    pair[turned, 0] = (pair[turned, 0] + 180.0) % 360.0 - 180.0
    return pair
