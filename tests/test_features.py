"""Features of images of any size, their cache, and the photos they are read from."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Bytes, Floats
from pipeline.matching import features as module
from pipeline.matching.features import Features, ahead, cached_features, extract, store_features
from pipeline.matching.images import read_colour, read_grey, shrunk_size, to_full_pixels
from pipeline.matching.sift import SiftExtractor
from pipeline.matching.tiles import tiles


def blobs(rng: np.random.Generator, width: int, height: int, sigma: float) -> tuple[Bytes, Floats]:
    """An image of round spots at known places."""
    step = 14.0 * sigma
    at = np.stack(np.meshgrid(np.arange(step, width - step, step), np.arange(step, height - step, step)), -1).reshape(
        -1, 2
    )
    at += rng.uniform(-0.5, 0.5, at.shape)
    v, u = np.mgrid[:height, :width]
    image = np.full((height, width), 60.0)
    for x, y in at:
        image += 150.0 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2.0 * sigma**2))
    return image.round().clip(0, 255).astype(np.uint8), at


def texture(rng: np.random.Generator, width: int, height: int) -> Bytes:
    image = cv2.GaussianBlur(rng.integers(0, 256, (height, width)).astype(np.float32), (0, 0), 2.0)
    return cv2.normalize(image, np.empty_like(image), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def same(a: Features, b: Features) -> bool:
    names = ("pixels", "descriptors", "strength", "scale")
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in names)


@pytest.mark.parametrize("shrink", [1.0, 2.0, 2.5])
def test_keypoints_lie_where_the_spots_are_at_any_size(shrink: float) -> None:
    """Half a pixel lost in resizing, or the detector's own quarter pixel, would show in the mean."""
    image, at = blobs(np.random.default_rng(12), 700, 500, 3.0 * shrink)
    (features,) = extract(SiftExtractor(round(700 / shrink)), [image])
    np.testing.assert_allclose(features.scale, shrink, rtol=1e-6)
    found = features.pixels
    gap = found[:, None] - at[None]
    nearest = gap[np.arange(len(found)), np.argmin(np.linalg.norm(gap, axis=2), axis=1)]
    nearest = nearest[np.linalg.norm(nearest, axis=1) < 3.0]
    assert len(nearest) > 20
    np.testing.assert_allclose(nearest.mean(axis=0), 0.0, atol=0.03 * shrink)
    assert nearest.std(axis=0).max() < 0.1 * shrink


@given(st.integers(1, 9000), st.integers(1, 9000), st.integers(64, 4000))
def test_shrinking_keeps_the_image_s_edges(width: int, height: int, longest: int) -> None:
    small = shrunk_size(width, height, longest)
    assert max(small) <= max(longest, 1)
    assert small == (width, height) or max(width, height) > longest
    corners = np.array([[-0.5, -0.5], [small[0] - 0.5, small[1] - 0.5]])
    full = to_full_pixels(corners, small, (width, height))
    np.testing.assert_allclose(full, [[-0.5, -0.5], [width - 0.5, height - 0.5]], atol=1e-9)


# --- large images in pieces ---


@settings(max_examples=60)
@given(
    width=st.integers(1, 40), height=st.integers(1, 40), longest=st.integers(1, 24), margin=st.integers(0, 12)
)  # fmt: skip
def test_every_pixel_is_owned_by_one_piece(width: int, height: int, longest: int, margin: int) -> None:
    v, u = np.mgrid[:height, :width].reshape(2, -1)
    whole = np.arange(width * height, dtype=np.uint32).reshape(height, width)
    between = np.random.default_rng(width).uniform(-0.5, (width - 0.5, height - 0.5), (200, 2))
    centres = np.stack([u, v], axis=1).astype(np.float64)
    # On the seams, too.
    asked = np.concatenate([centres, centres - 0.5, between])
    owners = np.zeros(len(asked), int)
    for tile in tiles(width, height, longest, margin):
        own = tile.owns(asked)
        owners += own
        piece = tile.cut(whole)
        assert piece.size
        assert max(piece.shape) <= longest + 2 * margin
        assert piece[0, 0] == tile.top * width + tile.left
        mine = centres[own[: len(centres)]]
        # A margin about what it owns, but where the image ends.
        least, most = mine.min(axis=0) - margin, mine.max(axis=0) + margin
        assert (tile.left, tile.top) == tuple(np.maximum(least, 0))
        assert piece[-1, -1] == whole[tuple(np.minimum(most, (width - 1, height - 1)).astype(int)[::-1])]
    assert (owners == 1).all()


def test_a_small_image_is_one_piece_and_pieces_are_of_about_equal_size() -> None:
    (only,) = tiles(2560, 1000, 2560, 128)
    assert (only.left, only.top, only.right, only.bottom) == (0, 0, 2560, 1000)
    widths = {tile.core[2] - tile.core[0] for tile in tiles(5281, 100, 2560, 128)}
    assert widths == {1760, 1761}


@dataclass(frozen=True)
class Lights:
    """Finds the pixels that are not black, as strong as they are bright; told of no neighbourhood, so exactly."""

    max_image_px: int = 10**6
    max_features: int = 10**6
    batch: int = 1
    settings: str = "lights"

    def detect(self, pieces: Sequence[Bytes]) -> list[Features]:
        assert len({piece.shape for piece in pieces}) == 1, "of one size"
        return [self._of(piece) for piece in pieces]

    def _of(self, piece: Bytes) -> Features:
        at = np.argwhere(piece)[:, ::-1]
        bright = piece[at[:, 1], at[:, 0]]
        rows = np.argsort(-bright.astype(int), kind="stable")[: self.max_features]
        one = np.ones(len(rows), np.float32)
        return Features(at[rows].astype(np.float64), bright[rows, None], bright[rows].astype(np.float32), one)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10**6), sizes=st.lists(st.tuples(st.integers(1, 90), st.integers(1, 90)), max_size=4),
    most=st.integers(1, 80), tile=st.integers(8, 100), margin=st.integers(0, 12),
)  # fmt: skip
def test_in_pieces_the_strongest_are_those_of_the_whole(
    seed: int, sizes: list[tuple[int, int]], most: int, tile: int, margin: int
) -> None:
    rng = np.random.default_rng(seed)
    images = []
    for height, width in sizes:
        image = np.zeros(height * width, np.uint8)
        n = min(image.size, 60)
        # Each as strong as no other, so that there is one answer.
        image[rng.permutation(image.size)[:n]] = 1 + rng.permutation(255)[:n]
        images.append(image.reshape(height, width))
    extractor = Lights(max_features=most)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "TILE_PX", tile)
        patch.setattr(module, "TILE_MARGIN_PX", margin)
        found = extract(extractor, images)
    assert len(found) == len(images)
    for image, features in zip(images, found, strict=True):
        (expected,) = extractor.detect([image])
        assert same(features, expected)


def test_sift_in_pieces_finds_what_it_finds_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    image = texture(np.random.default_rng(21), 1200, 900)
    extractor = SiftExtractor(1600, 100_000)
    (whole,) = extract(extractor, [image])
    monkeypatch.setattr(module, "TILE_PX", 500)
    (parts,) = extract(extractor, [image])
    assert (np.diff(parts.strength) <= 0.0).all()
    assert len(parts.pixels) == pytest.approx(len(whole.pixels), rel=0.005)
    for some, others in ((whole, parts), (parts, whole)):
        # A point has as many features as it has orientations: one on a seam would else be there twice.
        (at, seen), (there, seen_there) = (
            np.unique(of.pixels.round(2), axis=0, return_counts=True) for of in (some, others)
        )
        distance, nearest = cKDTree(there).query(at)
        alike = (distance < 0.05) & (seen == seen_there[nearest])
        assert alike.mean() > 0.995
        seam = np.minimum(np.abs(at[:, :1] - [399.5, 799.5]).min(axis=1), np.abs(at[:, 1] - 449.5)) < 20.0
        assert seam.sum() > 500
        assert alike[seam].mean() > 0.99
    distance, nearest = cKDTree(np.c_[whole.pixels, whole.descriptors]).query(np.c_[parts.pixels, parts.descriptors])
    assert np.mean(distance < 20.0) > 0.99, "and the descriptors are alike"


def test_the_strongest_of_all_pieces_are_kept_in_the_pixels_of_the_image_as_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    image = texture(np.random.default_rng(22), 1200, 900)
    image[:, :600] //= 3
    image[:, :600] += 80
    (all_of_them,) = extract(SiftExtractor(900, 100_000), [image])
    monkeypatch.setattr(module, "TILE_PX", 400)
    (few,) = extract(SiftExtractor(900, 200), [image])
    assert len(few.pixels) == 200
    least = np.sort(all_of_them.strength)[-200]
    assert few.strength.min() == pytest.approx(least, rel=0.02)
    assert np.mean(few.pixels[:, 0] > 600.0) > 0.97, "the half with a third of the contrast has few strong ones"
    np.testing.assert_allclose(few.scale, 4.0 / 3.0)
    distance, _ = cKDTree(all_of_them.pixels).query(few.pixels)
    assert np.mean(distance < 0.1) > 0.97


@pytest.mark.slow
def test_an_image_larger_than_a_piece_as_it_is() -> None:
    """Without changing the size of a piece: 2700 px are two."""
    image = texture(np.random.default_rng(23), 2700, 300)
    extractor = SiftExtractor(4000, 100_000)
    (whole,), (parts,) = extractor.detect([image]), extract(extractor, [image])
    assert len(parts.pixels) == pytest.approx(len(whole.pixels), rel=0.005)
    distance, _ = cKDTree(parts.pixels).query(whole.pixels)
    assert np.mean(distance < 0.05) > 0.99


def test_images_of_several_sizes_at_once() -> None:
    rng = np.random.default_rng(24)
    images = [texture(rng, *size) for size in ((320, 240), (240, 320), (320, 240), (500, 300))]
    images[2][:] = 0
    extractor = SiftExtractor(320, 100)
    together = extract(extractor, images)
    assert [same(a, extract(extractor, [image])[0]) for a, image in zip(together, images, strict=True)] == [True] * 4
    assert [len(features.pixels) > 50 for features in together] == [True, True, False, True]
    assert extract(extractor, []) == []


# --- ahead of the caller ---


@given(st.lists(st.integers(), max_size=20))
def test_ahead_keeps_the_order(items: list[int]) -> None:
    assert list(ahead(lambda item: item * 2, items)) == [item * 2 for item in items]


@given(n=st.integers(1, 12), bad=st.integers(0, 11))
def test_ahead_raises_in_its_turn_what_making_raised(n: int, bad: int) -> None:
    def make(item: int) -> int:
        if item == bad:
            raise InputError("E-IMAGE-02", "no image", where=str(item))
        return item

    results, got = ahead(make, range(n)), []
    if bad >= n:
        assert list(results) == list(range(n))
        return
    with pytest.raises(InputError) as caught:
        deque(got.append(item) for item in results)
    assert caught.value.where == str(bad)
    assert got == list(range(bad))
    assert list(results) == []


def test_ahead_makes_no_more_than_the_next_two() -> None:
    """Decoded images are large."""
    made: list[int] = []

    def make(item: int) -> int:
        made.append(item)
        return item

    results = ahead(make, range(50))
    for got in islice(results, 10):
        assert len(made) <= got + 3
    results.close()  # type: ignore[attr-defined]
    assert len(made) <= 12


# --- the cache ---


def textured(path: Path, seed: int = 0) -> Path:
    assert cv2.imwrite(str(path), texture(np.random.default_rng(seed), 320, 240))
    return path


def cached(cache: Path) -> list[Path]:
    return [path for path in cache.rglob("*") if path.is_file()]


def test_features_from_the_cache_are_those_that_were_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photo, cache = textured(tmp_path / "a.png"), tmp_path / "cache"
    extractor = SiftExtractor(200, 300)
    made = cached_features(photo, "digest", extractor, cache)
    assert 50 < len(made.pixels) <= 320
    assert len(cached(cache)) == 1
    photo.unlink()  # a hit does not read the photo
    assert same(made, cached_features(photo, "digest", extractor, cache))
    with pytest.raises(InputError):
        cached_features(photo, "another photo", extractor, cache)
    with pytest.raises(InputError):
        cached_features(photo, "digest", SiftExtractor(100, 300), cache)
    assert len(cached(cache)) == 1


@pytest.mark.parametrize("batch", [1, 2, 3, 8])
def test_stored_features_are_each_image_s_own(tmp_path: Path, batch: int) -> None:
    """Some already cached, one without texture: nobody gets the features of its neighbour in the batch."""
    photos = [textured(tmp_path / f"{i}.png", i) for i in range(7)]
    assert cv2.imwrite(str(photos[3]), np.zeros((240, 320), np.uint8))
    sources, cache = [(photo, f"digest {photo.name}") for photo in photos], tmp_path / "cache"
    extractor = replace(SiftExtractor(320, 60), batch=batch)
    for path, digest in sources[1:3]:
        cached_features(path, digest, extractor, cache)
        path.unlink()  # a hit does not read the photo
    store_features(sources, extractor, cache)
    assert len(cached(cache)) == 7
    store_features(sources, extractor, cache)
    expected = [
        cached_features(textured(tmp_path / "x.png", i), f"{i}", extractor, tmp_path / "other")
        for i in (0, 1, 2, 4, 5, 6)
    ]
    for photo in photos:
        photo.unlink(missing_ok=True)
    found = [cached_features(*source, extractor, cache) for source in sources]
    assert len(found[3].pixels) == 0
    assert all(same(a, b) for a, b in zip([*found[:3], *found[4:]], expected, strict=True))


def test_an_image_that_cannot_be_read_is_named_and_stores_nothing(tmp_path: Path) -> None:
    sources = [(textured(tmp_path / "a.png"), "a"), (tmp_path / "b.png", "b")]
    with pytest.raises(InputError, match="E-IMAGE-01") as caught:
        store_features(sources, replace(SiftExtractor(320, 60), batch=2), tmp_path / "cache")
    assert caught.value.where == str(tmp_path / "b.png")
    assert cached(tmp_path / "cache") == []


def test_a_damaged_cache_is_made_again(tmp_path: Path) -> None:
    photo, cache = textured(tmp_path / "a.png"), tmp_path / "cache"
    extractor = SiftExtractor(320, 100)
    made = cached_features(photo, "digest", extractor, cache)
    (file,) = cached(cache)
    whole = file.read_bytes()
    rng = np.random.default_rng(14)
    damaged = [whole[:n] for n in (0, 1, 30, 100, len(whole) // 2, len(whole) - 1)]
    for _ in range(40):
        bytes_ = bytearray(whole)
        bytes_[int(rng.integers(0, 400))] ^= int(rng.integers(1, 256))
        damaged.append(bytes(bytes_))
    for content in [*damaged, b"text", b"PK\x03\x04" + b"\0" * 100]:
        file.write_bytes(content)
        assert same(made, cached_features(photo, "digest", extractor, cache))


def test_two_workers_with_photos_of_the_same_bytes(tmp_path: Path) -> None:
    photo, cache = textured(tmp_path / "a.png"), tmp_path / "cache"
    extractor = SiftExtractor(320, 200)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: cached_features(photo, "digest", extractor, cache), range(16)))
    assert all(same(found[0], other) for other in found)
    assert len(cached(cache)) == 1


def test_a_cache_that_cannot_be_written_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="No space"):
        cached_features(textured(tmp_path / "a.png"), "digest", SiftExtractor(320), tmp_path / "cache")
    assert cached(tmp_path / "cache") == []


def test_an_image_without_features(tmp_path: Path) -> None:
    path = tmp_path / "black.png"
    cv2.imwrite(str(path), np.zeros((100, 100), np.uint8))
    for _ in range(2):
        found = cached_features(path, "digest", SiftExtractor(320), tmp_path / "cache")
        assert found.pixels.shape == (0, 2)
        assert len(found.descriptors) == len(found.strength) == len(found.scale) == 0


# --- decoding ---


@pytest.mark.parametrize(
    ("content", "code"), [(None, "E-IMAGE-01"), (b"", "E-IMAGE-02"), (b"no image" * 9, "E-IMAGE-02")]
)
def test_images_that_cannot_be_read_are_named(tmp_path: Path, content: bytes | None, code: str) -> None:
    path = tmp_path / "DJI_0001.JPG"
    if content is not None:
        path.write_bytes(content)
    for read in (read_grey, read_colour):
        with pytest.raises(InputError, match=code) as caught:
            read(path)
        assert caught.value.where == str(path)


def test_pixels_are_as_stored_whatever_the_orientation_tag(tmp_path: Path) -> None:
    from PIL import Image  # noqa: PLC0415

    exif = Image.Exif()
    exif[0x0112] = 6
    picture = np.zeros((40, 60, 3), np.uint8)
    picture[:, :30, 0] = 255
    Image.fromarray(picture).save(tmp_path / "a.jpg", exif=exif, quality=95)
    colour = read_colour(tmp_path / "a.jpg")
    assert colour.shape == (40, 60, 3)
    assert colour[20, 5, 0] > 200
    assert colour[20, 5, 2] < 50
    assert read_grey(tmp_path / "a.jpg").shape == (40, 60)
