"""Reference depth at any pixel: a plane through the nearest visible returns, fitted where planes are affine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.lidar.visibility import VisibleReturns

# Returns a plane is fitted to: three unknowns, and enough over to see that it is no plane.
NEIGHBOURS = 8
# No return used may be further from the pixel than this many distances between returns.
_REACH_FOOTPRINTS = 2.5
_LEAST_REACH_PX = 4.0
# The neighbours surround the pixel when their mean is not further off than this share of their own spread.
_OFF_CENTRE = 0.75
# Spread about the plane, in shares of the depth, beyond which the pixel is at an edge or on no surface.
_LARGEST_SPREAD = 0.01
# Neighbours nearly in one line of the image fix no plane.
_LEAST_ROUNDNESS = 0.02


@dataclass(frozen=True, slots=True)
class Reference:
    """Reference depths at pixels.

    Args:
        depth_m: (n,) along the optical axis, m; NaN where there is none.
        spread_m: (n,) root mean square of the returns about the local surface, in depth, m; NaN where there is none.
        slope: (n, 2) change of the inverse depth per ideal pixel, 1/(m px): the local plane; NaN where there is none.
        valid: (n,) whether there is one.
    """

    depth_m: Floats
    spread_m: Floats
    slope: Floats
    valid: Bools

    @classmethod
    def none(cls, count: int) -> Reference:
        """No reference at so many pixels."""
        nothing = np.full(count, np.nan)
        return cls(nothing, nothing, np.full((count, 2), np.nan), np.zeros(count, np.bool_))

    @classmethod
    def of_planes(cls, count: int, rows: Ints, offset: Floats, inverse: Floats) -> Reference:
        """References at some of the pixels, each by the plane through its neighbours; none where these make none.

        The inverse depth of a plane is affine in ideal (undistorted) pixels, so the fit is exact on planes at any
        slant.

        Args:
            count: Pixels in all.
            rows: (n,) those that have neighbours.
            offset: (n, k, 2) ideal pixels of the neighbours less that of the pixel.
            inverse: (n, k) their inverse depths, 1/m.
        """
        level, gradient, residual, sound = _plane_at_centre(offset, inverse)
        sound &= (level > 0.0) & (residual <= _LARGEST_SPREAD * level)
        rows, level, residual = rows[sound], level[sound], residual[sound]
        depth, spread, slope = np.full(count, np.nan), np.full(count, np.nan), np.full((count, 2), np.nan)
        depth[rows] = 1.0 / level
        spread[rows] = residual / level**2
        slope[rows] = gradient[sound]
        return cls(depth, spread, slope, np.isfinite(depth))

    def where(self, rows: AnyArray) -> Reference:
        """Those at some pixels."""
        return Reference(self.depth_m[rows], self.spread_m[rows], self.slope[rows], self.valid[rows])


def reference_depth(camera: Camera, pixels: Floats, visible: VisibleReturns) -> Reference:
    """Reference depths at pixels of a camera from the visible returns around them.

    Args:
        camera: Whose pixels they are.
        pixels: (n, 2) u, v of the image as given; NaN gives none.
        visible: The visible returns.

    Returns:
        One depth per pixel.
    """
    count, focal = len(pixels), camera.focal_px
    ideal = focal * camera.rays(pixels)[:, :2]
    rows = np.flatnonzero(np.isfinite(pixels).all(axis=1) & np.isfinite(ideal).all(axis=1))
    if len(visible.depth_m) < NEIGHBOURS or not len(rows):
        return Reference.none(count)
    # A tree asked so little is not worth balancing.
    tree = cKDTree(visible.pixels, balanced_tree=False, compact_nodes=False)
    distance, near = (np.asarray(found) for found in tree.query(pixels[rows], k=NEIGHBOURS))
    reach = np.maximum(_REACH_FOOTPRINTS * np.median(visible.footprint_px[near], axis=1), _LEAST_REACH_PX)
    close = distance[:, -1] <= reach
    rows, near = rows[close], near[close]
    if not len(rows):
        return Reference.none(count)
    # Only the returns that are used are brought to ideal pixels.
    used, back = np.unique(near, return_inverse=True)
    around = (focal * camera.rays(visible.pixels[used])[:, :2])[back.reshape(near.shape)]
    return Reference.of_planes(count, rows, around - ideal[rows, None, :], 1.0 / visible.depth_m[near])


def _plane_at_centre(offset: Floats, inverse: Floats) -> tuple[Floats, Floats, Floats, Bools]:
    """Least-squares affine function through neighbours, at offset zero.

    Args:
        offset: (n, k, 2) pixel offsets of the neighbours.
        inverse: (n, k) inverse depths, 1/m.

    Returns:
        Value at zero (n,), slope (n, 2), root mean square residual with k - 3 degrees of freedom (n,), and whether the
        neighbours surround the pixel and fix a plane (n,).
    """
    mean = offset.mean(axis=1)
    centred = offset - mean[:, None, :]
    level = inverse.mean(axis=1)
    scatter = np.einsum("nki,nkj->nij", centred, centred)
    trace, determinant = np.trace(scatter, axis1=1, axis2=2), np.linalg.det(scatter)
    sound: Bools = determinant > (_LEAST_ROUNDNESS * trace) ** 2
    sound &= np.einsum("ni,ni->n", mean, mean) <= _OFF_CENTRE**2 * trace / offset.shape[1]
    scatter = np.where(sound[:, None, None], scatter, np.eye(2))
    moment = np.einsum("nki,nk->ni", centred, inverse - level[:, None])
    slope = np.linalg.solve(scatter, moment[..., None])[..., 0]
    residual = inverse - level[:, None] - np.einsum("nki,ni->nk", centred, slope)
    rms = np.sqrt(np.sum(residual**2, axis=1) / (offset.shape[1] - 3))
    return level - np.einsum("ni,ni->n", mean, slope), slope, rms, sound
