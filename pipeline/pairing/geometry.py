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
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = centre[:, :2] / centre[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    far = ~(np.abs(pixels) < _FAR_PX).all(axis=1)
    return np.where(far[:, None], np.nan, pixels)


@dataclass(frozen=True, slots=True)
class PixelGrid:
    """Pixels spread over an image, with their rays.

    Args:
        ideal_px: (k, 2) undistorted pixels.
        rays: (k, 3) RDF, z = 1.
        spacing_px: Distance between neighbours.
    """

    ideal_px: Floats
    rays: Floats
    spacing_px: float

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
        left, top, right, bottom = box
        u = np.linspace(left * camera.width, right * camera.width, per_side) - 0.5
        v = np.linspace(top * camera.height, bottom * camera.height, per_side) - 0.5
        pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        rays = camera.rays(pixels)
        good = np.isfinite(rays).all(axis=1)
        ideal = rays[good, :2] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        return cls(ideal, rays[good], float(max(u[1] - u[0], v[1] - v[0])))


def sees_ground(frames: View, grid: PixelGrid, above_ground_m: Floats, max_range_m: float) -> Bools:
    """Which pixels of each frame look at level ground within a range.

    Args:
        frames: m frames.
        grid: k pixels.
        above_ground_m: (m,) height of each camera above the ground.
        max_range_m: Farthest ground that counts.

    Returns:
        (m, k).
    """
    down = -np.einsum("mj,kj->mk", frames.rotation[:, 2, :], grid.rays)
    length = np.linalg.norm(grid.rays, axis=1)
    with np.errstate(divide="ignore"):
        distance = np.where(down > 0.0, above_ground_m[:, None] * length / down, np.inf)
    return distance <= max_range_m


def epipole_margins(epipole_px: Floats, grid: PixelGrid, interest: Bools) -> Floats:
    """Signed distance from each epipole to the region of interest.

    The region is the union of the grid's cells around its pixels; half a cell is taken off the distance.

    Args:
        epipole_px: (m, 2) ideal pixels, NaN at infinity.
        grid: k pixels.
        interest: (m, k) which of them belong to the region of interest.

    Returns:
        (m,) px: positive outside; negative inside, by the distance to the nearest pixel that is not of interest;
        infinite when the epipole is at infinity or nothing is of interest.
    """
    distance = np.linalg.norm(epipole_px[:, None, :] - grid.ideal_px[None], axis=2)
    half = 0.5 * grid.spacing_px
    to_interest = np.where(interest, distance, np.inf).min(axis=1)
    to_rest = np.where(interest, np.inf, distance).min(axis=1)
    low, high = grid.ideal_px.min(axis=0) - half, grid.ideal_px.max(axis=0) + half
    to_border = np.minimum(epipole_px - low, high - epipole_px).min(axis=1)
    inside = (to_interest <= to_rest) & (to_border > 0.0)
    depth_inside = np.minimum(np.maximum(to_rest - half, 0.0), to_border)
    margin = np.where(inside, -depth_inside, np.maximum(to_interest - half, 0.0))
    return np.where(np.isnan(epipole_px).any(axis=1) | ~interest.any(axis=1), np.inf, margin)


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
    world = np.einsum("mij,kj->mki", ref.rotation, grid.rays)
    length = np.linalg.norm(grid.rays, axis=1)
    with np.errstate(divide="ignore"):
        scale = np.where(world[:, :, 2] < 0.0, above_ground_m[:, None] / -world[:, :, 2], np.inf)
    counted = scale * length <= max_range_m
    none = ~counted.any(axis=1)
    scale = np.where(none[:, None], 2.0 * above_ground_m[:, None], scale)
    counted |= none[:, None]
    points = world * np.where(counted, scale, 1.0)[:, :, None] + (ref.centre - src.centre)[:, None, :]
    inside = in_image(src_camera, np.einsum("mji,mkj->mki", src.rotation, points))
    out: Floats = (inside & counted).sum(axis=1) / counted.sum(axis=1)
    return out


def in_image(camera: Camera, points: Floats) -> Bools:
    """Whether points in the camera frame fall into its image.

    Args:
        camera: The camera.
        points: (..., 3) m, RDF.

    Returns:
        (...).
    """
    # The ideal image a little enlarged guards against the distortion polynomial folding far points back in.
    reach = 0.75 * np.array([camera.width / camera.fx, camera.height / camera.fy])
    with np.errstate(divide="ignore", invalid="ignore"):
        near = (points[..., 2] > 0.0) & (np.abs(points[..., :2]) <= reach * points[..., 2:]).all(axis=-1)
    pixels = camera.project(np.where(near[..., None], points, np.nan))
    size = np.array([camera.width, camera.height]) - 0.5
    inside: Bools = np.all((pixels >= -0.5) & (pixels <= size), axis=-1)
    return inside
