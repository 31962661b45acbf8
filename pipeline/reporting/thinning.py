"""A bounded number of a run's points, even in space and the same in every run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from pipeline.engine.tables import dataset, explained
from pipeline.flight import columns
from pipeline.geometry.arrays import AnyArray, Bytes, Floats, Ints
from pipeline.points.geoparquet import PointDataset

_XYZ, _SIGMAS, _RGB = ("x", "y", "z"), ("sigma_x_m", "sigma_y_m", "sigma_z_m"), ("red", "green", "blue")
# Cells to begin with, per point that is asked for: so fine that few points are lost to the first grid.
_FINENESS = 16.0
# Cells along an axis: three such numbers fit into 63 bits.
_MOST_CELLS = 1 << 20


@dataclass(frozen=True, slots=True)
class ShownPoints:
    """Points of a run.

    Args:
        xyz: (n, 3) in the dataset's CRS.
        sigma_m: (n,) root of the summed variances along x, y and z.
        rgb: (n, 3).
    """

    xyz: Floats
    sigma_m: Floats
    rgb: Bytes

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, rows: AnyArray) -> ShownPoints:
        """Some of them."""
        return ShownPoints(self.xyz[rows], self.sigma_m[rows], self.rgb[rows])

    def joined(self, table: pa.Table) -> ShownPoints:
        """With the rows of a table of points after them."""
        return ShownPoints(
            np.concatenate([self.xyz, columns(table, _XYZ)]),
            np.concatenate([self.sigma_m, np.linalg.norm(columns(table, _SIGMAS), axis=1)]),
            np.concatenate([self.rgb, columns(table, _RGB).astype(np.uint8)]),
        )

    @staticmethod
    def none() -> ShownPoints:
        """No points."""
        return ShownPoints(np.empty((0, 3)), np.empty(0), np.empty((0, 3), np.uint8))


def thinned(points: PointDataset, limit: int) -> ShownPoints:
    """At most so many points, one per cell of a grid: the first of the dataset that lies in it.

    The grid is coarsened along one axis after the other until the cells are few enough. Each is a whole number of cells
    of the one before, so that the points do not depend on the pieces the dataset is read in.

    Args:
        points: The dataset, of which `limit` points and a piece are in memory.
        limit: Largest number of points.

    Returns:
        The points in the order of the dataset.

    Raises:
        InputError: A file is damaged.
    """
    low, high = np.array(points.bounds[:3]), np.array(points.bounds[3:])
    size = np.maximum(high - low, 1e-3)
    edge = max(float(np.sqrt(size[0] * size[1] / (_FINENESS * limit))), float(size.max()) / _MOST_CELLS)
    kept, step = ShownPoints.none(), 0
    for path in points.files:
        with explained(path, "points"):
            for batch in dataset(path).to_batches(columns=[*_XYZ, *_SIGMAS, *_RGB]):
                kept = kept.joined(pa.Table.from_batches([batch]))
                if points.rows <= limit:
                    continue
                kept = kept.take(_first_of_cells(kept.xyz - low, edge, step))
                while len(kept) > limit:
                    step += 1
                    kept = kept.take(_first_of_cells(kept.xyz - low, edge, step))
    return kept


def _first_of_cells(xyz: Floats, edge: float, step: int) -> Ints:
    """The rows that are the first of their cell; each step doubles the cells along the next axis."""
    doublings = np.array([(step + 2) // 3, (step + 1) // 3, step // 3])
    cells = np.floor(xyz / edge).astype(np.int64) >> doublings
    # One number per cell, three times as fast to sort as three.
    _, first = np.unique(cells @ np.array([1, _MOST_CELLS << 1, (_MOST_CELLS << 1) ** 2]), return_index=True)
    out: Ints = np.sort(first)
    return out
