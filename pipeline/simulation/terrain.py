"""The ground: low hills and hollows in a plane, and where rays meet it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.simulation.vectors import dot

# A ray this close to the ground, measured along the vertical, is one Newton step from it: the step leaves < 1e-10 m.
_CLOSE_M = 1e-6
# Beyond this the ground is lost in the haze and a ray ends in the sky.
HORIZON_M = 3000.0
_NEWTON_STEPS = 12
_BISECTION_STEPS = 60


@dataclass(frozen=True, slots=True)
class Hill:
    """A bell-shaped hill, or a hollow.

    Args:
        east_m: Its middle, ENU.
        north_m: Its middle, ENU.
        height_m: Of the middle; negative for a hollow.
        width_m: One sigma of the bell.
    """

    east_m: float
    north_m: float
    height_m: float
    width_m: float


@dataclass(frozen=True, slots=True)
class Terrain:
    """Gentle relief, flat (up = 0) far away.

    Args:
        hills: What rises from and sinks below the plane.
    """

    hills: tuple[Hill, ...]

    @property
    def highest_m(self) -> float:
        """A bound of |up|."""
        return sum(abs(hill.height_m) for hill in self.hills)

    def surface(self, east_m: Floats, north_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Height and slope of the ground.

        Args:
            east_m: (...) ENU.
            north_m: (...) ENU.

        Returns:
            Up (m) and its derivatives by east and by north, each (...).
        """
        up, slope_x, slope_y = np.zeros_like(east_m), np.zeros_like(east_m), np.zeros_like(east_m)
        for hill in self.hills:
            x, y = east_m - hill.east_m, north_m - hill.north_m
            bell = hill.height_m * np.exp((x * x + y * y) * (-0.5 / hill.width_m**2))
            up += bell
            bell *= -1.0 / hill.width_m**2
            slope_x += x * bell
            slope_y += y * bell
        return up, slope_x, slope_y

    def height(self, east_m: Floats | float, north_m: Floats | float) -> Floats:
        """Up (m) of the ground at east and north (m), each (...)."""
        return self.surface(np.asarray(east_m, np.float64), np.asarray(north_m, np.float64))[0]

    def cast(self, origins: Floats, directions: Floats) -> Floats:
        """Where rays from above meet the ground.

        The first crossing is found for rays steeper than the slopes they cross, as all are from well above the relief.

        Args:
            origins: (3,) or (n, 3) ENU, m; above the ground.
            directions: (n, 3) ENU, any length.

        Returns:
            (n,) multiples of the direction; inf for rays that end in the sky.
        """
        out = np.full(len(directions), np.inf)
        origins = np.broadcast_to(np.asarray(origins, np.float64), directions.shape)
        low, high = self._bracket(origins, directions)
        meets = (low < high) & (low**2 * dot(directions, directions) < HORIZON_M**2)
        if not np.any(meets):
            return out
        everything = bool(np.all(meets))
        o, d = (origins, directions) if everything else (origins[meets], directions[meets])
        out[meets] = self._solve(o, d, low[meets], high[meets])
        return out

    def _bracket(self, origins: Floats, directions: Floats) -> tuple[Floats, Floats]:
        """Where the rays pass the highest and the lowest level of the relief; low >= high for rays that do not fall."""
        falls = directions[:, 2] < 0.0
        rate = np.where(falls, -directions[:, 2], 1.0)
        low = np.maximum(origins[:, 2] - self.highest_m, 0.0) / rate
        high = np.where(falls, (origins[:, 2] + self.highest_m) / rate, 0.0)
        return np.where(falls, low, 0.0), high

    def _solve(self, o: Floats, d: Floats, low: Floats, high: Floats) -> Floats:
        """Newton's method inside the bracket; what does not converge is bisected."""
        ox, oy, oz, dx, dy, dz = o[:, 0], o[:, 1], o[:, 2], d[:, 0], d[:, 1], d[:, 2]
        t = 0.5 * (low + high)
        late = np.arange(len(t))
        for _ in range(_NEWTON_STEPS):
            height, slope_x, slope_y = self.surface(ox + t * dx, oy + t * dy)
            gap = oz + t * dz - height
            rate = dz - slope_x * dx - slope_y * dy
            t = np.clip(t - gap / np.where(rate < 0.0, rate, dz), low, high)
            late = np.flatnonzero(np.abs(gap) > _CLOSE_M)
            if not len(late):
                return t
        t[late] = self._bisect(o[late], d[late], low[late], high[late])
        return t

    def _bisect(self, o: Floats, d: Floats, low: Floats, high: Floats) -> Floats:
        for _ in range(_BISECTION_STEPS):
            middle = 0.5 * (low + high)
            p = o + middle[:, None] * d
            above = p[:, 2] > self.height(p[:, 0], p[:, 1])
            low, high = np.where(above, middle, low), np.where(above, high, middle)
        return 0.5 * (low + high)
