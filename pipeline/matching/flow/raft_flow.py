"""RAFT as an estimator of flow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np
import torch

from pipeline.geometry.arrays import Bytes, Singles
from pipeline.matching.devices import in_batches
from pipeline.matching.flow.estimators import ImagePair
from pipeline.matching.flow.raft import Raft


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
