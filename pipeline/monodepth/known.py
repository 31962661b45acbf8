"""The baselines by name, and the published models that serve them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

CONFIG, PROCESSOR, WEIGHTS = "config.json", "preprocessor_config.json", "model.safetensors"
# The class that transformers builds, as a model's config.json names it.
ARCHITECTURES: Mapping[str, str] = {
    "zoedepth": "ZoeDepthForDepthEstimation",
    "depth-anything-v2": "DepthAnythingForDepthEstimation",
}
BASELINES = tuple(ARCHITECTURES)
INSTALL = "pip install 'epitransfer[baselines]'"


@dataclass(frozen=True, slots=True)
class KnownModel:
    """A model that somebody published in the layout of transformers.

    Args:
        baseline: The baseline it serves.
        repository: Owner and name at its publisher.
        size_mb: Rounded size of its weights (MB).
        licence: SPDX identifier of the weights' licence.
        scenes: What it was trained for.
        note: What to know before using it.
        publisher: Address of the publisher.
    """

    baseline: str
    repository: str
    size_mb: int
    licence: str
    scenes: str
    note: str = ""
    publisher: str = "https://huggingface.co"

    @property
    def name(self) -> str:
        """Its own name: the folder it is fetched into."""
        return self.repository.partition("/")[2]

    @property
    def page(self) -> str:
        """The address of its card."""
        return f"{self.publisher}/{self.repository}"

    def url(self, file: str, revision: str = "main") -> str:
        """The address of one of its files."""
        return f"{self.page}/resolve/{revision}/{file}"


def _zoedepth(domain: str, scenes: str) -> KnownModel:
    return KnownModel("zoedepth", f"Intel/zoedepth-{domain}", 1380, "MIT", scenes)


def _depth_anything(scene: str, size: str, size_mb: int, licence: str, note: str = "") -> KnownModel:
    repository = f"depth-anything/Depth-Anything-V2-Metric-{scene}-{size}-hf"
    trained = {"Outdoor": "outdoor, to 80 m (Virtual KITTI 2)", "Indoor": "indoor, to 20 m (Hypersim)"}[scene]
    return KnownModel("depth-anything-v2", repository, size_mb, licence, trained, note)


_NON_COMMERCIAL = "CC-BY-NC-4.0"
_ALSO_APACHE = "licence as the authors' README states it for this size; the model's card says Apache-2.0"

# In order of preference within a baseline: first the one whose training and licence suit most flights. The licences of
# Depth Anything V2 are those of its authors' README, by size (Small: Apache-2.0; Base, Large: CC-BY-NC-4.0).
KNOWN_MODELS: tuple[KnownModel, ...] = (
    _zoedepth("nyu-kitti", "indoor to 10 m (NYU Depth v2) and outdoor to 80 m (KITTI)"),
    _zoedepth("kitti", "outdoor, to 80 m (KITTI)"),
    _zoedepth("nyu", "indoor, to 10 m (NYU Depth v2)"),
    _depth_anything("Outdoor", "Small", 99, "Apache-2.0"),
    _depth_anything("Outdoor", "Base", 390, _NON_COMMERCIAL),
    _depth_anything("Outdoor", "Large", 1340, _NON_COMMERCIAL, _ALSO_APACHE),
    _depth_anything("Indoor", "Small", 99, "Apache-2.0"),
    _depth_anything("Indoor", "Base", 390, _NON_COMMERCIAL),
    _depth_anything("Indoor", "Large", 1340, _NON_COMMERCIAL),
)


def models_of(baseline: str) -> tuple[KnownModel, ...]:
    """The known models that serve a baseline, the preferred first."""
    return tuple(known for known in KNOWN_MODELS if known.baseline == baseline)


def known_model(name: str) -> KnownModel | None:
    """The preferred model of a baseline, or the one of that name or repository."""
    named = (known for known in KNOWN_MODELS if name in {known.baseline, known.name, known.repository})
    return next(named, None)
