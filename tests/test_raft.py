"""RAFT against its published shapes and against motions that are known; the batches it runs in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from known_motion import HOMOGRAPHIES, endpoint_error, moved_by, noise_image

from pipeline.engine.errors import InputError, ResourceError, UsageError
from pipeline.geometry.arrays import Bytes, Floats
from pipeline.matching.devices import choose_device, in_batches
from pipeline.matching.flow.raft import LARGE, SMALL, Raft, RaftKind, raft_from_state


@pytest.fixture(scope="module")
def small(shared: Path) -> Raft:
    state = torch.load(shared / "weights/raft-small.pth", map_location="cpu", weights_only=True)
    return raft_from_state(state)


def seeded(kind: RaftKind) -> Raft:
    torch.manual_seed(1)
    raft = Raft(kind)
    return raft_from_state(raft.state_dict())


# --- the published networks ---


@pytest.mark.parametrize(("kind", "tensors", "parameters"), [(SMALL, 106, 990_162), (LARGE, 179, 5_257_536)])
def test_as_many_parameters_as_published(kind: RaftKind, tensors: int, parameters: int) -> None:
    raft = Raft(kind)
    assert len(raft.state_dict()) == tensors
    assert sum(p.numel() for p in raft.parameters()) == parameters


def test_the_large_network_has_the_authors_names_and_shapes() -> None:
    shapes = {name: tuple(value.shape) for name, value in Raft(LARGE).state_dict().items()}
    published = {
        "fnet.conv1.weight": (64, 3, 7, 7),
        "fnet.layer2.0.downsample.0.weight": (96, 64, 1, 1),
        "fnet.conv2.weight": (256, 128, 1, 1),
        "cnet.norm1.running_mean": (64,),
        "cnet.layer3.0.norm3.weight": (128,),
        "cnet.layer3.0.downsample.1.weight": (128,),
        "cnet.layer3.1.norm2.running_var": (128,),
        "cnet.conv2.weight": (256, 128, 1, 1),
        "update_block.encoder.convc1.weight": (256, 324, 1, 1),
        "update_block.encoder.convc2.weight": (192, 256, 3, 3),
        "update_block.encoder.convf1.weight": (128, 2, 7, 7),
        "update_block.encoder.convf2.weight": (64, 128, 3, 3),
        "update_block.encoder.conv.weight": (126, 256, 3, 3),
        "update_block.gru.convz1.weight": (128, 384, 1, 5),
        "update_block.gru.convq2.weight": (128, 384, 5, 1),
        "update_block.flow_head.conv1.weight": (256, 128, 3, 3),
        "update_block.flow_head.conv2.weight": (2, 256, 3, 3),
        "update_block.mask.0.weight": (256, 128, 3, 3),
        "update_block.mask.2.weight": (576, 256, 1, 1),
    }
    assert {name: shapes.get(name) for name in published} == published
    assert not any(name.startswith("fnet") and "norm" in name for name in shapes)


@pytest.mark.parametrize("kind", [SMALL, LARGE], ids=lambda kind: kind.name)
def test_the_kind_is_told_by_the_names_and_the_authors_prefix_is_taken_off(kind: RaftKind) -> None:
    state = {f"module.{name}": value for name, value in Raft(kind).state_dict().items()}
    # Counters of the training that older checkpoints lack.
    state = {name: value for name, value in state.items() if not name.endswith("num_batches_tracked")}
    raft = raft_from_state(state)
    assert raft.kind is kind
    assert not raft.training
    assert torch.equal(raft.fnet.conv1.weight, state["module.fnet.conv1.weight"])


def test_other_weights_are_refused_with_their_names() -> None:
    state = Raft(SMALL).state_dict()
    wide = {**state, "fnet.conv2.weight": torch.zeros(64, 96, 1, 1)}
    short = {name: value for name, value in state.items() if name != "fnet.conv1.bias"}
    for wrong, told in (
        ({"keypoint_head.0.weight": torch.zeros(3)}, "keypoint_head.0.weight"),
        ({}, "0 tensors"),
        (wide, "fnet.conv2.weight"),
        (short, "fnet.conv1.bias"),
        ({**state, "surplus": torch.zeros(1)}, "surplus"),
    ):
        with pytest.raises(InputError, match="E-WEIGHTS-04") as caught:
            raft_from_state(wrong, "somewhere.pth")
        assert told in caught.value.found
        assert caught.value.where == "somewhere.pth"
        assert "RAFT" in caught.value.message


@pytest.mark.parametrize("kind", [SMALL, LARGE], ids=lambda kind: kind.name)
@pytest.mark.parametrize(("height", "width"), [(64, 64), (17, 90), (1, 1), (75, 131)])
def test_any_size_gives_a_finite_flow_of_that_size(kind: RaftKind, height: int, width: int) -> None:
    images = 255.0 * torch.rand(2, 2, 3, height, width, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        flow = seeded(kind)(images[0], images[1], 2)
    assert flow.shape == (2, 2, height, width)
    assert torch.isfinite(flow).all()


@pytest.mark.parametrize("kind", [SMALL, LARGE], ids=lambda kind: kind.name)
def test_a_batch_gives_what_its_items_give_alone(kind: RaftKind) -> None:
    raft = seeded(kind)
    images = 255.0 * torch.rand(2, 2, 3, 96, 128, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        together = raft(images[0], images[1], 3)
        alone = torch.cat([raft(images[0, i : i + 1], images[1, i : i + 1], 3) for i in range(2)])
    assert together.abs().max() > 1e-3
    assert torch.allclose(together, alone, atol=1e-4)


# --- known motions, with the published weights ---


def run(raft: Raft, ref: Bytes, src: Bytes, iterations: int) -> Floats:
    images = [torch.from_numpy(np.ascontiguousarray(i.transpose(2, 0, 1)[None])).float() for i in (ref, src)]
    with torch.inference_mode():
        return raft(images[0], images[1], iterations)[0].numpy().transpose(1, 2, 0).astype(np.float64)


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize("name", HOMOGRAPHIES)
def test_the_small_network_finds_known_motions_of_a_photo(small: Raft, shared: Path, name: str) -> None:
    photo = sorted((shared / "data/photos/sheffield_cross/images").iterdir())[3]
    image = np.asarray(cv2.imread(str(photo))[:600, :800, ::-1])
    src, truth = moved_by(HOMOGRAPHIES[name], image)
    # The cells of eight pixels do not allow for less.
    assert 0.05 < endpoint_error(run(small, image, src, 12), truth).mean() < (0.15 if name == "shift" else 0.23)


@pytest.mark.real
@pytest.mark.parametrize("name", HOMOGRAPHIES)
def test_the_small_network_finds_known_motions_of_noise(small: Raft, name: str) -> None:
    """At half the size, and so half the motion."""
    half, image = np.diag([0.5, 0.5, 1.0]), noise_image(300, 400)
    src, truth = moved_by(half @ HOMOGRAPHIES[name] @ np.linalg.inv(half), image)
    assert 0.05 < endpoint_error(run(small, image, src, 12), truth).mean() < (0.3 if name == "perspective" else 0.2)
    # Before the first step nothing is known.
    assert endpoint_error(run(small, image, src, 0), truth).mean() > 3.5


@pytest.mark.real
def test_images_that_are_the_same_do_not_move(small: Raft) -> None:
    image = noise_image(160, 200)
    flow = run(small, image, image, 8)
    assert np.abs(flow).mean() < 0.05


# --- devices ---


def test_a_device_that_is_not_there_is_refused_and_auto_takes_one_that_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    assert choose_device("auto") == torch.device("cpu")
    assert choose_device("cpu") == torch.device("cpu")
    for name in ("cuda", "cuda:0", "mps"):
        with pytest.raises(ResourceError, match="E-DEVICE-02") as caught:
            choose_device(name)
        assert caught.value.exit_code == 6
        assert name in caught.value.message
    for name in ("gpu", "cpu:1", "cuda:x", ""):
        with pytest.raises(UsageError):
            choose_device(name)


def test_auto_prefers_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_device("auto").type == "mps"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert choose_device("auto").type == "cuda"
    with pytest.raises(ResourceError):
        choose_device("cuda:1")


class FakeNetwork:
    """Doubles numbers; on "cuda" it has room for so many at once, and for none that is larger than `largest`."""

    def __init__(self, room: int, largest: int = 10**9) -> None:
        self.room, self.largest = room, largest
        self.calls: list[tuple[str, int]] = []

    def __call__(self, items: Sequence[int], device: torch.device) -> list[str]:
        self.calls.append((device.type, len(items)))
        if device.type == "cuda" and (len(items) > self.room or max(items) > self.largest):
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3.4 GiB.")
        return [f"{device.type} {2 * item}" for item in items]


@given(n=st.integers(0, 40), room=st.integers(1, 20), batch=st.integers(1, 33))
def test_batches_shrink_until_they_fit_and_nothing_is_lost(n: int, room: int, batch: int) -> None:
    network = FakeNetwork(room)
    notes: list[str] = []
    assert in_batches(network, range(n), torch.device("cuda"), batch, notes) == [f"cuda {2 * i}" for i in range(n)]
    assert not any("CPU" in note for note in notes)
    # It does not try the large batch over and over again.
    assert sum(size > room for _, size in network.calls) <= 6
    assert max([size for _, size in network.calls], default=0) <= batch


def test_what_does_not_fit_alone_goes_to_the_cpu_and_the_user_is_told() -> None:
    network = FakeNetwork(4, largest=9)
    notes: list[str] = []
    found = in_batches(network, list(range(14)), torch.device("cuda"), 4, notes)
    assert found == [f"{'cuda' if i <= 9 else 'cpu'} {2 * i}" for i in range(14)]
    assert sum("CPU" in note for note in notes) == 1
    assert "cuda ran out of memory" in notes[-1]
    assert "4 of 14" in notes[-1]
    assert network.calls[-1] == ("cpu", 4)


def test_memory_that_is_short_on_the_cpu_is_an_error_and_other_errors_are_not_swallowed() -> None:
    def short(items: Sequence[int], device: torch.device) -> list[int]:
        raise RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: can't allocate memory: 64 TB")

    def broken(items: Sequence[int], device: torch.device) -> list[int]:
        raise RuntimeError("expected 3 channels")

    with pytest.raises(ResourceError, match="E-DEVICE-03") as caught:
        in_batches(short, [1, 2, 3], torch.device("cpu"), 2, [])
    assert "DefaultCPUAllocator" in caught.value.found
    with pytest.raises(RuntimeError, match="3 channels"):
        in_batches(broken, [1, 2, 3], torch.device("cuda"), 2, [])
