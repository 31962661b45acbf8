"""Estimators of dense motion between two images of one size, behind one interface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from pipeline.geometry.arrays import Bytes, Singles

ImagePair = tuple[Bytes, Bytes]
# DIS refuses images below its patches' size.
_LEAST_DIS_PX = 16


class FlowEstimator(Protocol):
    """Finds the motion of every pixel from one image to another."""

    @property
    def settings(self) -> str:
        """All that the result depends on besides the images, as text."""

    @property
    def tile_px(self) -> int:
        """Longest side of an image it is to be run on in one piece."""

    @property
    def channels(self) -> int:
        """1 for grey images (h, w), 3 for (h, w, 3) red, green, blue."""

    def flows(self, pairs: Sequence[ImagePair]) -> list[Singles]:
        """The motion in pairs of images.

        Args:
            pairs: Ref and src of one size, with the estimator's channels.

        Returns:
            (h, w, 2) px for each pair: src pixel minus ref pixel, u then v.
        """


@dataclass(frozen=True, slots=True)
class DisFlow:
    """Dense inverse search, without a network.

    Source: Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016; OpenCV's medium preset.

    Args:
        finest_scale: Halvings of the image that patches are searched at; 0 is five times as slow as 1, and half as
            far off where the motion is no mere shift.
        tile_px: Longest side of an image in one piece.
    """

    finest_scale: int = 0
    tile_px: int = 1024

    @property
    def settings(self) -> str:
        """As `FlowEstimator.settings`."""
        return f"dis-1 {cv2.__version__} {self.finest_scale} {self.tile_px}"

    @property
    def channels(self) -> int:
        """As `FlowEstimator.channels`."""
        return 1

    def flows(self, pairs: Sequence[ImagePair]) -> list[Singles]:
        """As `FlowEstimator.flows`."""
        search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        search.setFinestScale(self.finest_scale)
        return [_dis(search, *pair) for pair in pairs]


def _dis(search: cv2.DISOpticalFlow, ref: Bytes, src: Bytes) -> Singles:
    height, width = ref.shape
    short = (0, max(0, _LEAST_DIS_PX - height), 0, max(0, _LEAST_DIS_PX - width))
    if any(short):
        ref, src = (np.asarray(cv2.copyMakeBorder(i, *short, cv2.BORDER_REPLICATE), np.uint8) for i in (ref, src))
    # An empty start is no start, while one of zeros is worse than that.
    nothing = np.empty(0, np.float32)
    found = search.calc(np.ascontiguousarray(ref), np.ascontiguousarray(src), nothing)
    return np.ascontiguousarray(found[:height, :width], np.float32)
