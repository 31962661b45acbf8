"""Depths of a pair's matches by every method, and which of them may be published."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import AnyArray, Bools, Floats
from pipeline.geometry.cameras import Camera, PixelSigma
from pipeline.geometry.poses import RelativePose
from pipeline.geometry.transfer import (
    Depths,
    PixelNoise,
    VirtualView,
    parallax,
    transfer_angle,
    transfer_with_sigma,
    variance_at,
)
from pipeline.geometry.triangulation import dlt_depth

METHODS = ("epitransfer", "dlt", "epitransfer-lateral", "epitransfer-vertical")
NO_DEPTH = "the rays do not meet in front of the cameras"
TOO_UNCERTAIN = "sigma above depth.max_relative_sigma"
TOO_FAR = "beyond depth.max_range_m"


@dataclass(frozen=True, slots=True)
class Limits:
    """What a published depth has to keep.

    Args:
        max_relative_sigma: Largest predicted sigma over depth.
        max_range_m: Largest distance from the ref camera.
    """

    max_relative_sigma: float
    max_range_m: float


@dataclass(frozen=True, slots=True)
class MatchedRays:
    """Matches of a pair as rays.

    Args:
        ref: (2, n) ideal image-plane coordinates in ref.
        src: (2, n) ideal image-plane coordinates in src.
        noise: Covariance of both.
    """

    ref: Floats
    src: Floats
    noise: PixelNoise

    @classmethod
    def of(
        cls, ref_px: Floats, src_px: Floats, ref_camera: Camera, src_camera: Camera, sigma: PixelSigma
    ) -> MatchedRays:
        """Removes the lens distortion from pixels and from their noise.

        Args:
            ref_px: (n, 2) pixels as given.
            src_px: (n, 2) pixels as given.
            ref_camera: Camera of ref.
            src_camera: Camera of src.
            sigma: Of the pixels.
        """
        ref, src = ref_camera.rays(ref_px), src_camera.rays(src_px)
        noise = PixelNoise(_noise(ref_camera, ref, sigma.of(ref_camera)), _noise(src_camera, src, sigma.of(src_camera)))
        return cls(np.ascontiguousarray(ref[:, :2].T), np.ascontiguousarray(src[:, :2].T), noise)


def _noise(camera: Camera, rays: Floats, sigma_px: float) -> Floats:
    """(3, n) covariance xx, xy, yy on the image plane of isotropic pixel noise."""
    a, b, c, d = (camera.pixel_jacobian(rays)[:, i, j] for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
    determinant = a * d - b * c
    scale = (sigma_px / determinant) ** 2
    # The inverse of the Jacobian times its transpose.
    return np.stack([(d * d + b * b) * scale, -(c * d + a * b) * scale, (a * a + c * c) * scale])


@dataclass(frozen=True, slots=True)
class MethodDepths:
    """Depths by one method.

    Args:
        depths: With variance and normal.
        parallax_rad: (n,).
        transfer_angle_rad: (n,).
        kept: (n,).
        reason: (n,) text; empty when kept.
    """

    depths: Depths
    parallax_rad: Floats
    transfer_angle_rad: Floats
    kept: Bools
    reason: AnyArray


def depths_by(
    method: str, view: VirtualView, virtual_baseline_m: float, rays: MatchedRays, pose: RelativePose, limits: Limits
) -> MethodDepths:
    """Depths of a pair's matches by one of METHODS.

    Args:
        method: One of METHODS; "epitransfer" takes `view`.
        view: The configured virtual view.
        virtual_baseline_m: Distance of a lateral or vertical view.
        rays: The matches.
        pose: src_from_ref with covariance.
        limits: What a published depth has to keep.
    """
    if method == "dlt":
        depth = dlt_depth(rays.ref, rays.src, pose)
        variance, normal = variance_at(rays.ref, rays.src, pose, depth, rays.noise)
        found = Depths(depth, variance, normal)
    else:
        fixed = {"epitransfer-lateral": VirtualView.LATERAL, "epitransfer-vertical": VirtualView.VERTICAL}
        found = transfer_with_sigma(
            rays.ref, rays.src, pose, fixed.get(method, view), rays.noise, virtual_baseline_m=virtual_baseline_m
        )
    kept, reason = _masked(found, rays, pose, limits)
    with np.errstate(invalid="ignore"):
        # Where the view has no plane its normal is infinite, and the angle no number.
        angle = transfer_angle(rays.src, pose, found.normal)
    return MethodDepths(found, parallax(rays.ref, rays.src, pose), angle, kept, reason)


def _masked(found: Depths, rays: MatchedRays, pose: RelativePose, limits: Limits) -> tuple[Bools, AnyArray]:
    depth = found.depth_m
    ray = np.concatenate([rays.ref, np.ones((1, depth.size))])
    with np.errstate(invalid="ignore", over="ignore"):
        behind_src = ((depth * ray - pose.centre[:, None]).T @ pose.rotation.T)[:, 2] <= 0.0
        none = ~(np.isfinite(depth) & (depth > 0.0)) | behind_src
        sigma = np.sqrt(found.variance_m2)
        uncertain = ~(sigma <= limits.max_relative_sigma * depth)
        far = depth * np.linalg.norm(ray, axis=0) > limits.max_range_m
    reason = np.select([none, uncertain, far], [NO_DEPTH, TOO_UNCERTAIN, TOO_FAR], "")
    return reason == "", reason
