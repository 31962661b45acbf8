"""XFeat*: semi-dense features of two scales, one per cell of 8 x 8 px, moved within the cell by the fine matcher.

Potje et al., CVPR 2024, section 3.3. The network's offset says where in ref's cell the point lies that src's cell
shows; both are told from the middle of a cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from pipeline.geometry.arrays import Bytes, Floats, Singles
from pipeline.geometry.poses import RelativePose
from pipeline.matching.devices import in_batches
from pipeline.matching.features import Features
from pipeline.matching.guided import match_guided
from pipeline.matching.images import resized
from pipeline.matching.matcher import Candidates, SearchLimits, View
from pipeline.matching.xfeat.network import XFeatNetwork, padded
from pipeline.matching.xfeat.sparse import unit

# The scales the image is looked at, and each one's share of the features (the paper's).
_SCALES = ((0.6, 0.2), (1.3, 0.8))
_CELL_PX = 8
# The offset of a cell's first pixel. From the cell's first pixel, as published, instead of its middle, positions go
# astray by a pixel as soon as one image is turned or zoomed against the other; measured on known motions.
_FIRST_PX = 3
# The network tells an offset by its probabilities over the cell, sharpened, and is sure enough of it from here on.
_SHARPNESS, _LEAST_CONFIDENCE = 3.0, 0.25


@dataclass(frozen=True, slots=True)
class StarExtractor:
    """The most reliable cells of an image at two scales.

    Args:
        network: The network.
        max_image_px: Longest side an image is looked at.
        max_features: Most cells kept.
    """

    network: XFeatNetwork
    max_image_px: int
    max_features: int

    @property
    def settings(self) -> str:
        """As `Extractor.settings`."""
        return f"xfeat-star-2 {self.network.settings} {self.max_image_px} {self.max_features}"

    @property
    def batch(self) -> int:
        """As `Extractor.batch`."""
        return self.network.batch

    def detect(self, pieces: Sequence[Bytes]) -> list[Features]:
        """As `Extractor.detect`."""
        return self.network.each(self._run, pieces)

    def _run(self, pieces: Sequence[Bytes], device: torch.device) -> list[Features]:
        height, width = pieces[0].shape
        at_scales: list[list[Features]] = []
        for scale, share in _SCALES:
            size = (max(_CELL_PX, round(width * scale)), max(_CELL_PX, round(height * scale)))
            scaled = [resized(piece, size) for piece in pieces]
            at_scales.append(self._cells(scaled, (width, height), round(share * self.max_features), device))
        return [Features.joined(parts) for parts in zip(*at_scales, strict=True)]

    def _cells(self, scaled: Sequence[Bytes], full: tuple[int, int], most: int, device: torch.device) -> list[Features]:
        height, width = scaled[0].shape
        with torch.inference_mode():
            maps, _, reliability = self.network.model.to(device).net(padded(scaled).to(device))
        step = full[0] / width
        out = []
        for features, sure in zip(maps, reliability[:, 0], strict=True):
            # Cells that are padding alone are none.
            rows, columns = -(-height // _CELL_PX), -(-width // _CELL_PX)
            strength, order = sure[:rows, :columns].reshape(-1).topk(min(most, rows * columns))
            chosen = order.cpu().numpy()
            cell = np.stack([chosen % columns, chosen // columns], axis=1).astype(np.float64)
            flat = features[:, :rows, :columns].reshape(features.shape[0], -1)[:, order].T
            out.append(
                Features(
                    (cell + 0.5) * _CELL_PX * (full[0] / width, full[1] / height) - 0.5,
                    flat.cpu().numpy(),
                    strength.cpu().numpy(),
                    np.full(len(cell), step, np.float32),
                )
            )
        return out


@dataclass(frozen=True, slots=True)
class StarMatcher:
    """Mutual nearest cells in the band, moved by the fine matcher where it is sure.

    Args:
        extractor: Finds the cells.
        ratio: Largest ratio of best to second-best distance.
    """

    extractor: StarExtractor
    ratio: float
    colour: bool = False

    def candidates(self, ref: View, src: View, pose: RelativePose, limits: SearchLimits) -> Candidates:
        """As `Matcher.candidates`; the score is the fine matcher's confidence."""
        in_ref, in_src = ref.features, src.features
        reach = limits.reach(in_ref.pixels, ref.camera, in_src.pixels, src.camera, pose)
        found = match_guided(unit(in_ref.descriptors), unit(in_src.descriptors), reach, ratio=self.ratio)
        offset, confidence = self._offsets(in_ref.descriptors[found.ref], in_src.descriptors[found.src])
        sure = confidence > _LEAST_CONFIDENCE
        rows, columns = found.ref[sure], found.src[sure]
        ref_px = in_ref.pixels[rows] + offset[sure] * in_ref.scale[rows][:, None]
        src_px, score = in_src.pixels[columns], confidence[sure]
        # The offset may take a match over the edge of what the pose allows.
        each = np.arange(len(rows))
        near = limits.reach(ref_px, ref.camera, src_px, src.camera, pose).allows(each, each)
        return Candidates.alike(ref_px[near], src_px[near], score[near], ref, src, limits)

    def _offsets(self, ref: Singles, src: Singles) -> tuple[Floats, Floats]:
        """(n, 2) px of ref's own scale, and (n,) confidence."""
        if not len(ref):
            return np.empty((0, 2)), np.empty(0)
        network = self.extractor.network
        pairs = list(np.concatenate([ref, src], axis=1))
        chance = np.stack(in_batches(self._chances, pairs, network.device, len(pairs), network.notes))
        index = np.arange(_CELL_PX) - _FIRST_PX
        across, down = np.tile(index, _CELL_PX), np.repeat(index, _CELL_PX)
        return np.stack([chance @ across, chance @ down], axis=1), chance.max(axis=1)

    def _chances(self, pairs: Sequence[Singles], device: torch.device) -> list[Floats]:
        """Of each pair of descriptors, the probabilities of the cell's 64 pixels."""
        with torch.inference_mode():
            fine = self.extractor.network.model.to(device).net.fine_matcher
            logits = _SHARPNESS * fine(torch.from_numpy(np.stack(pairs)).to(device))
            return list(logits.softmax(dim=1).cpu().numpy().astype(np.float64))
