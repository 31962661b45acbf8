"""Epipolar transfer against the textbook construction, the best plane against its definition, DLT against OpenCV."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from oracles import (
    LATERAL,
    VERTICAL,
    best_plane,
    displacement_covariance,
    midpoint_depth,
    plane_ray_depth,
    rays_in_ref,
    transferred_depth,
)

from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.poses import Pose, PoseSigmas, RelativePose, relative_pose
from pipeline.geometry.rotations import enu_from_cam, rotation_from_vector
from pipeline.geometry.transfer import (
    BLOCK,
    PixelNoise,
    VirtualView,
    parallax,
    transfer,
    transfer_angle,
    transfer_with_sigma,
    variance_at,
)
from pipeline.geometry.triangulation import dlt_depth

DEG = np.pi / 180.0
OWN = PoseSigmas(np.full(3, 0.053), np.array([0.25, 0.08, 0.08]) * DEG)
COMMON = PoseSigmas(np.zeros(3), np.array([0.25, 0.0, 0.0]) * DEG)
NOISE = PixelNoise.isotropic(0.5, 1120.0)
FIXED = [(VirtualView.LATERAL, LATERAL), (VirtualView.VERTICAL, VERTICAL)]
VIEWS = list(VirtualView)


@dataclass(frozen=True)
class Scene:
    pose: RelativePose
    ref: Floats
    src: Floats
    depth: Floats

    def only(self, rows: Bools) -> Scene:
        return Scene(self.pose, self.ref[:, rows], self.src[:, rows], self.depth[rows])


def seen(pose: RelativePose, n: int, seed: int, noise: float = 0.0) -> Scene:
    """Points 8 to 100 m away that both cameras of a pair see, with noise on the image plane."""
    rng = np.random.default_rng(seed)
    ref, depth = rng.uniform(-0.6, 0.6, (2, 4 * n)), rng.uniform(8.0, 100.0, 4 * n)
    points = pose.rotation @ (np.concatenate([ref, np.ones((1, 4 * n))]) * depth) + pose.translation[:, None]
    both = np.flatnonzero(points[2] > 1.0)[:n]
    src = points[:2, both] / points[2, both]
    return Scene(
        pose,
        ref[:, both] + noise * rng.normal(size=(2, len(both))),
        src + noise * rng.normal(size=src.shape),
        depth[both],
    )


def flown(heading_deg: float, turn_deg: float = 2.0, climb_m: float = 0.3) -> RelativePose:
    """Two frames 5 m apart in a direction against the heading; the camera looks 20 deg down."""
    angles, later = np.array([40.0, -20.0, 0.5]) * DEG, np.array([40.0 + turn_deg, -20.0 - turn_deg / 2, -0.5]) * DEG
    way = (40.0 + heading_deg) * DEG
    moved = np.array([5.0 * np.sin(way), 5.0 * np.cos(way), climb_m])
    return relative_pose(
        Pose(enu_from_cam(*angles), np.zeros(3), OWN, COMMON), Pose(enu_from_cam(*later), moved, OWN, COMMON)
    )


FORWARD, SIDEWAYS, DIAGONAL = flown(0.0), flown(90.0), flown(50.0)


@st.composite
def scenes(draw: st.DrawFn, noise: float = 3e-4) -> Scene:
    turn = np.array(draw(st.tuples(*[st.floats(-0.3, 0.3)] * 3)))
    direction = np.array(draw(st.tuples(*[st.floats(-1.0, 1.0)] * 3)))
    assume(np.linalg.norm(direction) > 0.1)
    centre = direction / np.linalg.norm(direction) * draw(st.floats(0.5, 8.0))
    rotation = rotation_from_vector(turn)
    half = (
        np.random.default_rng(draw(st.integers(0, 2**32 - 1))).normal(size=(6, 6))
        * np.repeat([0.004, 0.08], 3)[:, None]
    )
    scene = seen(RelativePose(rotation, -rotation @ centre, half @ half.T), 25, draw(st.integers(0, 999)), noise)
    scene = scene.only(parallax(scene.ref, scene.src, scene.pose) > 2e-3)
    assume(scene.depth.size > 0)
    return scene


def apart(scene: Scene, baseline_m: Floats) -> Bools:
    """Where the two epipolar lines in the virtual view are not nearly parallel, and neither lies at infinity."""
    if np.linalg.norm(baseline_m - scene.pose.centre) < 1e-3:
        return np.zeros(scene.depth.size, np.bool_)
    ref, src = rays_in_ref(scene.ref, scene.src, scene.pose)
    virtual, source = np.cross(baseline_m, ref), np.cross(baseline_m - scene.pose.centre, src)
    sine = np.linalg.norm(np.cross(virtual, source), axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        well = sine / np.linalg.norm(virtual, axis=1) / np.linalg.norm(source, axis=1) > 1e-2
        slope = np.abs(np.sum(source * ref, axis=1)) / np.linalg.norm(source, axis=1)
        cut = np.abs(source @ scene.pose.centre) / np.linalg.norm(source, axis=1)
        steep: Bools = well & (slope > 1e-3) & (cut > 1e-2)
    return steep


@pytest.mark.parametrize(("view", "direction"), FIXED)
@given(scene=scenes(), baseline=st.floats(0.1, 30.0))
def test_transfer_is_the_textbook_construction(
    view: VirtualView, direction: Floats, scene: Scene, baseline: float
) -> None:
    scene = scene.only(apart(scene, baseline * direction))
    found = transfer(scene.ref, scene.src, scene.pose, view, virtual_baseline_m=baseline)
    expected = transferred_depth(scene.ref, scene.src, scene.pose, baseline * direction)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    np.testing.assert_allclose(
        found, plane_ray_depth(scene.ref, scene.src, scene.pose, baseline * direction), rtol=1e-9
    )


@given(scene=scenes(), baseline=st.floats(0.1, 30.0), angle=st.floats(-np.pi, np.pi))
def test_the_plane_cut_is_the_textbook_construction_in_any_direction(
    scene: Scene, baseline: float, angle: float
) -> None:
    virtual = baseline * np.array([np.cos(angle), np.sin(angle), 0.0])
    scene = scene.only(apart(scene, virtual))
    np.testing.assert_allclose(
        plane_ray_depth(scene.ref, scene.src, scene.pose, virtual),
        transferred_depth(scene.ref, scene.src, scene.pose, virtual),
        rtol=1e-9,
    )


@given(scene=scenes())
def test_adaptive_without_covariance_is_the_midpoint_s_depth(scene: Scene) -> None:
    found = transfer(scene.ref, scene.src, scene.pose, VirtualView.ADAPTIVE)
    np.testing.assert_allclose(found, midpoint_depth(scene.ref, scene.src, scene.pose), rtol=1e-9)


@given(scene=scenes())
def test_adaptive_is_the_best_plane_of_the_full_covariance(scene: Scene) -> None:
    found = transfer_with_sigma(scene.ref, scene.src, scene.pose, VirtualView.ADAPTIVE, NOISE)
    length = float(np.linalg.norm(scene.pose.centre))
    start = midpoint_depth(scene.ref, scene.src, scene.pose)

    def held(depth: float) -> float:
        return min(max(depth, 0.5 * length), 1000.0 * length) if depth > 0.0 else 1000.0 * length

    for i in range(scene.depth.size):
        x_ref, x_src = scene.ref[:, i], scene.src[:, i]
        # The first covariance at the midpoint, the second where the first plane cuts the ray.
        covariance = displacement_covariance(x_ref, x_src, scene.pose, NOISE, held(start[i]))
        first = best_plane(x_ref, x_src, scene.pose, covariance)[0]
        covariance = displacement_covariance(x_ref, x_src, scene.pose, NOISE, held(first))
        depth, variance, normal = best_plane(x_ref, x_src, scene.pose, covariance)
        np.testing.assert_allclose(found.depth_m[i], depth, rtol=1e-7)
        np.testing.assert_allclose(found.variance_m2[i], variance, rtol=1e-7)
        np.testing.assert_allclose(found.normal[i], normal, rtol=1e-7, atol=1e-7 * float(np.linalg.norm(normal)))


@pytest.mark.parametrize(("view", "direction"), FIXED)
@given(scene=scenes(), baseline=st.floats(0.1, 30.0))
def test_a_fixed_view_s_variance_is_that_of_its_plane(
    view: VirtualView, direction: Floats, scene: Scene, baseline: float
) -> None:
    scene = scene.only(apart(scene, baseline * direction))
    found = transfer_with_sigma(scene.ref, scene.src, scene.pose, view, NOISE, virtual_baseline_m=baseline)
    ref, src = rays_in_ref(scene.ref, scene.src, scene.pose)
    length = float(np.linalg.norm(scene.pose.centre))
    for i in np.flatnonzero((found.depth_m > 0.5 * length) & (found.depth_m < 1000.0 * length)):
        normal = np.cross(baseline * direction - scene.pose.centre, src[i])
        normal /= normal @ ref[i]
        covariance = displacement_covariance(
            scene.ref[:, i], scene.src[:, i], scene.pose, NOISE, float(found.depth_m[i])
        )
        np.testing.assert_allclose(found.normal[i], normal, rtol=1e-7, atol=1e-7 * float(np.linalg.norm(normal)))
        np.testing.assert_allclose(found.variance_m2[i], normal @ covariance @ normal, rtol=1e-7)


@given(scene=scenes())
def test_no_view_has_less_variance_than_the_adaptive_one(scene: Scene) -> None:
    """At the same point: the variance of the equal-weight plane and of any other is not smaller."""
    best = transfer_with_sigma(scene.ref, scene.src, scene.pose, VirtualView.ADAPTIVE, NOISE)
    rng = np.random.default_rng(0)
    length = float(np.linalg.norm(scene.pose.centre))
    for i in np.flatnonzero((best.depth_m > 0.5 * length) & (best.depth_m < 1000.0 * length)):
        x_ref, x_src = scene.ref[:, i], scene.src[:, i]
        covariance = displacement_covariance(x_ref, x_src, scene.pose, NOISE, float(best.depth_m[i]))
        _, least, _ = best_plane(x_ref, x_src, scene.pose, covariance)
        ref, src = rays_in_ref(scene.ref[:, i : i + 1], scene.src[:, i : i + 1], scene.pose)
        for other in np.cross(rng.normal(size=(10, 3)), src[0]):
            n = other / (other @ ref[0])
            assert n @ covariance @ n >= least * (1.0 - 1e-7)


def test_lateral_and_vertical_are_measured_along_the_image_s_axes() -> None:
    """A view below ref on the flight line of a climb is useless, one to the right of it is not."""
    climb = RelativePose(np.eye(3), np.array([0.0, 5.0, 0.0]), FORWARD.covariance)
    scene = seen(climb, 200, 3, 2e-4)
    lateral = transfer_with_sigma(scene.ref, scene.src, climb, VirtualView.LATERAL, NOISE)
    vertical = transfer_with_sigma(scene.ref, scene.src, climb, VirtualView.VERTICAL, NOISE)
    assert np.median(np.abs(lateral.depth_m / scene.depth - 1.0)) < 0.05
    assert not np.any(np.sqrt(vertical.variance_m2) < vertical.depth_m)


@pytest.mark.parametrize("pose", [FORWARD, SIDEWAYS, DIAGONAL], ids=["forward", "sideways", "diagonal"])
@pytest.mark.parametrize("view", VIEWS)
def test_noise_free_matches_give_the_true_depth(pose: RelativePose, view: VirtualView) -> None:
    scene = seen(pose, 500, 1)
    found = transfer_with_sigma(scene.ref, scene.src, pose, view, NOISE)
    angle = transfer_angle(scene.src, pose, found.normal)
    good = (angle > 1e-4) & (parallax(scene.ref, scene.src, pose) > 1e-4)
    assert np.mean(good) > 0.95
    np.testing.assert_allclose(found.depth_m[good], scene.depth[good], rtol=1e-7)
    plain = transfer(scene.ref, scene.src, pose, view)
    np.testing.assert_allclose(plain[good], scene.depth[good], rtol=1e-7)


@pytest.mark.parametrize("pose", [FORWARD, SIDEWAYS, DIAGONAL], ids=["forward", "sideways", "diagonal"])
def test_dlt_and_adaptive_agree_without_noise(pose: RelativePose) -> None:
    scene = seen(pose, 300, 2)
    scene = scene.only(parallax(scene.ref, scene.src, pose) > 1e-3)
    dlt = dlt_depth(scene.ref, scene.src, pose)
    np.testing.assert_allclose(dlt, scene.depth, rtol=1e-9)
    np.testing.assert_allclose(transfer(scene.ref, scene.src, pose, VirtualView.ADAPTIVE), dlt, rtol=1e-9)


@given(scene=scenes(noise=1e-3))
def test_dlt_is_opencv_s(scene: Scene) -> None:
    src = np.concatenate([scene.pose.rotation, scene.pose.translation[:, None]], axis=1)
    points = cv2.triangulatePoints(np.eye(3, 4), src, scene.ref, scene.src)
    depth = points[2] / points[3]
    near = (depth > 0.0) & (depth < 1000.0)
    np.testing.assert_allclose(dlt_depth(scene.ref, scene.src, scene.pose)[near], depth[near], rtol=1e-8)


def test_a_lateral_view_says_that_it_fails_in_lateral_flight() -> None:
    exact = RelativePose(np.eye(3), np.array([-5.0, 0.0, 0.0]), SIDEWAYS.covariance)
    scene = seen(exact, 400, 4, 0.5 / 1120.0)
    lateral = transfer_with_sigma(scene.ref, scene.src, exact, VirtualView.LATERAL, NOISE)
    sigma = np.sqrt(lateral.variance_m2)
    assert not np.any(sigma <= 0.25 * lateral.depth_m)
    adaptive = transfer_with_sigma(scene.ref, scene.src, exact, VirtualView.ADAPTIVE, NOISE)
    assert np.all(np.sqrt(adaptive.variance_m2) <= 0.25 * adaptive.depth_m)


@pytest.mark.parametrize("baseline_m", [1.0, 10.0])
def test_a_lateral_view_publishes_next_to_nothing_in_nearly_lateral_flight(baseline_m: float) -> None:
    pose = flown(90.0, turn_deg=0.3, climb_m=0.02)
    scene = seen(pose, 2000, 5, 0.5 / 1120.0)
    found = transfer_with_sigma(scene.ref, scene.src, pose, VirtualView.LATERAL, NOISE, virtual_baseline_m=baseline_m)
    assert np.mean(np.sqrt(found.variance_m2) <= 0.25 * found.depth_m) < 0.02


@pytest.mark.parametrize("view", [VirtualView.LATERAL, VirtualView.VERTICAL])
@pytest.mark.parametrize("pose", [FORWARD, DIAGONAL], ids=["forward", "diagonal"])
def test_noise_is_inflated_by_the_inverse_sine_of_the_transfer_angle(pose: RelativePose, view: VirtualView) -> None:
    """Noise equal in all directions across the src ray: a shift of the src camera, the same along all axes."""
    shift = RelativePose(pose.rotation, pose.translation, np.diag([0.0, 0.0, 0.0, 1e-4, 1e-4, 1e-4]))
    none = PixelNoise(np.zeros(3), np.zeros(3))
    scene = seen(pose, 300, 6)
    scene = scene.only(parallax(scene.ref, scene.src, pose) > 1e-3)
    fixed = transfer_with_sigma(scene.ref, scene.src, shift, view, none)
    best = transfer_with_sigma(scene.ref, scene.src, shift, VirtualView.ADAPTIVE, none)
    np.testing.assert_allclose(transfer_angle(scene.src, shift, best.normal), np.pi / 2.0, atol=1e-6)
    inflation = np.sqrt(fixed.variance_m2 / best.variance_m2)
    np.testing.assert_allclose(inflation, 1.0 / np.sin(transfer_angle(scene.src, shift, fixed.normal)), rtol=1e-7)


def test_the_transfer_angle_in_the_epipolar_plane_is_zero() -> None:
    scene = seen(FORWARD, 50, 7)
    ref, src = rays_in_ref(scene.ref, scene.src, FORWARD)
    assert np.all(transfer_angle(scene.src, FORWARD, np.cross(FORWARD.centre, src)) < 1e-12)
    assert np.all(transfer_angle(scene.src, FORWARD, -3.0 * np.cross(FORWARD.centre, src)) < 1e-12)
    angle = np.arccos(np.sum(ref * src, axis=1) / np.linalg.norm(ref, axis=1))
    np.testing.assert_allclose(parallax(scene.ref, scene.src, FORWARD), angle, atol=1e-7)


@pytest.mark.parametrize("view", VIEWS)
def test_redraws_of_small_noise_spread_as_the_variance_says(view: VirtualView) -> None:
    """Pixels and the relative pose are redrawn from their covariance, small enough to be linear."""
    rng, n, small = np.random.default_rng(8), 1500, 0.02
    scene = seen(DIAGONAL, 40, 9)
    covariance = small**2 * DIAGONAL.covariance
    noise = PixelNoise.isotropic(small * 0.5, 1120.0)
    errors = rng.multivariate_normal(np.zeros(6), covariance, size=n)
    depths = []
    for error in errors:
        # The logged pose is off; the matches come from the true one.
        rotation = DIAGONAL.rotation @ rotation_from_vector(-error[:3])
        centre = DIAGONAL.centre + error[3:]
        logged = RelativePose(rotation, -rotation @ centre, covariance)
        jitter = rng.normal(size=(2, *scene.ref.shape)) * small * 0.5 / 1120.0
        depths.append(transfer(scene.ref + jitter[0], scene.src + jitter[1], logged, view))
    said = transfer_with_sigma(
        scene.ref, scene.src, RelativePose(DIAGONAL.rotation, DIAGONAL.translation, covariance), view, noise
    )
    if view is VirtualView.ADAPTIVE:
        # `transfer` weights all directions equally.
        variance = variance_at(
            scene.ref, scene.src, RelativePose(DIAGONAL.rotation, DIAGONAL.translation, covariance), scene.depth, noise
        )[0]
        assert np.all(said.variance_m2 <= variance * (1.0 + 1e-9))
    else:
        variance = said.variance_m2
    ratio = np.std(depths, axis=0) / np.sqrt(variance)
    linear = np.sqrt(variance) < 0.05 * scene.depth
    assert np.mean(linear) > 0.7
    # 1500 draws give a standard deviation to 1.8 %; points share the pose's draws.
    assert np.all((ratio[linear] > 0.92) & (ratio[linear] < 1.08))


@pytest.mark.parametrize("n", [0, 1, BLOCK - 1, BLOCK, BLOCK + 1])
def test_blocks_do_not_matter(n: int) -> None:
    scene = seen(DIAGONAL, BLOCK + 1, 10, 2e-4).only(np.arange(BLOCK + 1) < n)
    assert scene.depth.size == n
    some = np.unique(np.clip([0, 1, n // 2, BLOCK - 1, BLOCK, n - 1], 0, max(n - 1, 0)))[:n]
    picked = scene.only(np.isin(np.arange(n), some))
    for view in VIEWS:
        np.testing.assert_array_equal(
            transfer(scene.ref, scene.src, DIAGONAL, view)[some], transfer(picked.ref, picked.src, DIAGONAL, view)
        )
        whole = transfer_with_sigma(scene.ref, scene.src, DIAGONAL, view, NOISE)
        part = transfer_with_sigma(picked.ref, picked.src, DIAGONAL, view, NOISE)
        assert (whole.depth_m.shape, whole.variance_m2.shape, whole.normal.shape) == ((n,), (n,), (n, 3))
        np.testing.assert_allclose(whole.depth_m[some], part.depth_m, rtol=1e-12)
        np.testing.assert_allclose(whole.variance_m2[some], part.variance_m2, rtol=1e-10)
        np.testing.assert_allclose(whole.normal[some], part.normal, rtol=1e-10, atol=1e-12)
    variance, normal = variance_at(scene.ref, scene.src, DIAGONAL, scene.depth, NOISE)
    variance_of_part = variance_at(picked.ref, picked.src, DIAGONAL, picked.depth, NOISE)[0]
    assert (variance.shape, normal.shape) == ((n,), (n, 3))
    np.testing.assert_allclose(variance[some], variance_of_part, rtol=1e-10)
    assert dlt_depth(picked.ref, picked.src, DIAGONAL).shape == (len(some),)


@pytest.mark.parametrize("view", VIEWS)
def test_a_row_without_numbers_stays_alone_and_silent(view: VirtualView) -> None:
    scene = seen(FORWARD, 6, 12, 2e-4)
    ref, src = scene.ref.copy(), scene.src.copy()
    ref[0, 1], src[1, 3], ref[:, 4] = np.nan, np.nan, np.nan
    bad = np.array([False, True, False, True, True, False])
    clean = transfer_with_sigma(scene.ref, scene.src, FORWARD, view, NOISE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = transfer_with_sigma(ref, src, FORWARD, view, NOISE)
        plain = transfer(ref, src, FORWARD, view)
        dlt = dlt_depth(ref, src, FORWARD)
        variance, _ = variance_at(ref, src, FORWARD, dlt, NOISE)
    for values in (plain, dlt, variance, found.variance_m2):
        assert not np.any(np.isfinite(values[bad]))
        assert np.all(np.isfinite(values[~bad]))
    assert not np.any(np.isfinite(found.depth_m[bad]))
    np.testing.assert_allclose(found.depth_m[~bad], clean.depth_m[~bad], rtol=1e-12)
    np.testing.assert_allclose(found.variance_m2[~bad], clean.variance_m2[~bad], rtol=1e-12)


@pytest.mark.parametrize("view", VIEWS)
def test_a_pixel_at_infinity_has_no_depth(view: VirtualView) -> None:
    scene = seen(FORWARD, 6, 12, 2e-4)
    ref, src = scene.ref.copy(), scene.src.copy()
    ref[:, 1], src[:, 3] = np.inf, np.inf
    found = transfer_with_sigma(ref, src, FORWARD, view, NOISE)
    dlt = dlt_depth(ref, src, FORWARD)
    for depth in (found.depth_m, dlt):
        np.testing.assert_array_equal(np.isfinite(depth) & (depth > 0.0), [True, False, True, False, True, True])


@pytest.mark.parametrize("view", VIEWS)
def test_equal_noise_per_point_is_the_same_as_one_noise(view: VirtualView) -> None:
    scene = seen(DIAGONAL, BLOCK + 7, 13, 2e-4)
    n = scene.depth.size
    per_point = PixelNoise(np.tile(NOISE.ref[:, None], n), np.tile(NOISE.src[:, None], n))
    one = transfer_with_sigma(scene.ref, scene.src, DIAGONAL, view, NOISE)
    many = transfer_with_sigma(scene.ref, scene.src, DIAGONAL, view, per_point)
    np.testing.assert_allclose(many.depth_m, one.depth_m, rtol=1e-12)
    np.testing.assert_allclose(many.variance_m2, one.variance_m2, rtol=1e-12)


def test_noise_along_the_epipolar_line_counts_and_across_it_hardly() -> None:
    exact = RelativePose(np.eye(3), np.array([-5.0, 0.0, 0.0]), np.zeros((6, 6)))
    scene = seen(exact, 100, 14)
    flat, none = np.array([1e-6, 0.0, 1e-14]), np.array([1e-14, 0.0, 1e-14])
    along = transfer_with_sigma(scene.ref, scene.src, exact, VirtualView.ADAPTIVE, PixelNoise(none, flat))
    across = transfer_with_sigma(scene.ref, scene.src, exact, VirtualView.ADAPTIVE, PixelNoise(none, flat[::-1].copy()))
    # depth = 5 / disparity: a disparity off by 1e-3 moves the depth by 1e-3 depth^2 / 5.
    np.testing.assert_allclose(np.sqrt(along.variance_m2), 1e-3 * scene.depth**2 / 5.0, rtol=1e-4)
    assert np.all(across.variance_m2 < 1e-4 * along.variance_m2)


def test_noise_of_both_images_adds_up() -> None:
    exact = RelativePose(np.eye(3), np.array([-5.0, 0.0, 0.0]), np.zeros((6, 6)))
    scene = seen(exact, 100, 15)
    found = transfer_with_sigma(scene.ref, scene.src, exact, VirtualView.ADAPTIVE, NOISE)
    expected = np.sqrt(2.0) * 0.5 / 1120.0 * scene.depth**2 / 5.0
    np.testing.assert_allclose(np.sqrt(found.variance_m2), expected, rtol=1e-6)


def test_two_frames_from_one_spot_give_no_depth_and_no_error() -> None:
    still = RelativePose(np.eye(3), np.zeros(3), FORWARD.covariance)
    xy = np.random.default_rng(1).uniform(-0.5, 0.5, (2, 20))
    for view in VIEWS:
        found = transfer_with_sigma(xy, xy, still, view, NOISE)
        assert not np.any((found.depth_m > 0.0) & (np.sqrt(found.variance_m2) <= 0.25 * found.depth_m))
