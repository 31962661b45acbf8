"""What makes depth possible in a pair: view angle, epipole against the region of interest, overlap on the ground.

Vectorised over pairs; every function takes stacked poses, one row per pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.cameras import Camera

# An epipole farther than this from the image is at infinity for every rule here.
_FAR_PX = 1e6


@dataclass(frozen=True, slots=True)
class View:
    """One side of m pairs, or m frames.

    Args:
        rotation: (m, 3, 3) enu_from_cam.
        centre: (m, 3) m, ENU.
    """

    rotation: Floats
    centre: Floats


def view_angles(ref: View, src: View) -> Floats:
    """Angle between the optical axes.

    Returns:
        (m,) rad.
    """
    a, b = ref.rotation[:, :, 2], src.rotation[:, :, 2]
    out: Floats = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))
    return out


def epipoles(ref: View, src: View, camera: Camera) -> Floats:
    """Where the line through both centres meets the ref image plane, in ideal (undistorted) pixels.

    Distortion is left out on purpose: its polynomial means nothing outside the image, where epipoles should be.

    Returns:
        (m, 2) px; NaN where the line is parallel to the image plane.
    """
    centre = np.einsum("mji,mj->mi", ref.rotation, src.centre - ref.centre)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        pixels = centre[:, :2] / centre[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    far = ~(np.abs(pixels) < _FAR_PX).all(axis=1)
    return np.where(far[:, None], np.nan, pixels)


@dataclass(frozen=True, slots=True)
class PixelGrid:
    """Pixels spread over an image, with their rays.

    Args:
        camera: Of the image.
        box: Left, top, right, bottom of the part they cover, px.
        rays: (k, 3) RDF, z = 1; NaN where the lens model gives none.
        per_side: Pixels in a row; the rows follow one another.
    """

    camera: Camera
    box: tuple[float, float, float, float]
    rays: Floats
    per_side: int

    @classmethod
    def of(
        cls, camera: Camera, per_side: int, box: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    ) -> PixelGrid:
        """A grid over a part of the image.

        Args:
            camera: Of the image.
            per_side: Pixels along each side of the part.
            box: Left, top, right, bottom as fractions of the image.
        """
        # The edges of the image lie half a pixel outside the centres of its outermost pixels.
        left, right = (fraction * camera.width - 0.5 for fraction in box[::2])
        top, bottom = (fraction * camera.height - 0.5 for fraction in box[1::2])
        u, v = np.linspace(left, right, per_side), np.linspace(top, bottom, per_side)
        pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        return cls(camera, (left, top, right, bottom), camera.rays(pixels), per_side)

    @property
    def ideal_px(self) -> Floats:
        """(k, 2) undistorted pixels."""
        return self.rays[:, :2] * (self.camera.fx, self.camera.fy) + (self.camera.cx, self.camera.cy)

    def covers(self, rays: Floats) -> Bools:
        """Whether rays (m, 3) with z = 1 fall into the part of the image."""
        pixels = self.camera.project(rays)
        left, top, right, bottom = self.box
        inside: Bools = np.all((pixels >= (left, top)) & (pixels <= (right, bottom)), axis=-1)
        return inside


def ground_level(frames: View, rays: Floats, above_ground_m: Floats, max_range_m: float) -> Floats:
    """How steeply rays look down, against what it takes to meet level ground within a range.

    Args:
        frames: m frames.
        rays: (k, 3) for all frames, or (m, k, 3).
        above_ground_m: (m,) height of each camera above the ground.
        max_range_m: Farthest ground that counts.

    Returns:
        (m, k); not negative where the ground is within the range, and smooth across the horizon.
    """
    down = -np.einsum(
        "mj,mkj->mk", frames.rotation[:, 2, :], np.broadcast_to(rays, (len(above_ground_m), *rays.shape[-2:]))
    )
    out: Floats = down / np.linalg.norm(rays, axis=-1) * max_range_m - above_ground_m[:, None]
    return out


def ground_overlap(
    ref: View, src: View, grid: PixelGrid, src_camera: Camera, above_ground_m: Floats, max_range_m: float
) -> Floats:
    """Share of the ground that ref sees within a range which src sees too.

    Where ref sees no level ground (a camera that looks at a façade), the points lie at twice the height along its rays.

    Args:
        ref: m frames.
        src: m frames.
        grid: k pixels of ref.
        src_camera: Camera of src.
        above_ground_m: (m,) height of ref above the ground.
        max_range_m: Farthest ground that counts.

    Returns:
        (m,) in [0, 1].
    """
    rays = grid.rays[np.isfinite(grid.rays).all(axis=1)]
    world = np.einsum("mij,kj->mki", ref.rotation, rays)
    length = np.linalg.norm(rays, axis=1)
    with np.errstate(divide="ignore"):
        scale = np.where(world[:, :, 2] < 0.0, above_ground_m[:, None] / -world[:, :, 2], np.inf)
    counted = scale * length <= max_range_m
    none = ~counted.any(axis=1)
    scale = np.where(none[:, None], 2.0 * above_ground_m[:, None], scale)
    counted |= none[:, None]
    points = world * np.where(counted, scale, 1.0)[:, :, None] + (ref.centre - src.centre)[:, None, :]
    inside = src_camera.holds(src_camera.project(np.einsum("mji,mkj->mki", src.rotation, points)))
    out: Floats = (inside & counted).sum(axis=1) / counted.sum(axis=1)
    return out
