"""Metric depth of one image by a network, through transformers."""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Bytes, Singles
from pipeline.matching.devices import in_batches
from pipeline.monodepth.found import FoundModel

# What transformers raises of configurations and weights that do not fit it or one another.
_UNFIT = (OSError, ValueError, TypeError, LookupError, AttributeError, RuntimeError, SafetensorError)


class MonoDepth:
    """A network with the image processor it was published with.

    Both baselines are trained on depth along the optical axis, not on distance from the camera's centre: NYU Depth v2
    and KITTI hold it (ZoeDepth), Virtual KITTI 2 too, and Hypersim's distances are made into it before Depth Anything
    V2 is trained on them. Each image is seen once: ZoeDepth's authors also average with its mirror image, which the
    library leaves out by default.

    Source: Bhat et al., ZoeDepth, arXiv 2302.12288; Yang et al., Depth Anything V2, arXiv 2406.09414, and its
    repository's metric_depth/dataset.

    Args:
        model: The folder to load.
        device: Where to run it, as torch names it.

    Raises:
        InputError: The weights are not those of the network that the configuration describes.
    """

    def __init__(self, model: FoundModel, device: str) -> None:
        self._processor, self._network = _load(model)
        self._device = torch.device(device)
        self._pads = model.baseline == "zoedepth" and bool(self._processor.do_pad)

    def depth_map(self, image: Bytes) -> Singles:
        """Depths of all pixels of an image.

        Args:
            image: (height, width, 3) red, green, blue.

        Returns:
            (height, width) depths along the optical axis (m); bicubic between those of the network, so that they may
            overshoot beside an edge.

        Raises:
            ResourceError: The network does not fit into memory.
        """
        # One at a time: ZoeDepth chooses its head, indoor or outdoor, for all images of a batch together.
        return in_batches(self._run, [image], self._device, 1, [])[0]

    def _run(self, images: Sequence[Bytes], device: torch.device) -> list[Singles]:
        network = self._network.to(device)
        out = []
        with torch.inference_mode():
            for image in images:
                inputs = self._processor(images=image, return_tensors="pt", input_data_format="channels_last")
                predicted = network(inputs["pixel_values"].to(device)).predicted_depth
                out.append(self._at_image_size(predicted.float().cpu(), (image.shape[0], image.shape[1])))
        return out

    def _at_image_size(self, predicted: torch.Tensor, size: tuple[int, int]) -> Singles:
        """Undoes the processor's resizing and padding, as its `post_process_depth_estimation` does by default.

        That method of ZoeDepth's needs torchvision for a resizing that torch has.

        Args:
            predicted: (1, h, w) depths on the network's grid (m).
            size: Height and width of the image.
        """
        height, width = size
        above, left = (_padding(height), _padding(width)) if self._pads else (0, 0)
        whole = torch.nn.functional.interpolate(
            predicted[None], (height + 2 * above, width + 2 * left), mode="bicubic", align_corners=False
        )
        return np.ascontiguousarray(whole[0, 0, above : above + height, left : left + width].numpy(), np.float32)


def _padding(side: int) -> int:
    """What ZoeDepth's image processor puts on each end of a side, mirrored (px)."""
    return int(math.sqrt(side / 2) * 3)


def _load(model: FoundModel) -> tuple[Any, torch.nn.Module]:
    """The image processor and the network of a folder."""
    from huggingface_hub.errors import StrictDataclassError  # noqa: PLC0415 - comes with transformers

    # An optional part, which takes seconds.
    library: Any = importlib.import_module("transformers")
    # It draws bars, and prints tables, on a terminal that has ours.
    library.logging.disable_progress_bar()
    library.logging.set_verbosity_error()
    local = {"local_files_only": True, "trust_remote_code": False}
    network: torch.nn.Module
    try:
        # The other backend needs torchvision, and gives slightly other values: the same everywhere instead.
        processor = library.AutoImageProcessor.from_pretrained(model.folder, backend="pil", **local)
        network, told = library.AutoModelForDepthEstimation.from_pretrained(
            model.folder,
            use_safetensors=True,
            dtype=torch.float32,
            ignore_mismatched_sizes=True,  # told below, by name
            output_loading_info=True,
            **local,
        )
    except (*_UNFIT, StrictDataclassError) as error:
        raise _other_weights(model, f"{type(error).__name__}: {error}"[:300]) from error
    # What the file does not hold was drawn at random, but for buffers, which are computed.
    drawn = set(told["missing_keys"]) & {name for name, _ in network.named_parameters()}
    drawn |= {entry[0] for entry in told["mismatched_keys"]}
    if drawn:
        raise _other_weights(
            model, f"{len(drawn)} tensors are missing or of another shape: {', '.join(sorted(drawn)[:3])}"
        )
    return processor, network.eval()


def _other_weights(model: FoundModel, found: str) -> InputError:
    return InputError(
        "E-BASELINE-06",
        "the folder's files do not belong together",
        where=str(model.folder),
        found=found,
        expected=f"the configuration and the weights of one {model.architecture}",
        hint=f"fetch it again: epitransfer models fetch {model.baseline}",
    )
