"""Writes tiny ZoeDepth and Depth Anything V2 models with random weights: they prove the path, and measure nothing.

    python benchmarks/tiny_monodepth.py FOLDER

FOLDER/zoedepth and FOLDER/depth-anything-v2 are laid out as the published ones (config.json, preprocessor_config.json,
model.safetensors); `score.models = FOLDER` then takes them. Their config.json says "epitransfer_random_weights": true,
so that whatever shows their depths can say that nobody trained them.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch
from transformers import (
    BeitConfig,
    DepthAnythingConfig,
    DepthAnythingForDepthEstimation,
    Dinov2Config,
    PreTrainedModel,
    ZoeDepthConfig,
    ZoeDepthForDepthEstimation,
    logging,
)

MARK = "epitransfer_random_weights"
MAX_DEPTH_M = 80
_LAYERS, _WIDTH = 4, 16
_BACKBONE = {
    "hidden_size": _WIDTH,
    "num_hidden_layers": _LAYERS,
    "num_attention_heads": 2,
    "intermediate_size": 2 * _WIDTH,
    "reshape_hidden_states": False,
}


def zoedepth() -> ZoeDepthForDepthEstimation:
    """A ZoeDepth with two metric heads and the network that chooses between them, as zoedepth-nyu-kitti."""
    backbone = BeitConfig(
        **_BACKBONE,
        image_size=64,
        patch_size=16,
        use_relative_position_bias=True,
        out_features=[f"stage{number}" for number in range(1, _LAYERS + 1)],
    )
    config = ZoeDepthConfig(
        backbone_config=backbone,
        neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8,
        bottleneck_features=8,
        num_relative_features=8,
        bin_embedding_dim=8,
        num_attractors=[4, 2, 2, 1],
        bin_configurations=[
            {"name": "nyu", "n_bins": 8, "min_depth": 0.001, "max_depth": 10.0},
            {"name": "kitti", "n_bins": 8, "min_depth": 0.001, "max_depth": float(MAX_DEPTH_M)},
        ],
        num_patch_transformer_layers=4,
        patch_transformer_hidden_size=128,  # this and the four layers are what the choosing network takes
        patch_transformer_intermediate_size=_WIDTH,
        patch_transformer_num_attention_heads=2,
    )
    return ZoeDepthForDepthEstimation(config)


def depth_anything(kind: str = "metric") -> DepthAnythingForDepthEstimation:
    """A Depth Anything V2.

    Args:
        kind: "metric", or "relative" for one that knows no metres.
    """
    backbone = Dinov2Config(
        **_BACKBONE, image_size=56, patch_size=14, out_indices=list(range(1, _LAYERS + 1)), mlp_ratio=2
    )
    config = DepthAnythingConfig(
        backbone_config=backbone,
        patch_size=14,
        reassemble_hidden_size=_WIDTH,
        neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8,
        head_hidden_size=8,
        depth_estimation_type=kind,
        max_depth=MAX_DEPTH_M,
    )
    return DepthAnythingForDepthEstimation(config)


# As the published models' preprocessor_config.json, for smaller images.
_ZOE_IMAGES = {
    "image_processor_type": "ZoeDepthImageProcessor",
    "do_pad": True,
    "do_resize": True,
    "do_rescale": True,
    "do_normalize": True,
    "size": {"height": 96, "width": 128},
    "keep_aspect_ratio": True,
    "ensure_multiple_of": 32,
    "resample": 2,
    "rescale_factor": 1 / 255,
    "image_mean": [0.5, 0.5, 0.5],
    "image_std": [0.5, 0.5, 0.5],
}
_DEPTH_ANYTHING_IMAGES = {
    "image_processor_type": "DPTImageProcessor",
    "do_pad": False,
    "do_resize": True,
    "do_rescale": True,
    "do_normalize": True,
    "size": {"height": 112, "width": 112},
    "keep_aspect_ratio": True,
    "ensure_multiple_of": 14,
    "resample": 3,
    "rescale_factor": 1 / 255,
    "image_mean": [0.485, 0.456, 0.406],
    "image_std": [0.229, 0.224, 0.225],
}


def write(model: PreTrainedModel, images: dict[str, object], folder: Path) -> Path:
    """Writes a model as the published ones are laid out, its weights redrawn, and marks it as untrained."""
    with torch.no_grad():
        for name, weights in model.named_parameters():
            # Those that transformers draws are so small that every pixel would have the same depth.
            if name.endswith("weight") and weights.dim() > 1:
                torch.nn.init.kaiming_normal_(weights, nonlinearity="linear")
    logging.disable_progress_bar()
    model.save_pretrained(folder)
    config = folder / "config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {MARK: True}, indent=2))
    (folder / "preprocessor_config.json").write_text(json.dumps(images, indent=2))
    return folder


def write_zoedepth(folder: Path) -> Path:
    """A tiny ZoeDepth in a folder; the same bytes every time."""
    torch.manual_seed(1)
    return write(zoedepth(), _ZOE_IMAGES, folder)


def write_depth_anything(folder: Path, kind: str = "metric") -> Path:
    """A tiny Depth Anything V2 in a folder; the same bytes every time."""
    torch.manual_seed(2)
    return write(depth_anything(kind), _DEPTH_ANYTHING_IMAGES, folder)


def main() -> None:
    """Writes both."""
    folder = Path(sys.argv[1])
    for path in (write_zoedepth(folder / "zoedepth"), write_depth_anything(folder / "depth-anything-v2")):
        print(path)


if __name__ == "__main__":
    main()
