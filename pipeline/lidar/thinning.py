"""Returns finer than any camera can use, thinned to one per voxel, which grows with the distance from the cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import AnyArray, Bools, Floats
from pipeline.lidar.reach import Reach

# Edge of a voxel as the nearest camera sees it, of the order of the distance between the matches that are scored. Edges
# come in steps of a square root of two, so that neighbouring returns are of one grid; a voxel is 5.7 to 8 px wide.
_LARGEST_PX = 8.0
_STEPS_PER_OCTAVE = 2.0
_SMALLEST_M = 0.01
# Returns that a voxel's footprint has to hold, for thinning to be worth it. A survey sparser than this stays whole.
_FEWEST_PER_VOXEL = 2.0
# A voxel as one number: its place along each axis and its step; places repeat after ten kilometres and more.
_PLACE_BITS, _UP_BITS = 21, 17
_TABLE_BITS = 21
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


@dataclass(frozen=True, slots=True)
class Thinning:
    """How returns are thinned.

    Args:
        focal_px: The longest focal length among the cameras, px.
    """

    focal_px: float

    def steps(self, nearest_m: Floats) -> Floats:
        """(n,) steps above the smallest voxel at distances from the nearest camera, m; below zero there is none."""
        edge = np.maximum(nearest_m, 1e-9) * (_LARGEST_PX / (self.focal_px * _SMALLEST_M))
        return np.floor(_STEPS_PER_OCTAVE * np.log2(edge))

    @staticmethod
    def edges_m(steps: Floats) -> Floats:
        """(n,) edges of voxels, m."""
        return _SMALLEST_M * np.exp2(steps / _STEPS_PER_OCTAVE)

    def voxels(self, points_in_enu_m: Floats, reach: Reach, density_per_m2: float) -> AnyArray:
        """The voxel of every return, as a number.

        Args:
            points_in_enu_m: (3, n) ENU, m.
            reach: How near the cameras come.
            density_per_m2: Returns per square metre of ground.

        Returns:
            (n,) uint64; 0 for a return that stays, come what may.
        """
        steps = self.steps(reach.nearest_m(points_in_enu_m))
        np.clip(steps, -1.0, (1 << 5) - 2.0, out=steps)
        edge = self.edges_m(steps)
        place = np.floor(points_in_enu_m / edge).astype(np.int64).view(np.uint64)
        ground, up = np.uint64((1 << _PLACE_BITS) - 1), np.uint64((1 << _UP_BITS) - 1)
        number = place[0] & ground
        number |= (place[1] & ground) << np.uint64(_PLACE_BITS)
        number |= (place[2] & up) << np.uint64(2 * _PLACE_BITS)
        number |= (steps + 1.0).astype(np.uint64) << np.uint64(2 * _PLACE_BITS + _UP_BITS)
        whole = (steps < 0.0) | (density_per_m2 * edge * edge < _FEWEST_PER_VOXEL)
        out: AnyArray = np.where(whole, np.uint64(0), number)
        return out


class FirstOfVoxel:
    """Tells the first return of a voxel from later ones; it remembers many voxels, though not all."""

    def __init__(self) -> None:
        self._known = np.zeros(1 << _TABLE_BITS, np.uint64)
        self._row = np.zeros(1 << _TABLE_BITS, np.int64)

    def take(self, voxels: AnyArray) -> Bools:
        """Which returns are the first of their voxel.

        Two voxels may share a place of the memory, and then some that are not the first are taken for it; never the
        other way round.

        Args:
            voxels: (n,) from `Thinning.voxels`, in the order of the returns.

        Returns:
            (n,).
        """
        place = (voxels * _GOLDEN) >> np.uint64(64 - _TABLE_BITS)
        rows = np.arange(len(voxels))
        # Of several assignments to a place the last one stays, hence backwards.
        self._row[place[::-1]] = rows[::-1]
        winner = self._row[place]
        first: Bools = ((winner == rows) | (voxels[winner] != voxels)) & (self._known[place] != voxels)
        first |= voxels == 0
        self._known[place[first]] = voxels[first]
        return first
