"""The learned baselines of a run: found once, and asked for depths at the pixels of an image."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.geometry.arrays import Singles
from pipeline.matching.images import read_colour
from pipeline.monodepth.found import FoundModel, find_models

if TYPE_CHECKING:
    from pipeline.monodepth.network import MonoDepth


@dataclass(frozen=True, slots=True)
class BaselineSetting:
    """Which baselines, where their models lie and where they run; small and picklable, for it goes to every worker.

    Args:
        names: The baselines, as the configuration names them.
        models: The model of each.
        device: "cpu", "cuda" or "mps".
    """

    names: tuple[str, ...] = ()
    models: tuple[FoundModel, ...] = ()
    device: str = "cpu"

    @classmethod
    def find(cls, names: Sequence[str], folder: Path | str | None = None, device: str = "auto") -> BaselineSetting:
        """Finds the models and chooses the device; networks are not loaded yet.

        Args:
            names: "zoedepth", "depth-anything-v2"; none is no baseline, and loads nothing.
            folder: Where to look first: `score.models`.
            device: "auto", or a type of device.

        Raises:
            InputError: A folder holds no such model.
            MissingPartError: transformers is not installed, or a model is nowhere.
            ResourceError: The device is not there.
            UsageError: No such baseline, or no such device.
        """
        if not names:
            return cls()
        models = find_models(names, folder)
        # Whoever wants no baseline should not wait for torch.
        from pipeline.matching.devices import choose_device  # noqa: PLC0415

        return cls(tuple(names), models, choose_device(device).type)


def depth_maps(setting: BaselineSetting, image: Path | str) -> dict[str, Singles]:
    """What each baseline says of an image; `sampled` asks at pixels.

    Args:
        setting: The baselines.
        image: File or URL of the image as given; its orientation tag is ignored, as matching does.

    Returns:
        By name: (h, w) depths along the optical axis (m) at the image's own size.

    Raises:
        InputError: The image cannot be read, or a model's weights do not fit it.
        ResourceError: A network does not fit into memory.
    """
    if not setting.models:
        return {}
    colours = read_colour(image)
    return {model.baseline: _loaded(model, setting.device).depth_map(colours) for model in setting.models}


@functools.cache
def _loaded(model: FoundModel, device: str) -> MonoDepth:
    """A network, loaded once in a process."""
    from pipeline.monodepth.network import MonoDepth  # noqa: PLC0415 - torch and transformers take seconds

    return MonoDepth(model, device)
