"""The search where the pose allows a match: against brute force, and its band against redrawn poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from feature_scenes import BAND, PLAIN, STRONG, pose
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.poses import RelativePose, relative_pose
from pipeline.matching.guided import match_guided
from pipeline.matching.reach import Band, EpipolarAngles, Reach, epipolar_angles, rays_in_ref


def brute_angles(rays: Floats, centre: Floats) -> tuple[Floats, Floats]:
    """About and along by elementary geometry: a frame with its third axis on the baseline, found by QR."""
    axis = centre / np.linalg.norm(centre)
    q = np.linalg.qr(np.column_stack([axis, *np.eye(3)]))[0]
    frame = np.column_stack([q[:, 1], np.cross(axis, q[:, 1])])
    across = rays @ frame
    return np.arctan2(across[:, 1], across[:, 0]), np.arccos(np.clip(rays @ axis, -1.0, 1.0))


def brute_band(reach: Reach, rays: tuple[Floats, Floats], centre: Floats) -> Bools:
    """(n, m) which rays may match, every one with every other."""
    ref, src = reach.ref, reach.src
    (ref_about, ref_along), (src_about, src_along) = (brute_angles(r, centre) for r in rays)
    turn = np.abs(np.angle(np.exp(1j * (ref_about[:, None] - src_about[None]))))
    rise = src_along[None] - ref_along[:, None]
    slack = np.maximum(ref.slack[:, None], src.slack[None])
    band: Bools = (
        (turn <= np.maximum(ref.tolerance[:, None], src.tolerance[None]))
        & (rise >= -slack)
        & (rise <= reach.max_parallax_rad + slack)
    )
    return band & np.isfinite(ref.about)[:, None] & np.isfinite(src.about)[None]


def brute_matches(similarity: Floats, band: Bools, ratio: float) -> list[tuple[int, int]]:
    """Mutual nearest neighbours in the band that pass the ratio test there."""
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


def random_reach(
    rng: np.random.Generator, n: int, m: int, sigmas: float, parallax: float
) -> tuple[Reach, tuple[Floats, Floats], Floats]:
    """Rays all around, on both sides of the baseline and across the seam of the angle; and that baseline."""
    centre = random_rays(rng, 1)[0] * rng.uniform(1.0, 20.0)
    given_pose = RelativePose(np.eye(3), -centre, np.diag([2e-5, 1e-5, 3e-5, 0.01, 0.02, 0.01]))
    rays = random_rays(rng, n), random_rays(rng, m)
    ref, src = (epipolar_angles(r, given_pose, Band(sigmas, 0.5, 5.0), 1 / 2800) for r in rays)
    return Reach(ref, src, parallax), rays, given_pose.centre


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10**6), n=st.integers(0, 300), m=st.integers(0, 300), sigmas=st.floats(1.0, 60.0),
    parallax=st.floats(0.01, 3.0), ratio=st.floats(0.5, 1.0),
)  # fmt: skip
def test_the_search_gives_what_brute_force_gives(
    seed: int, n: int, m: int, sigmas: float, parallax: float, ratio: float
) -> None:
    rng = np.random.default_rng(seed)
    reach, rays, centre = random_reach(rng, n, m, sigmas, parallax)
    descriptors = [np.abs(rng.normal(size=(k, 16))) for k in (n, m)]
    ref_d, src_d = ((d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32) for d in descriptors)
    found = match_guided(ref_d, src_d, reach, ratio=ratio)
    similarity = ref_d.astype(np.float64) @ src_d.astype(np.float64).T
    expected = brute_matches(similarity, brute_band(reach, rays, centre), ratio)
    got = list(zip(found.ref.tolist(), found.src.tolist(), strict=True))
    assert found.ref.tolist() == sorted(found.ref.tolist())
    # Single precision may turn a ratio that is met to the last digit.
    assert len(set(got) ^ set(expected)) <= 1 + len(expected) // 200


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10**6), n=st.integers(1, 60), m=st.integers(1, 60), sigmas=st.floats(1.0, 90.0),
    parallax=st.floats(0.01, 3.0),
)  # fmt: skip
def test_what_is_in_reach_whichever_way_the_indices_are_given(
    seed: int, n: int, m: int, sigmas: float, parallax: float
) -> None:
    rng = np.random.default_rng(seed)
    reach, rays, centre = random_reach(rng, n, m, sigmas, parallax)
    expected = brute_band(reach, rays, centre)
    np.testing.assert_array_equal(reach.allows(np.arange(n)[:, None], np.arange(m)[None]), expected)
    rows, columns = rng.integers(0, n, 40), rng.integers(0, m, 40)
    np.testing.assert_array_equal(reach.allows(rows, columns), expected[rows, columns])
    np.testing.assert_array_equal(reach.allows(rows[:1], columns), expected[rows[0], columns])
    grid = columns[:36].reshape(6, 6)
    np.testing.assert_array_equal(reach.allows(rows[:6, None], grid), expected[rows[:6, None], grid])
    assert reach.allows(rows[:0], columns[:0]).shape == (0,)
    # A block of neighbours about the baseline sees all of its own.
    usable = np.flatnonzero(np.isfinite(reach.ref.about))
    block = usable[np.argsort(reach.ref.about[usable])][:20]
    if block.size:
        assert set(np.flatnonzero(expected[block].any(axis=0))) <= set(reach.near(block))


def test_few_of_many_rays_are_in_reach() -> None:
    """The test above would pass where everything is allowed, or nothing."""
    reach, _, _ = random_reach(np.random.default_rng(5), 500, 500, 4.0, 0.3)
    allowed = reach.allows(np.arange(500)[:, None], np.arange(500)[None])
    assert 0.001 < allowed.mean() < 0.05
    block = np.argsort(reach.ref.about)[200:220]
    assert len(reach.near(block)) < 250


def test_the_band_goes_across_the_seam_of_the_angle() -> None:
    flat = np.full(2, 1.5)
    about = np.array([np.pi - 1e-4, -1.0])
    ref = EpipolarAngles(about, flat, np.full(2, 1e-3), np.full(2, 1e-3))
    src = EpipolarAngles(np.array([-np.pi + 1e-4, -1.0]), flat + 0.1, np.full(2, 1e-3), np.full(2, 1e-3))
    one = np.eye(2, dtype=np.float32)
    for a, b in ((ref, src), (replace(ref, about=-about), replace(src, about=-src.about))):
        found = match_guided(one, one, Reach(a, b, 0.2), ratio=0.9)
        assert found.ref.tolist() == [0, 1]
        assert found.src.tolist() == [0, 1]
    assert match_guided(one, one, Reach(ref, src, 0.05), ratio=0.9).ref.tolist() == [], "nearer than nearest_m"
    behind = replace(src, along=flat - 0.1)
    assert match_guided(one, one, Reach(ref, behind, 0.2), ratio=0.9).ref.tolist() == [], "behind the cameras"


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
