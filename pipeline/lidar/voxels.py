"""Returns thinned by voxel: one mean per cube, in memory that grows with the cubes and not with the returns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from pipeline.geometry.arrays import AnyArray, Floats, Ints

# A voxel's place in its tile as one number: 32 bits of height about the zero, 16 of north, 16 of east.
_NORTH_BITS, _UP_BITS = 16, 32
_UP_ZERO = 1 << (_UP_BITS - 1)
_RECORD = np.dtype([("key", "<u8"), ("count", "<u4"), ("sum", "<f4", 3)])
_LEAST_READ = 1_000_000


@dataclass(frozen=True, slots=True)
class Voxels:
    """Occupied voxels of one tile.

    Args:
        key: (n,) their places in the tile; sorted and distinct after `thinned`.
        count: (n,) returns in each.
        sum_m: (n, 3) sum of the returns' offsets from the voxel's lower corner, m.
    """

    key: AnyArray
    count: Ints
    sum_m: Floats

    @classmethod
    def none(cls) -> Self:
        """No voxel."""
        return cls(np.zeros(0, np.uint64), np.zeros(0, np.int64), np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.key)

    def with_more(self, other: Voxels) -> Voxels:
        """These and others, equal places joined."""
        return Voxels(
            np.concatenate([self.key, other.key]),
            np.concatenate([self.count, other.count]),
            np.concatenate([self.sum_m, other.sum_m]),
        ).thinned()

    def thinned(self) -> Voxels:
        """Equal places joined, in the order of places."""
        if not len(self):
            return self
        order = np.argsort(self.key, kind="stable")
        key = self.key[order]
        first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
        return Voxels(
            key[first], np.add.reduceat(self.count[order], first), np.add.reduceat(self.sum_m[order], first, axis=0)
        )

    def means(self, corner: tuple[int, int], voxel_m: float) -> Floats:
        """The mean return of each voxel.

        Args:
            corner: Column and row of the tile's first voxel.
            voxel_m: Edge of a voxel, m.

        Returns:
            (n, 3) m, in the frame of the returns.
        """
        east = (self.key & np.uint64((1 << _NORTH_BITS) - 1)).astype(np.int64) + corner[0]
        north = ((self.key >> np.uint64(_NORTH_BITS)) & np.uint64((1 << _NORTH_BITS) - 1)).astype(np.int64) + corner[1]
        up = (self.key >> np.uint64(2 * _NORTH_BITS)).astype(np.int64) - _UP_ZERO
        out: Floats = np.stack([east, north, up], axis=1) * voxel_m + self.sum_m / self.count[:, None]
        return out


def by_tile(points_m: Floats, voxel_m: float, voxels_per_tile: int) -> Iterator[tuple[tuple[int, int], Voxels]]:
    """Sorts returns into the voxels of square tiles.

    Args:
        points_m: (n, 3), all finite.
        voxel_m: Edge of a voxel, m.
        voxels_per_tile: Voxels along the edge of a tile, at most 65536.

    Yields:
        The tile (column, row) and its voxels, by column and then row.
    """
    cell = np.floor(points_m / voxel_m).astype(np.int64)
    tile = cell[:, :2] // voxels_per_tile
    place = cell[:, :2] - tile * voxels_per_tile
    key = (place[:, 0] | place[:, 1] << _NORTH_BITS).astype(np.uint64)
    key |= (cell[:, 2] + _UP_ZERO).astype(np.uint64) << np.uint64(2 * _NORTH_BITS)
    offset = points_m - cell * voxel_m
    order = np.lexsort((tile[:, 1], tile[:, 0]))
    tile = tile[order]
    ends = np.flatnonzero(np.any(tile[1:] != tile[:-1], axis=1)) + 1
    for rows in np.split(order, ends) if len(order) else ():
        column, row = cell[rows[0], :2] // voxels_per_tile
        yield (int(column), int(row)), Voxels(key[rows], np.ones(len(rows), np.int64), offset[rows]).thinned()


def append(path: Path, voxels: Voxels) -> None:
    """Adds voxels at the end of a file."""
    records = np.empty(len(voxels), _RECORD)
    records["key"], records["count"], records["sum"] = voxels.key, voxels.count, voxels.sum_m
    with path.open("ab") as file:
        file.write(records.tobytes())


def merged(path: Path, most: int) -> Iterator[Voxels]:
    """The voxels of a file, equal places joined.

    Args:
        path: What `append` wrote.
        most: Voxels held in memory; a tile with more of them comes in several parts, which may share places.

    Yields:
        Parts, never empty.
    """
    held = Voxels.none()
    with path.open("rb") as file:
        # As many again as are held, as far as memory goes: sorting them all over then costs little more than once.
        while len(data := file.read(_RECORD.itemsize * max(_LEAST_READ, min(len(held), most - len(held))))):
            records = np.frombuffer(data, _RECORD)
            held = held.with_more(
                Voxels(records["key"], records["count"].astype(np.int64), records["sum"].astype(np.float64))
            )
            if len(held) > most:
                yield held
                held = Voxels.none()
    if len(held):
        yield held
