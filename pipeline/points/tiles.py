"""Square tiles of the output CRS, and the order of points inside a tile."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.geometry.arrays import Floats, Ints

_BITS = 16


def tile_corners(points: Floats, tile_m: int) -> Ints:
    """The lower-left corner of the tile each point lies in; lower and left edges belong to the tile.

    Args:
        points: (n, 2) or (n, 3) x, y in the output CRS, m.
        tile_m: Edge of a tile, m.

    Returns:
        (n, 2) easting and northing, m, multiples of tile_m.
    """
    return (np.floor(np.asarray(points, np.float64)[:, :2] / tile_m) * tile_m).astype(np.int64)


def tile_name(corner: Ints | tuple[int, int]) -> str:
    """The name of a tile: t_EASTING_NORTHING of its lower-left corner in metres."""
    return f"t_{int(corner[0])}_{int(corner[1])}"


def tile_corner(name: str) -> Ints:
    """(2,) the lower-left corner of a tile, m, from its name."""
    return np.array([int(part) for part in name.split("_")[1:]], np.int64)


def split(points: Floats, tile_m: int, boxes: tuple[Floats, Floats] | None = None) -> Iterator[tuple[str, Ints]]:
    """The tiles of points, by easting and then northing.

    Args:
        points: (n, 2) or (n, 3) x, y in the output CRS, m.
        tile_m: Edge of a tile, m.
        boxes: (n, 2) lower-left and (n, 2) upper-right corners of a box about each point, m; all tiles that it touches
            are the point's. Without boxes a point has one tile.

    Yields:
        The tile's name, and the rows (m,) of its points in `tile_order`.
    """
    if not len(points):
        return
    low, high = boxes or (points, points)
    rows, corners = _touched(tile_corners(low, tile_m), tile_corners(high, tile_m), tile_m)
    unique, of_row = np.unique(corners, axis=0, return_inverse=True)
    by_tile = np.argsort(of_row.ravel(), kind="stable")
    bounds = np.searchsorted(of_row.ravel()[by_tile], np.arange(len(unique) + 1))
    for corner, start, stop in zip(unique, bounds[:-1], bounds[1:], strict=True):
        some = rows[by_tile[start:stop]]
        yield tile_name(corner), some[tile_order(points[some], corner, tile_m)]


def _touched(first: Ints, last: Ints, tile_m: int) -> tuple[Ints, Ints]:
    """Rows and corners of all tiles from one corner to another, one row per point and tile."""
    rows, corners = [], []
    steps = (np.max(last - first, axis=0) // tile_m).tolist()
    for i in range(steps[0] + 1):
        for j in range(steps[1] + 1):
            corner = first + np.array([i, j]) * tile_m
            touched = np.flatnonzero((corner <= last).all(axis=1))
            rows.append(touched)
            corners.append(corner[touched])
    return np.concatenate(rows), np.concatenate(corners)


def tile_order(points: Floats, corner: Ints, tile_m: int) -> Ints:
    """The order along the tile's Hilbert curve, so that a row group is a compact patch.

    Args:
        points: (n, 3) x, y, z in the output CRS, m.
        corner: (2,) the tile's lower-left corner, m.
        tile_m: Edge of the tile, m.

    Returns:
        (n,) rows; points of one cell are ordered by their coordinates, so that the order of the input does not show.
    """
    cell = (np.asarray(points, np.float64)[:, :2] - corner) * ((1 << _BITS) / tile_m)
    index = hilbert_index(np.clip(cell, 0, (1 << _BITS) - 1).astype(np.int64))
    keys = [points[:, axis] for axis in range(points.shape[1] - 1, -1, -1)]
    return np.lexsort((*keys, index))


def hilbert_index(cells: Ints) -> Ints:
    """Distance along the Hilbert curve of cells in a square of 2^16 by 2^16.

    Args:
        cells: (n, 2) column and row, 0 .. 65535.

    Returns:
        (n,) index, 0 .. 2^32 - 1; neighbours on the curve are neighbours in the square.

    Source: Hilbert, "Ueber die stetige Abbildung einer Linie auf ein Flaechenstueck", Math. Ann. 38 (1891): quadrant by
    quadrant, turning the square so that each quadrant is entered where the last one was left.
    """
    x, y = (np.array(cells[:, axis], np.int64) for axis in (0, 1))
    index = np.zeros(len(x), np.int64)
    for bit in range(_BITS - 1, -1, -1):
        side = np.int64(1) << bit
        right, upper = (x & side) != 0, (y & side) != 0
        index += side * side * ((3 * right) ^ upper)
        x, y = x & (side - 1), y & (side - 1)
        mirrored = right & ~upper
        x, y = np.where(mirrored, side - 1 - x, x), np.where(mirrored, side - 1 - y, y)
        x, y = np.where(upper, x, y), np.where(upper, y, x)
    return index
