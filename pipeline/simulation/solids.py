"""What stands on the ground: buildings as boxes, poles as cylinders, crowns as balls, and where rays meet them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.simulation.vectors import dot, squared_distance_to_line

# Faces of a building: the two across its length, the two along it, and the roof. A pole's are its mantle and its top;
# a crown has its mantle alone.
FRONT, BACK, RIGHT, LEFT, TOP = range(5)
MANTLE = FRONT
_TINY = 1e-300


@dataclass(frozen=True, slots=True)
class Building:
    """An upright box.

    Args:
        east_m: Centre, ENU.
        north_m: Centre, ENU.
        half_length_m: Half of the extent along the heading.
        half_width_m: Half of the extent across the heading.
        heading_rad: Of its length, clockwise from north.
        floor_m: Up of its lower face, below the ground everywhere under it.
        roof_m: Up of its flat roof.
    """

    east_m: float
    north_m: float
    half_length_m: float
    half_width_m: float
    heading_rad: float
    floor_m: float
    roof_m: float

    @property
    def axes(self) -> Floats:
        """(3, 3) rows: along the heading, to its right, up; in ENU."""
        s, c = np.sin(self.heading_rad), np.cos(self.heading_rad)
        return np.array([[s, c, 0.0], [c, -s, 0.0], [0.0, 0.0, 1.0]])

    @property
    def centre_in_enu_m(self) -> Floats:
        """(3,) centre of the box."""
        return np.array([self.east_m, self.north_m, 0.5 * (self.floor_m + self.roof_m)])

    @property
    def half_m(self) -> Floats:
        """(3,) half extents along `axes`."""
        return np.array([self.half_length_m, self.half_width_m, 0.5 * (self.roof_m - self.floor_m)])

    @property
    def reach_m(self) -> float:
        """Radius of the ball about the centre that holds the box."""
        return float(np.linalg.norm(self.half_m))

    def corners(self) -> Floats:
        """(8, 3) ENU, m."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
        return self.centre_in_enu_m + (signs * self.half_m) @ self.axes

    def local(self, p_in_enu_m: Floats) -> Floats:
        """(n, 3) points on the building's axes about its centre, m."""
        out: Floats = (p_in_enu_m - self.centre_in_enu_m) @ self.axes.T
        return out

    def cast(self, origins: Floats, directions: Floats) -> tuple[Floats, Ints]:
        """Where rays meet the box, by slabs; from inside, where they leave it.

        Args:
            origins: (3,) or (n, 3) ENU, m.
            directions: (n, 3) ENU, any length.

        Returns:
            (n,) multiples of the direction, inf for a miss; (n,) the face met.
        """
        o, d = self.local(np.atleast_2d(origins)), directions @ self.axes.T
        d = np.where(d == 0.0, _TINY, d)
        with np.errstate(over="ignore"):
            middle, half = -o / d, self.half_m / np.abs(d)
        ex, ey, ez = (middle[:, i] - half[:, i] for i in range(3))
        last = np.minimum(np.minimum(middle[:, 0] + half[:, 0], middle[:, 1] + half[:, 1]), middle[:, 2] + half[:, 2])
        enters = np.maximum(np.maximum(ex, ey), ez)
        axis = np.where(ez == enters, 2, np.where(ey == enters, 1, 0))
        facing = np.where(axis == 2, d[:, 2], np.where(axis == 1, d[:, 1], d[:, 0])) < 0.0
        first = np.where(enters > 0.0, enters, last)
        hit = (enters <= last) & (last > 0.0)
        face = np.where(axis == 2, TOP, 2 * axis + ~facing)
        return np.where(hit, first, np.inf), face.astype(np.int64)


@dataclass(frozen=True, slots=True)
class Pole:
    """An upright cylinder.

    Args:
        east_m: Axis, ENU.
        north_m: Axis, ENU.
        radius_m: Of the cylinder.
        floor_m: Up of its lower end, below the ground.
        top_m: Up of its upper end.
    """

    east_m: float
    north_m: float
    radius_m: float
    floor_m: float
    top_m: float

    @property
    def centre_in_enu_m(self) -> Floats:
        """(3,) middle of the axis."""
        return np.array([self.east_m, self.north_m, 0.5 * (self.floor_m + self.top_m)])

    @property
    def reach_m(self) -> float:
        """Radius of the ball about the centre that holds the cylinder."""
        return float(np.hypot(self.radius_m, 0.5 * (self.top_m - self.floor_m)))

    def corners(self) -> Floats:
        """(8, 3) ENU, m: of the upright box that holds it."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
        half = np.array([self.radius_m, self.radius_m, 0.5 * (self.top_m - self.floor_m)])
        out: Floats = self.centre_in_enu_m + signs * half
        return out

    def cast(self, origins: Floats, directions: Floats) -> tuple[Floats, Ints]:
        """Where rays from outside meet the cylinder.

        Args:
            origins: (3,) or (n, 3) ENU, m; outside the cylinder.
            directions: (n, 3) ENU, any length.

        Returns:
            (n,) multiples of the direction, inf for a miss; (n,) the face met, MANTLE or TOP.
        """
        o = np.atleast_2d(origins) - self.centre_in_enu_m
        half = 0.5 * (self.top_m - self.floor_m)
        ox, oy, oz, dx, dy = o[:, 0], o[:, 1], o[:, 2], directions[:, 0], directions[:, 1]
        dz = np.where(directions[:, 2] == 0.0, _TINY, directions[:, 2])
        a = np.maximum(dx * dx + dy * dy, _TINY)
        b = ox * dx + oy * dy
        # The square of the ray's distance to the axis, free of the cancellation in b^2 - a c.
        room = self.radius_m**2 * a - (ox * dy - oy * dx) ** 2
        side = (-b - np.sqrt(np.maximum(room, 0.0))) / a
        on_side = (room >= 0.0) & (side > 0.0) & (np.abs(oz + side * dz) <= half)
        with np.errstate(over="ignore", invalid="ignore"):
            cap = (half - oz) / dz
            on_cap = (cap > 0.0) & ((ox + cap * dx) ** 2 + (oy + cap * dy) ** 2 <= self.radius_m**2)
        side, cap = np.where(on_side, side, np.inf), np.where(on_cap, cap, np.inf)
        nearest: Floats = np.minimum(side, cap)
        return nearest, np.where(cap < side, TOP, MANTLE).astype(np.int64)


@dataclass(frozen=True, slots=True)
class Crown:
    """A ball: the crown of a tree, or a bush.

    Args:
        east_m: Centre, ENU.
        north_m: Centre, ENU.
        up_m: Centre, ENU.
        radius_m: Of the ball.
    """

    east_m: float
    north_m: float
    up_m: float
    radius_m: float

    @property
    def centre_in_enu_m(self) -> Floats:
        """(3,) centre of the ball."""
        return np.array([self.east_m, self.north_m, self.up_m])

    @property
    def reach_m(self) -> float:
        """Radius of the ball about the centre that holds it: its own."""
        return self.radius_m

    def corners(self) -> Floats:
        """(8, 3) ENU, m: of the upright box that holds it."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
        return self.centre_in_enu_m + signs * self.radius_m

    def cast(self, origins: Floats, directions: Floats) -> tuple[Floats, Ints]:
        """Where rays meet the ball; from inside, where they leave it.

        Args:
            origins: (3,) or (n, 3) ENU, m.
            directions: (n, 3) ENU, any length.

        Returns:
            (n,) multiples of the direction, inf for a miss; (n,) the face met, MANTLE.
        """
        o = np.atleast_2d(origins) - self.centre_in_enu_m
        size = dot(directions, directions)
        # The square of the ray's distance to the centre, free of the cancellation in b^2 - a c.
        room = self.radius_m**2 * size - squared_distance_to_line(np.zeros(3), o, directions)
        middle, half = -dot(o, directions) / size, np.sqrt(np.maximum(room, 0.0)) / size
        first = np.where(middle > half, middle - half, middle + half)
        hit = (room >= 0.0) & (first > 0.0)
        return np.where(hit, first, np.inf), np.full(len(first), MANTLE, np.int64)


Solid = Building | Pole | Crown
