"""Building the matchers that are networks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from pipeline.matching.flow.matcher import DenseMatcher
from pipeline.matching.flow.raft import raft_from_state
from pipeline.matching.flow.raft_flow import RaftFlow
from pipeline.matching.matcher import Matcher
from pipeline.matching.nearest import NearestMatcher
from pipeline.matching.weights.files import load_state
from pipeline.matching.xfeat.lighterglue import LighterGlueMatcher, LighterGlueNetwork
from pipeline.matching.xfeat.network import XFeatNetwork
from pipeline.matching.xfeat.sparse import XFeatExtractor, unit
from pipeline.matching.xfeat.star import StarExtractor, StarMatcher

# Pieces of an image that a GPU looks at together.
_GPU_BATCH = 4

if TYPE_CHECKING:
    from pipeline.matching.matchers import MatcherSetting


def build(setting: MatcherSetting, max_features: int, ratio: float, notes: list[str]) -> Matcher:
    """A matcher that is a network, or built on one.

    Args:
        setting: With the name, the size images are matched at, the weights and the device.
        max_features: Most features of an image.
        ratio: Largest ratio of best to second-best distance.
        notes: Where networks write what the user should be told.
    """
    device = torch.device(setting.device)
    if setting.name == "raft":
        (weights,) = setting.weights
        network = raft_from_state(load_state(weights), str(weights.path))
        batch = 1 if device.type == "cpu" else _GPU_BATCH
        return DenseMatcher(RaftFlow(network, weights.sha256, device, batch=batch, notes=notes), max_features)
    xfeat = XFeatNetwork(setting.weights[0], device, notes)
    if setting.name == "xfeat-star":
        return StarMatcher(StarExtractor(xfeat, setting.max_image_px, max_features), ratio)
    extractor = XFeatExtractor(xfeat, setting.max_image_px, max_features)
    if setting.name == "xfeat-lighterglue":
        return LighterGlueMatcher(extractor, LighterGlueNetwork(setting.weights[1], device, notes))
    return NearestMatcher(extractor, unit, ratio)
