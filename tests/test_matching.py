"""Guided matching on features whose correspondences are known, against brute force, and the features themselves."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Bytes, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Pose, PoseSigmas, RelativePose, relative_pose
from pipeline.geometry.rotations import enu_from_cam, rotation_from_vector
from pipeline.matching.features import Features, SiftExtractor, cached_features
from pipeline.matching.guided import Band, EpipolarAngles, epipolar_angles, match_guided, rays_in_ref
from pipeline.matching.images import read_colour, read_grey, shrunk_size, to_full_pixels
from pipeline.matching.pair import PairImage, PairMatches, SearchLimits, match_pair, root_sift
from pipeline.matching.verify import consensus, epipolar_residuals, without_duplicates

DEG = np.pi / 180.0
PLAIN = Camera("pinhole", 4000, 3000, 2800.0, 2810.0, 2010.0, 1490.0)
STRONG = Camera("brown", 4000, 3000, 3600.0, 3600.0, 1999.5, 1499.5, (-0.3, 0.0, 0.001, -0.0005, 0.0))
SMALL = Camera("fisheye", 1600, 1200, 900.0, 905.0, 802.0, 597.0, (0.02, -0.003, 0.0, 0.0))
OWN = PoseSigmas(np.array([0.05, 0.05, 0.08]), np.array([0.25, 0.08, 0.08]) * DEG)
NONE = PoseSigmas(np.zeros(3), np.zeros(3))
BAND = Band(4.0, 0.5, 5.0)
LIMITS = SearchLimits(BAND, 0.85, 1.5, 10**6)

# Name: (yaw, pitch, roll) and centre of ref and of src.
FLIGHTS = {
    "forward, 20 deg down, epipole in the image": ((0, -20, 0), (0, 5, 31), (1, -21, 0.5), (0, 0, 31)),
    "level forward, epipole in the middle": ((0, 0, 0), (0, 5, 31), (0, 0, 0), (0, 0, 31)),
    "backward": ((0, -20, 0), (0, 0, 31), (0, -20, 0), (0, 5, 31)),
    "sideways": ((0, -20, 0), (5, 0, 31), (2, -20, 0), (0, 0, 31)),
    "nadir, turned": ((40, -89, 0), (3, 4, 60), (43, -88, 0), (0, 0, 60)),
    "long forward": ((0, -20, 0), (0, 18, 31), (0, -20, 0), (0, 0, 31)),
}


def pose(angles_deg: object, centre: object) -> Pose:
    return Pose(
        enu_from_cam(*np.radians(np.asarray(angles_deg, np.float64))), np.asarray(centre, np.float64), OWN, NONE
    )


def disturbed(rng: np.random.Generator, angles_deg: object, centre: object) -> Pose:
    true = pose(angles_deg, centre)
    turn = rotation_from_vector(true.error_axes @ rng.normal(0.0, OWN.gimbal_rad))
    return replace(true, rotation=turn @ true.rotation, centre=true.centre + rng.normal(0.0, OWN.position_m))


@dataclass(frozen=True)
class Scene:
    """Features of two images; ref feature i is src feature partner[i], -1 for clutter."""

    ref: PairImage
    src: PairImage
    partner: Ints
    logged: RelativePose


def scene(
    rng: np.random.Generator, name: str, ref_camera: Camera = PLAIN, src_camera: Camera | None = None, *, n: int = 800
) -> Scene:
    """Points at 12..100 m, half a pixel of noise, as much clutter as points, and poses as a drone logs them."""
    src_camera = src_camera or ref_camera
    ref_angles, ref_centre, src_angles, src_centre = FLIGHTS[name]
    ref, src = pose(ref_angles, ref_centre), pose(src_angles, src_centre)
    pixels = rng.uniform(0.0, (ref_camera.width - 1, ref_camera.height - 1), (3 * n, 2))
    rays = ref_camera.rays(pixels)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points = rays * rng.uniform(12.0, 100.0, (len(rays), 1))
    src_pixels = src_camera.project((points @ ref.rotation.T + ref.centre - src.centre) @ src.rotation)
    seen = np.flatnonzero(src_camera.holds(src_pixels))[:n]
    k = len(seen)
    base = rng.integers(0, 120, (k, 128))
    ref_features, src_features = (
        Features(
            np.concatenate([px[seen] + rng.normal(0.0, 0.5, (k, 2)), rng.uniform(0.0, (c.width, c.height), (n, 2))]),
            np.concatenate(
                [np.clip(base + rng.normal(0, 8, base.shape), 0, 255), rng.integers(0, 120, (n, 128))]
            ).astype(np.uint8),
        )
        for px, c in ((pixels, ref_camera), (src_pixels, src_camera))
    )
    shuffled = rng.permutation(k + n)
    partner = np.full(k + n, -1)
    partner[:k] = np.argsort(shuffled)[:k]
    src_features = Features(src_features.pixels[shuffled], src_features.descriptors[shuffled])
    logged = relative_pose(disturbed(rng, ref_angles, ref_centre), disturbed(rng, src_angles, src_centre))
    return Scene(PairImage(ref_features, ref_camera), PairImage(src_features, src_camera), partner, logged)


def indices(features: Features, pixels: Floats) -> Ints:
    """Which feature each pixel belongs to."""
    known = {tuple(p): i for i, p in enumerate(features.pixels)}
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
    found = match_pair(of.ref, of.src, of.logged, LIMITS)
    recall, precision = judged(of, found)
    # Next to an epipole in the image there is no band, and no depth to be had.
    assert recall > (0.99 if name in {"sideways", "nadir, turned"} else 0.88)
    assert precision > 0.995
    assert found.inlier.mean() > 0.95


def test_a_camera_of_another_kind_and_size_in_src() -> None:
    for cameras in ((PLAIN, SMALL), (SMALL, STRONG)):
        of = scene(np.random.default_rng(2), "nadir, turned", *cameras)
        recall, precision = judged(of, match_pair(of.ref, of.src, of.logged, LIMITS))
        assert recall > 0.99
        assert precision > 0.99


def test_a_pose_that_is_wrong_beyond_its_sigma_finds_next_to_nothing() -> None:
    """The band is the pose's: without it, the test of recall above would show nothing."""
    of = scene(np.random.default_rng(3), "sideways")
    turned = enu_from_cam(0.0, 25.0 * DEG, 0.0).T @ enu_from_cam(0.0, 0.0, 0.0)
    wrong = replace(of.logged, rotation=turned @ of.logged.rotation)
    found = match_pair(of.ref, of.src, wrong, LIMITS)
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
    shifted = PairImage(Features(moved, of.src.features.descriptors), PLAIN)
    found = match_pair(of.ref, shifted, of.logged, LIMITS)
    src = indices(shifted.features, found.src_px)
    is_victim = np.isin(src, victims)
    assert is_victim.sum() > 0.5 * len(victims)
    assert found.inlier[is_victim].mean() < 0.1
    assert found.inlier[~is_victim].mean() > 0.95


@pytest.mark.parametrize("sizes", [(0, 0), (0, 50), (50, 0), (1, 1), (4, 4)])
def test_few_or_no_features(sizes: tuple[int, int]) -> None:
    of = scene(np.random.default_rng(5), "sideways")
    ref, src = (
        PairImage(Features(image.features.pixels[:n], image.features.descriptors[:n]), image.camera)
        for image, n in zip((of.ref, of.src), sizes, strict=True)
    )
    found = match_pair(ref, src, of.logged, LIMITS)
    assert not found.inlier.any()
    assert len(found.ref_px) == len(found.src_px) == len(found.score) == len(found.inlier)


def test_twice_the_same_and_whatever_the_order_of_the_features() -> None:
    rng = np.random.default_rng(6)
    of = scene(rng, "forward, 20 deg down, epipole in the image")
    first, again = (match_pair(of.ref, of.src, of.logged, LIMITS) for _ in range(2))
    for name in ("ref_px", "src_px", "score", "inlier"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    order = rng.permutation(len(of.partner))
    mixed = PairImage(Features(of.ref.features.pixels[order], of.ref.features.descriptors[order]), PLAIN)
    other = match_pair(mixed, of.src, of.logged, LIMITS)

    def rows(found: PairMatches) -> set[tuple[float, ...]]:
        return {tuple(row) for row in np.concatenate([found.ref_px, found.src_px], axis=1)}

    assert rows(other) == rows(first)


# --- the search itself ---


def brute_angles(rays: Floats, centre: Floats) -> tuple[Floats, Floats]:
    """About and along by elementary geometry: a frame with its third axis on the baseline, found by QR."""
    axis = centre / np.linalg.norm(centre)
    q = np.linalg.qr(np.column_stack([axis, *np.eye(3)]))[0]
    frame = np.column_stack([q[:, 1], np.cross(axis, q[:, 1])])
    across = rays @ frame
    return np.arctan2(across[:, 1], across[:, 0]), np.arccos(np.clip(rays @ axis, -1.0, 1.0))


def brute_matches(
    similarity: Floats,
    ref: EpipolarAngles,
    src: EpipolarAngles,
    rays: tuple[Floats, Floats],
    centre: Floats,
    *,
    parallax: float,
    ratio: float,
) -> list[tuple[int, int]]:
    """Every feature with every other: band, mutual nearest neighbours, ratio."""
    (ref_about, ref_along), (src_about, src_along) = (brute_angles(r, centre) for r in rays)
    turn = np.abs(np.angle(np.exp(1j * (ref_about[:, None] - src_about[None]))))
    rise = src_along[None] - ref_along[:, None]
    slack = np.maximum(ref.slack[:, None], src.slack[None])
    with np.errstate(invalid="ignore"):
        band = (
            (turn <= np.maximum(ref.tolerance[:, None], src.tolerance[None]))
            & (rise >= -slack)
            & (rise <= parallax + slack)
        )
    band &= np.isfinite(ref.about)[:, None] & np.isfinite(src.about)[None]
    masked = np.where(band, similarity, -np.inf)
    out = []
    for i in range(len(masked)):
        if not band[i].any():
            continue
        j = int(np.argmax(masked[i]))
        others = np.delete(masked[i], j)
        second = max(float(others.max(initial=-np.inf)), -1.0)
        distances = np.sqrt(2.0 - 2.0 * masked[i, j]), np.sqrt(2.0 - 2.0 * second)
        if int(np.argmax(masked[:, j])) == i and distances[0] <= ratio * distances[1]:
            out.append((i, j))
    return out


def random_rays(rng: np.random.Generator, n: int) -> Floats:
    rays = rng.normal(size=(n, 3))
    out: Floats = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return out


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6), n=st.integers(0, 300), m=st.integers(0, 300), sigmas=st.floats(1.0, 60.0),
    parallax=st.floats(0.01, 3.0), ratio=st.floats(0.5, 1.0),
)  # fmt: skip
def test_the_search_gives_what_brute_force_gives(
    seed: int, n: int, m: int, sigmas: float, parallax: float, ratio: float
) -> None:
    """Rays all around, on both sides of the baseline and across the seam of the angle."""
    rng = np.random.default_rng(seed)
    centre = random_rays(rng, 1)[0] * rng.uniform(1.0, 20.0)
    given_pose = RelativePose(np.eye(3), -centre, np.diag([2e-5, 1e-5, 3e-5, 0.01, 0.02, 0.01]))
    rays = random_rays(rng, n), random_rays(rng, m)
    descriptors = [np.abs(rng.normal(size=(k, 16))) for k in (n, m)]
    ref_d, src_d = ((d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32) for d in descriptors)
    ref, src = (epipolar_angles(r, given_pose, Band(sigmas, 0.5, 5.0), 1 / 2800) for r in rays)
    found = match_guided(ref_d, src_d, ref, src, max_parallax_rad=parallax, ratio=ratio)
    similarity = ref_d.astype(np.float64) @ src_d.astype(np.float64).T
    expected = brute_matches(similarity, ref, src, rays, given_pose.centre, parallax=parallax, ratio=ratio)
    got = list(zip(found.ref.tolist(), found.src.tolist(), strict=True))
    assert found.ref.tolist() == sorted(found.ref.tolist())
    # Single precision may turn a ratio or a band that is met to the last digit.
    assert len(set(got) ^ set(expected)) <= 1 + len(expected) // 200


def test_the_band_goes_across_the_seam_of_the_angle() -> None:
    flat = np.full(2, 1.5)
    about = np.array([np.pi - 1e-4, -1.0])
    ref = EpipolarAngles(about, flat, np.full(2, 1e-3), np.full(2, 1e-3))
    src = EpipolarAngles(np.array([-np.pi + 1e-4, -1.0]), flat + 0.1, np.full(2, 1e-3), np.full(2, 1e-3))
    one = np.eye(2, dtype=np.float32)
    for a, b in ((ref, src), (replace(ref, about=-about), replace(src, about=-src.about))):
        found = match_guided(one, one, a, b, max_parallax_rad=0.2, ratio=0.9)
        assert found.ref.tolist() == [0, 1]
        assert found.src.tolist() == [0, 1]
    assert match_guided(one, one, ref, src, max_parallax_rad=0.05, ratio=0.9).ref.tolist() == [], (
        "nearer than nearest_m"
    )
    behind = replace(src, along=flat - 0.1)
    assert match_guided(one, one, ref, behind, max_parallax_rad=0.2, ratio=0.9).ref.tolist() == [], "behind the cameras"


def test_angles_about_the_baseline_are_equal_for_both_views_of_a_point() -> None:
    rng = np.random.default_rng(7)
    of = relative_pose(pose((10, -30, 2), (3, 8, 30)), pose((14, -25, -3), (0, 0, 31)))
    points = PLAIN.rays(rng.uniform(0.0, (4000.0, 3000.0), (500, 2))) * rng.uniform(10.0, 100.0, (500, 1))
    ref_px = PLAIN.project(points)
    src_px = STRONG.project(points @ of.rotation.T + of.translation)
    known = STRONG.holds(src_px)
    ref = epipolar_angles(rays_in_ref(ref_px[known], PLAIN, np.eye(3)), of, BAND, 1 / 2800)
    src = epipolar_angles(rays_in_ref(src_px[known], STRONG, of.rotation.T), of, BAND, 1 / 3600)
    assert known.sum() > 200
    turn = np.angle(np.exp(1j * (ref.about - src.about)))
    assert np.isfinite(turn).mean() > 0.9, "only rays next to the baseline have no angle"
    np.testing.assert_allclose(turn[np.isfinite(turn)], 0.0, atol=1e-9)
    sine = np.sin(src.along - ref.along)
    back = np.linalg.norm(points[known] - of.centre, axis=1)
    np.testing.assert_allclose(sine, np.linalg.norm(of.centre) * np.sin(ref.along) / back, rtol=1e-9)
    assert (src.along > ref.along).all()


def test_the_width_of_the_band_is_that_of_redrawn_poses() -> None:
    """The turn of the epipolar plane at the nearest range, over 4000 redraws of pose and pixels, in sigmas."""
    rng = np.random.default_rng(8)
    angles = ((0.0, -20.0, 0.0), (5.0, 5.0, 31.0), (2.0, -21.0, 0.0), (0.0, 0.0, 31.0))
    given_pose = relative_pose(pose(*angles[:2]), pose(*angles[2:]))
    rays = PLAIN.rays(np.array([[300.0, 2800.0], [2000.0, 1500.0], [3900.0, 2000.0]]))
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    reach = BAND.nearest_for(given_pose)
    point = given_pose.centre + reach * unit
    band = epipolar_angles(unit, given_pose, BAND, 1 / 2800)
    about = []
    for _ in range(4000):
        error = rng.multivariate_normal(np.zeros(6), given_pose.covariance)
        centre = given_pose.centre + error[3:]
        seen = point - centre
        seen = seen / np.linalg.norm(seen, axis=1, keepdims=True)
        # The src camera is turned by the error: a ray that is logged in one direction came from another.
        seen = seen - np.cross(error[:3], seen) + rng.normal(0.0, 0.5 * np.sqrt(2.0) / 2800.0, (3, 3))
        about.append(epipolar_angles(seen, given_pose, BAND, 1 / 2800).about)
    spread = np.std(about, axis=0)
    np.testing.assert_allclose(band.tolerance / BAND.sigmas, spread, rtol=0.06)


@pytest.mark.parametrize("offset", [(-15.0, 0.0, 0.3), (15.0, 0.0, 0.3), (0.0, 15.0, 0.0), (-5.0, 0.0, 0.0)])
def test_the_band_is_wide_enough_whichever_way_and_however_far(offset: tuple[float, float, float]) -> None:
    """Forward, backward and sideways, over all ranges looked for: true matches stay inside the band."""
    rng = np.random.default_rng(11)
    ref = pose((90.0, -20.0, 0.0), (0.0, 0.0, 31.0))
    given_pose = relative_pose(ref, pose((91.0, -20.5, 0.0), (offset[0], offset[1], 31.0 + offset[2])))
    rays = PLAIN.rays(rng.uniform((100.0, 1200.0), (3900.0, 2900.0), (60, 2)))
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    nearest = BAND.nearest_for(given_pose)
    points = unit * (nearest / rng.uniform(0.05, 0.9, (60, 1)))
    of_ref = epipolar_angles(unit, given_pose, BAND, 1 / 2800)
    turns, widths = [], []
    for _ in range(1500):
        error = rng.multivariate_normal(np.zeros(6), given_pose.covariance)
        seen = points - (given_pose.centre + error[3:])
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        seen = seen - np.cross(error[:3], seen) + rng.normal(0.0, 0.5 * np.sqrt(2.0) / 2800.0, seen.shape)
        src = epipolar_angles(seen, given_pose, BAND, 1 / 2800)
        turns.append(np.angle(np.exp(1j * (src.about - of_ref.about))))
        widths.append(np.maximum(src.tolerance, of_ref.tolerance))
    share = np.mean(np.abs(turns) <= np.array(widths), axis=0)
    known = np.isfinite(of_ref.about) & np.isfinite(turns).all(axis=0)
    assert known.sum() >= 40
    assert share[known].min() > 0.995


# --- residuals, duplicates, consensus ---


def test_residuals_are_angles_off_the_epipolar_plane_and_their_sigma_holds() -> None:
    rng = np.random.default_rng(9)
    shares = []
    for _ in range(40):
        of = scene(rng, "forward, 20 deg down, epipole in the image", n=60)
        true = of.partner >= 0
        ref = rays_in_ref(of.ref.features.pixels[true], PLAIN, np.eye(3))
        src = rays_in_ref(of.src.features.pixels[of.partner[true]], PLAIN, of.logged.rotation.T)
        found = epipolar_residuals(ref, src, of.logged, 0.5 / 2800)
        normal = np.cross(of.logged.centre, ref)
        expected = 0.5 * np.pi - np.arccos(np.sum(normal * src, axis=1) / np.linalg.norm(normal, axis=1))
        np.testing.assert_allclose(found.angle_rad, expected, atol=1e-9)
        shares.append(np.abs(found.angle_rad) < found.sigma_rad)
    # The points of a pair share its pose error, so 40 redraws leave a few percent.
    assert 0.58 < np.mean(np.concatenate(shares)) < 0.78


def test_duplicates_leave_the_better_match() -> None:
    ref = np.array([[10.0, 10.0], [10.2, 9.9], [50.0, 50.0], [70.0, 70.0], [90.0, 90.0]])
    src = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0], [3.1, 2.9], [9.0, 9.0]])
    keep = without_duplicates(ref, src, np.array([0.2, 0.5, 0.3, 0.4, 0.1]))
    assert keep.tolist() == [False, True, False, True, True]
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
    true = of.partner >= 0
    ref = PLAIN.rays(of.ref.features.pixels[true])[:, :2]
    src = PLAIN.rays(of.src.features.pixels[of.partner[true]])[:, :2]
    src[:100] += rng.normal(0.0, 0.05, (100, 2))
    masks = [consensus(ref, src, 1.5 / 2800) for _ in range(3)]
    assert (masks[0] == masks[1]).all()
    assert (masks[0] == masks[2]).all()
    assert masks[0][:100].mean() < 0.15
    assert masks[0][100:].mean() > 0.9


# --- features ---


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


@pytest.mark.parametrize("shrink", [1.0, 2.0, 2.5])
def test_keypoints_lie_where_the_spots_are_at_any_size(shrink: float) -> None:
    """Half a pixel lost in resizing, or the detector's own quarter pixel, would show in the mean."""
    image, at = blobs(np.random.default_rng(12), 700, 500, 3.0 * shrink)
    found = SiftExtractor(round(700 / shrink)).extract(image).pixels
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


def test_root_sift_is_of_unit_length() -> None:
    rng = np.random.default_rng(13)
    descriptors = rng.integers(0, 256, (50, 128)).astype(np.uint8)
    descriptors[7] = 0
    rooted = root_sift(Features(np.zeros((50, 2)), descriptors))
    length = np.linalg.norm(rooted, axis=1)
    np.testing.assert_allclose(np.delete(length, 7), 1.0, atol=1e-6)
    assert length[7] == 0.0
    assert rooted.dtype == np.float32


def textured(path: Path, seed: int = 0) -> Path:
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(rng.integers(0, 256, (240, 320)).astype(np.float32), (0, 0), 2.0)
    image = cv2.normalize(image, np.empty_like(image), 0, 255, cv2.NORM_MINMAX)
    assert cv2.imwrite(str(path), image.astype(np.uint8))
    return path


def same(a: Features, b: Features) -> bool:
    return a.pixels.tobytes() == b.pixels.tobytes() and a.descriptors.tobytes() == b.descriptors.tobytes()


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
        assert found.descriptors.shape == (0, 128)


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
