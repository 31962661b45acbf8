"""SIFT by OpenCV, compared as RootSIFT."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.geometry.arrays import AnyArray, Bytes, Singles
from pipeline.matching.features import Features


@dataclass(frozen=True, slots=True)
class SiftExtractor:
    """SIFT, the strongest features first.

    Args:
        max_image_px: Longest side the image is matched at.
        max_features: Most features kept.
        contrast: Detection threshold.
    """

    max_image_px: int
    max_features: int = 8192
    contrast: float = 0.02
    batch: int = 1

    @property
    def settings(self) -> str:
        """As `Extractor.settings`."""
        return f"sift-5 {cv2.__version__} {self.max_image_px} {self.max_features} {self.contrast}"

    def detect(self, pieces: Sequence[Bytes]) -> list[Features]:
        """As `Extractor.detect`."""
        return [self._of(piece) for piece in pieces]

    def _of(self, grey: Bytes) -> Features:
        # Without the precise upscale every keypoint lies a quarter of a pixel too far right and down.
        detector = cv2.SIFT.create(
            nfeatures=self.max_features, contrastThreshold=self.contrast, enable_precise_upscale=True
        )
        keypoints, descriptors = detector.detectAndCompute(np.ascontiguousarray(grey), None)
        if descriptors is None or not keypoints:
            return Features.none()
        pixels = np.array([point.pt for point in keypoints], np.float64)
        strength = np.array([point.response for point in keypoints], np.float32)
        return Features(pixels, descriptors.astype(np.uint8), strength, np.ones(len(pixels), np.float32))


def root_sift(descriptors: AnyArray) -> Singles:
    """Unit descriptors: the square root of the L1-normalised ones (Arandjelovic and Zisserman, CVPR 2012).

    Args:
        descriptors: (n, d) uint8.

    Returns:
        (n, d) float32.
    """
    values = descriptors.astype(np.float32)
    total = np.maximum(values.sum(axis=1, keepdims=True), np.float32(1e-12))
    out: Singles = np.sqrt(values / total)
    return out
