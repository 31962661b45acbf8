"""Learned baselines: the path from a folder of weights to metres at pixels, with tiny networks that nobody trained."""

from __future__ import annotations

import json
import pickle
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import huggingface_hub
import numpy as np
import pytest
import tiny_monodepth
import torch
from safetensors.torch import load_file, save_file

from pipeline.engine.errors import EpiTransferError, InputError, MissingPartError, ResourceError, UsageError
from pipeline.geometry.arrays import Bytes, Floats
from pipeline.matching.weights import files as weights
from pipeline.monodepth import found as finding
from pipeline.monodepth import known
from pipeline.monodepth.baselines import BaselineSetting, depth_maps
from pipeline.monodepth.found import FoundModel, find_models, model_files, read_model
from pipeline.monodepth.network import MonoDepth
from pipeline.monodepth.sampling import sampled

NAMES = known.BASELINES
HEIGHT, WIDTH = 150, 200


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both tiny models, in folders named after the baselines; not to be changed."""
    folder = tmp_path_factory.mktemp("models")
    tiny_monodepth.write_zoedepth(folder / "zoedepth")
    tiny_monodepth.write_depth_anything(folder / "depth-anything-v2")
    return folder


@pytest.fixture(autouse=True)
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Empty caches instead of the user's."""
    monkeypatch.setattr(weights, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.delenv(weights.VARIABLE, raising=False)
    return tmp_path


@pytest.fixture(scope="module")
def image() -> Bytes:
    """Large soft blobs, so that neighbouring pixels are alike."""
    coarse = np.random.default_rng(4).integers(0, 256, (4, 5, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), np.uint8)


def refused(kind: type[EpiTransferError], *arguments: Any) -> EpiTransferError:
    with pytest.raises(kind) as caught:
        find_models(*arguments)
    return caught.value


# --- depth maps ---


@pytest.mark.parametrize("name", NAMES)
def test_a_depth_map_has_the_images_own_size(name: str, tiny: Path, image: Bytes) -> None:
    network = MonoDepth(find_models([name], tiny)[0], "cpu")
    depth = network.depth_map(image)
    assert (depth.shape, depth.dtype) == ((HEIGHT, WIDTH), np.float32)
    assert np.all((depth > 0.0) & (depth <= tiny_monodepth.MAX_DEPTH_M))
    assert np.ptp(depth) > 0.001  # it depends on the image
    assert np.array_equal(depth, network.depth_map(image))
    again = MonoDepth(find_models([name], tiny)[0], "cpu").depth_map(image)
    assert np.array_equal(depth, again)
    assert not np.array_equal(depth, network.depth_map(255 - image))


class _Seeing(torch.nn.Module):
    """Stands for a network: the depth of a pixel is the red it sees there (m)."""

    def __init__(self, mean: float, spread: float) -> None:
        super().__init__()
        self.mean, self.spread = mean, spread

    def forward(self, pixel_values: torch.Tensor) -> SimpleNamespace:
        return SimpleNamespace(predicted_depth=(pixel_values[:, 0] * self.spread + self.mean) * 255.0)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("axis", [0, 1])
def test_a_depth_lies_at_the_pixel_it_was_seen_at(
    name: str, axis: int, tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A ramp of one metre per pixel: what the depth is wrong by is how far it has moved.

    ZoeDepth's own processor puts the corner pixels' centres onto each other when it shrinks the image, and the areas
    onto each other when it brings the depth back, which moves depths near the edges by part of a pixel of its grid.
    """
    network = MonoDepth(find_models([name], tiny)[0], "cpu")
    processor = network._processor
    monkeypatch.setattr(network, "_network", _Seeing(processor.image_mean[0], processor.image_std[0]))
    side = (HEIGHT, WIDTH)[axis]
    x = np.arange(side)
    ramp = np.broadcast_to(x if axis else x[:, None], (HEIGHT, WIDTH)).astype(np.uint8)
    moved = (network.depth_map(np.repeat(ramp[:, :, None], 3, axis=2)) - ramp).mean(axis=1 - axis)
    expected = np.zeros(side)
    if name == "zoedepth":
        padding = int(3 * np.sqrt(side / 2))
        full, grid = side + 2 * padding, (96, 128)[axis]
        seen = ((x + padding + 0.5) * grid / full - 0.5) * (full - 1) / (grid - 1) - padding
        expected = seen - x
        assert np.ptp(expected) > 0.5
    # Means over 24 pixels, for the ramp and the resized image have 8 bits; a ramp ends, and mirrors, at the edges.
    windows = range(12, side - 36, 24)
    differences = [(moved - expected)[start : start + 24].mean() for start in windows]
    assert np.abs(differences).max() < 0.1


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [(150, 200), (97, 61)])
def test_resizing_is_that_of_the_library(
    name: str, size: tuple[int, int], tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ZoeDepth's own method needs torchvision; where that is absent, the one function it calls is put in its place."""
    module = sys.modules[type(MonoDepth(find_models([name], tiny)[0], "cpu")._processor).__module__]

    def resize(depth: torch.Tensor, size: list[int], interpolation: object, antialias: bool) -> torch.Tensor:
        return torch.nn.functional.interpolate(depth[None], size, mode="bicubic", align_corners=False)[0]

    if not hasattr(module, "tvF"):
        stand_in = SimpleNamespace(resize=resize, InterpolationMode=SimpleNamespace(BICUBIC=None))
        monkeypatch.setattr(module, "tvF", stand_in, raising=False)
    network = MonoDepth(find_models([name], tiny)[0], "cpu")
    predicted = torch.rand(1, 64, 96, generator=torch.Generator().manual_seed(1)) + 1.0
    outputs = SimpleNamespace(predicted_depth=predicted)
    expected = network._processor.post_process_depth_estimation(outputs, [size])[0]["predicted_depth"]
    assert np.array_equal(network._at_image_size(predicted, size), expected.numpy())


# --- sampling ---


def ramp(across: float, down: float) -> Floats:
    y, x = np.mgrid[:7, :9]
    return (3.0 + across * x + down * y).astype(np.float32)


def test_sampling_is_bilinear_between_pixel_centres() -> None:
    pixels = np.random.default_rng(2).uniform([0.0, 0.0], [8.0, 6.0], (200, 2))
    for across, down in ((1.0, 0.0), (0.0, 0.5), (0.25, 2.0)):
        expected = 3.0 + across * pixels[:, 0] + down * pixels[:, 1]
        assert np.allclose(sampled(ramp(across, down), pixels), expected, rtol=1e-6)
    # x times y is bilinear, too; a nearest-neighbour or a shifted grid would not give it.
    y, x = np.mgrid[:7, :9]
    product = (1.0 + x * y).astype(np.float32)
    assert np.allclose(sampled(product, pixels), 1.0 + pixels[:, 0] * pixels[:, 1], rtol=1e-6)


def test_sampling_at_the_edge_and_outside() -> None:
    depth = ramp(1.0, 0.0)
    pixels = np.array(
        [[0, 0], [8, 6], [-0.5, 0], [8.5, 6.5], [-0.51, 0], [8.51, 0], [0, 6.51], [np.nan, 1], [np.inf, 1]], float
    )
    expected = [3.0, 11.0, 3.0, 11.0, *[np.nan] * 5]
    assert np.array_equal(sampled(depth, pixels), expected, equal_nan=True)
    assert sampled(depth, np.empty((0, 2))).shape == (0,)
    assert sampled(np.array([[2.0]], np.float32), np.array([[0.2, -0.3]])) == [2.0]


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_a_depth_that_is_none_spreads_no_further_than_its_neighbours(bad: float) -> None:
    depth = ramp(1.0, 0.0)
    depth[3, 4] = bad
    pixels = np.array([[4, 3], [3.5, 3], [4, 2.5], [3, 3], [5, 3], [4, 2], [4, 4], [3.0, 2.5], [5.0, 3.9]])
    assert np.isnan(sampled(depth, pixels)).tolist() == [True] * 3 + [False] * 6


# --- the baselines of a run ---


def test_depths_at_pixels_of_a_photo(tiny: Path, image: Bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "socket", None)  # whoever asked the network would fail
    setting = BaselineSetting.find(NAMES, tiny, "cpu")
    assert pickle.loads(pickle.dumps(setting)) == setting  # noqa: S301 - our own
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), image[:, :, ::-1])
    pixels = np.array([[0.0, 0.0], [17.25, 80.5], [WIDTH - 1, HEIGHT - 1], [WIDTH, 3.0]])
    depths = {name: sampled(found, pixels) for name, found in depth_maps(setting, path).items()}
    assert list(depths) == list(NAMES)
    for model in setting.models:
        expected = sampled(MonoDepth(model, "cpu").depth_map(image), pixels)
        assert np.array_equal(depths[model.baseline], expected, equal_nan=True)
        assert np.isnan(expected).tolist() == [False, False, False, True]
        assert model.untrained
        assert model.note.endswith("random weights: proves the path only")
        assert model.provenance["architecture"] == known.ARCHITECTURES[model.baseline]
        assert json.dumps(model.provenance)


def test_no_baseline_loads_nothing(tmp_path: Path) -> None:
    code = (
        "import sys; from pipeline.monodepth.baselines import BaselineSetting, depth_maps\n"
        "setting = BaselineSetting.find((), 'nowhere', 'auto')\n"
        "assert depth_maps(setting, 'nowhere.jpg') == {}\n"
        "sys.exit(bool({'torch', 'transformers', 'huggingface_hub', 'safetensors'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False, text=True)
    assert done.returncode == 0, done.stderr


def test_a_device_that_is_not_there(tiny: Path) -> None:
    with pytest.raises(UsageError, match="E-DEVICE-01"):
        BaselineSetting.find(NAMES, tiny, "abacus")
    if not torch.backends.mps.is_available():
        with pytest.raises(ResourceError, match="E-DEVICE-02"):
            BaselineSetting.find(NAMES, tiny, "mps")


# --- where models are looked for ---


def laid(folder: Path, source: Path) -> Path:
    shutil.copytree(source, folder)
    return folder


def test_places_in_their_order(tiny: Path, nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tiny / "zoedepth"
    hub = nowhere / "hub" / "models--Intel--zoedepth-kitti"
    snapshot = laid(hub / "snapshots" / ("0" * 40), source)
    (hub / "refs").mkdir()
    (hub / "refs" / "main").write_text("0" * 40)

    def found(*stated: Path) -> tuple[Path, str]:
        model = find_models(["zoedepth"], *stated)[0]
        return model.folder, model.origin

    assert found() == (snapshot, finding.HUB)
    only_asked = nowhere / "hub" / "models--Intel--zoedepth-nyu-kitti"
    shutil.copytree(hub, only_asked)
    (only_asked / "snapshots" / ("0" * 40) / known.WEIGHTS).unlink()
    assert found() == (snapshot, finding.HUB)
    cached = laid(nowhere / "cache" / "zoedepth-nyu", source)
    assert found() == (cached, "cache")
    monkeypatch.setenv(weights.VARIABLE, f"{nowhere / 'other'}:{nowhere / 'env'}")
    named = laid(nowhere / "env" / "zoedepth", source)
    assert found() == (named, "$EPITRANSFER_WEIGHTS")
    assert found(tiny) == (source, finding.CONFIGURED)
    assert found(source) == (source, finding.CONFIGURED)
    assert model_files(["zoedepth"]) == [named / "config.json", named / known.PROCESSOR, named / known.WEIGHTS]
    assert model_files(NAMES, source)[0] == source / "config.json"
    assert model_files(["depth-anything-v2"], nowhere) == []
    assert found(tiny / "depth-anything-v2" / "..") == (tiny / "depth-anything-v2" / ".." / "zoedepth", "score.models")


def test_a_stated_model_serves_its_baseline_only(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(weights.VARIABLE, str(tiny))
    models = find_models(NAMES, tiny / "zoedepth")
    assert [model.origin for model in models] == [finding.CONFIGURED, "$EPITRANSFER_WEIGHTS"]
    error = refused(InputError, ["depth-anything-v2"], tiny / "zoedepth")
    assert (error.code, error.exit_code) == ("E-BASELINE-02", 3)
    assert error.found == "architecture ZoeDepthForDepthEstimation"
    assert error.expected == "DepthAnythingForDepthEstimation"


def test_a_model_that_is_nowhere(tmp_path: Path) -> None:
    error = refused(MissingPartError, ["zoedepth"])
    assert (error.code, error.exit_code) == ("E-BASELINE-01", 7)
    assert error.hint.startswith("epitransfer models fetch zoedepth; ")
    assert str(tmp_path / "cache") in error.found
    (tmp_path / "empty").mkdir()
    assert str(tmp_path / "empty") in refused(MissingPartError, ["zoedepth"], tmp_path / "empty").found


def test_what_is_asked_for_wrongly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    error = refused(UsageError, ["midas"])
    assert (error.code, error.expected) == ("E-BASELINE-07", "zoedepth, depth-anything-v2")
    error = refused(InputError, ["zoedepth"], tmp_path / "gone")
    assert (error.code, error.exit_code, error.where) == ("E-BASELINE-02", 3, "score.models")
    monkeypatch.setattr(finding.importlib.util, "find_spec", lambda _: None)
    error = refused(MissingPartError, ["zoedepth"])
    assert (error.code, error.exit_code, error.hint) == ("E-BASELINE-05", 7, "pip install 'epitransfer[baselines]'")


# --- folders that hold no such model ---


@pytest.fixture
def copied(tiny: Path, tmp_path: Path) -> Path:
    return laid(tmp_path / "copied", tiny / "depth-anything-v2")


def changed(folder: Path, **entries: object) -> None:
    path = folder / known.CONFIG
    path.write_text(json.dumps(json.loads(path.read_text()) | entries))


def told(folder: Path, baseline: str = "depth-anything-v2") -> EpiTransferError:
    with pytest.raises(InputError) as caught:
        read_model(folder, baseline, finding.CONFIGURED)
    assert caught.value.exit_code == 3
    assert str(folder) in caught.value.where
    return caught.value


def test_relative_depth_is_refused(copied: Path) -> None:
    changed(copied, depth_estimation_type="relative")
    error = told(copied)
    assert (error.code, error.found, error.expected) == ("E-BASELINE-03", "depth_estimation_type 'relative'", "metric")


def test_another_architecture_is_refused(copied: Path) -> None:
    assert told(copied, "zoedepth").code == "E-BASELINE-02"
    changed(copied, architectures=None)
    assert told(copied).found == "architecture none"
    error = refused(InputError, NAMES, copied)
    assert error.expected == "ZoeDepthForDepthEstimation or DepthAnythingForDepthEstimation"


DAMAGES = {
    "no preprocessor_config.json": lambda f: (f / known.PROCESSOR).unlink(),
    "preprocessor_config.json is no JSON": lambda f: (f / known.PROCESSOR).write_bytes(b"\xff{"),
    "config.json is no JSON object": lambda f: (f / known.CONFIG).write_text("[]"),
    "no model.safetensors": lambda f: (f / known.WEIGHTS).rename(f / "pytorch_model.bin"),
    "model.safetensors is truncated": lambda f: (f / known.WEIGHTS).write_bytes((f / known.WEIGHTS).read_bytes()[:-1]),
    "truncated or damaged": lambda f: (f / known.WEIGHTS).write_bytes(b""),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_folder_that_is_not_whole_is_refused(damage: str, copied: Path) -> None:
    DAMAGES[damage](copied)
    error = told(copied)
    assert error.code == "E-BASELINE-04"
    assert damage in error.found


def loading(folder: Path) -> EpiTransferError:
    model: FoundModel = read_model(folder, "depth-anything-v2", finding.CONFIGURED)
    with pytest.raises(InputError) as caught:
        MonoDepth(model, "cpu")
    assert (caught.value.code, caught.value.exit_code) == ("E-BASELINE-06", 3)
    return caught.value


def test_tensors_that_do_not_fit_are_refused(copied: Path) -> None:
    """Else transformers draws what is missing at random, and depths would be noise."""
    tensors = load_file(copied / known.WEIGHTS)
    name = "head.conv3.weight"
    save_file({key: value for key, value in tensors.items() if key != name}, copied / known.WEIGHTS, {"format": "pt"})
    assert loading(copied).found == f"1 tensors are missing or of another shape: {name}"
    save_file(tensors | {name: torch.ones(2, 8, 1, 1)}, copied / known.WEIGHTS, {"format": "pt"})
    assert loading(copied).found == f"1 tensors are missing or of another shape: {name}"
    changed(copied, max_depth="far")
    assert "max_depth" in loading(copied).found


def test_an_image_processor_that_is_none_is_refused(copied: Path) -> None:
    (copied / known.PROCESSOR).write_text('{"image_processor_type": "NoSuchProcessor"}')
    assert "Unrecognized image processor" in loading(copied).found
