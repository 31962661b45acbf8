"""Which ground the cameras of a flight may see, how near they come to it, and how fine returns are of use there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from scipy import ndimage

from pipeline.geodesy.transform import FrameTransform
from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints, Singles

# Ground cells in shares of the range: what is within reach of no camera is told this finely.
_CELLS_PER_REACH = 12.0
_SMALLEST_CELL_M = 1.0
_MOST_CELLS = 4_000_000


@dataclass(frozen=True, slots=True)
class Reach:
    """A ground grid about the cameras.

    Args:
        origin_m: (2,) east and north of the grid's lower corner, m.
        cell_m: Cell size, m.
        ground_m: (columns, rows) least ground distance of a point in the cell from a camera, m; inf out of reach.
        lowest_m: (columns, rows) ENU up of the lowest camera within reach, m; inf out of reach.
    """

    origin_m: Floats
    cell_m: float
    ground_m: Singles
    lowest_m: Singles

    @classmethod
    def of(cls, centres_in_enu_m: Floats, reach_m: float) -> Self:
        """The grid about some cameras.

        Args:
            centres_in_enu_m: (n, 3) camera centres, ENU m; n >= 1.
            reach_m: Largest ground distance from the nearest camera, m.
        """
        low, high = centres_in_enu_m[:, :2].min(axis=0) - reach_m, centres_in_enu_m[:, :2].max(axis=0) + reach_m
        cell = max(reach_m / _CELLS_PER_REACH, _SMALLEST_CELL_M, float(np.sqrt(np.prod(high - low) / _MOST_CELLS)))
        # One cell more all around, so that what is beside the grid is out of reach.
        origin = low - cell
        shape = tuple(int(n) for n in np.ceil((high - origin) / cell) + 1)
        ground, lowest = np.full(shape, np.inf, np.float32), np.full(shape, np.inf, np.float32)
        wide = int(np.ceil(reach_m / cell)) + 1
        for centre in centres_in_enu_m:
            at = np.floor((centre[:2] - origin) / cell).astype(np.int64)
            first, last = np.maximum(at - wide, 0), np.minimum(at + wide + 1, shape)
            window = slice(first[0], last[0]), slice(first[1], last[1])
            # The nearest place of a cell, which is straight below a camera in the cell that holds it.
            east, north = (
                np.abs(origin[i] + (np.arange(first[i], last[i]) + 0.5) * cell - centre[i]) - 0.5 * cell
                for i in range(2)
            )
            nearest = np.hypot(np.maximum(east, 0.0)[:, None], np.maximum(north, 0.0)[None, :])
            met = nearest <= reach_m
            ground[window] = np.where(met, np.minimum(ground[window], nearest), ground[window])
            lowest[window] = np.where(met, np.minimum(lowest[window], centre[2]), lowest[window])
        return cls(origin, cell, ground, lowest)

    def cell_of(self, east_m: Floats, north_m: Floats) -> Ints:
        """(n,) number of the cell that holds each place; places beside the grid fall into its rim, out of reach."""
        return cell_number(east_m, north_m, self.origin_m, self.cell_m, self.ground_m.shape)

    def nearest_m(self, points_in_enu_m: Floats) -> Floats:
        """How near a camera can be to points.

        Args:
            points_in_enu_m: (3, n) ENU, m.

        Returns:
            (n,) no more than the distance of the nearest camera, m; inf out of reach.
        """
        cell = self.cell_of(points_in_enu_m[0], points_in_enu_m[1])
        ground = self.ground_m.ravel()[cell].astype(np.float64)
        above = np.maximum(self.lowest_m.ravel()[cell] - points_in_enu_m[2], 0.0)
        out: Floats = np.sqrt(ground * ground + above * above)
        return out

    def save(self, path: Path) -> None:
        """Writes the grid as .npz."""
        np.savez(path, origin_m=self.origin_m, cell_m=self.cell_m, ground_m=self.ground_m, lowest_m=self.lowest_m)

    @classmethod
    def load(cls, path: Path) -> Self:
        """What `save` wrote."""
        with np.load(path) as stored:
            return cls(stored["origin_m"], float(stored["cell_m"]), stored["ground_m"], stored["lowest_m"])


@dataclass(frozen=True, slots=True)
class Mask:
    """The same ground in a CRS, so that returns elsewhere are left out before they are brought anywhere.

    Args:
        origin: (2,) x and y of the mask's lower corner, CRS.
        cell: Cell size, in the CRS's units.
        within: (columns, rows) whether a camera may reach something in the cell; the rim is out of reach.
    """

    origin: Floats
    cell: float
    within: Bools

    @classmethod
    def of(cls, reach: Reach, transform: FrameTransform, up_m: float) -> Self:
        """The mask of a grid.

        Args:
            reach: The grid in the local frame.
            transform: From and to the CRS.
            up_m: About where the ground lies, ENU m.
        """
        size = np.array(reach.ground_m.shape) * reach.cell_m
        edge = np.linspace(0.0, 1.0, 9)
        box = np.stack(np.meshgrid(edge * size[0], edge * size[1]), axis=-1).reshape(-1, 2) + reach.origin_m
        there = transform.from_enu(np.column_stack([box, np.full(len(box), up_m)]))
        low, high = there[:, :2].min(axis=0), there[:, :2].max(axis=0)
        # As many CRS units as a cell has metres, whatever the unit; degrees are longer north than east.
        per_m = float(np.min((high - low) / size))
        cell = reach.cell_m * per_m
        origin = low - 2.0 * cell
        shape = np.ceil((high - origin) / cell).astype(np.int64) + 2
        x, y = (origin[i] + (np.arange(shape[i]) + 0.5) * cell for i in range(2))
        middles = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        level = transform.from_enu(np.array([*(reach.origin_m + size / 2.0), up_m]))[2]
        enu = transform.enu_from(np.column_stack([middles, np.full(len(middles), level)]))
        # Half a cell to either side, and the turn between the two grids: never more than a cell.
        near = ndimage.binary_dilation(np.isfinite(reach.ground_m), np.ones((3, 3), np.bool_))
        within = near.ravel()[reach.cell_of(enu[:, 0], enu[:, 1])].reshape(tuple(shape))
        within[[0, -1]] = False
        within[:, [0, -1]] = False
        return cls(origin, cell, within)

    def holds(self, x: Floats, y: Floats) -> Bools:
        """(n,) whether a camera may reach places of the CRS."""
        out: Bools = self.within.ravel()[cell_number(x, y, self.origin, self.cell, self.within.shape)]
        return out

    def meets(self, lower: AnyArray, upper: AnyArray) -> bool:
        """Whether a camera may reach something in a box of the CRS, given by (2+,) corners."""
        first, last = (np.floor((np.asarray(corner)[:2] - self.origin) / self.cell) for corner in (lower, upper))
        first, last = (np.clip(at, 0, np.array(self.within.shape) - 1).astype(np.int64) for at in (first, last))
        return bool(self.within[first[0] : last[0] + 1, first[1] : last[1] + 1].any())


def cell_number(x: Floats, y: Floats, origin: Floats, cell: float, shape: tuple[int, ...]) -> Ints:
    """(n,) row-major number of the cell each place falls into; what is beside the grid falls into its rim."""
    column = np.clip((x - origin[0]) * (1.0 / cell), 0.0, shape[0] - 1.0).astype(np.int32)
    row = np.clip((y - origin[1]) * (1.0 / cell), 0.0, shape[1] - 1.0).astype(np.int32)
    out: Ints = column * np.int64(shape[1]) + row
    return out
