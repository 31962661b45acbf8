"""Estimators of dense motion between two images of one size, behind one interface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Protocol

import cv2
import numpy as np
import torch

from pipeline.geometry.arrays import Bytes, Singles
from pipeline.matching.devices import in_batches
from pipeline.matching.raft import Raft

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


@dataclass(frozen=True, slots=True)
class RaftFlow:
    """RAFT on a device.

    Args:
        network: With its weights.
        weights_sha256: Of the file the weights came from.
        device: Where it runs.
        iterations: Steps of the recurrence; from 12 on the small network no longer gets nearer.
        tile_px: Longest side of an image in one piece; memory grows with its fourth power.
        batch: Most pairs at once.
        notes: Gets a sentence for the user when the device's memory was too small.
    """

    network: Raft
    weights_sha256: str
    device: torch.device
    iterations: int = 12
    tile_px: int = 640
    batch: int = 1
    notes: list[str] = field(default_factory=list)

    @property
    def settings(self) -> str:
        """As `FlowEstimator.settings`."""
        return (
            f"{self.network.kind.name}-1 {self.weights_sha256} {self.iterations} {self.tile_px}"
            f" torch {torch.__version__} {self.device.type}"
        )

    @property
    def channels(self) -> int:
        """As `FlowEstimator.channels`."""
        return 3

    def flows(self, pairs: Sequence[ImagePair]) -> list[Singles]:
        """As `FlowEstimator.flows`."""
        found: list[Singles] = []
        # A batch is of one size; the pieces of an image are cut so that neighbours mostly are.
        for _, group in groupby(pairs, key=lambda pair: pair[0].shape):
            found += in_batches(self._run, list(group), self.device, self.batch, self.notes)
        return found

    def _run(self, pairs: Sequence[ImagePair], device: torch.device) -> list[Singles]:
        network = self.network.to(device)
        ref, src = (_tensor([pair[i] for pair in pairs], device) for i in (0, 1))
        # Without the GPU's shortened floats its result is the CPU's but for the last digits.
        with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False):
            flow: torch.Tensor = network(ref, src, self.iterations)
        return list(np.ascontiguousarray(flow.cpu().numpy().transpose(0, 2, 3, 1)))


def _tensor(images: Sequence[Bytes], device: torch.device) -> torch.Tensor:
    """(b, 3, h, w) float32 on a device."""
    stacked = np.ascontiguousarray(np.stack(images).transpose(0, 3, 1, 2))
    return torch.from_numpy(stacked).to(device).float()
