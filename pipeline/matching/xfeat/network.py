"""XFeat's network, by kornia, on its device.

Potje, Cadar, Araujo, Martins and Nascimento, "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import kornia
import numpy as np
import torch
from kornia.feature import XFeat
from kornia.feature.xfeat import BasicLayer
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from pipeline.geometry.arrays import Bytes
from pipeline.matching.devices import in_batches
from pipeline.matching.features import Features
from pipeline.matching.weights.files import FoundWeights, load_state, strict_load

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
        versions = f"opencv {cv2.__version__} kornia {kornia.__version__} torch {torch.__version__}"
        return f"{self.weights.sha256} {versions} {self.device.type}"

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

    def each(
        self, run: Callable[[Sequence[Bytes], torch.device], list[Features]], pieces: Sequence[Bytes]
    ) -> list[Features]:
        """The features of images of one size, in batches that the device's memory bears.

        Args:
            run: From a batch, on a device.
            pieces: (height, width) each.
        """
        return in_batches(run, pieces, self.device, self.batch, self.notes)


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
