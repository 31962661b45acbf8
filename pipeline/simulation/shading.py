"""What surfaces look like: colours of ground, walls, roofs, poles and sky under one sun."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.simulation.site import GROUND, SKY, Hits, Site, place
from pipeline.simulation.solids import BACK, FRONT, LEFT, RIGHT, TOP, Building, Crown, Pole
from pipeline.simulation.texture import Noise, Singles, inside, look_up
from pipeline.simulation.vectors import dot, length, squared_distance_to_line

_AMBIENT = 0.46
_HAZE_M = 2500.0
_FINE_M = tuple(0.05 * 2.0**k for k in range(10))
_COARSE_M = (6.0, 13.0, 28.0)
_WALL_M = tuple(0.025 * 2.0**k for k in range(9))
_LEAVES_M = (0.1, 0.2, 0.4, 0.8)
_GRASS, _SOIL, _ROAD = (92.0, 112.0, 62.0), (156.0, 130.0, 98.0), (112.0, 111.0, 114.0)
_HORIZON, _ZENITH, _TREES = (214.0, 220.0, 226.0), (126.0, 164.0, 214.0), (112.0, 126.0, 112.0)
_WALLS = ((186, 160, 130), (158, 96, 78), (198, 190, 176), (140, 142, 146), (176, 142, 96), (120, 128, 112))
_ROOFS = ((120, 112, 106), (150, 88, 70), (96, 100, 108), (168, 162, 150))
_LEAVES = (78.0, 98.0, 56.0)
_GLASS, _FRAME = (52.0, 62.0, 78.0), (222.0, 220.0, 214.0)
# Roads run along the flight at 7 m to its right and across it at 83 m.
_ROADS_M = ((1, 7.0), (0, 83.0))
_ROAD_HALF_M = 3.0
_STOREY_M, _WINDOW_PITCH_M = 3.0, 2.7
_TARGET_M = 0.6
_SHADOW_STEP_M = 0.4
_SHADOW_SPAN_M = 340.0


@dataclass(frozen=True, slots=True)
class Shader:
    """Colours of what rays meet.

    Args:
        site: The site.
        noise: Its texture.
        shadow: Share of the sun that reaches the ground, on a grid.
        shadow_corner_m: East and north of the grid's first cell.
    """

    site: Site
    noise: Noise
    shadow: Singles
    shadow_corner_m: tuple[float, float]

    @classmethod
    def of(cls, site: Site) -> Shader:
        """The shader of a site; casts its shadows."""
        middle = np.mean([solid.centre_in_enu_m[:2] for solid in site.solids], axis=0)
        corner = (float(middle[0]) - 0.5 * _SHADOW_SPAN_M, float(middle[1]) - 0.5 * _SHADOW_SPAN_M)
        return cls(site, Noise.seeded(site.seed), _shadow(site, corner), corner)

    def colours(self, origin: Floats, directions: Floats, hits: Hits, pixel_rad: float) -> Singles:
        """Colours of pixels.

        Args:
            origin: (3,) camera centre, ENU, m.
            directions: (n, 3) rays, ENU.
            hits: What they meet.
            pixel_rad: Angle a pixel covers.

        Returns:
            (n, 3) red, green, blue, 0 to 255.
        """
        out = np.empty((len(directions), 3), np.float32)
        size = length(directions)
        # Small integers are sorted by counting.
        thing_of = hits.thing.astype(np.int16)
        order = np.argsort(thing_of, kind="stable")
        edges = np.flatnonzero(np.diff(thing_of[order])) + 1
        for at in np.split(order, edges):
            thing = int(hits.thing[at[0]]) if len(at) else SKY
            if thing == SKY:
                out[at] = self._sky(directions[at] / size[at, None], pixel_rad)
                continue
            distance_m = hits.distance[at] * size[at]
            p = origin + hits.distance[at, None] * directions[at]
            footprint = (distance_m * pixel_rad).astype(np.float32)
            unit = directions[at] / size[at, None]
            if thing == GROUND:
                colour = self._ground(p, unit, footprint)
            else:
                colour = self._solid(thing, hits.face[at], p, unit, footprint)
            haze = (1.0 - np.exp(distance_m / -_HAZE_M)).astype(np.float32)
            out[at] = mix(colour, _HORIZON, haze)
        return out

    def _sky(self, unit: Floats, pixel_rad: float) -> Singles:
        rise = unit[:, 2].astype(np.float32)
        bearing = np.arctan2(unit[:, 0], unit[:, 1])
        clouds = self.noise.bands(
            unit[:, 0] / (rise + 0.12), unit[:, 1] / (rise + 0.12), np.full(len(rise), 0.02, np.float32), (1.0, 0.5), 50
        )
        colour = mix(plain(_HORIZON, len(rise)), _ZENITH, np.clip(rise * 2.6, 0.0, 1.0))
        colour += (clouds * np.clip(rise * 40.0, 0.0, 5.0))[:, None]
        angle = np.full(len(rise), pixel_rad, np.float32)
        crowns = self.noise.bands(bearing, np.zeros_like(bearing), angle, (0.005, 0.01, 0.04, 0.2), 53)
        leaves = self.noise.bands(bearing, unit[:, 2], angle, (0.003, 0.006, 0.012), 57)
        trees = plain(_TREES, len(rise)) * (1.0 + 0.06 * leaves[:, None])
        return mix(colour, trees, inside(0.009 + 0.0022 * crowns - rise, angle))

    def _ground(self, p: Floats, unit: Floats, footprint: Singles) -> Singles:
        x, y = p[:, 0], p[:, 1]
        normal, stretched = self._lie(x, y, unit, footprint)
        fine = self.noise.bands(x, y, stretched, _FINE_M, 0)
        coarse = self.noise.bands(x, y, stretched, _COARSE_M, 20)
        grass = _step(0.7 * coarse + 0.25 * fine)
        colour = mix(plain(_SOIL, len(p)), _GRASS, grass) * (1.0 + 0.05 * coarse[:, None])
        road, paint = self._roads(x, y, stretched)
        colour = mix(colour, _ROAD, road) * np.maximum(1.0 + (0.10 - 0.04 * road) * fine, 0.15)[:, None]
        colour = self._targets(mix(colour, _FRAME, paint), x, y, stretched)
        return colour * self._light(normal, self._sunlit(x, y))[:, None]

    def _lie(self, x: Floats, y: Floats, unit: Floats, footprint: Singles) -> tuple[Floats, Singles]:
        """How the ground lies to the rays: its normals, and the size of a pixel on it."""
        _, slope_x, slope_y = self.site.terrain.surface(x, y)
        steep = 1.0 / np.sqrt(1.0 + slope_x**2 + slope_y**2)
        normal = np.stack([-slope_x * steep, -slope_y * steep, steep], axis=1)
        facing = np.maximum(-dot(normal, unit), 0.02).astype(np.float32)
        return normal, (footprint / np.sqrt(facing)).astype(np.float32)

    def _sunlit(self, x: Floats, y: Floats) -> Singles:
        """Share of the sun that reaches the ground."""
        column = (x - self.shadow_corner_m[0]) / _SHADOW_STEP_M
        row = (y - self.shadow_corner_m[1]) / _SHADOW_STEP_M
        return look_up(self.shadow, column.astype(np.float32), row.astype(np.float32))

    def _roads(self, x: Floats, y: Floats, footprint: Singles) -> tuple[Singles, Singles]:
        """Shares of a pixel that are road and white paint."""
        basis = place(np.eye(2))
        road, paint = np.zeros(len(x), np.float32), np.zeros(len(x), np.float32)
        for axis, middle_m in _ROADS_M:
            across = x * basis[axis, 0] + y * basis[axis, 1] - middle_m
            along = x * basis[1 - axis, 0] + y * basis[1 - axis, 1]
            across = across + 0.4 * np.sin(along / 17.0)
            road = np.maximum(road, inside(_ROAD_HALF_M - np.abs(across), footprint))
            dash = inside(1.0 - np.abs(np.mod(along, 6.0) - 3.0), footprint)
            paint = np.maximum(paint, dash * inside(0.08 - np.abs(across), footprint))
        return road, paint

    def _targets(self, colour: Singles, x: Floats, y: Floats, footprint: Singles) -> Singles:
        """Paints the control points: two black and two white quarters that meet at the point, in a white ring."""
        for east_m, north_m, _ in self.site.control_in_enu_m:
            dx, dy = x - east_m, y - north_m
            near = np.flatnonzero((np.abs(dx) < _TARGET_M + 0.3) & (np.abs(dy) < _TARGET_M + 0.3))
            if not len(near):
                continue
            fp, dx, dy = footprint[near], dx[near], dy[near]
            radius = np.hypot(dx, dy)
            quarters = (2.0 * inside(dx, fp) - 1.0) * (2.0 * inside(dy, fp) - 1.0)
            grey = np.where(radius < 0.8 * _TARGET_M, 130.0 + 105.0 * quarters, 235.0).astype(np.float32)
            colour[near] = mix(colour[near], np.repeat(grey[:, None], 3, axis=1), inside(_TARGET_M - radius, fp))
        return colour

    def _solid(self, number: int, face: Ints, p: Floats, unit: Floats, footprint: Singles) -> Singles:
        solid = self.site.solids[number]
        if isinstance(solid, Pole):
            return self._pole(solid, number, face, p, footprint)
        if isinstance(solid, Crown):
            return self._crown(solid, number, p, footprint)
        out = np.empty((len(p), 3), np.float32)
        for side in (FRONT, BACK, RIGHT, LEFT, TOP):
            at = np.flatnonzero(face == side)
            if not len(at):
                continue
            normal = solid.axes[side // 2] * (1.0 if side % 2 == 0 else -1.0)
            facing = np.maximum(np.abs(unit[at] @ normal), 0.02).astype(np.float32)
            paint = self._roof if side == TOP else self._wall
            local = solid.local(p[at])
            colour = paint(solid, 8 * number + side, local, footprint[at] / np.sqrt(facing), side)
            out[at] = colour * self._light(normal[None, :], np.ones(1, np.float32))
        return out

    def _wall(self, solid: Building, salt: int, local: Floats, footprint: Singles, side: int) -> Singles:
        along_x = side in (RIGHT, LEFT)
        s = local[:, 0] if along_x else local[:, 1]
        half = solid.half_length_m if along_x else solid.half_width_m
        below = solid.half_m[2] - local[:, 2]
        fine = self.noise.bands(s + 41.0 * salt, below, footprint, _WALL_M, 30)
        colour = plain(_WALLS[(salt // 8) % len(_WALLS)], len(s)) * (1.0 + 0.075 * fine[:, None])
        ledge = inside(0.12 - np.abs(np.mod(below - 0.5, _STOREY_M) - 0.12), footprint)
        colour = mix(colour, colour * np.float32(1.25), ledge)
        count = max(int(2.0 * half / _WINDOW_PITCH_M), 1)
        column = s / _WINDOW_PITCH_M + 0.5 * count
        row = (below - 0.9) / _STOREY_M
        number = np.floor(column), np.floor(row)
        chance = chances(self.site.seed + salt, number[0], number[1])
        real = (number[0] >= 0) & (number[0] < count) & (number[1] >= 0) & (chance[0] > 0.12)
        u = (column - number[0] - 0.5) * _WINDOW_PITCH_M
        v = (row - number[1]) * _STOREY_M - 0.75
        wide = 0.45 + 0.25 * chance[1]
        frame = inside(wide + 0.1 - np.abs(u), footprint) * inside(0.8 - np.abs(v), footprint) * real
        pane = inside(wide - np.abs(u), footprint) * inside(0.7 - np.abs(v), footprint) * real
        pane *= 1.0 - inside(0.03 - np.abs(u), footprint)
        blind = inside(v + 0.7 - 1.4 * (1.0 - chance[2]), footprint)
        glass = mix(plain(_FRAME, len(s)) * np.float32(0.8), _GLASS, blind)
        glass *= (0.7 + 0.6 * chance[3]).astype(np.float32)[:, None] * (1.0 + 0.05 * fine[:, None])
        return mix(mix(colour, _FRAME, frame), glass, pane)

    def _roof(self, solid: Building, salt: int, local: Floats, footprint: Singles, side: int) -> Singles:
        del side
        x, y = local[:, 0], local[:, 1]
        fine = self.noise.bands(x + 41.0 * salt, y, footprint, _WALL_M, 40)
        colour = plain(_ROOFS[(salt // 8) % len(_ROOFS)], len(x)) * (1.0 + 0.08 * fine[:, None])
        cell = np.floor(x / 2.2), np.floor(y / 2.2)
        chance = chances(self.site.seed + salt, *cell)
        u, v = x - (cell[0] + 0.5) * 2.2, y - (cell[1] + 0.5) * 2.2
        hatch = inside(0.35 + 0.4 * chance[1] - np.abs(u), footprint)
        hatch *= inside(0.35 + 0.4 * chance[2] - np.abs(v), footprint) * (chance[0] > 0.72)
        colour = mix(colour, colour * (0.45 + 1.2 * chance[3]).astype(np.float32)[:, None], hatch)
        rim = np.minimum(solid.half_length_m - np.abs(x), solid.half_width_m - np.abs(y))
        return mix(colour, colour * np.float32(1.3), inside(0.3 - rim, footprint))

    def _pole(self, pole: Pole, number: int, face: Ints, p: Floats, footprint: Singles) -> Singles:
        dx, dy = p[:, 0] - pole.east_m, p[:, 1] - pole.north_m
        round_m = np.arctan2(dx, dy) * pole.radius_m
        below = pole.top_m - p[:, 2]
        fine = self.noise.bands(round_m + 13.0 * number, below, footprint, _WALL_M[:7], 44)
        band = inside(0.5 - np.abs(np.mod(below, 2.0) - 1.0), footprint) * np.float32(number % 2)
        colour = mix(plain((150, 140, 126), len(p)), (196.0, 70.0, 58.0), band) * (1.0 + 0.12 * fine[:, None])
        mantle = np.stack([dx, dy, np.zeros_like(dx)], axis=1) / pole.radius_m
        normal = np.where((face == TOP)[:, None], [[0.0, 0.0, 1.0]], mantle)
        return colour * self._light(normal, np.ones(1, np.float32))[:, None]

    def _crown(self, crown: Crown, number: int, p: Floats, footprint: Singles) -> Singles:
        normal = (p - crown.centre_in_enu_m) / crown.radius_m
        # Two projections, so that neither the top nor the sides are smeared.
        fine = self.noise.bands(p[:, 0] + 17.0 * number, p[:, 1], footprint, _LEAVES_M, 34)
        fine = 0.7 * fine + 0.7 * self.noise.bands(p[:, 2] + 17.0 * number, p[:, 0] - p[:, 1], footprint, _LEAVES_M, 39)
        light = self._light(normal, np.ones(1, np.float32)) * np.maximum(1.0 + 0.06 * fine, 0.2)
        out: Singles = plain(_LEAVES, len(p)) * light[:, None]
        return out

    def _light(self, normal: Floats, sunlit: Singles) -> Singles:
        """Lambert's law under one sun and an even sky."""
        sun = np.maximum(dot(self.site.to_sun, normal), 0.0).astype(np.float32)
        out: Singles = _AMBIENT + np.float32(0.7) * sun * sunlit
        return out


def _shadow(site: Site, corner_m: tuple[float, float]) -> Singles:
    """Share of the sun that reaches the ground, softened by a cell or two."""
    n = int(_SHADOW_SPAN_M / _SHADOW_STEP_M)
    place_m = _SHADOW_STEP_M * np.arange(n)
    x, y = (a.ravel() for a in np.meshgrid(corner_m[0] + place_m, corner_m[1] + place_m))
    p = np.stack([x, y, site.terrain.height(x, y)], axis=1)
    lit = np.ones(n * n, np.float32)
    to_sun = np.broadcast_to(site.to_sun, p.shape)
    for solid in site.solids:
        beside = squared_distance_to_line(solid.centre_in_enu_m, p, to_sun)
        near = np.flatnonzero(beside <= solid.reach_m**2)
        distance, _ = solid.cast(p[near], to_sun[near])
        lit[near[np.isfinite(distance)]] = 0.0
    grid = lit.reshape(n, n)
    padded = np.pad(grid, 1, mode="edge")
    return sum(
        (np.float32(w) * padded[i : i + n, j : j + n] for i, j, w in _BINOMIAL), start=np.zeros((n, n), np.float32)
    )


_BINOMIAL = tuple((i, j, (1, 2, 1)[i] * (1, 2, 1)[j] / 16.0) for i in range(3) for j in range(3))


def plain(colour: tuple[float, ...], n: int) -> Singles:
    """(n, 3) of one colour."""
    return np.repeat(np.asarray(colour, np.float32)[None, :], n, axis=0)


def mix(colour: Singles, other: Singles | tuple[float, ...], share: Singles) -> Singles:
    """(n, 3) colours blended by (n,) shares of the other."""
    out: Singles = colour + (np.asarray(other, np.float32) - colour) * np.asarray(share, np.float32)[:, None]
    return out


def _step(value: Singles) -> Singles:
    """A soft step about 0."""
    s = np.clip(value * np.float32(0.8) + np.float32(0.5), 0.0, 1.0)
    out: Singles = s * s * (np.float32(3.0) - np.float32(2.0) * s)
    return out


def chances(seed: int, column: Floats, row: Floats) -> Floats:
    """(4, n) numbers in 0..1 that depend on the cell alone."""
    table = np.random.default_rng([seed, 4]).random((4, 16, 64))
    found: Floats = table[:, row.astype(np.int64) % 16, column.astype(np.int64) % 64]
    return found
