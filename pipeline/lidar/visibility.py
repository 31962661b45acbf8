"""Which LiDAR returns a camera sees.

Returns are samples; what blocks a view are the surfaces between them. Two tests stand for these surfaces:

* columns: what lies above the ground stands on a column (a roof on its walls, a crown on its tree), so a return is
  hidden when a column on the way to the camera reaches above the line of sight. This is exact for what is
  2.5-dimensional and needs no return on a wall.
* z-buffer: in the image, a return is hidden or at a depth edge when its bin or a neighbouring one holds a return that
  is nearer by more than the slope of the surface explains; a return with no others around is dropped.

Under a ceiling or a crown that was scanned from below nothing stands on columns: there the z-buffer is alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
from scipy import ndimage

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.lidar.blocks import Blocks, widest_slope
from pipeline.lidar.heightfield import HeightField

# What stands within this many cells in front of a return is taken as the return's own surface.
_OWN_CELLS = 1.5
# The line of sight may pass this far below a top: the noise of LiDAR heights.
_CLEARANCE_M = 0.1
# Points projected together, and rays of the horizon followed together: few enough for the processor's cache.
_POINTS_AT_ONCE, _RAYS_AT_ONCE = 8192, 64
# Bins of the z-buffer in spacings of the returns as the camera sees them.
_BIN_SPACINGS = 1.0
_SMALLEST_BIN_PX = 2.0
_LEVELS = 6
# In its own bin and the eight around it a return on a surface has some nine others.
_FEWEST_IN_BINS = 3
# A background return is dropped where inverse depth rises towards the near side by more than this share ...
_EDGE_SHARE = 0.08
# ... and by more than this many times what it falls towards the far side, which is what a slope would do.
_EDGE_ASYMMETRY = 3.0


@dataclass(frozen=True, slots=True)
class View:
    """A camera at its place.

    Args:
        camera: Intrinsics.
        centre_in_enu_m: (3,) camera centre, ENU m.
        rotation_enu_from_cam: (3, 3).
    """

    camera: Camera
    centre_in_enu_m: Floats
    rotation_enu_from_cam: Floats


@dataclass(frozen=True, slots=True)
class VisibleReturns:
    """Returns that a camera sees.

    Args:
        index: (n,) rows of the returns given.
        pixels: (n, 2) u, v of the image as given (distorted).
        depth_m: (n,) along the optical axis, m.
        footprint_px: (n,) distance between neighbouring returns as the camera sees it, px.
    """

    index: Ints
    pixels: Floats
    depth_m: Floats
    footprint_px: Floats

    @classmethod
    def none(cls) -> Self:
        """Nothing in sight."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0))


def visible_returns(
    view: View,
    points_in_enu_m: Floats,
    field: HeightField | None,
    spacing_m: float,
    max_range_m: float,
    blocks: Blocks | None = None,
) -> VisibleReturns:
    """The returns that a camera sees within a range.

    Args:
        view: The camera.
        points_in_enu_m: (n, 3) returns, ENU m.
        field: The height field of the returns, everything between them and the camera included; None where returns are
            not from above.
        spacing_m: Between neighbouring returns, m.
        max_range_m: Largest Euclidean distance from the camera, m.
        blocks: Of the returns, to be quick where a camera sees few of them; they change nothing else.
    """
    index, pixels, depth = in_image(view, points_in_enu_m, max_range_m, blocks)
    if field is not None:
        seen = ~behind_columns(view.centre_in_enu_m, points_in_enu_m[index], field, max_range_m)
        index, pixels, depth = index[seen], pixels[seen], depth[seen]
    footprint = view.camera.focal_px * spacing_m / depth
    seen = _passes_z_buffer(view.camera, pixels, depth, footprint)
    return VisibleReturns(index[seen], pixels[seen], depth[seen], footprint[seen])


def in_image(
    view: View, points_in_enu_m: Floats, max_range_m: float, blocks: Blocks | None = None
) -> tuple[Ints, Floats, Floats]:
    """Which points fall into the image, were nothing in the way.

    Args:
        view: The camera.
        points_in_enu_m: (n, 3) ENU, m.
        max_range_m: Largest Euclidean distance, m.
        blocks: Of the points.

    Returns:
        Rows (m,), pixels (m, 2) and depths (m,) in m of those in the image, before the camera and within range.
    """
    slope = widest_slope(view.camera)
    runs = [slice(0, len(points_in_enu_m))]
    if blocks is not None:
        axis = view.rotation_enu_from_cam[:, 2]
        runs = blocks.runs(blocks.before(view.centre_in_enu_m, axis, slope, max_range_m))
    parts = [
        _in_image(view, points_in_enu_m, slice(start, min(start + _POINTS_AT_ONCE, run.stop)), slope, max_range_m)
        for run in runs
        for start in range(run.start, run.stop, _POINTS_AT_ONCE)
    ]
    if not parts:
        return np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0)
    index, pixels, depth = (np.concatenate(part) for part in zip(*parts, strict=True))
    return index, pixels, depth


def _in_image(
    view: View, points_in_enu_m: Floats, rows: slice, slope: float, max_range_m: float
) -> tuple[Ints, Floats, Floats]:
    """Those of some rows; what is further from the axis than a slope is not projected."""
    offset = points_in_enu_m[rows] - view.centre_in_enu_m
    near = np.flatnonzero(np.einsum("ij,ij->i", offset, offset) <= max_range_m**2)
    in_cam = offset[near] @ view.rotation_enu_from_cam
    before = in_cam[:, 2] > 0.0
    if np.isfinite(slope):
        before &= in_cam[:, 0] ** 2 + in_cam[:, 1] ** 2 <= (slope * in_cam[:, 2]) ** 2
    if not before.all():
        in_cam, near = in_cam[before], near[before]
    pixels = view.camera.project(in_cam)
    inside = np.flatnonzero(view.camera.holds(pixels))
    return near[inside] + rows.start, pixels[inside], in_cam[inside, 2]


def behind_columns(centre: Floats, points: Floats, field: HeightField, max_range_m: float) -> Bools:
    """Whether a column stands between the camera and each point: the horizon of the height field.

    The field is sampled along rays of equal azimuth; the running maximum of the slope (rise over ground distance) along
    each is the horizon as it is met at every distance, so that a point costs one look-up whatever lies before it.

    Args:
        centre: (3,) camera centre, ENU m.
        points: (n, 3) ENU, m; all finite.
        field: The height field.
        max_range_m: Largest ground distance of a point, m.
    """
    if not len(points):
        return np.zeros(0, np.bool_)
    offset = points - centre
    ground = np.hypot(offset[:, 0], offset[:, 1])
    azimuth = np.arctan2(offset[:, 1], offset[:, 0])
    # Half a cell apart where the rays are widest; measured from the mean direction, so that +-180 deg is no seam.
    reach = min(max_range_m, float(ground.max())) + field.cell_m
    middle = np.arctan2(offset[:, 1].sum(), offset[:, 0].sum())
    azimuth = (azimuth - middle + np.pi) % (2.0 * np.pi)
    step = 0.5 * field.cell_m / reach
    first = np.floor(azimuth.min() / step)
    ray = (azimuth / step - first).astype(np.int64)
    # Samples before the point's own surface.
    before = np.floor((ground - _OWN_CELLS * field.cell_m) / (0.5 * field.cell_m)).astype(np.int64)
    before = np.clip(before, 0, int(reach / (0.5 * field.cell_m)) + 1)
    met = np.full(len(points), -np.inf)
    rows = np.flatnonzero(before > 0)
    rays, at = np.unique(ray[rows], return_inverse=True)
    angles = (first + rays + 0.5) * step + middle - np.pi
    met[rows] = _horizon(centre, field, angles, at, before[rows])
    hidden: Bools = offset[:, 2] < met * ground
    return hidden


def _horizon(centre: Floats, field: HeightField, angles: Floats, ray: Ints, samples: Ints) -> Floats:
    """The steepest slope that points meet on their rays.

    Args:
        centre: (3,) camera centre, ENU m.
        field: The height field, sampled every half cell.
        angles: (r,) azimuth of each ray, rad.
        ray: (n,) which one a point lies on.
        samples: (n,) how many samples lie before a point, at least one.

    Returns:
        (n,) rise over ground distance.
    """
    met = np.empty(len(ray))
    order = np.argsort(ray, kind="stable")
    starts = np.searchsorted(ray[order], np.arange(0, len(angles) + _RAYS_AT_ONCE, _RAYS_AT_ONCE))
    for number, (low, high) in enumerate(pairwise(starts)):
        rows = order[low:high]
        some = slice(number * _RAYS_AT_ONCE, (number + 1) * _RAYS_AT_ONCE)
        if not len(rows):
            continue
        distance = (np.arange(int(samples[rows].max())) + 1.0) * 0.5 * field.cell_m
        tops = field.at(
            centre[0] + distance[None, :] * np.cos(angles[some])[:, None],
            centre[1] + distance[None, :] * np.sin(angles[some])[:, None],
        )
        slope = (tops - centre[2] - _CLEARANCE_M) / distance
        horizon = np.maximum.accumulate(slope, axis=1)
        met[rows] = horizon[ray[rows] - some.start, samples[rows] - 1]
    return met


def _passes_z_buffer(camera: Camera, pixels: Floats, depth: Floats, footprint: Floats) -> Bools:
    """Drops returns that are alone or behind a depth edge, in bins as large as the returns are apart.

    Near returns are further apart in pixels than far ones: bins double from level to level. A return blocks on the
    level of its own footprint, and is judged on that level and on those of all returns that may be nearer.
    """
    keep = np.ones(len(pixels), np.bool_)
    if not len(pixels):
        return keep
    inverse = 1.0 / depth
    bin_px = np.maximum(_BIN_SPACINGS * footprint, _SMALLEST_BIN_PX)
    finest = float(bin_px.min())
    level = np.clip(np.ceil(np.log2(bin_px / finest) - 1e-9), 0, _LEVELS - 1).astype(np.int64)
    for k in np.unique(level):
        size = finest * 2.0**k
        shape = int(camera.width // size) + 3, int(camera.height // size) + 3
        cell = np.clip(np.floor((pixels + 0.5) / size).astype(np.int64) + 1, 0, (shape[0] - 1, shape[1] - 1))
        flat = cell[:, 0] * shape[1] + cell[:, 1]
        own, judged = level == k, level <= k
        near, far = np.zeros(shape[0] * shape[1]), np.full(shape[0] * shape[1], np.inf)
        np.maximum.at(near, flat[own], inverse[own])
        np.minimum.at(far, flat, inverse)
        q, at = inverse[judged], flat[judged]
        rise = ndimage.maximum_filter(near.reshape(shape), 3).reshape(-1)[at] - q
        fall = q - ndimage.minimum_filter(far.reshape(shape), 3).reshape(-1)[at]
        keep[judged] &= rise <= np.maximum(_EDGE_SHARE * q, _EDGE_ASYMMETRY * fall)
        count = np.bincount(flat, minlength=near.size).reshape(shape)
        around = ndimage.convolve(count, np.ones((3, 3), np.int64), mode="constant").reshape(-1)
        keep[own] &= around[flat[own]] >= _FEWEST_IN_BINS
    return keep
