"""A room with pillars and crates: where rays meet it, and what its surfaces look like under even lamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.simulation.site import Hits
from pipeline.simulation.solids import Building, Pole
from pipeline.simulation.texture import Noise, Singles, inside
from pipeline.simulation.vectors import dot, length, squared_distance_to_line

WIDTH_M, DEPTH_M, HEIGHT_M = 12.0, 9.0, 4.0
# What a ray meets: the room's own walls, floor and ceiling, or a thing in it, numbered from 1.
ROOM = 0
# Faces of the room: east, west, north, south, ceiling, floor.
_CEILING_FACE, _FLOOR_FACE = 4, 5
_HALF_M = np.array([0.5 * WIDTH_M, 0.5 * DEPTH_M, 0.5 * HEIGHT_M])
_MIDDLE_M = np.array([0.0, 0.0, 0.5 * HEIGHT_M])
# East, north and radius of pillars from floor to ceiling.
_PILLARS = ((-2.1, 1.4, 0.22), (2.4, 2.5, 0.25), (4.9, -0.6, 0.22))
# East, north, half extents along and across, heading (deg), lower and upper face.
_CRATES = (
    (-4.2, 3.3, 0.5, 0.7, 8.0, 0.0, 1.2),
    (-0.4, 2.9, 0.45, 0.8, -12.0, 0.0, 0.8),
    (-0.3, 2.9, 0.35, 0.4, 25.0, 0.8, 1.5),
    (0.9, 1.2, 0.35, 0.3, 40.0, 0.0, 0.95),
    (4.3, 3.5, 0.45, 0.9, 0.0, 0.0, 2.1),
    (-5.3, 0.4, 0.6, 0.4, 0.0, 0.0, 1.8),
    (3.6, 1.2, 0.4, 0.5, -30.0, 0.0, 0.7),
    (-2.8, 2.9, 0.3, 0.3, 15.0, 0.0, 0.6),
)
_FOOTING_M = 0.02
_FINE_M = tuple(0.01 * 2.0**k for k in range(7))
_PAINT = ((176, 168, 152), (150, 160, 168), (168, 150, 140), (158, 166, 146))
_CARTON = ((168, 128, 86), (108, 126, 140), (150, 96, 80), (128, 138, 104), (182, 166, 120))
_FLOOR, _CEILING, _CONCRETE = (128, 122, 116), (196, 196, 192), (150, 148, 144)
_POSTER_M, _TILE_M, _TAPE_M = 0.85, 0.6, 0.5
# Lamps hang over the middle of the room; walls of equal material differ by where they face.
_LAMP = np.array([0.35, -0.5, 0.79])
# Rows worked on at a time, so that the arrays stay in the processor's cache.
_ROWS = 32
# Where pixels on an outline are sampled, px.
_SAMPLES_PX = ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375))


@dataclass(frozen=True, slots=True)
class Room:
    """The room; its middle on the floor is the origin, z is up.

    Args:
        solids: What stands in it.
        noise: Its texture.
        seed: Of the texture.
    """

    solids: tuple[Building | Pole, ...]
    noise: Noise
    seed: int

    @classmethod
    def seeded(cls, seed: int) -> Room:
        """The room of the example; the seed changes its texture alone."""
        crates = (
            Building(east, north, along, across, float(np.radians(heading)), low - _FOOTING_M, high)
            for east, north, along, across, heading, low, high in _CRATES
        )
        pillars = (Pole(east, north, radius, -_FOOTING_M, HEIGHT_M + _FOOTING_M) for east, north, radius in _PILLARS)
        return cls((*crates, *pillars), Noise.seeded(seed), seed)

    def cast(self, origins: Floats, directions: Floats) -> Hits:
        """What rays from inside the room meet first.

        Args:
            origins: (3,) or (n, 3) m, in the room and outside what stands in it.
            directions: (n, 3) of any length.

        Returns:
            The first hit of each ray; there always is one.
        """
        distance, face = _walls(origins, directions)
        hits = Hits(distance, np.full(len(directions), ROOM, np.int64), face)
        origins = np.broadcast_to(np.asarray(origins, np.float64), directions.shape)
        size = dot(directions, directions)
        for number, solid in enumerate(self.solids, start=1):
            beside = squared_distance_to_line(solid.centre_in_enu_m, origins, directions)
            near = np.flatnonzero(beside <= solid.reach_m**2 * size)
            if len(near):
                hits.update(near, number, *solid.cast(origins[near], directions[near]))
        return hits

    def colours(self, origin: Floats, directions: Floats, hits: Hits, pixel_rad: float) -> Singles:
        """Colours of pixels.

        Args:
            origin: (3,) camera centre, m.
            directions: (n, 3) rays.
            hits: What they meet.
            pixel_rad: Angle a pixel covers.

        Returns:
            (n, 3) red, green, blue, 0 to 255.
        """
        out = np.empty((len(directions), 3), np.float32)
        size = length(directions)
        surface = hits.thing * 8 + hits.face
        for number in np.unique(surface):
            at = np.flatnonzero(surface == number)
            p = origin + hits.distance[at, None] * directions[at]
            unit = directions[at] / size[at, None]
            footprint = (hits.distance[at] * size[at] * pixel_rad).astype(np.float32)
            thing, face = int(number // 8), int(number % 8)
            out[at] = (
                self._inner_face(face, p, unit, footprint)
                if thing == ROOM
                else self._thing(thing, face, p, unit, footprint)
            )
        return out

    def _inner_face(self, face: int, p: Floats, unit: Floats, footprint: Singles) -> Singles:
        axis = face // 2
        a, b = (p[:, i] for i in range(3) if i != axis)
        normal = np.zeros(3)
        normal[axis] = -1.0 if face % 2 == 0 else 1.0
        stretched = _stretched(footprint, normal[None, :], unit)
        if face in {_CEILING_FACE, _FLOOR_FACE}:
            colour = self._tiles(a, b, stretched, face, _CEILING if face == _CEILING_FACE else _FLOOR)
        else:
            colour = self._wall(a, b, stretched, face, _PAINT[face])
        return colour * _light(normal)

    def _thing(self, thing: int, face: int, p: Floats, unit: Floats, footprint: Singles) -> Singles:
        solid = self.solids[thing - 1]
        if isinstance(solid, Pole):
            across = (p[:, :2] - solid.centre_in_enu_m[:2]) / solid.radius_m
            around = np.arctan2(across[:, 0], across[:, 1]) * solid.radius_m
            colour = self._pillar(around, p[:, 2], footprint, 8 * thing)
            return colour * _light(np.column_stack([across, np.zeros(len(p))]))[:, None]
        local, axis = solid.local(p), face // 2
        a, b = (local[:, i] for i in range(3) if i != axis)
        normal = solid.axes[axis] * (1.0 if face % 2 == 0 else -1.0)
        stretched = _stretched(footprint, normal[None, :], unit)
        return self._carton(a, b, stretched, 8 * thing + face, _CARTON[thing % len(_CARTON)]) * _light(normal)

    def _wall(self, a: Floats, b: Floats, footprint: Singles, salt: int, base: tuple[int, ...]) -> Singles:
        fine = self._fine(a, b, footprint, salt)
        colour = np.asarray(base, np.float32) * (1.0 + 0.05 * fine[:, None])
        cell = np.floor(a / _POSTER_M), np.floor(b / _POSTER_M)
        chance = _chance(self.seed + salt, *cell)
        u, v = a - (cell[0] + 0.5) * _POSTER_M, b - (cell[1] + 0.5) * _POSTER_M
        sheet = inside(0.2 + 0.2 * chance[1] - np.abs(u), footprint) * inside(
            0.2 + 0.2 * chance[2] - np.abs(v), footprint
        )
        sheet *= chance[0] > 0.45
        print_m = 0.05 + 0.07 * chance[3]
        squares = inside(np.abs(np.mod(u, 2 * print_m) - print_m) - 0.5 * print_m, footprint)
        squares = np.abs(squares - inside(np.abs(np.mod(v, 2 * print_m) - print_m) - 0.5 * print_m, footprint))
        ink = np.stack([60 + 150 * chance[1], 50 + 150 * chance[2], 60 + 140 * chance[3]], axis=1).astype(np.float32)
        paper = np.float32(215.0) + (ink - np.float32(215.0)) * squares[:, None]
        paper *= 1.0 + 0.05 * fine[:, None]
        out: Singles = colour + (paper - colour) * sheet[:, None]
        return out

    def _tiles(self, a: Floats, b: Floats, footprint: Singles, salt: int, base: tuple[int, ...]) -> Singles:
        fine = self._fine(a, b, footprint, salt)
        cell = np.floor(a / _TILE_M), np.floor(b / _TILE_M)
        shade = (0.9 + 0.2 * _chance(self.seed + salt, *cell)[0]).astype(np.float32)
        colour = np.asarray(base, np.float32) * (shade * (1.0 + 0.055 * fine))[:, None]
        edge = np.minimum(*(0.5 * _TILE_M - np.abs(np.mod(x, _TILE_M) - 0.5 * _TILE_M) for x in (a, b)))
        out: Singles = colour * (1.0 - 0.45 * inside(0.008 - edge, footprint))[:, None]
        return out

    def _carton(self, a: Floats, b: Floats, footprint: Singles, salt: int, base: tuple[int, ...]) -> Singles:
        fine = self._fine(a, b, footprint, salt)
        colour = np.asarray(base, np.float32) * (1.0 + 0.07 * fine[:, None])
        tape = inside(0.03 - np.abs(np.mod(a + 0.1 * salt, _TAPE_M) - 0.5 * _TAPE_M), footprint)
        out: Singles = colour * (1.0 + 0.35 * tape)[:, None]
        return out

    def _pillar(self, around: Floats, up: Floats, footprint: Singles, salt: int) -> Singles:
        fine = self._fine(around, up, footprint, salt)
        band = inside(0.1 - np.abs(np.mod(up, 0.8) - 0.4), footprint)
        out: Singles = np.asarray(_CONCRETE, np.float32) * ((1.0 + 0.07 * fine) * (1.0 - 0.3 * band))[:, None]
        return out

    def _fine(self, a: Floats, b: Floats, footprint: Singles, salt: int) -> Singles:
        return self.noise.bands(a + 41.0 * salt, b, footprint, _FINE_M, salt)


def render(
    room: Room, rays: Floats, focal_px: float, rotation_world_from_cam: Floats, centre_m: Floats
) -> tuple[Singles, Floats]:
    """A picture without sensor noise, and its depth.

    Args:
        room: The room.
        rays: (height, width, 3) of all pixels, RDF with z = 1, from `render.camera_rays`.
        focal_px: Of the camera.
        rotation_world_from_cam: (3, 3).
        centre_m: (3,) camera centre.

    Returns:
        (height, width, 3) red, green, blue in 0..255, and (height, width) z in the camera frame at the pixels' centres.
    """
    height, width = rays.shape[:2]
    picture, depth = np.empty((height, width, 3), np.float32), np.empty((height, width))
    surface = np.empty((height, width), np.int64)
    for start in range(0, height, _ROWS):
        rows = slice(start, start + _ROWS)
        directions = rays[rows].reshape(-1, 3) @ rotation_world_from_cam.T
        hits = room.cast(centre_m, directions)
        picture[rows] = room.colours(centre_m, directions, hits, 1.0 / focal_px).reshape(-1, width, 3)
        depth[rows] = hits.distance.reshape(-1, width)
        surface[rows] = (hits.thing * 8 + hits.face).reshape(-1, width)
    edge = np.zeros((height, width), np.bool_)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        differs = surface[a] != surface[b]
        edge[a] |= differs
        edge[b] |= differs
    v, u = np.nonzero(edge)
    # One-sided differences at the image's last row and column.
    u1, v1 = np.minimum(u, width - 2), np.minimum(v, height - 2)
    along_u, along_v = rays[v, u1 + 1] - rays[v, u1], rays[v1 + 1, u] - rays[v1, u]
    total = np.zeros((len(u), 3), np.float32)
    for du, dv in _SAMPLES_PX:
        sample = (rays[v, u] + du * along_u + dv * along_v) @ rotation_world_from_cam.T
        total += room.colours(centre_m, sample, room.cast(centre_m, sample), 1.0 / focal_px)
    picture[v, u] = total / np.float32(len(_SAMPLES_PX))
    return picture, depth


def _walls(origins: Floats, directions: Floats) -> tuple[Floats, Ints]:
    """Where rays from inside the room leave it: multiples of the direction, and the face."""
    with np.errstate(divide="ignore"):
        reach = (np.copysign(_HALF_M, directions) - (origins - _MIDDLE_M)) / directions
    x, y, z = (np.where(directions[:, i] == 0.0, np.inf, reach[:, i]) for i in range(3))
    distance = np.minimum(np.minimum(x, y), z)
    axis = np.where(z == distance, 2, np.where(y == distance, 1, 0))
    backwards = np.take_along_axis(directions, axis[:, None], axis=1)[:, 0] < 0.0
    return distance, (2 * axis + backwards).astype(np.int64)


def _stretched(footprint: Singles, normal: Floats, unit: Floats) -> Singles:
    """Size of a pixel on a surface that it sees aslant."""
    facing = np.maximum(np.abs(dot(normal, unit)), 0.02).astype(np.float32)
    out: Singles = np.asarray(footprint / np.sqrt(facing), np.float32)
    return out


def _light(normal: Floats) -> Singles:
    """Lambert's law under lamps, with much light from all sides."""
    out: Singles = (0.78 + 0.26 * (normal @ _LAMP)).astype(np.float32)
    return out


def _chance(seed: int, column: Floats, row: Ints | Floats) -> Floats:
    """(4, n) numbers in 0..1 that depend on the cell alone."""
    table = np.random.default_rng([seed, 8]).random((4, 32, 32))
    found: Floats = table[:, row.astype(np.int64) % 32, column.astype(np.int64) % 32]
    return found
