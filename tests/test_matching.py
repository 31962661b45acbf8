"""Whole pairs on features whose correspondences are known, their residuals, duplicates and consensus."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from feature_scenes import BAND, DEG, FLIGHTS, PLAIN, SMALL, STRONG, Scene, pose, scene
from hypothesis import given
from hypothesis import strategies as st
from pixel_noise import drawn, slanted
from plane_photos import plane_photos

from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import RelativePose, relative_pose
from pipeline.geometry.rotations import enu_from_cam
from pipeline.matching.features import Features, extract
from pipeline.matching.matcher import SearchLimits, View
from pipeline.matching.nearest import NearestMatcher
from pipeline.matching.pair import PairMatches, match_pair
from pipeline.matching.reach import rays_in_ref
from pipeline.matching.sift import SiftExtractor, root_sift
from pipeline.matching.verify import consensus, epipolar_residuals, without_duplicates

LIMITS = SearchLimits(BAND, 1.5, 10**6)
MATCHER = NearestMatcher(SiftExtractor(10**6), root_sift, 0.85)


def matched(ref: View, src: View, of: RelativePose) -> PairMatches:
    """By descriptors alone: there is nothing to be seen in the images."""
    return match_pair(MATCHER, ref, src, of, LIMITS, subpixel=False)


def indices(of: Features, pixels: Floats) -> Ints:
    """Which feature each pixel belongs to."""
    known = {tuple(p): i for i, p in enumerate(of.pixels)}
    return np.array([known[tuple(p)] for p in pixels], np.int64)


def judged(of: Scene, found: PairMatches) -> tuple[float, float]:
    """Recall and precision of the matches."""
    ref, src = indices(of.ref.features, found.ref_px), indices(of.src.features, found.src_px)
    right = (of.partner[ref] == src).sum()
    return right / (of.partner >= 0).sum(), right / max(1, len(ref))


# --- whole pairs ---


@pytest.mark.parametrize("camera", [PLAIN, STRONG], ids=["pinhole", "k1 = -0.3"])
@pytest.mark.parametrize("name", FLIGHTS)
def test_nearly_all_correspondences_are_found_and_nearly_none_invented(name: str, camera: Camera) -> None:
    of = scene(np.random.default_rng(1), name, camera)
    found = matched(of.ref, of.src, of.logged)
    recall, precision = judged(of, found)
    # Next to an epipole in the image there is no band, and no depth to be had.
    assert recall > (0.99 if name in {"sideways", "nadir, turned"} else 0.88)
    assert precision > 0.995
    assert found.inlier.mean() > 0.95


def test_a_camera_of_another_kind_and_size_in_src() -> None:
    for cameras in ((PLAIN, SMALL), (SMALL, STRONG)):
        of = scene(np.random.default_rng(2), "nadir, turned", *cameras)
        recall, precision = judged(of, matched(of.ref, of.src, of.logged))
        assert recall > 0.99
        assert precision > 0.99


def test_a_pose_that_is_wrong_beyond_its_sigma_finds_next_to_nothing() -> None:
    """The band is the pose's: without it, the test of recall above would show nothing."""
    of = scene(np.random.default_rng(3), "sideways")
    turned = enu_from_cam(0.0, 25.0 * DEG, 0.0).T @ enu_from_cam(0.0, 0.0, 0.0)
    wrong = replace(of.logged, rotation=turned @ of.logged.rotation)
    found = matched(of.ref, of.src, wrong)
    recall, _ = judged(of, found)
    assert recall < 0.2
    assert found.inlier.sum() < 0.1 * len(of.partner)


def test_inliers_agree_with_the_pose_and_outliers_in_the_band_are_told_apart() -> None:
    rng = np.random.default_rng(4)
    of = scene(rng, "sideways")
    # A tenth of the true partners is moved off its epipolar line by 12 px: in the band, but not consistent.
    moved = of.src.features.pixels.copy()
    victims = of.partner[of.partner >= 0][::10]
    moved[victims] += rng.choice([-12.0, 12.0], (len(victims), 1)) * np.array([0.0, 1.0])
    shifted = replace(of.src, features=replace(of.src.features, pixels=moved))
    found = matched(of.ref, shifted, of.logged)
    src = indices(shifted.features, found.src_px)
    is_victim = np.isin(src, victims)
    assert is_victim.sum() > 0.5 * len(victims)
    assert found.inlier[is_victim].mean() < 0.1
    assert found.inlier[~is_victim].mean() > 0.95


@pytest.mark.parametrize("sizes", [(0, 0), (0, 50), (50, 0), (1, 1), (4, 4)])
def test_few_or_no_features(sizes: tuple[int, int]) -> None:
    of = scene(np.random.default_rng(5), "sideways")
    ref, src = (
        replace(view, features=view.features.take(np.arange(n)))
        for view, n in zip((of.ref, of.src), sizes, strict=True)
    )
    for subpixel in (False, True):
        found = match_pair(MATCHER, ref, src, of.logged, LIMITS, subpixel=subpixel)
        assert not found.inlier.any()
        assert len(found.ref_px) == len(found.src_px) == len(found.score) == len(found.inlier)
        assert found.covariance.shape == (len(found.score), 3)


def test_twice_the_same_and_whatever_the_order_of_the_features() -> None:
    rng = np.random.default_rng(6)
    of = scene(rng, "forward, 20 deg down, epipole in the image")
    first, again = (matched(of.ref, of.src, of.logged) for _ in range(2))
    for name in ("ref_px", "src_px", "score", "covariance", "inlier"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    order = rng.permutation(len(of.partner))
    mixed = replace(of.ref, features=of.ref.features.take(order))
    other = matched(mixed, of.src, of.logged)

    def rows(found: PairMatches) -> set[tuple[float, ...]]:
        return {tuple(row) for row in np.concatenate([found.ref_px, found.src_px], axis=1)}

    assert rows(other) == rows(first)


def test_without_a_fit_every_match_has_the_matchers_variance() -> None:
    of = scene(np.random.default_rng(17), "nadir, turned", PLAIN, SMALL)
    limits = replace(LIMITS, max_image_px=2000)
    found = match_pair(MATCHER, of.ref, of.src, of.logged, limits, subpixel=False)
    variance = limits.prior_variance(PLAIN, SMALL)
    np.testing.assert_allclose(found.covariance, np.tile([variance, 0.0, variance], (len(found.score), 1)))


def test_where_the_images_show_nothing_no_match_is_an_inlier() -> None:
    """Whatever the descriptors say, with the fit of the patches the images have the last word."""
    of = scene(np.random.default_rng(18), "sideways", SMALL)
    found = match_pair(MATCHER, of.ref, of.src, of.logged, LIMITS)
    assert len(found.score) > 300
    assert not found.inlier.any()
    assert np.isfinite(found.covariance).all()


def test_a_black_image_matches_nothing() -> None:
    """Its extractor gives no descriptors, not even their width."""
    of = scene(np.random.default_rng(19), "sideways", n=30)
    black = replace(of.src, features=Features.none())
    for ref, src in ((of.ref, black), (black, of.src), (black, black)):
        for subpixel in (False, True):
            found = match_pair(MATCHER, ref, src, of.logged, LIMITS, subpixel=subpixel)
            assert found.ref_px.shape == found.src_px.shape == (0, 2)
            assert found.covariance.shape == (0, 3)


def test_the_fit_of_the_patches_brings_a_match_nearer_and_knows_how_near() -> None:
    """Matched at half the size and fitted on the whole image, under poses with an error."""
    rng = np.random.default_rng(20)
    matcher = NearestMatcher(SiftExtractor(400, 1500), root_sift, 0.85)
    of = plane_photos(rng)
    features = extract(matcher.extractor, of.images)
    ref, src = (View(*parts) for parts in zip(of.cameras, of.images, features, strict=True))
    logged = relative_pose(*(replace(p, centre=p.centre + rng.normal(0.0, p.own.position_m)) for p in of.poses))
    limits = SearchLimits(BAND, 1.5, 400)
    median, share = {}, {}
    for subpixel in (False, True):
        found = match_pair(matcher, ref, src, logged, limits, up_in_ref=of.poses[0].rotation[2], subpixel=subpixel)
        error = of.errors(found.ref_px, found.src_px)[found.inlier]
        uu, uv, vv = found.covariance[found.inlier].T
        squares = (vv * error[:, 0] ** 2 - 2.0 * uv * error[:, 0] * error[:, 1] + uu * error[:, 1] ** 2) / (
            uu * vv - uv * uv
        )
        assert len(error) > 400
        median[subpixel] = np.median(np.linalg.norm(error, axis=1))
        share[subpixel] = np.median(squares)
    assert median[True] < 0.03
    assert median[True] < 0.2 * median[False]
    # Half of the squares of Gaussian errors are below 1.39; on a plane without outlines the covariance is cautious.
    assert 0.15 < share[True] < 2.0


# --- residuals, duplicates, consensus ---


def test_residuals_are_angles_off_the_epipolar_plane_and_their_sigma_holds() -> None:
    rng = np.random.default_rng(9)
    shares = []
    variance = LIMITS.prior_variance(PLAIN, PLAIN)
    for _ in range(40):
        of = scene(rng, "forward, 20 deg down, epipole in the image", n=60)
        ref_px, src_px = of.true_px
        ref, src = rays_in_ref(ref_px, PLAIN, np.eye(3)), rays_in_ref(src_px, PLAIN, of.logged.rotation.T)
        noise = PLAIN.plane_covariance(PLAIN.rays(src_px), np.tile([variance, 0.0, variance], (len(src_px), 1)))
        found = epipolar_residuals(ref, src, of.logged, noise)
        normal = np.cross(of.logged.centre, ref)
        expected = 0.5 * np.pi - np.arccos(np.sum(normal * src, axis=1) / np.linalg.norm(normal, axis=1))
        np.testing.assert_allclose(found.angle_rad, expected, atol=1e-9)
        shares.append(np.abs(found.angle_rad) < found.sigma_rad)
    # The points of a pair share its pose error, so 40 redraws leave a few percent.
    assert 0.58 < np.mean(np.concatenate(shares)) < 0.78


@pytest.mark.parametrize("camera", [PLAIN, STRONG, SMALL], ids=["pinhole", "brown", "fisheye"])
def test_the_sigma_of_a_residual_is_that_of_redrawn_src_pixels(camera: Camera) -> None:
    """A src that is turned by 40 deg and rolled: on the wrong axes the noise would have another slant."""
    rng, draws = np.random.default_rng(15), 2000
    of = relative_pose(pose((10, -50, 2), (3, 8, 30)), pose((50, -40, -25), (0, 0, 31)))
    points = PLAIN.rays(rng.uniform(0.0, (4000.0, 3000.0), (400, 2))) * rng.uniform(15.0, 60.0, (400, 1))
    src_px = camera.project(points @ of.rotation.T + of.translation)
    seen = np.flatnonzero(camera.holds(src_px))[:40]
    assert len(seen) == 40
    ref, src_px, covariance = points[seen], src_px[seen], slanted(40)
    exact = replace(of, covariance=np.zeros((6, 6)))
    noise = camera.plane_covariance(camera.rays(src_px), covariance)
    predicted = epipolar_residuals(ref, camera.rays(src_px) @ of.rotation, exact, noise)
    np.testing.assert_allclose(predicted.angle_rad, 0.0, atol=1e-9)
    several = np.tile(src_px, (draws, 1)) + drawn(rng, np.tile(covariance, (draws, 1)))
    redrawn = epipolar_residuals(
        np.tile(ref, (draws, 1)), camera.rays(several) @ of.rotation, exact, np.tile(noise, (1, draws))
    )
    spread = np.std(redrawn.angle_rad.reshape(draws, -1), axis=0)
    np.testing.assert_allclose(spread / predicted.sigma_rad, 1.0, atol=0.07)
    assert np.ptp(predicted.sigma_rad) > 0.5 * predicted.sigma_rad.min()
    with_pose = epipolar_residuals(ref, camera.rays(src_px) @ of.rotation, of, noise)
    alone = epipolar_residuals(ref, camera.rays(src_px) @ of.rotation, of, np.zeros((3, 1)))
    np.testing.assert_allclose(with_pose.sigma_rad**2, alone.sigma_rad**2 + predicted.sigma_rad**2, rtol=1e-9)


@pytest.mark.parametrize("cameras", [(PLAIN, PLAIN), (PLAIN, SMALL), (SMALL, PLAIN)])
@pytest.mark.parametrize("longest", [1000, 10**6])
def test_the_error_of_a_feature_match_is_that_of_both_images_seen_in_src(
    cameras: tuple[Camera, Camera], longest: int
) -> None:
    """Far points near the axis, where one focal length serves; sigma_px counts at the size matched at."""
    ref, src = cameras
    rng = np.random.default_rng(16)
    in_ref, in_src = (0.5 * max(1.0, camera.width / longest) for camera in cameras)
    at = np.array([ref.cx, ref.cy])
    seen = ref.rays(at + rng.normal(0.0, in_ref, (20_000, 2)))
    error = src.project(seen) + rng.normal(0.0, in_src, (20_000, 2)) - (src.cx, src.cy)
    limits = SearchLimits(BAND, 1.5, longest)
    np.testing.assert_allclose(np.var(error, axis=0), limits.prior_variance(ref, src), rtol=0.05)


def test_duplicates_leave_the_better_match() -> None:
    ref = np.array([[10.0, 10.0], [10.2, 9.9], [50.0, 50.0], [70.0, 70.0], [90.0, 90.0]])
    src = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0], [3.1, 2.9], [9.0, 9.0]])
    keep = without_duplicates(ref, src, np.array([0.2, 0.5, 0.3, 0.4, 0.1]))
    assert keep.tolist() == [False, True, False, True, True]
    # Whoever lost its ref pixel is no rival in src: a chain loses its middle alone.
    chain = np.array([[0.0, 0.0], [0.0, 0.0], [9.0, 9.0]]), np.array([[0.0, 0.0], [5.0, 5.0], [5.0, 5.0]])
    assert without_duplicates(*chain, np.array([0.9, 0.8, 0.7])).tolist() == [True, False, True]
    near = np.array([[0.0, 0.0], [1.4, 0.0]])
    assert without_duplicates(near, near, np.array([0.5, 0.6])).tolist() == [True, True]
    assert without_duplicates(near, near, np.array([0.5, 0.6]), (3.0, 3.0)).tolist() == [False, True]
    assert without_duplicates(ref[:0], src[:0], np.empty(0)).tolist() == []


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5), st.floats(0, 1)), max_size=40))
def test_no_pixel_is_used_twice(rows: list[tuple[int, int, float]]) -> None:
    ref, src, score = (np.array([row[i] for row in rows], np.float64) for i in range(3))
    keep = without_duplicates(np.stack([ref, ref], 1), np.stack([src, src], 1), score)
    assert len(set(ref[keep])) == len(set(src[keep])) == keep.sum()
    if rows:
        assert keep[np.argmax(score)]


@pytest.mark.parametrize(
    "make",
    [
        lambda n, _: (np.zeros((n, 2)), np.zeros((n, 2))),
        lambda n, _: (np.ones((n, 2)) * np.arange(n)[:, None], np.ones((n, 2)) * np.arange(n)[:, None] * 0.1),
        lambda n, rng: (rng.normal(size=(n, 2)),) * 2,
        lambda n, rng: (rng.normal(size=(n, 2)), rng.normal(size=(n, 2))),
    ],
    ids=["one point", "a line", "no motion", "noise"],
)
@pytest.mark.parametrize("n", [0, 4, 5, 6, 30])
def test_consensus_on_what_has_none(n: int, make: Callable[[int, np.random.Generator], tuple[Floats, Floats]]) -> None:
    ref, src = make(n, np.random.default_rng(10))
    assert consensus(ref, src, 1e-3).shape == (n,)


def test_consensus_is_the_same_every_time_and_tells_outliers() -> None:
    rng = np.random.default_rng(11)
    of = scene(rng, "sideways")
    ref, src = (PLAIN.rays(pixels)[:, :2] for pixels in of.true_px)
    src[:100] += rng.normal(0.0, 0.05, (100, 2))
    masks = [consensus(ref, src, 1.5 / 2800) for _ in range(3)]
    assert (masks[0] == masks[1]).all()
    assert (masks[0] == masks[2]).all()
    assert masks[0][:100].mean() < 0.15
    assert masks[0][100:].mean() > 0.9


# --- RootSIFT ---


def test_root_sift_is_of_unit_length() -> None:
    rng = np.random.default_rng(13)
    descriptors = rng.integers(0, 256, (50, 128)).astype(np.uint8)
    descriptors[7] = 0
    rooted = root_sift(descriptors)
    length = np.linalg.norm(rooted, axis=1)
    np.testing.assert_allclose(np.delete(length, 7), 1.0, atol=1e-6)
    assert length[7] == 0.0
    assert rooted.dtype == np.float32
