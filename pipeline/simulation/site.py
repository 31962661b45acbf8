"""The site: terrain, buildings, poles and control points in one ENU frame, and what a ray meets there first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geodesy.enu import LocalFrame
from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.simulation.solids import Building, Pole, Solid
from pipeline.simulation.terrain import Hill, Terrain
from pipeline.simulation.vectors import dot, length, squared_distance_to_line

# 1.6 deg of grid convergence in UTM zone 17; the ground lies some 153 m above NAVD 88 and 120 m above the ellipsoid.
ORIGIN = LocalFrame(37.5, -78.3, 120.0)
UNDULATION_M = -33.0
HEADING_RAD = np.radians(30.0)

# What a ray met. Solids are numbered from 0, buildings first.
SKY, GROUND = -2, -1

# Places are (forward, right) of the flight's start, m. The roads lie in the strips right 3..11 and forward 79..87.
_ROWS_M = (40.0, 66.0, 104.0, 136.0)
_COLUMNS_M = (-54.0, -21.0, 29.0, 61.0)
_POLES = ((30, -36), (52, 14), (55, -4), (76, -8), (77, 15), (90, 14), (90, -38), (91, 45), (120, 1), (120, 14))
# Forward, right, height and width; heights are a sixteenth of the widths at most, so that no slope exceeds some 6 %.
_HILLS_M = (
    (30.0, -60.0, 2.6, 45.0),
    (105.0, 35.0, 3.0, 50.0),
    (60.0, 10.0, -1.4, 32.0),
    (150.0, -50.0, -2.4, 48.0),
    (15.0, 55.0, -1.0, 30.0),
)
_CONTROL = ((53.0, -37.5), (53.0, 2.0), (60.0, 46.0), (75.0, -37.5), (92.0, 27.0), (95.0, -2.0))
_FOOTING_M = 2.0


@dataclass(frozen=True, slots=True)
class Hits:
    """What rays meet first.

    Args:
        distance: (n,) multiples of the direction, inf for the sky; the depth for directions with z = 1 in the camera.
        thing: (n,) SKY, GROUND, or the number of the solid.
        face: (n,) face of the solid, 0 elsewhere.
    """

    distance: Floats
    thing: Ints
    face: Ints

    def update(self, at: Ints | Bools | slice, number: int, distance: Floats, face: Ints) -> None:
        """Takes a solid's hits where they are nearer than what was met so far."""
        nearer = distance < self.distance[at]
        self.distance[at] = np.where(nearer, distance, self.distance[at])
        self.thing[at] = np.where(nearer, number, self.thing[at])
        self.face[at] = np.where(nearer, face, self.face[at])


@dataclass(frozen=True, slots=True)
class Site:
    """A place to fly over.

    Args:
        frame: Its ENU frame; heights are ellipsoidal.
        terrain: The ground.
        solids: Buildings first.
        control_in_enu_m: (k, 3) centres of the painted control points, on the ground.
        to_sun: (3,) unit vector, ENU.
        seed: Of its shapes and textures.
    """

    frame: LocalFrame
    terrain: Terrain
    solids: tuple[Solid, ...]
    control_in_enu_m: Floats
    to_sun: Floats
    seed: int

    @classmethod
    def seeded(cls, seed: int) -> Site:
        """The example's site: 16 buildings in a loose grid about two roads, and 10 poles."""
        rng = np.random.default_rng([seed, 0])
        terrain = _terrain(rng)
        solids: list[Solid] = [_building(rng, terrain, f, r) for f in _ROWS_M for r in _COLUMNS_M]
        solids += [_pole(rng, terrain, float(f), float(r)) for f, r in _POLES]
        control = place(np.array(_CONTROL))
        control = np.column_stack([control, terrain.height(control[:, 0], control[:, 1])])
        return cls(ORIGIN, terrain, tuple(solids), control, sun(), seed)

    def cast(self, origins: Floats, directions: Floats) -> Hits:
        """What rays meet first.

        Args:
            origins: (3,) or (n, 3) ENU, m; above the ground and outside the solids.
            directions: (n, 3) ENU, any length.

        Returns:
            The first hit of each ray.
        """
        hits = self.cast_ground(origins, directions)
        origins = np.broadcast_to(np.asarray(origins, np.float64), directions.shape)
        size = dot(directions, directions)
        for number, solid in enumerate(self.solids):
            beside = squared_distance_to_line(solid.centre_in_enu_m, origins, directions)
            near = np.flatnonzero(beside <= solid.reach_m**2 * size)
            if len(near):
                hits.update(near, number, *solid.cast(origins[near], directions[near]))
        return hits

    def cast_ground(self, origins: Floats, directions: Floats) -> Hits:
        """As `cast`, without the solids."""
        distance = self.terrain.cast(origins, directions)
        thing = np.where(np.isfinite(distance), GROUND, SKY).astype(np.int64)
        return Hits(distance, thing, np.zeros(len(distance), np.int64))

    def sees(self, origins: Floats, p_in_enu_m: Floats, slack_m: float = 0.01) -> Bools:
        """Whether points on surfaces are seen from places above the ground.

        Args:
            origins: (3,) or (n, 3) ENU, m.
            p_in_enu_m: (n, 3) ENU, m.
            slack_m: How far before the point a ray may end and still count as having met it.

        Returns:
            (n,).
        """
        rays = p_in_enu_m - origins
        out: Bools = (1.0 - self.cast(origins, rays).distance) * length(rays) < slack_m
        return out


def sun() -> Floats:
    """(3,) unit vector to the sun of the flight's hour, ENU."""
    to_sun = np.array([0.45, -0.55, 0.78])
    out: Floats = to_sun / np.linalg.norm(to_sun)
    return out


def place(forward_right_m: Floats) -> Floats:
    """East and north of places given along and across the flight.

    Args:
        forward_right_m: (n, 2) m from the flight's start.

    Returns:
        (n, 2) ENU, m.
    """
    s, c = np.sin(HEADING_RAD), np.cos(HEADING_RAD)
    out: Floats = np.asarray(forward_right_m, np.float64) @ np.array([[s, c], [c, -s]])
    return out


def _terrain(rng: np.random.Generator) -> Terrain:
    middles = place(np.array(_HILLS_M)[:, :2] + rng.uniform(-12.0, 12.0, (len(_HILLS_M), 2)))
    return Terrain(
        tuple(
            Hill(float(east), float(north), height * float(rng.uniform(0.8, 1.2)), width)
            for (east, north), (_, _, height, width) in zip(middles, _HILLS_M, strict=True)
        )
    )


def _building(rng: np.random.Generator, terrain: Terrain, forward_m: float, right_m: float) -> Building:
    east, north = place(np.array([[forward_m, right_m]]) + rng.uniform(-1.5, 1.5, (1, 2)))[0]
    half_length, half_width = rng.uniform(4.0, 7.0), rng.uniform(5.0, 9.0)
    heading = HEADING_RAD + np.radians(rng.uniform(-12.0, 12.0))
    outline = Building(float(east), float(north), half_length, half_width, float(heading), 0.0, 1.0).corners()
    ground = terrain.height(outline[:, 0], outline[:, 1])
    storeys = int(rng.integers(1, 4))
    roof = float(ground.max()) + 1.1 + 3.0 * storeys + float(rng.uniform(0.0, 0.9))
    return Building(
        float(east), float(north), half_length, half_width, float(heading), float(ground.min()) - _FOOTING_M, roof
    )


def _pole(rng: np.random.Generator, terrain: Terrain, forward_m: float, right_m: float) -> Pole:
    east, north = place(np.array([[forward_m, right_m]]))[0]
    ground = float(terrain.height(east, north))
    radius, height = float(rng.uniform(0.15, 0.3)), float(rng.uniform(6.0, 10.0))
    return Pole(float(east), float(north), radius, ground - _FOOTING_M, ground + height)
