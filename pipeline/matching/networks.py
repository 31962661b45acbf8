"""Building the matchers that need torch or optical flow."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from pipeline.matching.dense import DenseMatcher
from pipeline.matching.flow import DisFlow, RaftFlow
from pipeline.matching.lighterglue import LighterGlueMatcher, LighterGlueNetwork
from pipeline.matching.matcher import Matcher
from pipeline.matching.raft import raft_from_state
from pipeline.matching.weights import load_state
from pipeline.matching.xfeat import XFeatExtractor, XFeatMatcher, XFeatNetwork
from pipeline.matching.xfeat_star import StarExtractor, StarMatcher

# Pieces of an image that a GPU looks at together.
_GPU_BATCH = 4

if TYPE_CHECKING:
    from pipeline.matching.matchers import MatcherSetting


def build(setting: MatcherSetting, max_features: int, ratio: float, notes: list[str]) -> Matcher:
    """A matcher that is not SIFT.

    Args:
        setting: With the name, the size images are matched at, the weights and the device.
        max_features: Most features of an image.
        ratio: Largest ratio of best to second-best distance.
        notes: Where networks write what the user should be told.
    """
    device = torch.device(setting.device)
    if setting.name == "dis":
        return DenseMatcher(DisFlow(), max_features)
    if setting.name == "raft":
        (weights,) = setting.weights
        network = raft_from_state(load_state(weights)).eval()
        batch = 1 if device.type == "cpu" else _GPU_BATCH
        return DenseMatcher(RaftFlow(network, weights.sha256, device, batch=batch, notes=notes), max_features)
    xfeat = XFeatNetwork(setting.weights[0], device, notes)
    if setting.name == "xfeat-star":
        return StarMatcher(StarExtractor(xfeat, setting.max_image_px, max_features), ratio)
    extractor = XFeatExtractor(xfeat, setting.max_image_px, max_features)
    if setting.name == "xfeat-lighterglue":
        return LighterGlueMatcher(extractor, LighterGlueNetwork(setting.weights[1], device, notes))
    return XFeatMatcher(extractor, ratio)
