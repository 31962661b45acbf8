"""Depths of a pair by every method: agreement on exact data, pixel noise through the lens, and what is masked why."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from pixel_noise import drawn, matrices, slanted

from pipeline.depthing import METHODS, NO_DEPTH, TOO_FAR, TOO_UNCERTAIN, Limits, MatchedRays, MethodDepths, depths_by
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Pose, PoseSigmas, RelativePose, relative_pose
from pipeline.geometry.rotations import enu_from_cam
from pipeline.geometry.transfer import VirtualView

DEG = np.pi / 180.0
PLAIN = Camera("pinhole", 4000, 3000, 2800.0, 2810.0, 2010.0, 1490.0)
LENS = Camera("brown", 4000, 3000, 2900.0, 2905.0, 2010.0, 1490.0, (-0.15, 0.03, 0.001, -0.0005, 0.0))
WIDE = Camera("fisheye", 1600, 1200, 700.0, 705.0, 802.0, 597.0, (0.02, -0.003, 0.0, 0.0))
OWN = PoseSigmas(np.array([0.05, 0.05, 0.08]), np.array([0.15, 0.08, 0.08]) * DEG)
NONE = PoseSigmas(np.zeros(3), np.zeros(3))
LIMITS = Limits(0.25, 100.0)


def pair(ref: tuple[object, object], src: tuple[object, object], own: PoseSigmas = OWN) -> RelativePose:
    poses = (
        Pose(enu_from_cam(*np.radians(np.asarray(a, np.float64))), np.asarray(c, np.float64), own, NONE)
        for a, c in (ref, src)
    )
    return relative_pose(*poses)


FORWARD = pair(((0, -20, 0), (0, 5, 31)), ((0.5, -20.5, 0.2), (0.1, 0, 31)))
SIDEWAYS = pair(((0, -20, 0), (5, 0, 31)), ((0, -20, 0), (0, 0, 31)))


def seen(
    pose: RelativePose, cameras: tuple[Camera, Camera], n: int = 400, seed: int = 0, far: float = 80.0
) -> tuple[Floats, Floats, Floats]:
    """Ref and src pixels of points in both images, and their depths."""
    rng = np.random.default_rng(seed)
    ref_px = rng.uniform((0.0, 0.45 * cameras[0].height), (cameras[0].width - 1, cameras[0].height - 1), (4 * n, 2))
    rays = cameras[0].rays(ref_px)
    depth = rng.uniform(12.0, far, len(rays)) / np.linalg.norm(rays, axis=1)
    src_px = cameras[1].project(depth[:, None] * rays @ pose.rotation.T + pose.translation)
    both = np.flatnonzero(cameras[1].holds(src_px))[:n]
    assert len(both) == n
    return ref_px[both], src_px[both], depth[both]


def rays_of(
    ref_px: Floats, src_px: Floats, cameras: tuple[Camera, Camera] = (PLAIN, PLAIN), scale: float = 1.0
) -> MatchedRays:
    return MatchedRays.of(ref_px, src_px, *cameras, slanted(len(ref_px), scale))


def found_by(
    method: str,
    pose: RelativePose,
    rays: MatchedRays,
    view: VirtualView = VirtualView.ADAPTIVE,
    limits: Limits = LIMITS,
) -> MethodDepths:
    return depths_by(method, view, 1.0, rays, pose, limits)


@pytest.mark.parametrize("cameras", [(PLAIN, PLAIN), (LENS, LENS), (LENS, WIDE), (WIDE, LENS)])
@pytest.mark.parametrize("method", METHODS)
def test_on_exact_data_every_method_gives_the_depth(method: str, cameras: tuple[Camera, Camera]) -> None:
    ref_px, src_px, depth = seen(FORWARD, cameras)
    found = found_by(method, FORWARD, rays_of(ref_px, src_px, cameras))
    # Next to a fixed view's trifocal plane even exact data lose their digits; there the sigma says so.
    sure = found.depths.variance_m2 < depth**2
    assert sure.mean() > (0.99 if method in {"epitransfer", "dlt"} else 0.5)
    np.testing.assert_allclose(found.depths.depth_m[sure], depth[sure], rtol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_kept_is_the_same_as_having_no_reason(method: str) -> None:
    ref_px, src_px, _ = seen(SIDEWAYS, (LENS, LENS), far=200.0)
    found = found_by(method, SIDEWAYS, rays_of(ref_px, src_px, (LENS, LENS)))
    assert (found.kept == (found.reason == "")).all()
    assert set(found.reason) <= {"", NO_DEPTH, TOO_UNCERTAIN, TOO_FAR}
    kept = found.depths
    assert np.isfinite(kept.depth_m[found.kept]).all()
    assert (np.sqrt(kept.variance_m2[found.kept]) <= 0.25 * kept.depth_m[found.kept]).all()
    assert np.isfinite(kept.normal[found.kept]).all()


def test_a_lateral_view_on_a_sideways_pair_masks_everything() -> None:
    """All three centres lie on one line: no view along it adds a plane."""
    rng = np.random.default_rng(1)
    ref_px, src_px, _ = seen(SIDEWAYS, (PLAIN, PLAIN))
    rays = rays_of(ref_px, src_px + drawn(rng, slanted(len(src_px))))
    for lateral in (
        found_by("epitransfer-lateral", SIDEWAYS, rays),
        found_by("epitransfer", SIDEWAYS, rays, VirtualView.LATERAL),
    ):
        assert not lateral.kept.any()
        assert set(lateral.reason) <= {NO_DEPTH, TOO_UNCERTAIN}
        assert np.degrees(lateral.transfer_angle_rad).max() < 1.0
    for method in ("epitransfer", "dlt", "epitransfer-vertical"):
        assert found_by(method, SIDEWAYS, rays).kept.mean() > 0.9
    assert np.degrees(found_by("dlt", SIDEWAYS, rays).transfer_angle_rad).min() > 89.0


def test_the_named_methods_do_not_follow_the_configured_view() -> None:
    ref_px, src_px, _ = seen(FORWARD, (PLAIN, PLAIN), n=50)
    rays = rays_of(ref_px, src_px + 0.7)
    for method in ("dlt", "epitransfer-lateral", "epitransfer-vertical"):
        depths = [found_by(method, FORWARD, rays, view).depths.depth_m for view in VirtualView]
        np.testing.assert_array_equal(depths[0], depths[1])
        np.testing.assert_array_equal(depths[0], depths[2])
    for view, name in ((VirtualView.LATERAL, "epitransfer-lateral"), (VirtualView.VERTICAL, "epitransfer-vertical")):
        np.testing.assert_array_equal(
            found_by("epitransfer", FORWARD, rays, view).depths.depth_m, found_by(name, FORWARD, rays).depths.depth_m
        )


@pytest.mark.parametrize("method", METHODS)
def test_rays_that_part_have_no_depth(method: str) -> None:
    """Parallax of the wrong sign: the rays meet behind the cameras."""
    ref_px, src_px, _ = seen(SIDEWAYS, (PLAIN, PLAIN), n=60)
    rays = rays_of(ref_px, 2.0 * ref_px - src_px)
    found = found_by(method, SIDEWAYS, rays)
    assert not found.kept.any()
    if method in {"dlt", "epitransfer"}:
        assert set(found.reason) == {NO_DEPTH}


def test_a_point_behind_src_has_no_depth() -> None:
    """Src stands ahead and looks on: a point between the two is in front of ref and behind src."""
    ahead = pair(((0, 0, 0), (0, 0, 31)), ((0, 0, 0), (0, 30, 31)))
    point = np.array([[3.0, 4.0, 20.0], [3.0, 4.0, 60.0]])
    in_src = point @ ahead.rotation.T + ahead.translation
    assert in_src[0, 2] < 0.0 < in_src[1, 2]
    # The image of a point behind is that of its ray continued through the centre.
    src_px = (in_src[:, :2] / in_src[:, 2:]) * (PLAIN.fx, PLAIN.fy) + (PLAIN.cx, PLAIN.cy)
    rays = rays_of(PLAIN.project(point), src_px)
    found = found_by("epitransfer", ahead, rays)
    assert found.depths.depth_m[0] == pytest.approx(20.0, rel=1e-6)
    assert found.reason.tolist() == [NO_DEPTH, ""]


def test_the_range_counts_from_the_camera_not_along_the_axis() -> None:
    ref_px, src_px, depth = seen(FORWARD, (PLAIN, PLAIN), n=300, far=130.0)
    sure = replace(FORWARD, covariance=np.zeros((6, 6)))
    found = found_by("epitransfer", sure, rays_of(ref_px, src_px, scale=2e-3))
    distance = depth * np.linalg.norm(PLAIN.rays(ref_px), axis=1)
    assert ((found.reason == TOO_FAR) == (distance > 100.0)).all()
    assert 0.1 < (found.reason == TOO_FAR).mean() < 0.5
    assert set(found.reason) == {"", TOO_FAR}


def test_a_larger_allowance_keeps_more_and_never_less() -> None:
    ref_px, src_px, _ = seen(FORWARD, (PLAIN, PLAIN), far=100.0)
    rays = rays_of(ref_px, src_px)
    kept = [found_by("epitransfer", FORWARD, rays, limits=Limits(s, 100.0)).kept for s in (0.02, 0.05, 0.25, 1.0)]
    assert [k.sum() for k in kept] == sorted(k.sum() for k in kept)
    assert kept[0].sum() < kept[-1].sum()
    for fewer, more in pairwise(kept):
        assert (fewer <= more).all()


def test_no_matches() -> None:
    none = np.empty((0, 2))
    for method in METHODS:
        found = found_by(method, FORWARD, rays_of(none, none, (LENS, LENS)))
        assert found.kept.shape == found.reason.shape == found.parallax_rad.shape == found.pixel_sigma_m.shape == (0,)


@pytest.mark.parametrize("camera", [PLAIN, LENS, WIDE], ids=["pinhole", "brown", "fisheye"])
def test_pixel_noise_goes_through_the_lens_of_src_alone(camera: Camera) -> None:
    """The covariance on the image plane against finite differences of the undistortion."""
    rng = np.random.default_rng(2)
    pixels = rng.uniform((0.0, 0.0), (camera.width - 1, camera.height - 1), (200, 2))
    given = slanted(len(pixels))
    noise = MatchedRays.of(pixels[::-1] / 3.0, pixels, replace(LENS, fx=1900.0), camera, given).noise
    step = 1e-3
    slope = np.stack(
        [
            (camera.rays(pixels + step * e)[:, :2] - camera.rays(pixels - step * e)[:, :2]) / (2.0 * step)
            for e in np.eye(2)
        ],
        axis=2,
    )
    expected = slope @ matrices(given) @ slope.transpose(0, 2, 1)
    np.testing.assert_allclose(matrices(noise.src.T), expected, rtol=1e-5, atol=1e-13)
    assert not np.any(noise.ref), "the depth is that of the ref pixel as given"
    if camera is not PLAIN:
        assert np.ptp(slope[:, 0, 0]) > 0.1 * slope[:, 0, 0].min(), "the lens matters here"


@pytest.mark.parametrize("cameras", [(PLAIN, PLAIN), (LENS, WIDE), (WIDE, LENS)])
@pytest.mark.parametrize("method", METHODS)
def test_the_sigma_of_the_pixels_is_that_of_redrawn_src_pixels(method: str, cameras: tuple[Camera, Camera]) -> None:
    """Both with the pose's covariance, which the adaptive plane follows, and without, where there is no other error."""
    rng, draws = np.random.default_rng(3), 1500
    ref_px, src_px, depth = seen(FORWARD, cameras, n=60, far=50.0)
    given = slanted(len(depth), 0.4)
    if method == "dlt":
        # Its own plane is that of equal weights only to a few percent, of which equal noise in all directions is blind.
        given = given[:, :1] * [1.0, 0.0, 1.0]
    several = [np.tile(values, (draws, 1)) for values in (ref_px, src_px, given)]
    several[1] += drawn(rng, several[2])
    for pose in (FORWARD, replace(FORWARD, covariance=np.zeros((6, 6)))):
        predicted = found_by(method, pose, MatchedRays.of(ref_px, src_px, *cameras, given))
        redrawn = found_by(method, pose, MatchedRays.of(several[0], several[1], *cameras, several[2]))
        spread = np.std(redrawn.depths.depth_m.reshape(draws, -1), axis=0)
        linear = predicted.pixel_sigma_m < 0.03 * depth
        assert linear.sum() > (12 if "-" in method else 40)
        np.testing.assert_allclose(spread[linear] / predicted.pixel_sigma_m[linear], 1.0, atol=0.08)


@pytest.mark.parametrize("cameras", [(PLAIN, PLAIN), (LENS, WIDE), (WIDE, LENS)])
@pytest.mark.parametrize("method", METHODS)
def test_the_sigma_of_the_pixels_is_a_part_of_the_whole(method: str, cameras: tuple[Camera, Camera]) -> None:
    ref_px, src_px, _ = seen(FORWARD, cameras)
    rays = rays_of(ref_px, src_px, cameras)
    whole = found_by(method, FORWARD, rays)
    part, sigma = whole.pixel_sigma_m[whole.kept], np.sqrt(whole.depths.variance_m2[whole.kept])
    assert whole.kept.sum() > 100
    assert (part > 0.0).all()
    assert (part < sigma).all()
    sure = found_by(method, replace(FORWARD, covariance=np.zeros((6, 6))), rays)
    alone = np.sqrt(sure.depths.variance_m2[sure.kept])
    np.testing.assert_allclose(sure.pixel_sigma_m[sure.kept], alone, rtol=1e-6)
    # Errors of pose and of pixels have nothing in common, so that their squares add up, whatever the plane.
    if method != "epitransfer":
        both = whole.kept & sure.kept
        np.testing.assert_allclose(whole.pixel_sigma_m[both], sure.pixel_sigma_m[both], rtol=1e-6)
