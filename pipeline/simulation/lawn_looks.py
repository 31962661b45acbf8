"""What the lawn and the hall look like: close to one colour each, with texture of a few grey values."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.simulation.lawn import HALL, LAWN_M
from pipeline.simulation.shading import Shader, chances, mix, plain
from pipeline.simulation.site import place
from pipeline.simulation.solids import LEFT, RIGHT, TOP, Building, Pole
from pipeline.simulation.texture import Singles, inside

_LAWN, _MEADOW, _PAVING = (88.0, 118.0, 60.0), (104.0, 116.0, 68.0), (150.0, 146.0, 138.0)
_SHEET, _CLADDING, _PLINTH, _DOOR = (
    (164.0, 167.0, 170.0),
    (150.0, 156.0, 160.0),
    (112.0, 110.0, 108.0),
    (92.0, 104.0, 120.0),
)
_DOME, _KERB, _METAL, _BARK = (206.0, 212.0, 216.0), (138.0, 140.0, 142.0), (148.0, 150.0, 152.0), (96.0, 84.0, 70.0)
# One sigma of a band of grass, one of a patch, and half of the step between two stripes: grey values in full light.
GRASS_GREY, PATCH_GREY, STRIPE_GREY = 2.8, 1.4, 2.5
# As above, for the roof's dirt and its stains; how much darker a seam is; one sigma between two sheets.
DIRT_GREY, STAIN_GREY, SEAM_GREY, SHEET_GREY = 3.4, 1.5, 8.0, 1.0
_GRASS_M = (0.03, 0.06, 0.12, 0.24, 0.48)
_PATCH_M = (1.9, 4.3, 11.0)
_DIRT_M, _STAIN_M = (0.06, 0.12, 0.24, 0.48), (1.7, 4.1, 9.0)
# A mower's width; it drives at an angle to the flight, so that no stripe lies along a baseline.
_STRIPE_M, _STRIPE_RAD, _STRIPE_EDGE_M = 2.1, np.radians(62.0), 0.3
_SEAM_M, _SEAM_HALF_M = 0.6, 0.025
_PATH_M, _PATH_HALF_M, _SLAB_M = -36.5, 0.9, 0.5
_EDGE_M = 0.5
# The mist over the horizon hides most of the far woods: as a share, and the sine of an elevation in which it thins.
_MIST, _MIST_RISE, _MIST_COLOUR = 0.85, 0.06, (214.0, 220.0, 226.0)


class LawnShader(Shader):
    """Colours of the lawn's site.

    A lawn that is mown close and often shows little from 30 m: its blades are millimetres wide and average out in
    pixels of 4 to 15 cm. What is left are tufts (2.8 grey values of 255 for each octave of size that a pixel resolves,
    mostly one or two), patches of growth (1.4 each) and the mower's stripes (2.5 up, 2.5 down). A roof of sheets is as
    even: dirt (3.4 for each octave), stains (1.5), and standing seams that are 8 darker and 5 cm wide, of which a pixel
    shows half. Together, one sigma in squares of 60 pixels is some 3.5 on the lawn and 4 to 5 on the roof; it is 10 to
    21 on the first flight's ground. The sensor adds its 2, and a JPEG of 8 bits rounds to steps of 1 to 5, so that no
    more than the strongest tufts stay alike from one photo to the next: few features, but not none.

    The same place has the same colour from everywhere: real stripes change with the view, these do not.
    """

    __slots__ = ()

    def _sky(self, unit: Floats, pixel_rad: float) -> Singles:
        mist = _MIST * np.exp(np.maximum(unit[:, 2], 0.0) / -_MIST_RISE)
        return mix(super()._sky(unit, pixel_rad), _MIST_COLOUR, mist.astype(np.float32))

    def _ground(self, p: Floats, unit: Floats, footprint: Singles) -> Singles:
        x, y = p[:, 0], p[:, 1]
        normal, stretched = self._lie(x, y, unit, footprint)
        (forward_x, forward_y), (right_x, right_y) = place(np.eye(2))
        forward, right = forward_x * x + forward_y * y, right_x * x + right_y * y
        (back, front), (left, rim) = LAWN_M
        within = np.minimum(np.minimum(forward - back, front - forward), np.minimum(right - left, rim - right))
        mown = inside(within, np.maximum(stretched, np.float32(_EDGE_M)))
        grass = GRASS_GREY * self.noise.bands(x, y, stretched, _GRASS_M, 0)
        grass += PATCH_GREY * self.noise.bands(x, y, stretched, _PATCH_M, 20)
        lawn = _toned(_LAWN, grass + STRIPE_GREY * self._stripes(forward, right, stretched))
        colour = mix(_toned(_MEADOW, 2.0 * grass), lawn, mown)
        colour = self._path(colour, forward, right, stretched)
        return colour * self._light(normal, self._sunlit(x, y))[:, None]

    def _stripes(self, forward: Floats, right: Floats, footprint: Singles) -> Singles:
        """Between -1 and 1: where the mower went, and where it came back."""
        c, s = np.cos(_STRIPE_RAD), np.sin(_STRIPE_RAD)
        along = c * forward + s * right
        # Nobody drives quite straight.
        across = (-s * forward + c * right) + 0.10 * np.sin(along / 5.3) + 0.06 * np.sin(along / 1.9)
        number = np.floor(across / _STRIPE_M)
        from_edge = 0.5 * _STRIPE_M - np.abs(across - (number + 0.5) * _STRIPE_M)
        soft = np.maximum(footprint, np.float32(_STRIPE_EDGE_M))
        sign = np.where(np.mod(number, 2.0) == 0.0, 1.0, -1.0) * (2.0 * inside(from_edge, soft) - 1.0)
        out: Singles = (sign * _resolved(footprint, _STRIPE_M)).astype(np.float32)
        return out

    def _path(self, colour: Singles, forward: Floats, right: Floats, footprint: Singles) -> Singles:
        """Lays a path of slabs along the lawn's left border."""
        across = right - _PATH_M + 0.5 * np.sin(forward / 23.0)
        joint = np.zeros(len(across), np.float32)
        for place_m in (across, forward):
            joint = np.maximum(joint, inside(0.012 - np.abs(np.mod(place_m, _SLAB_M) - 0.5 * _SLAB_M), footprint))
        slabs = _toned(_PAVING, np.float32(-30.0) * joint * _resolved(footprint, _SLAB_M))
        return mix(colour, slabs, inside(_PATH_HALF_M - np.abs(across), footprint))

    def _roof(self, solid: Building, salt: int, local: Floats, footprint: Singles, side: int) -> Singles:
        del side
        x, y = local[:, 0], local[:, 1]
        rim = np.minimum(solid.half_length_m - np.abs(x), solid.half_width_m - np.abs(y))
        if salt // 8 != HALL:
            return mix(plain(_DOME, len(x)), _KERB, inside(0.12 - rim, footprint))
        grey = DIRT_GREY * self.noise.bands(x, y, footprint, _DIRT_M, 40)
        grey += STAIN_GREY * self.noise.bands(x, y, footprint, _STAIN_M, 46)
        number = np.floor(x / _SEAM_M)
        seam = inside(_SEAM_HALF_M - np.abs(x - (number + 0.5) * _SEAM_M), footprint)
        sheet = 2.0 * chances(self.site.seed, number, np.zeros_like(number))[0] - 1.0
        grey += ((np.sqrt(3.0) * SHEET_GREY * sheet - SEAM_GREY * seam) * _resolved(footprint, _SEAM_M)).astype(
            np.float32
        )
        return mix(_toned(_SHEET, grey), _KERB, inside(0.25 - rim, footprint))

    def _wall(self, solid: Building, salt: int, local: Floats, footprint: Singles, side: int) -> Singles:
        along_x = side in (RIGHT, LEFT)
        s = local[:, 0] if along_x else local[:, 1]
        below = solid.half_m[2] - local[:, 2]
        if salt // 8 != HALL:
            return plain(_KERB, len(s))
        grey = DIRT_GREY * self.noise.bands(s + 41.0 * salt, below, footprint, _DIRT_M, 30)
        rib = inside(0.04 - np.abs(np.mod(s, 0.33) - 0.165), footprint)
        colour = _toned(_CLADDING, grey - 8.0 * rib * _resolved(footprint, 0.33))
        colour = mix(colour, _KERB, inside(0.3 - below, footprint))
        gate = inside(2.0 - np.abs(np.mod(s, 21.0) - 10.5), footprint) * inside(below - 3.0, footprint)
        colour = mix(colour, _DOOR, gate)
        return mix(colour, _PLINTH, inside(below - 7.0, footprint) * (1.0 - gate))

    def _pole(self, pole: Pole, number: int, face: Ints, p: Floats, footprint: Singles) -> Singles:
        del number, footprint
        mantle = np.stack([p[:, 0] - pole.east_m, p[:, 1] - pole.north_m, np.zeros(len(p))], axis=1) / pole.radius_m
        normal = np.where((face == TOP)[:, None], [[0.0, 0.0, 1.0]], mantle)
        on_roof = pole.floor_m > self.site.solids[HALL].centre_in_enu_m[2]
        colour = plain(_METAL if on_roof else _BARK, len(p))
        return colour * self._light(normal, np.ones(1, np.float32))[:, None]


def _toned(colour: tuple[float, float, float], grey: Singles) -> Singles:
    """(n, 3) of one colour whose mean is changed by grey values: lighter and darker, not greyer."""
    share = np.maximum(1.0 + grey / np.float32(sum(colour) / 3.0), 0.2).astype(np.float32)
    out: Singles = plain(colour, len(grey)) * share[:, None]
    return out


def _resolved(footprint: Singles, period_m: float) -> Singles:
    """What is left of a regular pattern: all where a pixel is a quarter of its period, nothing from half of it."""
    out: Singles = np.clip(np.float32(2.0) - np.float32(4.0 / period_m) * footprint, 0.0, 1.0)
    return out
