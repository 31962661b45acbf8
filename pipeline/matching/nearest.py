"""The matcher that compares descriptors: mutual nearest neighbours in the band that pass the ratio test."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pipeline.geometry.arrays import AnyArray, Singles
from pipeline.geometry.poses import RelativePose
from pipeline.matching.features import Extractor
from pipeline.matching.guided import match_guided
from pipeline.matching.matcher import Candidates, SearchLimits, View


@dataclass(frozen=True, slots=True)
class NearestMatcher:
    """Nearest neighbours among an extractor's features.

    Args:
        extractor: Finds the features.
        compared: Brings their descriptors (n, d) to unit length, (n, d) float32, as they are compared.
        ratio: Largest ratio of best to second-best distance.
    """

    extractor: Extractor
    compared: Callable[[AnyArray], Singles]
    ratio: float
    colour: bool = False

    def candidates(self, ref: View, src: View, pose: RelativePose, limits: SearchLimits) -> Candidates:
        """As `Matcher.candidates`; the score is 1 - ratio."""
        reach = limits.reach(ref.features.pixels, ref.camera, src.features.pixels, src.camera, pose)
        in_ref, in_src = (self.compared(view.features.descriptors) for view in (ref, src))
        found = match_guided(in_ref, in_src, reach, ratio=self.ratio)
        return Candidates.of_features(ref, src, (found.ref, found.src), found.score, limits)
