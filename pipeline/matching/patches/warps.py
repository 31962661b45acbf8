"""How a small patch about a match looks from the other image: the affine warp that pose, depth and surface predict.

A surface element at the match's point X with normal n is cut by the neighbouring ref rays at the depths that keep
n . X; their points, seen by src, move with the pixel by the derivative of that chain. Both lenses' distortion is in
it. Which way the surface faces is not known, so there is one warp per candidate: facing the two cameras, and, where
the direction of up is known, level ground. Where the pose gives no depth, the turn of the camera alone is taken.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import RelativePose
from pipeline.geometry.transfer import VirtualView, transfer

# A plane seen at less than this sine from either camera is not what a matched patch lies on.
_LEAST_SINE = 0.1
# Beyond this stretch or squeeze no matcher would have matched the patch: the depth is wrong.
_LARGEST_STRETCH = 4.0


def predicted_affines(
    ref_px: Floats,
    src_px: Floats,
    ref_camera: Camera,
    src_camera: Camera,
    pose: RelativePose,
    *,
    up_in_ref: Floats | None = None,
) -> tuple[Floats, ...]:
    """Derivatives of the src pixel by the ref pixel on a surface at each match's depth, one set per orientation.

    Args:
        ref_px: (n, 2) pixels of the ref image as given.
        src_px: (n, 2) pixels of the src image as given.
        ref_camera: Camera of ref.
        src_camera: Camera of src.
        pose: src_from_ref.
        up_in_ref: (3,) any length, the vertical on the ref camera's axes (RDF); adds level ground as a candidate.

    Returns:
        (n, 2, 2) each: first the surface facing the cameras, then, with `up_in_ref`, level ground (the facing one
        where that is seen edge-on or from below by one of the cameras); NaN where a pixel has no ray.
    """
    rays, src_rays = ref_camera.rays(ref_px), src_camera.rays(src_px)
    depth_m = transfer(rays[:, :2].T, src_rays[:, :2].T, pose, VirtualView.ADAPTIVE)
    turn = plane_affines(rays, rays, np.full(len(rays), np.inf), ref_camera, src_camera, pose)
    facing = _facing(rays, depth_m, pose)
    chosen = _where_sane(plane_affines(rays, facing, depth_m, ref_camera, src_camera, pose), turn)
    if up_in_ref is None:
        return (chosen,)
    level = np.broadcast_to(np.asarray(up_in_ref, np.float64), rays.shape)
    seen = _seen_alike(level, rays, depth_m, pose)
    ground = plane_affines(rays, level, depth_m, ref_camera, src_camera, pose)
    return chosen, _where_sane(np.where(seen[:, None, None], ground, np.nan), chosen)


def plane_affines(
    rays: Floats, normals: Floats, depth_m: Floats, ref_camera: Camera, src_camera: Camera, pose: RelativePose
) -> Floats:
    """Derivatives of the src pixel by the ref pixel on planes through the points at given depths.

    Args:
        rays: (n, 3) ref rays with z = 1.
        normals: (n, 3) of the planes on the ref camera's axes, any length and sign.
        depth_m: (n,) along ref's optical axis; infinite for the turn of the camera alone.
        ref_camera: Camera of ref.
        src_camera: Camera of src.
        pose: src_from_ref.

    Returns:
        (n, 2, 2); NaN where src does not see the point, or the plane contains the ray.
    """
    inverse = 1.0 / np.where(depth_m > 0.0, depth_m, np.nan)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # In units of the depth, so that points at infinity are points too.
        seen = rays @ pose.rotation.T + inverse[:, None] * pose.translation
        src_rays = seen / np.where(seen[:, 2:] > 0.0, seen[:, 2:], np.nan)
        slope = -normals[:, :2] / np.sum(normals * rays, axis=1)[:, None]
        on_plane = np.eye(3, 2) + rays[:, :, None] * slope[:, None, :]
        # The pinhole's derivative: the share along the viewing ray does not show.
        flat = np.concatenate([np.broadcast_to(np.eye(2), (len(rays), 2, 2)), -src_rays[:, :2, None]], axis=2)
        ideal = (flat @ (pose.rotation @ on_plane)) / seen[:, 2, None, None]
        # A plane through infinity is infinity's own: there the depth's slope moves nothing.
        from_ref = inverse_2x2(ref_camera.pixel_jacobian(rays))
        out: Floats = src_camera.pixel_jacobian(src_rays) @ ideal @ from_ref
    return out


def _facing(rays: Floats, depth_m: Floats, pose: RelativePose) -> Floats:
    """(n, 3): the bisector of the directions to both cameras, the orientation that both see best."""
    to_ref = -rays
    with np.errstate(invalid="ignore"):
        to_src = pose.centre - rays * depth_m[:, None]
        units = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in (to_ref, to_src)]
    out: Floats = units[0] + units[1]
    return out


def _seen_alike(normals: Floats, rays: Floats, depth_m: Floats, pose: RelativePose) -> Bools:
    """Whether both cameras see the same side of a plane, neither of them edge-on."""
    units = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        points = rays * depth_m[:, None]
        ref, src = (np.sum(units * v, axis=1) / np.linalg.norm(v, axis=1) for v in (points, points - pose.centre))
    out: Bools = (np.minimum(np.abs(ref), np.abs(src)) >= _LEAST_SINE) & (ref * src > 0.0)
    return out


def _where_sane(warps: Floats, otherwise: Floats) -> Floats:
    """Warps that neither mirror nor stretch beyond reason; the others replaced."""
    determinant = warps[:, 0, 0] * warps[:, 1, 1] - warps[:, 0, 1] * warps[:, 1, 0]
    # Singular values a >= b from a b and a^2 + b^2.
    total = np.sum(warps**2, axis=(1, 2))
    with np.errstate(invalid="ignore"):
        largest = np.sqrt(0.5 * (total + np.sqrt(np.maximum(total**2 - 4.0 * determinant**2, 0.0))))
        sane = (determinant > 0.0) & (largest <= _LARGEST_STRETCH) & (determinant >= largest / _LARGEST_STRETCH)
    return np.where(sane[:, None, None], warps, otherwise)


def inverse_2x2(matrices: Floats) -> Floats:
    """(n, 2, 2) inverses; not finite for a singular one, for which numpy would refuse them all."""
    a, b, c, d = (matrices[:, i, j] for i in (0, 1) for j in (0, 1))
    adjugate = np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        out: Floats = adjugate / (a * d - b * c)[:, None, None]
    return out
