"""Pictures and exact depth maps of the site."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipeline.geometry.arrays import Bytes, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.simulation.shading import Shader
from pipeline.simulation.site import Hits, Site
from pipeline.simulation.solids import Solid
from pipeline.simulation.texture import Singles

# A small drone's camera at reduced size; its principal point is off centre and its lens bends a little.
CAMERA = Camera("brown", 1600, 1200, 1121.3, 1119.8, 803.2, 595.1, (-0.03, 0.01, 0.0004, -0.0003, 0.0))
SENSOR_SIGMA = 2.0
# Rows worked on at a time, so that the arrays stay in the processor's cache.
_ROWS = 24
_NEAREST_M = 0.5
# Where pixels on an outline are sampled besides their centre, px.
_SAMPLES_PX = ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375))


def camera_rays(camera: Camera) -> Floats:
    """(height, width, 3) rays of all pixels, RDF with z = 1."""
    columns = np.arange(camera.width, dtype=np.float64)
    out = np.empty((camera.height, camera.width, 3))
    for rows in _blocks(camera.height):
        u, v = np.meshgrid(columns, np.arange(rows.start, rows.stop, dtype=np.float64))
        out[rows] = camera.rays(np.stack([u, v], axis=-1))
    return out


def scene_depth(
    site: Site, camera: Camera, rotation_enu_from_cam: Floats, centre_in_enu_m: Floats, pixels: Floats
) -> Floats:
    """Exact depths at any pixels.

    Args:
        site: The site.
        camera: The camera.
        rotation_enu_from_cam: (3, 3) attitude.
        centre_in_enu_m: (3,) camera centre.
        pixels: (n, 2) u, v.

    Returns:
        (n,) z in the camera frame, m; inf for the sky.
    """
    return site.cast(centre_in_enu_m, camera.rays(pixels) @ rotation_enu_from_cam.T).distance


@dataclass(frozen=True, slots=True)
class Renderer:
    """Renders a site with one camera.

    Args:
        camera: The camera.
        rays: Of all its pixels, from `camera_rays`.
        shader: The site with its looks.
    """

    camera: Camera
    rays: Floats
    shader: Shader

    def render(self, rotation_enu_from_cam: Floats, centre_in_enu_m: Floats) -> tuple[Singles, Floats]:
        """A picture without sensor noise, and its depth.

        Args:
            rotation_enu_from_cam: (3, 3) attitude.
            centre_in_enu_m: (3,) camera centre.

        Returns:
            (height, width, 3) red, green, blue in 0..255 and (height, width) z in the camera frame, m, at the pixels'
            centres; inf for the sky.
        """
        shape = (self.camera.height, self.camera.width)
        picture, depth = np.empty((*shape, 3), np.float32), np.empty(shape)
        surface = np.empty(shape, np.int64)
        windows = [self._window(solid, rotation_enu_from_cam, centre_in_enu_m) for solid in self.shader.site.solids]
        for rows in _blocks(shape[0]):
            directions = self.rays[rows].reshape(-1, 3) @ rotation_enu_from_cam.T
            hits = self._cast(rows, directions, centre_in_enu_m, windows)
            colours = self.shader.colours(centre_in_enu_m, directions, hits, 1.0 / self.camera.focal_px)
            picture[rows] = colours.reshape(-1, shape[1], 3)
            depth[rows] = hits.distance.reshape(-1, shape[1])
            surface[rows] = (hits.thing * 8 + hits.face).reshape(-1, shape[1])
        self._smooth_outlines(picture, surface, rotation_enu_from_cam, centre_in_enu_m, windows)
        return picture, depth

    def _cast(self, rows: slice, directions: Floats, centre: Floats, windows: list[tuple[slice, slice]]) -> Hits:
        """As `Site.cast`, each solid only inside its window of the image."""
        hits = self.shader.site.cast_ground(centre, directions)
        numbers = np.arange(len(directions)).reshape(-1, self.camera.width)
        for number, (v, u) in enumerate(windows):
            top, bottom = max(v.start, rows.start) - rows.start, min(v.stop, rows.stop) - rows.start
            at = numbers[max(top, 0) : max(bottom, 0), u].ravel()
            if len(at):
                hits.update(at, number, *self.shader.site.solids[number].cast(centre, directions[at]))
        return hits

    def _window(self, solid: Solid, rotation: Floats, centre: Floats) -> tuple[slice, slice]:
        """Rows and columns of the image outside of which the solid cannot be."""
        corners = (solid.corners() - centre) @ rotation
        nothing = slice(0, 0), slice(0, 0)
        everything = slice(0, self.camera.height), slice(0, self.camera.width)
        if np.all(corners[:, 2] < _NEAREST_M):
            return nothing
        if np.any(corners[:, 2] < _NEAREST_M):
            return everything
        # On the ideal image plane the corners' bounds hold the solid; the lens takes their outline to its outline.
        xy = corners[:, :2] / corners[:, 2:]
        low, high = xy.min(axis=0), xy.max(axis=0)
        share = np.linspace(0.0, 1.0, 33)[:, None]
        ring = [np.array([low, high])[[i, j], [0, 1]] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0))]
        outline = np.concatenate([a + share * (b - a) for a, b in pairwise(ring)])
        pixels = self.camera.project(np.column_stack([outline, np.ones(len(outline))]))
        (u0, v0), (u1, v1) = np.floor(pixels.min(axis=0)) - 1.0, np.ceil(pixels.max(axis=0)) + 2.0
        return _clipped(v0, v1, self.camera.height), _clipped(u0, u1, self.camera.width)

    def _smooth_outlines(
        self, picture: Singles, surface: Ints, rotation: Floats, centre: Floats, windows: list[tuple[slice, slice]]
    ) -> None:
        """Takes the mean of several samples where a pixel's neighbour shows another surface."""
        edge = np.zeros(surface.shape, np.bool_)
        for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
            differs = surface[a] != surface[b]
            edge[a] |= differs
            edge[b] |= differs
        v, u = np.nonzero(edge)
        # One-sided differences at the image's last row and column.
        u1, v1 = np.minimum(u, self.camera.width - 2), np.minimum(v, self.camera.height - 2)
        along_u = self.rays[v, u1 + 1] - self.rays[v, u1]
        along_v = self.rays[v1 + 1, u] - self.rays[v1, u]
        inside = [
            np.flatnonzero((v >= rows.start) & (v < rows.stop) & (u >= columns.start) & (u < columns.stop))
            for rows, columns in windows
        ]
        total = np.zeros((len(u), 3), np.float32)
        for du, dv in _SAMPLES_PX:
            directions = (self.rays[v, u] + du * along_u + dv * along_v) @ rotation.T
            hits = self.shader.site.cast_ground(centre, directions)
            for number, near in enumerate(inside):
                hits.update(near, number, *self.shader.site.solids[number].cast(centre, directions[near]))
            total += self.shader.colours(centre, directions, hits, 1.0 / self.camera.focal_px)
        picture[v, u] = total / np.float32(len(_SAMPLES_PX))


def exposed(picture: Singles, rng: np.random.Generator) -> Bytes:
    """The picture as a sensor reads it, with its noise.

    Args:
        picture: (height, width, 3) in 0..255.
        rng: Of the noise.

    Returns:
        (height, width, 3) red, green, blue.
    """
    # Alike in the three colours: what a sensor's own interpolation of colours leaves of its noise is mostly grey.
    noise = rng.standard_normal(picture.shape[:2], np.float32) * np.float32(SENSOR_SIGMA)
    read = picture + noise[..., None]
    np.rint(read, out=read)
    return np.clip(read, 0.0, 255.0, out=read).astype(np.uint8)


def _blocks(height: int) -> Iterator[slice]:
    return (slice(start, min(start + _ROWS, height)) for start in range(0, height, _ROWS))


def _clipped(low: float, high: float, size: int) -> slice:
    return slice(int(np.clip(low, 0, size)), int(np.clip(high, 0, size)))
