"""Least-squares matching where the correspondences are known: exact functions, warped photos, a rendered flight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from flight_truth import FlightTruth, reprojection_errors
from flights import SMALL
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.arrays import Bytes, Floats
from pipeline.geometry.poses import RelativePose
from pipeline.matching.images import read_grey
from pipeline.matching.patches.patch import Level, Window
from pipeline.matching.patches.subpixel import PatchSetting, Refined, refine
from pipeline.matching.patches.warps import predicted_affines
from pipeline.matching.tiles import Tile

WIDTH, HEIGHT = 320, 240
PLAIN = PatchSetting(WIDTH)
IDENTITY = np.eye(2)


@dataclass(frozen=True)
class Texture:
    """A sum of waves: known exactly at any place, so that no resampling has a part in the truth."""

    waves: Floats
    phases: Floats

    @classmethod
    def seeded(cls, seed: int, longest_px: float = 40.0, shortest_px: float = 6.0) -> Texture:
        rng = np.random.default_rng(seed)
        angle, length = rng.uniform(0.0, 2.0 * np.pi, 60), np.exp(rng.uniform(*np.log((shortest_px, longest_px)), 60))
        waves = 2.0 * np.pi * np.stack([np.cos(angle), np.sin(angle)], axis=1) / length[:, None]
        return cls(waves, rng.uniform(0.0, 2.0 * np.pi, 60))

    def at(self, px: Floats) -> Floats:
        """Grey values about 128, some 40 up and down."""
        out: Floats = 128.0 + 40.0 * np.sqrt(2.0 / 60.0) * np.cos(px @ self.waves.T + self.phases).sum(axis=-1)
        return out

    def image(self, place: Callable[[Floats], Floats] = lambda px: px, noise: float = 0.0, seed: int = 0) -> Floats:
        """What an image shows whose pixels see the texture at given places."""
        grid = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).astype(np.float64)
        values = self.at(place(grid.reshape(-1, 2))).reshape(HEIGHT, WIDTH)
        return values + np.random.default_rng(seed).normal(0.0, noise, values.shape) if noise else values


def as_bytes(values: Floats) -> Bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def points(n: int = 300, margin: int = 30, seed: int = 3) -> Floats:
    return np.random.default_rng(seed).uniform(margin, (WIDTH - margin, HEIGHT - margin), (n, 2))


def same(n: int, warp: Floats = IDENTITY) -> Floats:
    return np.tile(warp, (n, 1, 1))


def errors(found: Refined, true: Floats) -> Floats:
    """Distances of the refined ones."""
    out: Floats = np.linalg.norm(found.src_px - true, axis=1)[found.refined]
    return out


def normalised(found: Refined, true: Floats) -> Floats:
    """e^T C^-1 e of the refined ones, whose mean is 2 where the covariance is right."""
    e, (uu, uv, vv) = (found.src_px - true)[found.refined], found.covariance[found.refined].T
    covariance = np.stack([np.stack([uu, uv], axis=1), np.stack([uv, vv], axis=1)], axis=1)
    return np.einsum("ni,nij,nj->n", e, np.linalg.inv(covariance), e)


# --- the position


def test_identical_images_do_not_move_a_match() -> None:
    image = as_bytes(Texture.seeded(1).image(noise=4.0))
    at = np.rint(points())
    found = refine(image, image, at, at, [same(len(at))], PLAIN)
    assert found.refined.all()
    np.testing.assert_allclose(found.src_px, at, atol=1e-3)
    np.testing.assert_allclose(found.correlation, 1.0, atol=1e-5)


@pytest.mark.parametrize("shift", [(0.5, 0.0), (0.25, -0.4), (1.2, 0.8)])
def test_a_known_shift_is_found_through_gain_and_offset(shift: tuple[float, float]) -> None:
    texture, at = Texture.seeded(2), points()
    ref, src = texture.image(), 0.6 * texture.image(lambda px: px - shift) + 40.0
    found = refine(as_bytes(ref), as_bytes(src), at, at, [same(len(at))], PLAIN)
    assert found.refined.mean() > 0.98
    # The rounding of the grey values is left, and the interpolation's bias.
    assert 0.001 < np.median(errors(found, at + shift)) < 0.02
    assert np.linalg.norm(np.median((found.src_px - at - shift)[found.refined], axis=0)) < 0.02


@pytest.mark.parametrize(("turn_deg", "scale"), [(0.0, 1.0), (15.0, 1.0), (-15.0, 1.15), (10.0, 0.85)])
@pytest.mark.parametrize("predicted", [True, False])
def test_rounded_positions_are_refined_under_turn_and_scale(turn_deg: float, scale: float, predicted: bool) -> None:
    texture, at, middle = Texture.seeded(3), points(margin=60), np.array([WIDTH, HEIGHT]) / 2.0
    angle = np.radians(turn_deg)
    warp = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    true = (at - middle) @ warp.T + middle
    src = texture.image(lambda px: (px - middle) @ np.linalg.inv(warp).T + middle, noise=2.0, seed=1)
    affine = same(len(at), warp if predicted else IDENTITY)
    # Off by up to a pixel of an image of half the size.
    start = 2.0 * np.rint(true / 2.0)
    found = refine(
        as_bytes(texture.image(noise=2.0)), as_bytes(src), at, start, [affine], replace(PLAIN, matched_px=160)
    )
    assert found.refined.mean() > 0.95
    assert np.median(np.linalg.norm(start - true, axis=1)) > 0.6
    assert 0.005 < np.median(errors(found, true)) < 0.05
    assert np.quantile(errors(found, true), 0.95) < 0.15


def test_the_coarse_level_brings_large_errors_within_reach() -> None:
    texture, at = Texture.seeded(4, 60.0, 8.0), points(margin=60)
    rng = np.random.default_rng(5)
    angle = rng.uniform(0.0, 2.0 * np.pi, len(at))
    start = at + 2.8 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    images = [as_bytes(texture.image(noise=2.0, seed=seed)) for seed in (1, 2)]
    found = refine(*images, at, start, [same(len(at))], PatchSetting(128))
    assert found.refined.mean() > 0.95
    assert np.median(errors(found, at)) < 0.03
    # Alone, the fine level does not go so far.
    assert not refine(*images, at, start, [same(len(at))], PLAIN).refined.any()


def test_only_the_coarse_level_is_used_when_told() -> None:
    texture, at = Texture.seeded(4, 60.0, 8.0), points(margin=60)
    images = [as_bytes(texture.image(noise=4.0, seed=seed)) for seed in (1, 2)]
    coarse = refine(*images, at, at + 0.5, [same(len(at))], PatchSetting(160, finest_px=160))
    fine = refine(*images, at, at + 0.5, [same(len(at))], PatchSetting(160))
    assert coarse.refined.mean() > 0.95
    assert 0.5 < np.median(errors(coarse, at)) / np.median(errors(fine, at)) < 2.0
    # Each level's covariance is told in pixels of the image as given.
    assert 0.5 < normalised(coarse, at).mean() < 3.0
    assert 0.5 < normalised(fine, at).mean() < 3.0


def test_pieces_of_a_large_image_give_what_the_whole_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    texture, at = Texture.seeded(14), points(margin=20)
    moved = texture.image(lambda px: px + np.array([0.7, -0.4]), noise=2.0, seed=5)
    images = as_bytes(texture.image(noise=2.0)), as_bytes(moved)
    whole = refine(*images, at, at, [same(len(at))], replace(PLAIN, matched_px=160))
    monkeypatch.setattr("pipeline.matching.patches.subpixel._PIECE_PX", 90)
    pieces = refine(*images, at, at, [same(len(at))], replace(PLAIN, matched_px=160))
    assert whole.refined.mean() > 0.9
    np.testing.assert_array_equal(pieces.refined, whole.refined)
    # Sums are made in other blocks, and the last digits of single precision with them.
    np.testing.assert_allclose(pieces.src_px, whole.src_px, atol=1e-4)
    np.testing.assert_allclose(pieces.covariance, whole.covariance, rtol=1e-2, atol=1e-6)


def test_an_image_of_any_shape_and_scale_is_refined() -> None:
    """OpenCV refuses images of 32767 pixels, and patches of as many."""
    rng = np.random.default_rng(15)
    wide = cv2.GaussianBlur(rng.integers(0, 256, (120, 33000)).astype(np.float32), (0, 0), 2.0).astype(np.uint8)
    at = np.column_stack([rng.uniform(60, 32900, 60).round(), rng.uniform(40, 80, 60).round()])
    found = refine(wide, wide, at, at, [same(60)], PatchSetting(33000))
    assert found.refined.mean() > 0.9
    np.testing.assert_allclose(found.src_px, at, atol=0.01)
    assert (2 * PatchSetting(64).half_at(40_000) + 1) ** 2 < 32_767


def test_of_the_candidates_the_one_that_correlates_is_taken() -> None:
    texture, at, middle = Texture.seeded(5), points(margin=70), np.array([WIDTH, HEIGHT]) / 2.0
    warp = np.array([[0.0, -1.0], [1.0, 0.0]])
    true = (at - middle) @ warp.T + middle
    inside = np.all((true > 30.0) & (true < (WIDTH - 30.0, HEIGHT - 30.0)), axis=1)
    at, true = at[inside], true[inside]
    src = as_bytes(texture.image(lambda px: (px - middle) @ warp + middle, noise=2.0))
    ref, n = as_bytes(texture.image(noise=2.0, seed=9)), len(at)
    right, wrong = same(n, warp), same(n)
    for candidates in ([wrong, right], [right, wrong], [np.full((n, 2, 2), np.nan), right]):
        found = refine(ref, src, at, true + 0.4, candidates, PLAIN)
        assert found.refined.mean() > 0.98
        assert np.median(errors(found, true)) < 0.05
    assert refine(ref, src, at, true + 0.4, [wrong], PLAIN).refined.mean() < 0.05


def test_images_of_different_sizes_are_brought_to_the_size_matched_at() -> None:
    texture, at = Texture.seeded(6), points(margin=60)
    ref = as_bytes(texture.image(noise=1.0))
    src = cv2.resize(as_bytes(texture.image(noise=1.0, seed=4)), (160, 120), interpolation=cv2.INTER_AREA)
    true = (at + 0.5) / 2.0 - 0.5
    found = refine(ref, src, at, np.rint(true), [same(len(at), 0.5 * IDENTITY)], PatchSetting(160))
    assert found.refined.mean() > 0.9
    assert np.median(errors(found, true)) < 0.06


# --- the covariance


@pytest.mark.parametrize("noise", [2.0, 5.0, 10.0])
@pytest.mark.parametrize("setting", [PLAIN, PatchSetting(WIDTH, finest_px=WIDTH, half_px=6, iterations=5)])
def test_the_covariance_tells_the_errors_that_noise_makes(noise: float, setting: PatchSetting) -> None:
    texture, at = Texture.seeded(7), points(600)
    images = [as_bytes(texture.image(noise=noise, seed=seed)) for seed in (1, 2)]
    found = refine(*images, at, at + 0.3, [same(len(at))], setting)
    assert found.refined.mean() > 0.98
    square = normalised(found, at)
    # The constants are those of photos, not of white noise.
    assert 0.8 < square.mean() < 2.9
    assert np.mean(square > 9.21) < 0.06
    sigma = np.sqrt(found.covariance[found.refined][:, [0, 2]].mean())
    assert 0.8 < sigma / np.sqrt(np.mean((found.src_px - at)[found.refined] ** 2)) < 1.8


def test_more_noise_means_a_larger_covariance() -> None:
    texture, at = Texture.seeded(8), points()
    sigmas = []
    for noise in (3.0, 6.0):
        images = [as_bytes(texture.image(noise=noise, seed=seed)) for seed in (1, 2)]
        found = refine(*images, at, at, [same(len(at))], PLAIN)
        sigmas.append(np.sqrt(np.median(found.covariance[found.refined, 0])))
    assert 1.5 < sigmas[1] / sigmas[0] < 2.3


def test_the_covariance_is_longer_along_stripes_and_turns_with_the_warp() -> None:
    # Strong upright stripes with a little texture.
    grid = np.arange(WIDTH)[None]
    weak = (Texture.seeded(9).image() - 128.0) * 0.15
    values = 128.0 + 60.0 * np.sin(2.0 * np.pi * grid / 23.0) + weak
    rng = np.random.default_rng(1)
    ref, src = (as_bytes(values + rng.normal(0.0, 2.0, values.shape)) for _ in range(2))
    at = points(margin=40)
    found = refine(ref, src, at, at, [same(len(at))], PLAIN)
    uu, _, vv = found.covariance[found.refined].T
    assert found.refined.mean() > 0.8
    assert np.median(vv / uu) > 4.0
    assert 0.4 < normalised(found, at).mean() < 3.0
    # A src image turned by a quarter has them the other way round.
    turned = np.ascontiguousarray(np.rot90(src, -1))
    to = np.stack([HEIGHT - 1.0 - at[:, 1], at[:, 0]], axis=1)
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    other = refine(ref, turned, at, to, [same(len(at), quarter)], PLAIN)
    both = found.refined & other.refined
    np.testing.assert_allclose(other.covariance[both][:, [2, 0]], found.covariance[both][:, [0, 2]], rtol=0.05)


# --- what is not refined


def left_alone(found: Refined, start: Floats) -> None:
    np.testing.assert_array_equal(found.src_px, start)
    assert not found.refined.any()
    assert np.isnan(found.covariance).all()
    assert (found.correlation == 0.0).all()


def noisy(seed: int, noise: float = 3.0) -> Bytes:
    return as_bytes(np.full((HEIGHT, WIDTH), 90.0) + np.random.default_rng(seed).normal(0.0, noise, (HEIGHT, WIDTH)))


@pytest.mark.parametrize(
    "images",
    [
        (np.zeros((HEIGHT, WIDTH), np.uint8), np.zeros((HEIGHT, WIDTH), np.uint8)),
        (np.full((HEIGHT, WIDTH), 255, np.uint8), as_bytes(Texture.seeded(1).image())),
        (as_bytes(Texture.seeded(1).image()), np.full((HEIGHT, WIDTH), 77, np.uint8)),
        (noisy(1), noisy(2)),
    ],
    ids=["black", "flat ref", "flat src", "noise"],
)
def test_patches_that_tell_nothing_are_left_alone(images: tuple[Bytes, Bytes]) -> None:
    at = points(100)
    left_alone(refine(*images, at, at + 0.3, [same(len(at))], PLAIN), at + 0.3)


def test_false_matches_are_hardly_ever_refined() -> None:
    at = points(500)
    images = [as_bytes(Texture.seeded(seed).image()) for seed in (1, 2)]
    assert refine(*images, at, at, [same(len(at))], PLAIN).refined.mean() < 0.05
    assert refine(*images, at, at, [same(len(at))], replace(PLAIN, least_correlation=0.9)).refined.mean() < 0.01


def test_stripes_are_not_refined() -> None:
    values = np.tile(128.0 + 60.0 * np.sin(np.arange(WIDTH) / 4.0), (HEIGHT, 1))
    rng = np.random.default_rng(1)
    ref, src = (as_bytes(values + rng.normal(0.0, 2.0, values.shape)) for _ in range(2))
    at = points(100)
    found = refine(ref, src, at, at, [same(len(at))], PLAIN)
    assert found.refined.mean() < 0.15


def test_patches_that_leave_an_image_are_left_alone() -> None:
    image = as_bytes(Texture.seeded(1).image())
    inside, edge = np.array([160.3, 120.4]), PLAIN.half_px
    outside = np.array([[edge - 1.0, 100.0], [100.0, HEIGHT - edge], [WIDTH + 50.0, 100.0], [-1e9, 3.0], [np.nan, 5.0]])
    many = np.tile(inside, (len(outside), 1))
    for ref_px, src_px in ((outside, many), (many, outside)):
        left_alone(refine(image, image, ref_px, src_px, [same(len(many))], PLAIN), src_px)
    # A pixel farther in, they are refined.
    at = np.array([[edge + 2.0, 100.0], [100.0, HEIGHT - edge - 3.0]])
    assert refine(image, image, at, at, [same(2)], PLAIN).refined.all()


def test_nothing_to_refine_and_images_smaller_than_a_patch() -> None:
    image = as_bytes(Texture.seeded(1).image())
    none = np.empty((0, 2))
    assert refine(image, image, none, none, [np.empty((0, 2, 2))], PLAIN).src_px.shape == (0, 2)
    tiny = image[:7, :9]
    at = np.array([[4.0, 3.0]])
    left_alone(refine(tiny, tiny, at, at, [same(1)], PLAIN), at)
    left_alone(refine(image, image, points(1), points(1), [np.full((1, 2, 2), np.nan)], PLAIN), points(1))
    left_alone(refine(image, image, points(1), points(1), [np.zeros((1, 2, 2))], PLAIN), points(1))


@settings(max_examples=15)
@given(
    st.lists(st.tuples(*[st.floats(-30.0, 350.0)] * 4), min_size=1, max_size=8),
    st.lists(st.floats(-3.0, 3.0), min_size=4, max_size=4),
)
def test_positions_are_numbers_and_moves_stay_within_reach(
    rows: list[tuple[float, ...]], elements: list[float]
) -> None:
    image, other = as_bytes(Texture.seeded(1).image()), as_bytes(Texture.seeded(2).image())
    at = np.array(rows)
    warp = same(len(at), np.array(elements).reshape(2, 2))
    for src in (image, other):
        found = refine(image, src, at[:, :2], at[:, 2:], [warp, same(len(at))], PLAIN)
        assert np.isfinite(found.src_px).all()
        assert np.linalg.norm(found.src_px - at[:, 2:], axis=1).max() <= PLAIN.reach_px + 1e-9
        assert np.isfinite(found.covariance[found.refined]).all()
        assert np.isnan(found.covariance[~found.refined]).all()
        np.testing.assert_array_equal(found.src_px[~found.refined], at[~found.refined][:, 2:])


def test_a_match_does_not_depend_on_those_beside_it() -> None:
    texture, at = Texture.seeded(10), points(700)
    images = [as_bytes(texture.image(noise=3.0, seed=seed)) for seed in (1, 2)]
    whole = refine(*images, at, at + 0.4, [same(len(at))], PLAIN)
    again = refine(*images, at, at + 0.4, [same(len(at))], PLAIN)
    np.testing.assert_array_equal(whole.src_px, again.src_px)
    np.testing.assert_array_equal(whole.covariance, again.covariance)
    some = np.arange(5, 700, 7)
    part = refine(*images, at[some], at[some] + 0.4, [same(len(some))], PLAIN)
    np.testing.assert_allclose(part.src_px, whole.src_px[some], atol=1e-4)


# --- parts


def test_levels_go_from_the_size_matched_at_to_the_full_one() -> None:
    assert PatchSetting(1600).sizes(1600, 1200) == [(1600, 1200)]
    assert PatchSetting(1600).sizes(640, 480) == [(640, 480)]
    assert PatchSetting(1600).sizes(4000, 3000) == [(1600, 1200), (4000, 3000)]
    assert PatchSetting(640).sizes(4000, 3000) == [(640, 480), (1600, 1200), (4000, 3000)]
    assert PatchSetting(640, finest_px=1600).sizes(4000, 3000) == [(640, 480), (1600, 1200)]
    assert PatchSetting(640, finest_px=640).sizes(4000, 3000) == [(640, 480)]
    assert [PatchSetting(1600).half_at(px) for px in (800, 1600, 3200, 6400)] == [9, 9, 13, 18]


def test_a_levels_pixels_are_those_of_its_image() -> None:
    tile = Tile(20, 10, 100, 60, (20, 10, 100, 60))
    level = Level.of(np.zeros((80, 160), np.uint8), tile, np.array([0.5, 1 / 3]), 0.5)
    assert level.grey.shape == (50, 80)
    np.testing.assert_allclose(
        level.pixels(np.array([[0.0, 0.0], [319.0, 239.0]])) + level.corner, [[-0.25, -1 / 3], [159.25, 79.0 + 1 / 3]]
    )
    at = points(20)
    np.testing.assert_allclose(level.full_pixels(level.pixels(at)), at)


@pytest.mark.parametrize("half", [1, 2, 5, 6, 9, 13])
def test_every_pixel_of_a_window_is_in_as_many_parts(half: int) -> None:
    window = Window.of(half)
    assert window.parts.shape[0] == window.weights.size == (2 * half + 1) ** 2
    np.testing.assert_allclose((window.parts.astype(np.float64) ** 2).sum(axis=1), 1.0, rtol=1e-5)
    assert window.weights.sum() == pytest.approx(1.0, rel=1e-5)
    assert 1.0 < window.count <= window.weights.size


# --- photos


def warped_photo(photo: Bytes, seed: int) -> tuple[Bytes, Bytes, Floats]:
    """A photo and itself under a homography (turn to 15 deg, scale to 15 %, perspective), with noise and JPEG.

    Both are shrunk by two after the warp, so both are resampled.

    Returns:
        Ref, src, and the homography of their pixels.
    """
    rng = np.random.default_rng(seed)
    height, width = photo.shape
    angle, scale = np.radians(rng.uniform(-15.0, 15.0)), rng.uniform(0.85, 1.15)
    middle = np.array([[1.0, 0.0, (width - 1) / 2], [0.0, 1.0, (height - 1) / 2], [0.0, 0.0, 1.0]])
    inner = np.eye(3)
    inner[:2, :2] = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    inner[2, :2] = rng.uniform(-0.2, 0.2, 2) / (width, height)
    large = middle @ inner @ np.linalg.inv(middle)
    seen = cv2.warpPerspective(photo, large, (width, height), flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    shrunk = []
    for image in (photo, seen):
        small = cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA).astype(np.float64)
        grainy = as_bytes(small + rng.normal(0.0, 2.0, small.shape))
        coded = cv2.imencode(".jpg", grainy, [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
        shrunk.append(np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8))
    half = np.array([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]])
    return shrunk[0], shrunk[1], half @ large @ np.linalg.inv(half)


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "median_px"),
    [
        ("photos/mirafiori_p4m_rtk/DJI_0060.JPG", 0.03),
        ("photos/sheffield_cross/images/DJI_0065.JPG", 0.07),
        ("truth/fountain_p11/images/0005.jpg", 0.06),
    ],
)
def test_photos_under_known_homographies(shared: Path, name: str, median_px: float) -> None:
    ref, src, homography = warped_photo(read_grey(shared / "data" / name), 1)
    at = cv2.goodFeaturesToTrack(ref, 800, 0.002, 8)[:, 0].astype(np.float64)
    true = cv2.perspectiveTransform(at[:, None], homography)[:, 0]
    inside = np.all((true > 16.0) & (true < np.array(src.shape[::-1]) - 16.0), axis=1)
    inside &= np.all((at > 16.0) & (at < np.array(ref.shape[::-1]) - 16.0), axis=1)
    at, true = at[inside], true[inside]
    start = 2.0 * np.rint(true / 2.0)
    for affine in (IDENTITY, homography[:2, :2] / homography[2, 2]):
        found = refine(ref, src, at, start, [same(len(at), affine)], PatchSetting(max(ref.shape) // 2))
        assert found.refined.mean() > 0.95
        assert 0.25 * median_px < np.median(errors(found, true)) < median_px
        assert 0.6 < normalised(found, true).mean() < 2.6


@pytest.mark.slow
def test_matches_of_a_rendered_flight(small_flight: Path) -> None:
    truth = FlightTruth.of(small_flight)
    camera = SMALL
    squares, before, after = [], [], []
    names = list(truth.poses)
    for ref, src in pairwise(names):
        if not truth.neighbours(ref, src):
            continue
        images = [read_grey(small_flight / "photos" / f"{name}.JPG") for name in (ref, src)]
        at = cv2.goodFeaturesToTrack(images[0], 400, 0.005, 6)[:, 0].astype(np.float64)
        poses = truth.poses[ref], truth.poses[src]
        depth = truth.depths(ref, at)
        true = -reprojection_errors(at, np.zeros_like(at), depth, camera, ref=poses[0], src=poses[1])
        seen = np.isfinite(true).all(axis=1)
        at, true = at[seen], true[seen]
        turn = poses[1].rotation.T @ poses[0].rotation
        move = RelativePose(turn, poses[1].rotation.T @ (poses[0].centre - poses[1].centre), np.zeros((6, 6)))
        up = poses[0].rotation.T @ [0.0, 0.0, 1.0]
        start = np.rint(true)
        affines = predicted_affines(at, start, camera, camera, move, up_in_ref=up)
        found = refine(*images, at, start, affines, PatchSetting(camera.width))
        before.append(np.linalg.norm(start - true, axis=1)[found.refined])
        after.append(errors(found, true))
        squares.append(normalised(found, true))
    square, error = np.concatenate(squares), np.concatenate(after)
    assert len(error) > 300
    assert np.median(error) < 0.3 * np.median(np.concatenate(before))
    # Outlines of trees and roofs, where a patch shows two depths, are the tail.
    assert 1.2 < square[square < 25.0].mean() < 3.6
    assert np.mean(square > 25.0) < 0.06
