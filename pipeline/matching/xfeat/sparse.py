"""XFeat by kornia: sparse keypoints of 64 numbers each.

Potje, Cadar, Araujo, Martins and Nascimento, "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024.
Its keypoints are whole pixels of the image it looks at; `subpixel` makes them better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from pipeline.geometry.arrays import AnyArray, Bytes, Singles
from pipeline.matching.features import Features
from pipeline.matching.xfeat.network import XFeatNetwork, padded


@dataclass(frozen=True, slots=True)
class XFeatExtractor:
    """XFeat's sparse keypoints, the strongest first.

    Args:
        network: The network.
        max_image_px: Longest side an image is looked at.
        max_features: Most features kept.
        threshold: Least keypoint probability, the network's own.
    """

    network: XFeatNetwork
    max_image_px: int
    max_features: int
    threshold: float = 0.05

    @property
    def settings(self) -> str:
        """As `Extractor.settings`."""
        return f"xfeat-1 {self.network.settings} {self.max_image_px} {self.max_features} {self.threshold}"

    @property
    def batch(self) -> int:
        """As `Extractor.batch`."""
        return self.network.batch

    def detect(self, pieces: Sequence[Bytes]) -> list[Features]:
        """As `Extractor.detect`."""
        return self.network.each(self._run, pieces)

    def _run(self, pieces: Sequence[Bytes], device: torch.device) -> list[Features]:
        found = self.network.model.to(device).detectAndCompute(
            padded(pieces).to(device), self.max_features, self.threshold
        )
        return [_features(one, piece.shape) for one, piece in zip(found, pieces, strict=True)]


def _features(found: dict[str, torch.Tensor], shape: tuple[int, ...]) -> Features:
    pixels = found["keypoints"].cpu().numpy().astype(np.float64)
    height, width = shape
    inside = np.flatnonzero((pixels[:, 0] < width) & (pixels[:, 1] < height))
    return Features(
        pixels, found["descriptors"].cpu().numpy(), found["scores"].cpu().numpy(), np.ones(len(pixels), np.float32)
    ).take(inside)


def unit(descriptors: AnyArray) -> Singles:
    """(n, d) descriptors scaled to unit length, float32."""
    length = np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
    out: Singles = (descriptors / length).astype(np.float32)
    return out
