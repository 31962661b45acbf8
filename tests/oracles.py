"""Textbook constructions, written without regard to speed, that the closed forms are held against."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.geometry.arrays import Floats
from pipeline.geometry.poses import RelativePose
from pipeline.geometry.rotations import ENU_FROM_NED, FRD_FROM_RDF, skew
from pipeline.geometry.transfer import PixelNoise

LATERAL: Floats = np.array([1.0, 0.0, 0.0])
VERTICAL: Floats = np.array([0.0, 1.0, 0.0])


def enu_from_gimbal(yaw_rad: float, pitch_rad: float, roll_rad: float) -> Floats:
    """enu_from_cam of a gimbal that turns about the vertical, then the level forward axis, then the camera's right."""
    return ENU_FROM_NED @ Rotation.from_euler("ZXY", [yaw_rad, roll_rad, pitch_rad]).as_matrix() @ FRD_FROM_RDF


def fundamental(k: Floats, rotation_b_from_a: Floats, translation_b_from_a: Floats) -> Floats:
    """F = K^-T [t]x R K^-1, so that F x_a is the line of a's pixel x_a in b."""
    k_inv = np.linalg.inv(k)
    out: Floats = k_inv.T @ skew(translation_b_from_a) @ rotation_b_from_a @ k_inv
    return out


def transferred_depth(ref_xy: Floats, src_xy: Floats, pose: RelativePose, baseline_in_ref_m: Floats) -> Floats:
    """The paper's construction: both epipolar lines in the virtual view, their intersection, and its disparity.

    Args:
        ref_xy: (2, n) ideal image-plane coordinates in ref.
        src_xy: (2, n) ideal image-plane coordinates in src.
        pose: src_from_ref.
        baseline_in_ref_m: (3,) where the virtual view stands, in the image plane's directions.

    Returns:
        (n,) m.
    """
    k = np.array([[1120.0, 0.0, 799.5], [0.0, 1120.0, 599.5], [0.0, 0.0, 1.0]])
    b = float(np.linalg.norm(baseline_in_ref_m))
    u = baseline_in_ref_m / b
    # The virtual view has ref's axes: x_V = x_ref - b u, and x_ref = R^T (x_src - t).
    virtual_from_ref = fundamental(k, np.eye(3), -baseline_in_ref_m)
    virtual_from_src = fundamental(k, pose.rotation.T, -pose.rotation.T @ pose.translation - baseline_in_ref_m)
    depths = np.empty(ref_xy.shape[1])
    for i, (x_ref, x_src) in enumerate(zip(ref_xy.T, src_xy.T, strict=True)):
        pixel_ref, pixel_src = k @ (*x_ref, 1.0), k @ (*x_src, 1.0)
        pixel_virtual = np.cross(virtual_from_ref @ pixel_ref, virtual_from_src @ pixel_src)
        disparity_px = float(u[:2] @ (pixel_ref[:2] - pixel_virtual[:2] / pixel_virtual[2]))
        depths[i] = k[0, 0] * b / disparity_px
    return depths


def rays_in_ref(ref_xy: Floats, src_xy: Floats, pose: RelativePose) -> tuple[Floats, Floats]:
    """(n, 3) rays of ref with z = 1, and (n, 3) unit rays of src on ref's axes."""
    one = np.ones((1, ref_xy.shape[1]))
    ref = np.concatenate([ref_xy, one]).T
    src = np.concatenate([src_xy, one]).T @ pose.rotation
    return ref, src / np.linalg.norm(src, axis=1, keepdims=True)


def plane_ray_depth(ref_xy: Floats, src_xy: Floats, pose: RelativePose, baseline_in_ref_m: Floats) -> Floats:
    """(n,) m: the ref ray cut with the plane through the src centre, the virtual view and the src ray."""
    ref, src = rays_in_ref(ref_xy, src_xy, pose)
    normal = np.cross(baseline_in_ref_m - pose.centre, src)
    out: Floats = (normal @ pose.centre) / np.sum(normal * ref, axis=1)
    return out


def midpoint_depth(ref_xy: Floats, src_xy: Floats, pose: RelativePose) -> Floats:
    """(n,) m: the point of the ref ray nearest to the src ray, by least squares over both ray parameters."""
    ref, src = rays_in_ref(ref_xy, src_xy, pose)
    return np.array([np.linalg.lstsq(np.stack([d, -r], 1), pose.centre)[0][0] for d, r in zip(ref, src, strict=True)])


def displacement_covariance(
    x_ref: Floats, x_src: Floats, pose: RelativePose, noise: PixelNoise, depth_m: float
) -> Floats:
    """(3, 3) m^2: the gap between the two rays at the point, from pose and both pixels, on ref's axes.

    Args:
        x_ref: (2,) ideal image-plane coordinates in ref.
        x_src: (2,) ideal image-plane coordinates in src.
        pose: src_from_ref with its covariance.
        noise: (3,) each.
        depth_m: Of the point on the ref ray; it fixes where along the src ray the point lies.
    """
    point = depth_m * np.array([*x_ref, 1.0])
    ray = pose.rotation.T @ (*x_src, 1.0)
    # The point of the src ray at the same depth in ref.
    src_depth = (depth_m - pose.centre[2]) / ray[2]
    from_src = src_depth * ray
    jacobian = np.hstack([-skew(from_src), np.eye(3)])
    out: Floats = jacobian @ pose.covariance @ jacobian.T
    for scale, axes, (xx, xy, yy) in (
        (src_depth, pose.rotation.T, noise.src),
        (point[2], np.eye(3), noise.ref),
    ):
        across = scale * axes[:, :2]
        out = out + across @ np.array([[xx, xy], [xy, yy]]) @ across.T
    return out


def best_plane(x_ref: Floats, x_src: Floats, pose: RelativePose, covariance: Floats) -> tuple[float, float, Floats]:
    """Depth, variance and normal (scaled to 1 along the ref ray) of the best plane, n = P (P S P)^+ P r_t."""
    d = np.array([*x_ref, 1.0])
    r = pose.rotation.T @ (*x_src, 1.0)
    p = np.eye(3) - np.outer(r, r) / (r @ r)
    n = p @ np.linalg.pinv(p @ covariance @ p, rcond=1e-11, hermitian=True) @ p @ d
    n = n / (n @ d)
    return float(n @ pose.centre), float(n @ covariance @ n), n
