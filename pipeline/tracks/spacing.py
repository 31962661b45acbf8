"""Which frames of a video to use: one every so many metres of the way."""

from __future__ import annotations

import math

import numpy as np

from pipeline.geometry.arrays import Floats, Ints

# Steps shorter than this share of the spacing are a receiver's noise rather than way.
_NOISE = 0.1
# Half the spacing as the crow flies: hovering noise alone never earns a frame.
_APART = 0.5


def spaced(positions_enu_m: Floats, spacing_m: float) -> Ints:
    """Frames at a spacing along the way flown.

    Way is summed over steps of at least a tenth of the spacing, so that noise at hover adds none. A frame is taken once
    the way since the last one reaches the spacing and it is at least half the spacing from it in a straight line.

    Args:
        positions_enu_m: (n, 3) of all frames, in the order of time; NaN where not known, such frames are not taken.
        spacing_m: The way between two frames, m.

    Returns:
        (k,) indices, rising; the first known frame is the first.
    """
    points = np.asarray(positions_enu_m, np.float64)
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    if not len(known):
        return np.empty(0, np.int64)
    chosen = [int(known[0])]
    last = corner = tuple(points[known[0]])
    way_m = 0.0
    for index, point in zip(known[1:].tolist(), map(tuple, points[known[1:]].tolist()), strict=True):
        step_m = math.dist(point, corner)
        if way_m + step_m >= spacing_m and math.dist(point, last) >= _APART * spacing_m:
            chosen.append(index)
            last, corner, way_m = point, point, 0.0
        elif step_m >= _NOISE * spacing_m:
            corner, way_m = point, way_m + step_m
    return np.array(chosen, np.int64)
