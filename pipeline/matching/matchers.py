"""The matchers by name: which networks each needs, and how it is built from its settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.matching.flow.estimators import DisFlow
from pipeline.matching.flow.matcher import DenseMatcher
from pipeline.matching.matcher import Matcher
from pipeline.matching.nearest import NearestMatcher
from pipeline.matching.sift import SiftExtractor, root_sift
from pipeline.matching.weights.files import FoundWeights, find_weights
from pipeline.matching.weights.known import NETWORKS_OF

DENSE = ("raft", "dis")
SLOW = (*DENSE, "xfeat-lighterglue")
# Most features of an image: what a matcher takes in its stride.
MAX_FEATURES: Mapping[str, int] = {
    "sift": 8192,
    "xfeat": 4096,
    "xfeat-star": 8192,
    "xfeat-lighterglue": 2048,
    "raft": 8192,
    "dis": 8192,
}
# Largest ratio of best to second-best distance in the band.
_RATIO: Mapping[str, float] = {"sift": 0.85, "xfeat": 0.95, "xfeat-star": 0.97}


@dataclass(frozen=True, slots=True)
class MatcherSetting:
    """What a matcher is built from; small and picklable, for it goes to every worker.

    Args:
        name: Its name in the configuration.
        max_image_px: Longest side an image is matched at.
        max_features: Most features of an image, or points of a dense matcher; None for the matcher's own number.
        ratio: Largest ratio of best to second-best distance; None for the matcher's own.
        weights: Files of its networks, in the order of NETWORKS_OF.
        device: "cpu", "cuda" or "mps".
    """

    name: str
    max_image_px: int
    max_features: int | None = None
    ratio: float | None = None
    weights: tuple[FoundWeights, ...] = ()
    device: str = "cpu"

    def build(self, notes: list[str]) -> Matcher:
        """The matcher; its networks are loaded when they are first needed.

        Args:
            notes: Where it writes what the user should be told of how it ran.
        """
        most = self.max_features or MAX_FEATURES[self.name]
        ratio = self.ratio or _RATIO.get(self.name, 1.0)
        if self.name == "sift":
            return NearestMatcher(SiftExtractor(self.max_image_px, most), root_sift, ratio)
        if self.name == "dis":
            return DenseMatcher(DisFlow(), most)
        # Whoever matches without a network should not wait for torch.
        from pipeline.matching.networks import build  # noqa: PLC0415

        return build(self, most, ratio, notes)


def device_of(name: str, wanted: str) -> str:
    """The type of device a matcher runs on.

    Args:
        name: The matcher.
        wanted: "auto", or a type of device.

    Raises:
        ResourceError: The device that is wanted is not there.
    """
    if not NETWORKS_OF.get(name, ()):
        return "cpu"
    from pipeline.matching.devices import choose_device  # noqa: PLC0415

    return choose_device(wanted).type


def weights_of(name: str, configured: str | tuple[str, ...] | None) -> tuple[FoundWeights, ...]:
    """The weights files of a matcher's networks.

    Args:
        name: The matcher.
        configured: Where to look first: `match.weights`.

    Raises:
        MissingPartError: A network has no weights here.
        InputError: A file that is named is not there, or nobody knows its digest.
    """
    return tuple(find_weights(networks, configured or ()) for networks in NETWORKS_OF.get(name, ()))
