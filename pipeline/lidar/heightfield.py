"""The highest return of each ground cell: what stands in the way of a view, as columns from the ground to the top."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from pipeline.geometry.arrays import Floats

_DENSITY_CELL_M = 2.0
# Cells that are counted in a table; a few returns far apart span more than fit one.
_MOST_COUNTED = 10_000_000
# Ground cells this large hold some two returns, so that few inside a surface are empty.
_CELL_SPACINGS = 1.5
_SMALLEST_CELL_M, _LARGEST_CELL_M = 0.1, 3.0
# Rounds of filling: gaps up to twice as many cells wide are closed, larger ones (water) block nothing.
_FILL_ROUNDS = 3


def return_spacing_m(points_in_enu_m: Floats) -> float:
    """The typical distance between neighbouring returns on the ground.

    Args:
        points_in_enu_m: (n, 3) ENU, m; n >= 1.

    Returns:
        1 / sqrt(density), m, the density being the median over occupied 2 m cells.
    """
    cells = np.floor(points_in_enu_m[:, :2] / _DENSITY_CELL_M).astype(np.int64)
    cells -= cells.min(axis=0)
    flat = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    if flat.max() < _MOST_COUNTED:
        counts = np.bincount(flat)
        counts = counts[counts > 0]
    else:
        _, counts = np.unique(flat, return_counts=True)
    return float(_DENSITY_CELL_M / np.sqrt(np.median(counts)))


@dataclass(frozen=True, slots=True)
class HeightField:
    """Heights of the tops over a regular ground grid.

    Args:
        origin_m: (2,) east and north of the grid's lower corner, m.
        cell_m: Cell size, m.
        top_m: (columns, rows) ENU up of the highest return in each cell, m; -inf where nothing stands.
    """

    origin_m: Floats
    cell_m: float
    top_m: Floats

    @staticmethod
    def of(points_in_enu_m: Floats, spacing_m: float) -> HeightField:
        """The height field of returns.

        Args:
            points_in_enu_m: (n, 3) ENU, m; n >= 1.
            spacing_m: From `return_spacing_m`.
        """
        cell = float(np.clip(_CELL_SPACINGS * spacing_m, _SMALLEST_CELL_M, _LARGEST_CELL_M))
        origin = points_in_enu_m[:, :2].min(axis=0)
        index = np.floor((points_in_enu_m[:, :2] - origin) / cell).astype(np.int64)
        shape = tuple(int(n) for n in index.max(axis=0) + 1)
        top = np.full(shape, -np.inf)
        np.maximum.at(top.reshape(-1), index[:, 0] * shape[1] + index[:, 1], points_in_enu_m[:, 2])
        return HeightField(origin, cell, _filled(top))

    def moved(self, translation_m: Floats) -> HeightField:
        """The same field shifted by (3,) ENU m."""
        return HeightField(self.origin_m + translation_m[:2], self.cell_m, self.top_m + translation_m[2])

    def at(self, east_m: Floats, north_m: Floats) -> Floats:
        """The top of the cell under each position; -inf outside the grid.

        Args:
            east_m: (...) ENU, m.
            north_m: (...) ENU, m.

        Returns:
            (...) ENU up, m.
        """
        column = np.floor((east_m - self.origin_m[0]) / self.cell_m).astype(np.int64)
        row = np.floor((north_m - self.origin_m[1]) / self.cell_m).astype(np.int64)
        columns, rows = self.top_m.shape
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        index = np.where(inside, column * rows + row, 0)
        return np.where(inside, self.top_m.reshape(-1)[index], -np.inf)


def _filled(top: Floats) -> Floats:
    """Empty cells take the mean of their occupied neighbours, from the edge of a gap inwards."""
    for _ in range(_FILL_ROUNDS):
        known = np.isfinite(top)
        if known.all():
            break
        total = ndimage.uniform_filter(np.where(known, top, 0.0), 3, mode="constant")
        share = ndimage.uniform_filter(known.astype(np.float64), 3, mode="constant")
        # Less than two of nine is the outer rim, which would grow.
        fill = ~known & (share > 1.5 / 9.0)
        top = np.where(fill, total / np.where(fill, share, 1.0), top)
    return top
