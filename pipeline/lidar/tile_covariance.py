"""The covariances that a LAS tile carries with its points, where it is such as this project exports."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from pipeline.geometry.arrays import AnyArray, Floats

DIMENSIONS = ("sigma_x", "sigma_y", "sigma_z", "cov_xy", "cov_xz", "cov_yz")
"""Extra bytes: sigmas in m and covariances in m2, on the axes of the tile's CRS."""


class Columns(Protocol):
    """Points of a tile, as laspy reads them."""

    @property
    def array(self) -> AnyArray:
        """The record, a field for each dimension."""

    def __getitem__(self, name: str) -> AnyArray:
        """A dimension by its name."""


def tile_covariance(points: Columns) -> Floats | None:
    """The covariance of each point.

    Args:
        points: A chunk of a tile.

    Returns:
        (n, 3, 3) m^2, on the axes of the tile's CRS; None where the tile does not carry all six numbers.
    """
    if not set(DIMENSIONS) <= set(points.array.dtype.names or ()):
        return None
    return covariance_of([points[name] for name in DIMENSIONS])


def covariance_of(columns: Sequence[AnyArray]) -> Floats:
    """Covariances from their columns.

    Args:
        columns: Sigmas of x, y and z in m, covariances of xy, xz and yz in m2, (n,) each.

    Returns:
        (n, 3, 3) m^2.
    """
    sx, sy, sz, xy, xz, yz = (np.asarray(column, np.float64) for column in columns)
    rows = (sx**2, xy, xz, xy, sy**2, yz, xz, yz, sz**2)
    out: Floats = np.stack(rows, axis=-1).reshape(-1, 3, 3)
    return out
