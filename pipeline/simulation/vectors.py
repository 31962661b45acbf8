"""Dot and cross products of many short vectors; numpy's own are several times slower on three components."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import Floats


def dot(a: Floats, b: Floats) -> Floats:
    """(n,) dot products of (n, 3) or (3,) vectors with (n, 3) ones."""
    out: Floats = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
    return out


def length(a: Floats) -> Floats:
    """(n,) lengths of (n, 3) vectors."""
    out: Floats = np.sqrt(dot(a, a))
    return out


def squared_distance_to_line(p: Floats, origin: Floats, direction: Floats) -> Floats:
    """Squared distance of a point to lines, times the direction's squared length.

    Args:
        p: (3,) the point.
        origin: (3,) or (n, 3) on the line.
        direction: (n, 3) of the line.

    Returns:
        (n,).
    """
    x, y, z = (p[i] - origin[..., i] for i in range(3))
    dx, dy, dz = direction[..., 0], direction[..., 1], direction[..., 2]
    out: Floats = (y * dz - z * dy) ** 2 + (z * dx - x * dz) ** 2 + (x * dy - y * dx) ** 2
    return out
