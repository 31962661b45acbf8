"""XFeat, XFeat* and LighterGlue with their real weights: against kornia's own, and where the motion is known."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from known_motion import HOMOGRAPHIES, moved_by
from kornia.feature import LightGlue, XFeat
from kornia.feature.xfeat import XFeatModel
from safetensors.torch import load_file, save_file
from scipy.spatial import cKDTree

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Bools, Bytes, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.matching.features import Features, extract
from pipeline.matching.matcher import Matcher, View
from pipeline.matching.matchers import MatcherSetting, weights_of
from pipeline.matching.patches.subpixel import PatchSetting, refine
from pipeline.matching.weights.files import FoundWeights
from pipeline.matching.xfeat import star
from pipeline.matching.xfeat.lighterglue import LighterGlueNetwork, Points
from pipeline.matching.xfeat.network import XFeatNetwork, padded
from pipeline.matching.xfeat.sparse import XFeatExtractor

pytestmark = pytest.mark.real

CPU, CUDA = torch.device("cpu"), torch.device("cuda")
HEIGHT, WIDTH = 600, 800
CAMERA = Camera("pinhole", WIDTH, HEIGHT, 700.0, 700.0, 399.5, 299.5)


@dataclass(frozen=True)
class Reachable:
    """Stands for a reach: says itself which pairs are open."""

    open: Bools
    ref: SimpleNamespace = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "ref", SimpleNamespace(about=np.zeros(len(self.open))))

    def near(self, _: Ints) -> Ints:
        return np.arange(self.open.shape[1])

    def allows(self, rows: Ints, columns: Ints) -> Bools:
        return self.open[rows, columns]


class Anywhere:
    """Limits of a search without a pose: every pair is in reach."""

    def reach(self, ref_px: Floats, _: Camera, src_px: Floats, *__: object) -> Reachable:
        return Reachable(np.ones((len(ref_px), len(src_px)), np.bool_))

    def prior_variance(self, *_: Camera) -> float:
        return 1.0


@pytest.fixture(scope="module")
def built(shared: Path) -> Callable[..., Any]:
    """Matchers by name, with the weights there are."""

    def build(name: str, max_image_px: int = WIDTH, most: int = 2000) -> Matcher:
        weights = weights_of(name, str(shared / "weights"))
        return MatcherSetting(name, max_image_px, most, weights=weights).build([])

    return build


@pytest.fixture(scope="module")
def photo(shared: Path) -> Bytes:
    """(600, 800) of a real one."""
    path = sorted((shared / "data/photos/sheffield_cross/images").iterdir())[3]
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)[:HEIGHT, :WIDTH]


@pytest.fixture(scope="module")
def plain(shared: Path) -> XFeat:
    """Kornia's XFeat as it is, nothing folded."""
    model = XFeat().eval()
    model.net.load_state_dict(load_file(shared / "weights/xfeat_kornia.safetensors"))
    return model


def moved(name: str, image: Bytes) -> Bytes:
    return moved_by(HOMOGRAPHIES[name], image)[0]


def there(name: str, ref_px: Floats) -> Floats:
    """Where pixels are seen in the moved image."""
    at = np.column_stack([ref_px, np.ones(len(ref_px))]) @ HOMOGRAPHIES[name].T
    return at[:, :2] / at[:, 2:]


def seen_by(matcher: Matcher, ref: Bytes, src: Bytes) -> tuple[View, View]:
    in_ref, in_src = extract(matcher.extractor, [ref, src])
    return View(CAMERA, ref, in_ref), View(CAMERA, src, in_src)


def candidates(matcher: Matcher, views: tuple[View, View]) -> tuple[Floats, Floats]:
    made = matcher.candidates(*views, None, Anywhere())
    return made.ref_px, made.src_px


# --- sparse keypoints ---


def test_on_whole_multiples_of_32_the_features_are_kornias_own(
    built: Callable[..., Any], photo: Bytes, plain: XFeat
) -> None:
    image = np.ascontiguousarray(photo[:576])
    (found,) = built("xfeat").extractor.detect([image])
    (own,) = plain.detectAndCompute(torch.from_numpy(image)[None, None].float() / 255.0, 2000, 0.05)
    assert len(found.pixels) == len(own["keypoints"]) == 2000
    apart, nearest = cKDTree(own["keypoints"].numpy()).query(found.pixels)
    same = apart == 0.0
    assert same.mean() >= 0.995
    for mine, theirs, most in (("descriptors", "descriptors", 1e-4), ("strength", "scores", 1e-4)):
        assert np.abs(getattr(found, mine) - own[theirs].numpy()[nearest])[same].max() < most
    assert (np.diff(found.strength) <= 0.0).all()


@pytest.mark.parametrize(("height", "width"), [(571, 789), (577, 801)])
def test_on_other_sizes_they_are_those_of_the_padded_image_and_none_is_in_the_padding(
    built: Callable[..., Any], photo: Bytes, plain: XFeat, height: int, width: int
) -> None:
    image = np.ascontiguousarray(np.pad(photo, ((0, 0), (0, 8)), mode="reflect")[:height, :width])
    (found,) = built("xfeat", most=4000).extractor.detect([image])
    (own,) = plain.detectAndCompute(padded([image]), 4000, 0.05)
    theirs = own["keypoints"].numpy()
    inside = (theirs < (width, height)).all(axis=1)
    assert not inside.all(), "the padding tempts"
    assert len(found.pixels) == pytest.approx(inside.sum(), abs=3)
    apart, _ = cKDTree(theirs[inside]).query(found.pixels)
    assert np.mean(apart == 0.0) >= 0.995
    assert found.pixels.min() >= 0.0
    assert (found.pixels <= (width - 1, height - 1)).all()
    # Resized, as kornia does it by itself, they are elsewhere.
    (resized,) = plain.detectAndCompute(torch.from_numpy(image)[None, None].float() / 255.0, 4000, 0.05)
    apart, _ = cKDTree(resized["keypoints"].numpy()).query(found.pixels)
    assert np.mean(apart < 0.5) < 0.9


@pytest.mark.parametrize("more", [5, 13])
def test_more_columns_of_border_move_no_keypoint_away_from_it(
    built: Callable[..., Any], photo: Bytes, more: int
) -> None:
    image = np.ascontiguousarray(photo[:571, :789])
    wider = np.pad(image, ((0, 0), (0, more)), mode="edge")
    (found,), (again,) = (built("xfeat").extractor.detect([one]) for one in (image, wider))
    inner = found.pixels[found.pixels[:, 0] < 789 - 64]
    assert len(inner) > 1500
    apart, _ = cKDTree(again.pixels).query(inner)
    # 13 make the padded image one cell of the coarsest level wider, and its mean grey another.
    assert np.mean(apart == 0.0) >= (0.995 if more == 5 else 0.97)


def test_padding_repeats_the_last_row_and_column() -> None:
    rng = np.random.default_rng(0)
    pieces = [rng.integers(0, 256, (45, 33)).astype(np.uint8) for _ in range(2)]
    batch = padded(pieces)
    assert batch.shape == (2, 1, 64, 64)
    assert batch.dtype == torch.float32
    for one, piece in zip((255.0 * batch[:, 0]).round().numpy(), pieces, strict=True):
        assert np.array_equal(one[:45, :33], piece)
        assert (one[:45, 33:] == piece[:, -1:]).all()
        assert (one[45:, :33] == piece[-1:]).all()
        assert (one[45:, 33:] == piece[-1, -1]).all()
    assert padded([np.zeros((32, 64), np.uint8)]).shape == (1, 1, 32, 64)
    assert padded([np.full((1, 1), 255, np.uint8)]).eq(1.0).all()


def test_images_without_texture_and_tiny_ones_have_few_features_and_do_no_harm(built: Callable[..., Any]) -> None:
    for name in ("xfeat", "xfeat-star"):
        extractor = built(name).extractor
        for size in ((1, 1), (8, 300), (33, 17), (64, 64)):
            for image in (np.zeros(size, np.uint8), np.random.default_rng(0).integers(0, 255, size).astype(np.uint8)):
                (found,) = extractor.detect([image])
                assert np.isfinite(found.descriptors).all()
                assert found.descriptors.shape == (len(found.pixels), 64)
                assert name == "xfeat-star" or (found.pixels < size[::-1]).all()
    (blank,) = built("xfeat").extractor.detect([np.full((200, 300), 90, np.uint8)])
    assert len(blank.pixels) == 0


@pytest.mark.parametrize("name", HOMOGRAPHIES)
def test_whole_pixels_of_a_shrunk_image_become_exact_on_the_photo(
    built: Callable[..., Any], photo: Bytes, name: str
) -> None:
    src, matcher = moved(name, photo), built("xfeat", WIDTH // 2, 800)
    ref_px, src_px = candidates(matcher, seen_by(matcher, photo, src))
    true = there(name, ref_px)
    coarse = np.linalg.norm(src_px - true, axis=1)
    right = coarse < 4.0
    assert right.sum() > 200
    warps = [np.tile(np.eye(2), (len(ref_px), 1, 1))]
    found = refine(photo, src, ref_px, src_px, warps, PatchSetting(WIDTH // 2))
    assert found.refined[right].mean() > 0.8
    fine = np.linalg.norm(found.src_px - true, axis=1)
    assert 0.4 < np.median(coarse[right]) < 2.5
    # A shift by whole pixels is an exact copy.
    assert (0.0 if name == "shift" else 0.005) < np.median(fine[right & found.refined]) < 0.25


# --- XFeat*: where in its cell a point lies ---


@pytest.mark.parametrize("name", HOMOGRAPHIES)
def test_offsets_lead_from_the_cell_to_the_point(
    built: Callable[..., Any], photo: Bytes, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    matcher = built("xfeat-star", most=1000)
    views = seen_by(matcher, photo, moved(name, photo))

    def errors() -> Floats:
        ref_px, src_px = candidates(matcher, views)
        return src_px - there(name, ref_px)

    found, offsets = errors(), star.StarMatcher._offsets
    with monkeypatch.context() as patch:
        patch.setattr(star.StarMatcher, "_offsets", lambda *given: (0.0 * offsets(*given)[0], offsets(*given)[1]))
        of_cells = errors()
    # A cell of the smaller scale has a diagonal of 19 px.
    right = np.linalg.norm(of_cells, axis=1) < 20.0
    assert right.sum() > 400
    length, cell_length = (np.linalg.norm(error[right], axis=1) for error in (found, of_cells))
    assert 0.2 < np.median(length) < 1.0
    assert length.mean() < 0.5 * cell_length.mean()
    assert np.mean(length < cell_length) > 0.75
    # What is wrong is not the same for all: the pixel that offsets are told from is the right one.
    assert np.linalg.norm(found[right].mean(axis=0)) < 0.5
    for first in (2, 4):
        monkeypatch.setattr(star, "_FIRST_PX", first)
        assert np.linalg.norm(errors()[right].mean(axis=0)) > 0.9


# --- LighterGlue ---


@pytest.fixture(scope="module")
def glued(built: Callable[..., Any], photo: Bytes) -> tuple[LighterGlueNetwork, Points, Points]:
    """The network, and the points of a photo and of it moved."""
    matcher = built("xfeat-lighterglue", most=600)
    views = seen_by(matcher, photo, moved("turn and scale", photo))
    ref, src = (Points(view.features, WIDTH, HEIGHT) for view in views)
    return matcher.network, ref, src


def state_of(shared: Path) -> dict[str, torch.Tensor]:
    state: dict[str, torch.Tensor] = load_file(shared / "weights/xfeat_lighterglue_L3_kornia.safetensors")
    return state


def own_matches(shared: Path, ref: Points, src: Points) -> dict[tuple[int, int], float]:
    """Kornia's own, by its own forward."""
    model = LightGlue(
        None, input_dim=64, descriptor_dim=96, n_layers=3, num_heads=1, depth_confidence=-1, width_confidence=-1
    )
    left = model.load_state_dict(state_of(shared), strict=False)
    assert left.unexpected_keys == []
    assert all(
        name.startswith(("log_assignment.0", "log_assignment.1", "token_", "conf")) for name in left.missing_keys
    )
    given = {
        f"image{i}": {
            "keypoints": torch.from_numpy(points.features.pixels.astype(np.float32))[None],
            "descriptors": torch.from_numpy(points.features.descriptors)[None],
            "image_size": torch.tensor([[WIDTH, HEIGHT]]),
        }
        for i, points in enumerate((ref, src))
    }
    with torch.inference_mode():
        out = model.eval()(given)
    rows = out["matches"][0].numpy()
    return {(int(r), int(c)): float(score) for (r, c), score in zip(rows, out["scores"][0], strict=True)}


def by_pair(found: tuple[Ints, Ints, Floats]) -> dict[tuple[int, int], float]:
    return {(int(r), int(c)): float(score) for r, c, score in zip(*found, strict=True)}


def everything(ref: Points, src: Points) -> Reachable:
    return Reachable(np.ones((len(ref.features.pixels), len(src.features.pixels)), np.bool_))


def test_with_everything_open_the_matches_are_kornias_own(
    glued: tuple[LighterGlueNetwork, Points, Points], shared: Path
) -> None:
    network, ref, src = glued
    found, own = by_pair(network.match(ref, src, everything(ref, src))), own_matches(shared, ref, src)
    assert len(own) > 150
    assert found.keys() == own.keys()
    assert max(abs(found[pair] - own[pair]) for pair in own) < 1e-6
    assert np.ptp(list(own.values())) > 0.3


def test_a_closed_pair_is_not_assigned_and_a_point_without_an_open_one_is_none(
    glued: tuple[LighterGlueNetwork, Points, Points],
) -> None:
    network, ref, src = glued
    rows, columns, _ = network.match(ref, src, everything(ref, src))
    reach = everything(ref, src)
    # The partners of half the matches are closed; of some points all.
    half, alone = np.arange(0, len(rows), 2), rows[1::10]
    reach.open[rows[half], columns[half]] = False
    reach.open[alone] = False
    reach.open[:, columns[3::10]] = False
    found = network.match(ref, src, reach)
    assert len(found[0]) > 30
    assert reach.open[found[0], found[1]].all()
    assert not np.isin(found[0], alone).any()
    assert not np.isin(found[1], columns[3::10]).any()
    # The others stay, but for what a freed point now takes from them.
    open_still = {pair for pair in zip(rows.tolist(), columns.tolist(), strict=True) if reach.open[pair]}
    assert len(open_still & by_pair(found).keys()) > 0.9 * len(open_still)
    assert np.all((found[2] > 0.1) & (found[2] <= 1.0))
    closed = Reachable(np.zeros_like(reach.open))
    assert [len(part) for part in network.match(ref, src, closed)] == [0, 0, 0]


def test_what_is_closed_takes_no_share_of_the_probability(
    glued: tuple[LighterGlueNetwork, Points, Points],
) -> None:
    """Twins of src points halve their chance while they are open."""
    network, ref, src = glued
    rows, columns, _ = network.match(ref, src, everything(ref, src))
    n = len(src.features.pixels)
    doubled = replace(src, features=src.features.take(np.concatenate([np.arange(n), columns])))
    reach = everything(ref, doubled)
    # Of equal chances either twin may be the first.
    shared_chance = dict(zip(*network.match(ref, doubled, reach)[::2], strict=True))
    reach.open[:, n:] = False
    found = by_pair(network.match(ref, doubled, reach))
    both = [pair for pair in zip(rows, columns, strict=True) if pair in found and pair[0] in shared_chance]
    assert len(both) > 100
    assert all(column < n for _, column in found)
    gain = [found[pair] / shared_chance[pair[0]] for pair in both]
    assert np.median(gain) == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("n_ref", [0, 1, 2])
@pytest.mark.parametrize("n_src", [0, 1, 2])
def test_few_points_are_no_trouble(glued: tuple[LighterGlueNetwork, Points, Points], n_ref: int, n_src: int) -> None:
    network, ref, src = glued
    rows, columns, score = network.match(ref, src, everything(ref, src))
    best = np.argsort(-score)
    few_ref, few_src = (
        replace(points, features=points.features.take(of[best[:n]]))
        for points, of, n in ((ref, rows, n_ref), (src, columns, n_src))
    )
    found = network.match(few_ref, few_src, everything(few_ref, few_src))
    assert found[0].dtype == found[1].dtype == np.int64
    assert len(found[0]) == len(found[1]) == len(found[2]) <= min(n_ref, n_src)
    assert np.array_equal(found[0], found[1]), "the true partners, if any"
    # With all closed, shares of nothing are none: of one pair the chance would be whole.
    closed = Reachable(np.zeros((n_ref, n_src), np.bool_))
    assert len(network.match(few_ref, few_src, closed)[0]) == 0
    nothing = replace(ref, features=Features.none())
    assert len(network.match(nothing, src, everything(nothing, src))[0]) == 0


def published(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The same parameters by the names of the authors' file, among those of the extractor it was trained with."""
    out = {"extractor.net.block1.0.layer.0.weight": torch.zeros(4, 1, 3, 3)}
    for name, value in state.items():
        parts = name.split(".")
        if parts[0] == "transformers":
            parts = [parts[2], parts[1], *parts[3:]]
        out["matcher." + ".".join(parts)] = value.clone()
    assert any(name.startswith("matcher.self_attn.2.") for name in out)
    assert not any("transformers" in name for name in out)
    return out


def test_the_published_files_names_are_understood(
    glued: tuple[LighterGlueNetwork, Points, Points], shared: Path, tmp_path: Path
) -> None:
    network, ref, src = glued
    path = tmp_path / "xfeat-lighterglue-mine.pt"
    torch.save(published(state_of(shared)), path)
    other = LighterGlueNetwork(stated(path, "lighterglue"), CPU, [])
    expected, found = (by_pair(one.match(ref, src, everything(ref, src))) for one in (network, other))
    assert found == expected
    # Left out and renamed ones are missed.
    for change in (
        "matcher.input_proj.weight",
        "matcher.cross_attn.1.to_v.bias",
        "matcher.log_assignment.2.final_proj.bias",
    ):
        state = published(state_of(shared))
        state["matcher.something"] = state.pop(change)
        torch.save(state, path)
        with pytest.raises(InputError, match="E-WEIGHTS-04") as caught:
            LighterGlueNetwork(stated(path, "lighterglue"), CPU, []).match(ref, src, everything(ref, src))
        assert "something" in caught.value.found


# --- weights ---


def stated(path: Path, network: str) -> FoundWeights:
    """A file of the user's own, with its digest."""
    return FoundWeights(path, network, hashlib.sha256(path.read_bytes()).hexdigest(), None)


@pytest.mark.parametrize("name", ["xfeat", "xfeat-star", "xfeat-lighterglue"])
@pytest.mark.parametrize(
    ("file", "other"),
    [("raft-small.pth", True), ("xfeat_lighterglue_L3_kornia.safetensors", True), ("xfeat_kornia.safetensors", False)],
)
def test_weights_of_another_network_and_truncated_ones_are_refused(
    shared: Path, tmp_path: Path, name: str, file: str, other: bool
) -> None:
    right = weights_of(name, str(shared / "weights"))
    path = tmp_path / file
    data = (shared / "weights" / file).read_bytes()
    path.write_bytes(data if other else data[: len(data) // 2])
    wrong = stated(path, "xfeat") if other else replace(right[0], path=path)
    matcher = MatcherSetting(name, WIDTH, weights=(wrong, *right[1:])).build([])
    with pytest.raises(InputError) as caught:
        matcher.extractor.detect([np.zeros((64, 64), np.uint8)])
    assert caught.value.code == ("E-WEIGHTS-04" if other else "E-WEIGHTS-02")
    assert caught.value.where == str(path)
    assert ("xfeat" if other else "truncated") in caught.value.message


def test_the_extractors_weights_are_none_of_lighterglue(shared: Path, built: Callable[..., Any], photo: Bytes) -> None:
    (right,) = weights_of("xfeat", str(shared / "weights"))
    matcher = MatcherSetting("xfeat-lighterglue", WIDTH, 50, weights=(right, right)).build([])
    views = seen_by(matcher, photo[:128, :128], photo[:128, :128])
    with pytest.raises(InputError, match="E-WEIGHTS-04") as caught:
        candidates(matcher, views)
    assert "LighterGlue" in caught.value.message


def test_a_damaged_file_with_the_right_digest_is_refused(shared: Path, tmp_path: Path) -> None:
    """Stated by the user, so only its content can tell."""
    state = load_file(shared / "weights/xfeat_kornia.safetensors")
    name = "block3.0.layer.0.weight"
    for changed in ({**state, name: state[name][:, :3].contiguous()}, {k: v for k, v in state.items() if k != name}):
        path = tmp_path / "xfeat-mine.safetensors"
        save_file(changed, path)
        extractor = XFeatExtractor(XFeatNetwork(stated(path, "xfeat"), CPU, []), WIDTH, 100)
        with pytest.raises(InputError, match="E-WEIGHTS-04") as caught:
            extractor.detect([np.zeros((64, 64), np.uint8)])
        assert name in caught.value.found


# --- memory ---


def same(found: Features, expected: Features) -> bool:
    names = ("pixels", "descriptors", "strength", "scale")
    return all(np.allclose(getattr(found, of), getattr(expected, of), atol=1e-5) for of in names)


@pytest.fixture
def pieces(photo: Bytes) -> list[Bytes]:
    return [np.ascontiguousarray(photo[top : top + 96, 300:460]) for top in (100, 220, 340)]


@pytest.mark.parametrize("name", ["xfeat", "xfeat-star"])
def test_batches_that_do_not_fit_are_halved_and_give_the_same(
    built: Callable[..., Any], pieces: list[Bytes], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    extractor = built(name, most=100).extractor
    expected = extractor.detect(pieces)
    assert not same(expected[0], expected[1])
    sizes: list[int] = []
    forward = XFeatModel.forward

    def short(self: XFeatModel, x: torch.Tensor) -> Any:
        sizes.append(len(x))
        if len(x) > 1:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3.4 GiB.")
        return forward(self, x)

    monkeypatch.setattr(XFeatNetwork, "batch", property(lambda _: 4))
    monkeypatch.setattr(XFeatModel, "forward", short)
    assert all(map(same, extractor.detect(pieces), expected))
    assert sizes[0] == 3
    assert 1 in sizes
    assert not any("CPU" in note for note in extractor.network.notes)


@pytest.mark.parametrize("name", ["xfeat", "xfeat-star", "xfeat-lighterglue"])
def test_a_gpu_without_room_leaves_it_to_the_cpu_and_the_user_is_told(
    built: Callable[..., Any], pieces: list[Bytes], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    matcher = built(name, most=100)
    expected = matcher.extractor.detect(pieces)
    views = tuple(View(CAMERA, pieces[0], features) for features in (expected[0], expected[0]))
    pairs = candidates(matcher, views)
    notes: list[str] = []

    def to(model: torch.nn.Module, place: torch.device) -> torch.nn.Module:
        if place.type == "cuda":
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3.4 GiB.")
        return model

    networks = [matcher.extractor.network, *([matcher.network] if name == "xfeat-lighterglue" else [])]
    for network in networks:
        # Frozen for users; the network that is loaded is to stay.
        for key, value in (("device", CUDA), ("notes", notes)):
            object.__setattr__(network, key, value)
        monkeypatch.setattr(network.model, "to", partial(to, network.model))
    assert matcher.extractor.batch == 8
    assert all(map(same, matcher.extractor.detect(pieces), expected))
    assert "cuda ran out of memory: 3 of 3" in notes[-1]
    assert "CPU" in notes[-1]
    for found, right in zip(candidates(matcher, views), pairs, strict=True):
        assert np.array_equal(found, right)
    assert sum("CPU" in note for note in notes) >= len(networks)
