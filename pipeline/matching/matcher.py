"""The one interface of all matchers: features once per image, then candidates of a pair where the pose allows them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from pipeline.geometry.arrays import Bytes, Floats, Ints
from pipeline.geometry.cameras import Camera, PixelSigma
from pipeline.geometry.poses import RelativePose
from pipeline.matching.features import Extractor, Features
from pipeline.matching.reach import Band, Reach, rays_in_ref


@dataclass(frozen=True, slots=True)
class View:
    """One image of a pair.

    Args:
        camera: Its camera.
        image: (height, width) grey, or (height, width, 3) for a matcher of colour images; as given.
        features: Its features; none for a dense matcher.
    """

    camera: Camera
    image: Bytes
    features: Features

    @property
    def grey(self) -> Bytes:
        """(height, width): the image's luminance."""
        if self.image.ndim == 2:
            return self.image
        return np.asarray(cv2.cvtColor(self.image, cv2.COLOR_RGB2GRAY), np.uint8)


@dataclass(frozen=True, slots=True)
class SearchLimits:
    """Limits of the search.

    Args:
        band: Of the epipolar search.
        consensus_px: Largest residual from the pair's own epipolar geometry.
        max_image_px: Longest side images are matched at; the limits in pixels are at that size.
    """

    band: Band
    consensus_px: float
    max_image_px: int

    def shrink(self, camera: Camera) -> float:
        """How many pixels of an image as given are one at the size it is matched at."""
        return PixelSigma(1.0, self.max_image_px).of(camera)

    def pixel_rad(self, camera: Camera) -> float:
        """The angle of one pixel at the size an image is matched at."""
        return self.shrink(camera) / camera.focal_px

    def reach(
        self, ref_px: Floats, ref_camera: Camera, src_px: Floats, src_camera: Camera, pose: RelativePose
    ) -> Reach:
        """Which of n ref pixels may match which of m src pixels.

        Args:
            ref_px: (n, 2) pixels as given.
            ref_camera: Camera of ref.
            src_px: (m, 2) pixels as given.
            src_camera: Camera of src.
            pose: src_from_ref with its covariance.
        """
        return Reach.between(
            rays_in_ref(ref_px, ref_camera, np.eye(3)),
            rays_in_ref(src_px, src_camera, pose.rotation.T),
            pose,
            self.band,
            (self.pixel_rad(ref_camera), self.pixel_rad(src_camera)),
        )

    def prior_variance(self, ref: Camera, src: Camera) -> float:
        """Variance (px^2 of src as given) of a matched position per axis: the errors of both images, seen in src."""
        in_ref, in_src = (self.band.sigma_px * self.shrink(camera) for camera in (ref, src))
        return float(in_src**2 + (in_ref * src.focal_px / ref.focal_px) ** 2)


@dataclass(frozen=True, slots=True)
class Candidates:
    """Matches as a matcher makes them.

    Args:
        ref_px: (n, 2) pixels of the ref image as given.
        src_px: (n, 2) pixels of the src image as given.
        score: (n,) the matcher's own, 0 to 1.
        variance_px2: (n,) of the src position per axis, ref's taken as given.
    """

    ref_px: Floats
    src_px: Floats
    score: Floats
    variance_px2: Floats

    @classmethod
    def of_features(
        cls, ref: View, src: View, rows: tuple[Ints, Ints], score: Floats, limits: SearchLimits
    ) -> Candidates:
        """Pairs of features, all of the same variance.

        Args:
            ref: The image that gets the depth.
            src: The other.
            rows: Indices of the ref and of the src features.
            score: Of the pairs.
            limits: With the features' sigma.
        """
        return cls.alike(ref.features.pixels[rows[0]], src.features.pixels[rows[1]], score, ref, src, limits)

    @classmethod
    def alike(
        cls, ref_px: Floats, src_px: Floats, score: Floats, ref: View, src: View, limits: SearchLimits
    ) -> Candidates:
        """Positions that are all as good as a feature's."""
        return cls(ref_px, src_px, score, np.full(len(score), limits.prior_variance(ref.camera, src.camera)))


class Matcher(Protocol):
    """Finds correspondences of two images of known relative pose."""

    @property
    def extractor(self) -> Extractor | None:
        """What finds the features of one image; None for a dense matcher, which has none."""

    @property
    def colour(self) -> bool:
        """Whether it looks at colours."""

    def candidates(self, ref: View, src: View, pose: RelativePose, limits: SearchLimits) -> Candidates:
        """Correspondences within what the pose and the nearest range allow; none is made outside.

        Args:
            ref: The image that gets the depth.
            src: The other.
            pose: src_from_ref with its covariance.
            limits: Of the search.
        """
