"""Matches of one pair: guided search, duplicates, the logged pose's own error, and the pair's consensus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Bools, Floats, Singles
from pipeline.geometry.cameras import Camera, PixelSigma
from pipeline.geometry.poses import RelativePose
from pipeline.matching.features import Features
from pipeline.matching.guided import Band, epipolar_angles, match_guided, rays_in_ref
from pipeline.matching.verify import consensus, epipolar_residuals, without_duplicates


@dataclass(frozen=True, slots=True)
class PairImage:
    """One image of a pair.

    Args:
        features: Its features.
        camera: Its camera.
    """

    features: Features
    camera: Camera


@dataclass(frozen=True, slots=True)
class SearchLimits:
    """Limits of the search.

    Args:
        band: Of the epipolar search.
        ratio: Largest ratio of best to second-best distance.
        consensus_px: Largest residual from the pair's own epipolar geometry.
        max_image_px: Longest side images are matched at; the limits in pixels are at that size.
    """

    band: Band
    ratio: float
    consensus_px: float
    max_image_px: int

    def pixel_rad(self, camera: Camera) -> float:
        """The angle of one pixel at the size an image is matched at."""
        return PixelSigma(1.0, self.max_image_px).of(camera) / camera.focal_px


@dataclass(frozen=True, slots=True)
class PairMatches:
    """Matches of a pair.

    Args:
        ref_px: (n, 2) pixels of the ref image as given.
        src_px: (n, 2) pixels of the src image as given.
        score: (n,) higher is better.
        inlier: (n,) agrees with the pose within its error and with the pair's consensus.
    """

    ref_px: Floats
    src_px: Floats
    score: Floats
    inlier: Bools


def match_pair(ref: PairImage, src: PairImage, pose: RelativePose, limits: SearchLimits) -> PairMatches:
    """Matches two images under a pose with known covariance.

    Args:
        ref: The image that gets the depth.
        src: The other.
        pose: src_from_ref with its covariance.
        limits: Of the search.
    """
    ref_rays = rays_in_ref(ref.features.pixels, ref.camera, np.eye(3))
    src_rays = rays_in_ref(src.features.pixels, src.camera, pose.rotation.T)
    found = match_guided(
        root_sift(ref.features),
        root_sift(src.features),
        epipolar_angles(ref_rays, pose, limits.band, limits.pixel_rad(ref.camera)),
        epipolar_angles(src_rays, pose, limits.band, limits.pixel_rad(src.camera)),
        max_parallax_rad=_max_parallax(pose, limits.band.nearest_for(pose)),
        ratio=limits.ratio,
    )
    ref_px, src_px = ref.features.pixels[found.ref], src.features.pixels[found.src]
    keep = without_duplicates(ref_px, src_px, found.score)
    ref_px, src_px, score = ref_px[keep], src_px[keep], found.score[keep]
    ref_ray, src_ray = ref_rays[found.ref[keep]], src_rays[found.src[keep]]
    pixel_rad = limits.pixel_rad(ref.camera)
    residual = epipolar_residuals(ref_ray, src_ray, pose, limits.band.sigma_px * pixel_rad)
    inlier = np.abs(residual.angle_rad) <= limits.band.sigmas * residual.sigma_rad
    agreeing = consensus(
        ref_ray[inlier, :2] / ref_ray[inlier, 2:],
        image_plane(src_ray[inlier] @ pose.rotation.T),
        limits.consensus_px * pixel_rad,
    )
    inlier[inlier] = agreeing
    return PairMatches(ref_px, src_px, score, inlier)


def image_plane(rays: Floats) -> Floats:
    """(n, 2) coordinates at z = 1 of (n, 3) rays."""
    return rays[:, :2] / rays[:, 2:]


def root_sift(features: Features) -> Singles:
    """Unit descriptors: the square root of the L1-normalised ones (Arandjelovic and Zisserman, CVPR 2012).

    Returns:
        (n, d) float32.
    """
    values = features.descriptors.astype(np.float32)
    total = np.maximum(values.sum(axis=1, keepdims=True), np.float32(1e-12))
    out: Singles = np.sqrt(values / total)
    return out


def _max_parallax(pose: RelativePose, nearest_m: float) -> float:
    """The largest turn of a ray between the two centres for points no nearer than a range."""
    length = float(np.linalg.norm(pose.centre))
    return float(2.0 * np.arcsin(min(1.0, 0.5 * length / nearest_m)))
