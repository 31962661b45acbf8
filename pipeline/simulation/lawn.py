"""The second flight's site: a mown lawn and the wide flat roof of a hall, with trees and a path at their borders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.geodesy.enu import LocalFrame
from pipeline.geometry.arrays import Floats
from pipeline.simulation.flight import Trajectory, fly
from pipeline.simulation.site import HEADING_RAD, Site, place, sun
from pipeline.simulation.solids import Building, Crown, Pole, Solid
from pipeline.simulation.terrain import Hill, Terrain

# Some 600 m north of the first flight's site, in the same zone and at the same height.
ORIGIN = LocalFrame(37.5055, -78.3, 120.0)
# Number of the hall among the solids; what stands on its roof follows it.
HALL = 0
# The lawn, (forward, right) of the flight's start; rough meadow beyond.
LAWN_M = ((-40.0, 124.0), (-44.0, 66.0))
FRAMES, FEW_FRAMES = 8, 6
_LEAST_FOR_ALL = 24
_LATER_S = 1800.0

# Places are (forward, right) of the flight's start, m; sizes are half of the extents.
_HALL_AT_M, _HALL_HALF_M, _HALL_HEIGHT_M = (80.0, 27.0), (43.0, 23.0), 7.4
_HALL_TURN_RAD = np.radians(3.0)
# On the hall's axes: along, across; skylights are boxes, vents are tubes.
_SKYLIGHTS_M = ((-27.0, -12.0), (-27.0, 12.0), (0.0, -12.0), (0.0, 12.0), (27.0, -12.0), (27.0, 12.0))
_SKYLIGHT_HALF_M, _SKYLIGHT_HEIGHT_M = (1.5, 0.7), 0.45
_COOLER_M, _COOLER_HALF_M, _COOLER_HEIGHT_M = (14.0, 3.0), (1.6, 1.1), 1.5
_VENTS_M = ((-36.0, 4.0), (-12.0, -3.0), (33.0, -4.0))
_VENT_RADIUS_M, _VENT_HEIGHT_M = 0.25, 0.9
# Forward, right and the crown's radius.
_TREES_M = (
    *((130.0, -40.0, 4.2), (134.0, -29.0, 3.4), (131.0, -17.0, 4.6), (136.0, -6.0, 3.0), (133.0, 62.0, 4.0)),
    *((118.0, -43.0, 3.6), (88.0, -46.0, 4.4), (56.0, -45.0, 3.2), (70.0, 63.0, 3.8), (104.0, 64.0, 4.4)),
)
_BUSHES_M = ((34.0, -41.0, 1.3), (33.6, -38.4, 1.0), (35.0, 1.6, 1.1))
_FOOTING_M = 2.0


def lawn_seed(seed: int) -> int:
    """The seed of the second flight, so that its draws are none of the first's."""
    return int(np.random.SeedSequence([seed, 7]).generate_state(1)[0])


def lawn_frames(frames: int) -> int:
    """Photos of the second flight beside so many of the first."""
    return FRAMES if frames >= _LEAST_FOR_ALL else FEW_FRAMES


def lawn_site(seed: int) -> Site:
    """The second flight's site.

    Args:
        seed: Of its shapes and textures, from `lawn_seed`.

    Returns:
        The site: nearly flat, without painted control points; the hall is its first solid.
    """
    rng = np.random.default_rng([seed, 0])
    terrain = _terrain(rng)
    hall = _hall(terrain)
    solids: list[Solid] = [hall, *(_on_roof(hall, at, _SKYLIGHT_HALF_M, _SKYLIGHT_HEIGHT_M) for at in _SKYLIGHTS_M)]
    solids.append(_on_roof(hall, _COOLER_M, _COOLER_HALF_M, _COOLER_HEIGHT_M))
    for at in _VENTS_M:
        east, north = _from_hall(hall, at)
        solids.append(Pole(east, north, _VENT_RADIUS_M, hall.roof_m - 1.0, hall.roof_m + _VENT_HEIGHT_M))
    for forward, right, radius in _TREES_M:
        solids += _tree(rng, terrain, (forward, right), radius)
    for forward, right, radius in _BUSHES_M:
        east, north = place(np.array([[forward, right]]))[0]
        up = float(terrain.height(east, north)) + 0.4 * radius
        solids.append(Crown(float(east), float(north), up, radius))
    return Site(ORIGIN, terrain, tuple(solids), np.empty((0, 3)), sun(), seed)


def fly_lawn(site: Site, frames: int) -> Trajectory:
    """The second flight: as the first, but shorter and half an hour later.

    Args:
        site: Its site.
        frames: Number of frames.

    Returns:
        The true poses.
    """
    flown = fly(site.terrain, frames, site.seed)
    return replace(flown, time_s=flown.time_s + _LATER_S)


def _terrain(rng: np.random.Generator) -> Terrain:
    """A swell and a hollow: no slope exceeds 1 %."""
    middles: Floats = place(np.array([[60.0, -25.0], [20.0, 30.0]]) + rng.uniform(-8.0, 8.0, (2, 2)))
    (a, b), (c, d) = middles.tolist()
    return Terrain((Hill(a, b, 0.5, 34.0), Hill(c, d, -0.35, 28.0)))


def _hall(terrain: Terrain) -> Building:
    east, north = place(np.array([_HALL_AT_M]))[0]
    half_length, half_width = _HALL_HALF_M
    heading = HEADING_RAD + _HALL_TURN_RAD
    outline = Building(float(east), float(north), half_length, half_width, heading, 0.0, 1.0).corners()
    ground = terrain.height(outline[:, 0], outline[:, 1])
    floor, roof = float(ground.min()) - _FOOTING_M, float(ground.max()) + _HALL_HEIGHT_M
    return Building(float(east), float(north), half_length, half_width, heading, floor, roof)


def _from_hall(hall: Building, at_m: tuple[float, float]) -> tuple[float, float]:
    """East and north of a place on the hall's axes."""
    east, north, _ = hall.centre_in_enu_m + np.array([*at_m, 0.0]) @ hall.axes
    return float(east), float(north)


def _on_roof(hall: Building, at_m: tuple[float, float], half_m: tuple[float, float], height_m: float) -> Building:
    east, north = _from_hall(hall, at_m)
    return Building(east, north, *half_m, hall.heading_rad, hall.roof_m - 1.0, hall.roof_m + height_m)


def _tree(rng: np.random.Generator, terrain: Terrain, at_m: tuple[float, float], radius_m: float) -> list[Solid]:
    """A trunk and a round crown."""
    east, north = (float(x) for x in place(np.array([at_m]) + rng.uniform(-1.0, 1.0, (1, 2)))[0])
    ground = float(terrain.height(east, north))
    middle = ground + radius_m + float(rng.uniform(1.6, 2.6))
    return [Pole(east, north, 0.22, ground - _FOOTING_M, middle), Crown(east, north, middle, radius_m)]
