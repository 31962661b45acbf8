"""Points that stand where other frames look through: a frame that saw a point saw nothing before it.

A point that projects to where a frame observed another point, and lies clearly nearer, would have hidden it. One frame
may be mistaken, as the point's own may be: it takes more of them than had a part in the point.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.geodesy.transform import FrameTransform
from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.geometry.poses import Placement
from pipeline.geometry.rotations import skew
from pipeline.points.covariances import of_groups
from pipeline.points.merge import Merged
from pipeline.points.observed import Observed

# As far from the other point's pixel as matching may be off.
_REACH_PX = 1.5
# Where a frame sees the point has to be known to less than that, or it may see it beside the other: a thin pole before
# the ground.
_PLACED_PX = 0.75
_SIGMAS = 3.0
# The two may lie on one slanted surface, a pixel and a half apart: level ground seen at 2 degrees below the horizon.
_SHARE = 0.05
# More than the point's own, and never one alone.
_LEAST_FRAMES = 2


@dataclass(frozen=True, slots=True)
class Views:
    """The frames as they look at the points.

    Args:
        names: Of the frames by their numbers.
        cameras: By name.
        placements: Where they stand, by name.
        errors: Between the frames.
        transform: From ENU to the dataset's CRS.
    """

    names: Sequence[str]
    cameras: Mapping[str, Camera]
    placements: Mapping[str, Placement]
    errors: PoseErrors
    transform: FrameTransform


@dataclass(frozen=True, slots=True)
class _Claims:
    """What a frame holds against points: their rows, those of the points it saw instead, and where both lie from it."""

    point: Ints
    seen: Ints
    to_point: Floats
    to_seen: Floats


def looked_through(observed: Observed, track: Ints, merged: Merged, views: Views) -> Bools:
    """Which merged points more frames looked through than had a part in.

    Args:
        observed: The observations that were merged.
        track: (n,) their rows of `merged`.
        merged: The points.
        views: The frames.

    Returns:
        (m,) of the points.
    """
    p_in_enu = views.transform.enu_from(merged.xyz)
    # Each observation is one sight of its track from ref and one from src.
    frame = observed.frames.T.reshape(-1)
    pixel = np.concatenate([observed.ref_px, observed.src_px])
    of_track = np.tile(track, 2)
    against = np.zeros(len(merged.xyz), np.int64)
    for number in np.unique(frame):
        sights = np.flatnonzero(frame == number)
        placed = views.placements[views.names[number]]
        camera = views.cameras[views.names[number]]
        claims = _claims(p_in_enu, placed, camera, pixel[sights], of_track[sights])
        if len(claims.point):
            sure = _sure(claims, observed, merged, views, int(number))
            against[np.unique(claims.point[sure])] += 1
    out: Bools = (against >= _LEAST_FRAMES) & (against > merged.n_frames)
    return out


def _claims(p_in_enu: Floats, placed: Placement, camera: Camera, pixel: Floats, seen: Ints) -> _Claims:
    """Points that project beside a pixel where the frame saw another, and are nearer by a share."""
    in_cam = (p_in_enu - placed.centre) @ placed.rotation
    own = np.zeros(len(p_in_enu), bool)
    own[seen] = True
    rows = np.flatnonzero(~own & _in_view(in_cam, camera) & (in_cam[:, 2] < np.max(in_cam[seen, 2])))
    at = camera.project(in_cam[rows])
    inside = np.isfinite(at).all(axis=1)
    rows, at = rows[inside], at[inside]
    found = cKDTree(pixel).query(at, distance_upper_bound=_REACH_PX)
    distance, nearest = np.asarray(found[0]), np.asarray(found[1])
    hit = np.isfinite(distance)
    point, other = rows[hit], seen[nearest[hit]]
    nearer = in_cam[point, 2] < (1.0 - _SHARE) * in_cam[other, 2]
    point, other = point[nearer], other[nearer]
    return _Claims(point, other, p_in_enu[point] - placed.centre, p_in_enu[other] - placed.centre)


def _in_view(in_cam: Floats, camera: Camera) -> Bools:
    """Whether points may be in the image: those in the cone about its corners' rays, before the costly projection."""
    corners = np.array([[u, v] for u in (0.0, camera.width - 1.0) for v in (0.0, camera.height - 1.0)])
    rays = camera.rays(corners)
    widest = np.max(np.linalg.norm(rays[:, :2], axis=1), initial=0.0) if np.isfinite(rays).all() else np.inf
    z = in_cam[:, 2]
    out: Bools = (z > 0.0) & (np.linalg.norm(in_cam[:, :2], axis=1) <= widest * z)
    return out


def _sure(claims: _Claims, observed: Observed, merged: Merged, views: Views, frame: int) -> Bools:
    """Which claims hold: the point is nearer by more than both errors, and its place in the image is known."""
    name = views.names[frame]
    to_crs = views.transform.jacobian(views.placements[name].centre)
    of_point, known = _relative(merged.best[claims.point], claims.to_point, observed, views.errors, frame, to_crs)
    of_seen, known_too = _relative(merged.best[claims.seen], claims.to_seen, observed, views.errors, frame, to_crs)
    range_m = np.linalg.norm(claims.to_point, axis=1)
    sight = claims.to_point @ to_crs.T / range_m[:, None]
    gap = np.sum((merged.xyz[claims.seen] - merged.xyz[claims.point]) * sight, axis=1)
    apart = gap > _SIGMAS * np.sqrt(np.einsum("ni,nij,nj->n", sight, of_point + of_seen, sight))
    across = np.eye(3) - sight[:, :, None] * sight[:, None, :]
    beside_m = np.sqrt(np.trace(across @ of_point @ across, axis1=1, axis2=2) / 2.0)
    placed = beside_m * views.cameras[name].focal_px <= _PLACED_PX * range_m
    out: Bools = apart & placed & known & known_too
    return out


def _relative(
    best: Ints, offset: Floats, observed: Observed, errors: PoseErrors, frame: int, to_crs: Floats
) -> tuple[Floats, Bools]:
    """Covariance of points' errors less the displacement of a frame's rays there, by their best observations.

    What the frame shares with those that made the point does not count: it moves both.

    Args:
        best: (n,) rows of the observations.
        offset: (n, 3) m, ENU, from the frame to the points.
        observed: The observations.
        errors: Between the frames.
        frame: Number of the frame.
        to_crs: (3, 3) from ENU to the dataset's CRS.

    Returns:
        (n, 3, 3) m^2 and (n,) whether every covariance between the frames is kept.
    """
    of_best = observed.jacobian[best].reshape(-1, 3, 2, 6).transpose(0, 2, 1, 3)
    by_frame = to_crs @ np.concatenate([-skew(offset), np.broadcast_to(np.eye(3), (len(best), 3, 3))], axis=2)
    factors = np.concatenate([of_best, -by_frame[:, None]], axis=1)
    frames = np.concatenate([observed.frames[best], np.full((len(best), 1), frame)], axis=1)
    found, known = of_groups(factors, frames, errors)
    return found + observed.independent[best], known
