"""Matches of one pair: candidates, duplicates, the fit of their patches, the logged pose's error, the consensus.

The fit of the patches both finds the position to a fraction of a pixel and tells right from wrong: where no affine
warp makes the patches alike the match is none, whatever the descriptors say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.poses import RelativePose
from pipeline.matching.matcher import Matcher, SearchLimits, View
from pipeline.matching.patches.subpixel import PatchSetting, Refined, refine
from pipeline.matching.patches.warps import predicted_affines
from pipeline.matching.reach import rays_in_ref
from pipeline.matching.verify import consensus, epipolar_residuals, without_duplicates


@dataclass(frozen=True, slots=True)
class PairMatches:
    """Matches of a pair.

    Args:
        ref_px: (n, 2) pixels of the ref image as given.
        src_px: (n, 2) pixels of the src image as given.
        score: (n,) the matcher's own, 0 to 1.
        covariance: (n, 3) px^2 of the src position, ref's taken as given: uu, uv, vv.
        inlier: (n,) its patches fit, and it agrees with the pose within its error and with the pair's consensus.
    """

    ref_px: Floats
    src_px: Floats
    score: Floats
    covariance: Floats
    inlier: Bools


def match_pair(
    matcher: Matcher,
    ref: View,
    src: View,
    pose: RelativePose,
    limits: SearchLimits,
    *,
    up_in_ref: Floats | None = None,
    subpixel: bool = True,
) -> PairMatches:
    """Matches two images under a pose with known covariance.

    Args:
        matcher: Makes the candidates.
        ref: The image that gets the depth.
        src: The other.
        pose: src_from_ref with its covariance.
        limits: Of the search.
        up_in_ref: (3,) the vertical on the ref camera's axes; level ground is then one guess at a patch's surface.
        subpixel: Whether matches are moved to where their patches fit, and refused where these do not.
    """
    made = matcher.candidates(ref, src, pose, limits)
    cells = limits.shrink(ref.camera), limits.shrink(src.camera)
    keep = without_duplicates(made.ref_px, made.src_px, made.score, cells)
    ref_px, src_px, variance = made.ref_px[keep], made.src_px[keep], made.variance_px2[keep]
    covariance = np.stack([variance, np.zeros_like(variance), variance], axis=1)
    good = np.ones(len(ref_px), np.bool_)
    if subpixel:
        fitted = _fitted(ref_px, src_px, ref, src, pose, limits, up_in_ref)
        good = fitted.refined
        src_px[good], covariance[good] = fitted.src_px[good], fitted.covariance[good]
        # Neighbouring cells of a semi-dense matcher may find the same place.
        good[good] = without_duplicates(ref_px[good], src_px[good], made.score[keep][good])
    good[good] = _agreeing(ref_px[good], src_px[good], covariance[good], ref, src, pose, limits)
    return PairMatches(ref_px, src_px, made.score[keep], covariance, good)


def _fitted(
    ref_px: Floats,
    src_px: Floats,
    ref: View,
    src: View,
    pose: RelativePose,
    limits: SearchLimits,
    up_in_ref: Floats | None,
) -> Refined:
    warps = predicted_affines(ref_px, src_px, ref.camera, src.camera, pose, up_in_ref=up_in_ref)
    return refine(ref.grey, src.grey, ref_px, src_px, warps, PatchSetting(limits.max_image_px))


def _agreeing(
    ref_px: Floats,
    src_px: Floats,
    covariance: Floats,
    ref: View,
    src: View,
    pose: RelativePose,
    limits: SearchLimits,
) -> Bools:
    """Which matches agree with the pose within its error, and then with one another."""
    ref_ray = rays_in_ref(ref_px, ref.camera, np.eye(3))
    src_ray = rays_in_ref(src_px, src.camera, pose.rotation.T)
    in_src = src_ray @ pose.rotation.T
    noise = src.camera.plane_covariance(in_src / in_src[:, 2:], covariance)
    residual = epipolar_residuals(ref_ray, src_ray, pose, noise)
    inlier: Bools = np.abs(residual.angle_rad) <= limits.band.sigmas * residual.sigma_rad
    inlier[inlier] = consensus(
        image_plane(ref_ray[inlier]),
        image_plane(in_src[inlier]),
        limits.consensus_px * limits.pixel_rad(ref.camera),
    )
    return inlier


def image_plane(rays: Floats) -> Floats:
    """(n, 2) coordinates at z = 1 of (n, 3) rays."""
    return rays[:, :2] / rays[:, 2:]
