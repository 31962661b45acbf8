"""Depths of a pair's matches by every method, and which of them may be published."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import AnyArray, Bools, Floats
from pipeline.geometry.cameras import Camera
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
from pipeline.matching.verify import epipolar_residuals

METHODS = ("epitransfer", "dlt", "epitransfer-lateral", "epitransfer-vertical")
NO_DEPTH = "the rays do not meet in front of the cameras"
TOO_UNCERTAIN = "sigma above depth.max_relative_sigma"
TOO_FAR = "beyond depth.max_range_m"
MISSES = "the rays miss each other by more than depth.max_miss_sigmas"
# A median of absolute values as the sigma of a Gaussian.
_SIGMA_OF_MEDIAN = 1.4826


@dataclass(frozen=True, slots=True)
class Limits:
    """What a published depth has to keep.

    Args:
        max_relative_sigma: Largest predicted sigma over depth.
        max_range_m: Largest distance from the ref camera.
        max_miss_sigmas: How far the two rays may miss each other, in sigmas of pose and pixels.
        usual_miss_rad: Median of how far the pair's rays miss each other under its pose: an uncalibrated lens makes all
            miss by more than their sigmas, and that is no reason to distrust a few.
    """

    max_relative_sigma: float
    max_range_m: float
    max_miss_sigmas: float = np.inf
    usual_miss_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class MatchedRays:
    """Matches of a pair as rays.

    Args:
        ref: (2, n) ideal image-plane coordinates in ref.
        src: (2, n) ideal image-plane coordinates in src.
        noise: Covariance of the matched positions: all of it in src, for the depth is that of the ref pixel as given.
    """

    ref: Floats
    src: Floats
    noise: PixelNoise

    @classmethod
    def of(
        cls, ref_px: Floats, src_px: Floats, ref_camera: Camera, src_camera: Camera, covariance: Floats
    ) -> MatchedRays:
        """Removes the lens distortion from pixels and from their noise.

        Args:
            ref_px: (n, 2) pixels as given.
            src_px: (n, 2) pixels as given.
            ref_camera: Camera of ref.
            src_camera: Camera of src.
            covariance: (n, 3) px^2 of the src pixels, ref's taken as given: uu, uv, vv.
        """
        ref, src = ref_camera.rays(ref_px), src_camera.rays(src_px)
        noise = PixelNoise(np.zeros(3), src_camera.plane_covariance(src, covariance))
        return cls(np.ascontiguousarray(ref[:, :2].T), np.ascontiguousarray(src[:, :2].T), noise)


@dataclass(frozen=True, slots=True)
class MethodDepths:
    """Depths by one method.

    Args:
        depths: With variance and normal.
        pixel_sigma_m: (n,) the part of the depth's sigma that the matched positions have.
        parallax_rad: (n,).
        transfer_angle_rad: (n,).
        kept: (n,).
        reason: (n,) text; empty when kept.
    """

    depths: Depths
    pixel_sigma_m: Floats
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
        pixels = _pixel_sigma(found, rays, pose)
    return MethodDepths(found, pixels, parallax(rays.ref, rays.src, pose), angle, kept, reason)


def _pixel_sigma(found: Depths, rays: MatchedRays, pose: RelativePose) -> Floats:
    """How far one sigma of the src pixel moves the depth: by the normal, as any displacement of the src ray does."""
    point = found.depth_m * np.concatenate([rays.ref, np.ones((1, found.depth_m.size))]) - pose.centre[:, None]
    depth_in_src = pose.rotation[2] @ point
    along_x, along_y = (found.normal @ pose.rotation[:2].T).T
    xx, xy, yy = rays.noise.src
    out: Floats = np.abs(depth_in_src) * np.sqrt(along_x * (along_x * xx + 2.0 * along_y * xy) + along_y * along_y * yy)
    return out


def _masked(found: Depths, rays: MatchedRays, pose: RelativePose, limits: Limits) -> tuple[Bools, AnyArray]:
    depth = found.depth_m
    ray = np.concatenate([rays.ref, np.ones((1, depth.size))])
    with np.errstate(invalid="ignore", over="ignore"):
        behind_src = ((depth * ray - pose.centre[:, None]).T @ pose.rotation.T)[:, 2] <= 0.0
        none = ~(np.isfinite(depth) & (depth > 0.0)) | behind_src
        sigma = np.sqrt(found.variance_m2)
        uncertain = ~(sigma <= limits.max_relative_sigma * depth)
        misses = _misses(rays, pose, limits)
        far = depth * np.linalg.norm(ray, axis=0) > limits.max_range_m
    reason = np.select([none, misses, uncertain, far], [NO_DEPTH, MISSES, TOO_UNCERTAIN, TOO_FAR], "")
    return reason == "", reason


def _misses(rays: MatchedRays, pose: RelativePose, limits: Limits) -> Bools:
    """Where the src ray is too far off the plane of the ref ray and the baseline for their errors."""
    if not np.isfinite(limits.max_miss_sigmas):
        return np.zeros(rays.ref.shape[1], np.bool_)
    one = np.ones((1, rays.ref.shape[1]))
    ref, src = (np.concatenate([xy, one]).T for xy in (rays.ref, rays.src))
    found = epipolar_residuals(ref, src @ pose.rotation, pose, rays.noise.src)
    allowed = np.maximum(found.sigma_rad, _SIGMA_OF_MEDIAN * limits.usual_miss_rad)
    out: Bools = np.abs(found.angle_rad) > limits.max_miss_sigmas * allowed
    return out
