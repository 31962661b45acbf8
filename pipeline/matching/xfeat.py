"""XFeat by kornia: sparse keypoints of 64 numbers each, and mutual nearest neighbours of them in the band.

Potje, Cadar, Araujo, Martins and Nascimento, "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024.
Its keypoints are whole pixels of the image it looks at; `subpixel` makes them better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import kornia
import numpy as np
import torch
from kornia.feature import XFeat
from kornia.feature.xfeat import BasicLayer
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from pipeline.geometry.arrays import Bytes, Floats, Singles
from pipeline.geometry.poses import RelativePose
from pipeline.matching.devices import in_batches
from pipeline.matching.features import Features
from pipeline.matching.guided import match_guided
from pipeline.matching.matcher import Candidates, SearchLimits, View
from pipeline.matching.weights import FoundWeights, load_state, strict_load

# The network halves its image five times.
_MULTIPLE = 32


@dataclass(frozen=True)
class XFeatNetwork:
    """The network on its device, loaded when it is first needed.

    Args:
        weights: Its weights file.
        device: What it runs on.
        notes: Where it writes what the user should be told: that the device has too little memory.
    """

    weights: FoundWeights
    device: torch.device
    notes: list[str]

    @property
    def settings(self) -> str:
        """What its outputs depend on, as text."""
        return f"{self.weights.sha256} kornia {kornia.__version__} torch {torch.__version__} {self.device.type}"

    @cached_property
    def model(self) -> XFeat:
        """The network.

        Raises:
            InputError: The weights are damaged, or of another network.
        """
        model = XFeat()
        strict_load(model.net, load_state(self.weights), self.weights)
        return _folded(model.eval())

    @property
    def batch(self) -> int:
        """Images that are best looked at together: a processor gains nothing by it."""
        return 1 if self.device.type == "cpu" else 8


def _folded(model: XFeat) -> XFeat:
    """The same function with each normalisation folded into its convolution, in the layout convolutions like best.

    A third faster on a processor, and the same but for the last digits.
    """
    for layer in model.net.modules():
        if isinstance(layer, BasicLayer):
            convolution, normalisation, activation = layer.layer
            if isinstance(convolution, nn.Conv2d) and isinstance(normalisation, nn.BatchNorm2d):
                layer.layer = nn.Sequential(fuse_conv_bn_eval(convolution, normalisation), activation)
    model.net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return model


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
        network = self.network
        return in_batches(self._run, pieces, network.device, network.batch, network.notes)

    def _run(self, pieces: Sequence[Bytes], device: torch.device) -> list[Features]:
        found = self.network.model.to(device).detectAndCompute(
            padded(pieces).to(device), self.max_features, self.threshold
        )
        return [_features(one, piece.shape) for one, piece in zip(found, pieces, strict=True)]


def padded(pieces: Sequence[Bytes]) -> torch.Tensor:
    """Grey images of one size as a batch whose sides are multiples of 32, by repeating the last row and column.

    Resizing would move every keypoint by a fraction of a pixel and blur what is looked at.

    Args:
        pieces: (height, width) each.

    Returns:
        (n, 1, height', width') float32, 0 to 1.
    """
    height, width = pieces[0].shape
    more = ((0, -height % _MULTIPLE), (0, -width % _MULTIPLE))
    stacked = np.stack([np.pad(piece, more, mode="edge") for piece in pieces])
    return torch.from_numpy(stacked)[:, None].float() / 255.0


def _features(found: dict[str, torch.Tensor], shape: tuple[int, ...]) -> Features:
    pixels = found["keypoints"].cpu().numpy().astype(np.float64)
    height, width = shape
    inside = np.flatnonzero((pixels[:, 0] < width) & (pixels[:, 1] < height))
    return Features(
        pixels, found["descriptors"].cpu().numpy(), found["scores"].cpu().numpy(), np.ones(len(pixels), np.float32)
    ).take(inside)


@dataclass(frozen=True, slots=True)
class XFeatMatcher:
    """Mutual nearest neighbours that pass the ratio test in the band.

    Args:
        extractor: Finds the features.
        ratio: Largest ratio of best to second-best distance.
    """

    extractor: XFeatExtractor
    ratio: float
    colour: bool = False

    def candidates(self, ref: View, src: View, pose: RelativePose, limits: SearchLimits) -> Candidates:
        """As `Matcher.candidates`; the score is 1 - ratio."""
        reach = limits.reach(ref.features.pixels, ref.camera, src.features.pixels, src.camera, pose)
        found = match_guided(ref.features.descriptors, src.features.descriptors, reach, ratio=self.ratio)
        return Candidates.of_features(ref, src, (found.ref, found.src), found.score, limits)


def unit(descriptors: Floats | Singles) -> Singles:
    """(n, d) descriptors scaled to unit length."""
    length = np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
    out: Singles = (descriptors / length).astype(np.float32)
    return out
