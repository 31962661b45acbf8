"""Predicted warps of patches against planes: OpenCV's homographies, and numerical derivatives through both lenses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import RelativePose
from pipeline.geometry.rotations import rotation_from_vector
from pipeline.matching.patches.warps import inverse_2x2, plane_affines, predicted_affines

PLAIN = Camera("pinhole", 1600, 1200, 1120.0, 1118.0, 803.0, 595.0)
BROWN = Camera("brown", 1600, 1200, 1121.0, 1119.0, 803.0, 595.0, (-0.12, 0.03, 0.001, -0.0008, 0.0))
FISHEYE = Camera("fisheye", 1280, 960, 620.0, 622.0, 641.0, 478.0, (0.02, -0.003, 0.0, 0.0))
LENSES = {"plain": (PLAIN, PLAIN), "brown": (BROWN, BROWN), "brown to fisheye": (BROWN, FISHEYE)}
# 20 deg down: up on the camera's axes.
UP = np.array([0.0, -np.cos(np.radians(20.0)), -np.sin(np.radians(20.0))])
HEIGHT_M = 30.0


def pose(
    turn_deg: tuple[float, ...] = (2.0, -3.0, 10.0), centre_m: tuple[float, ...] = (3.0, 0.5, 4.0)
) -> RelativePose:
    rotation = rotation_from_vector(np.radians(turn_deg))
    return RelativePose(rotation, -rotation @ np.array(centre_m), np.zeros((6, 6)))


def pixels(camera: Camera, n: int = 200, seed: int = 0, top: float = 0.45) -> Floats:
    """Pixels that look well below the horizon."""
    low, high = (0.1 * camera.width, top * camera.height), (0.9 * camera.width, 0.95 * camera.height)
    return np.random.default_rng(seed).uniform(low, high, (n, 2))


def through_plane(px: Floats, normal: Floats, offset: Floats, ref: Camera, src: Camera, pose: RelativePose) -> Floats:
    """Src pixels of where ref rays meet the planes normal . x = offset."""
    rays = ref.rays(px)
    points = rays * (offset / np.sum(rays * normal, axis=1))[:, None]
    return src.project(points @ pose.rotation.T + pose.translation)


def numerical(px: Floats, normal: Floats, offset: Floats, ref: Camera, src: Camera, pose: RelativePose) -> Floats:
    step = 1e-3
    columns = [
        (
            through_plane(px + step * axis, normal, offset, ref, src, pose)
            - through_plane(px - step * axis, normal, offset, ref, src, pose)
        )
        / (2.0 * step)
        for axis in np.eye(2)
    ]
    return np.stack(columns, axis=2)


def turned(px: Floats, ref: Camera, src: Camera, pose: RelativePose) -> Floats:
    """Numerical derivative by the turn of the camera alone."""
    step = 1e-3
    ends = [
        [src.project(ref.rays(px + sign * step * axis) @ pose.rotation.T) for sign in (1, -1)] for axis in np.eye(2)
    ]
    return np.stack([(plus - minus) / (2.0 * step) for plus, minus in ends], axis=2)


def test_plane_warps_are_those_of_opencvs_homography() -> None:
    move = pose()
    normal, offset = np.array([0.2, -0.8, -0.5]), -24.0
    px = pixels(PLAIN)
    corners = np.array([[100.0, 700.0], [1500.0, 700.0], [1500.0, 1150.0], [100.0, 1150.0]])
    seen = through_plane(corners, normal, np.full(4, offset), PLAIN, PLAIN, move)
    homography = cv2.getPerspectiveTransform(corners.astype(np.float32), seen.astype(np.float32))

    def mapped(at: Floats) -> Floats:
        return cv2.perspectiveTransform(at[:, None], homography)[:, 0]

    expected = np.stack([(mapped(px + 0.5 * axis) - mapped(px - 0.5 * axis)) for axis in np.eye(2)], axis=2)
    rays = PLAIN.rays(px)
    found = plane_affines(rays, np.broadcast_to(normal, rays.shape), offset / (rays @ normal), PLAIN, PLAIN, move)
    np.testing.assert_allclose(found, expected, atol=2e-4)
    assert np.abs(found - np.eye(2)).max() > 0.1


@pytest.mark.parametrize("lens", LENSES)
def test_level_ground_and_facing_surfaces_are_the_numerical_derivatives(lens: str) -> None:
    ref, src = LENSES[lens]
    move = pose()
    px = pixels(ref)
    offset = np.full(len(px), -HEIGHT_M)
    seen = through_plane(px, UP, offset, ref, src, move)
    facing, level = predicted_affines(px, seen, ref, src, move, up_in_ref=5.0 * UP)
    np.testing.assert_allclose(level, numerical(px, UP, offset, ref, src, move), rtol=1e-5, atol=1e-6)
    rays = ref.rays(px)
    points = rays * (offset / (rays @ UP))[:, None]
    to_src = move.centre - points
    normal = to_src / np.linalg.norm(to_src, axis=1, keepdims=True)
    normal -= points / np.linalg.norm(points, axis=1, keepdims=True)
    expected = numerical(px, normal, np.sum(normal * points, axis=1), ref, src, move)
    np.testing.assert_allclose(facing, expected, rtol=1e-5, atol=1e-6)
    assert np.abs(facing - level).max() > 0.02
    (alone,) = predicted_affines(px, seen, ref, src, move)
    np.testing.assert_array_equal(alone, facing)


@given(
    turn=st.tuples(*[st.floats(-15.0, 15.0)] * 3),
    centre=st.tuples(*[st.floats(-4.0, 4.0)] * 3).filter(lambda c: np.linalg.norm(c) > 0.5),
)
def test_warps_hold_for_any_pose(turn: tuple[float, ...], centre: tuple[float, ...]) -> None:
    move = pose(turn, centre)
    px = pixels(BROWN, 30, top=0.6)
    offset = np.full(len(px), -HEIGHT_M)
    seen = through_plane(px, UP, offset, BROWN, BROWN, move)
    at = np.isfinite(seen).all(axis=1)
    _, level = predicted_affines(px[at], seen[at], BROWN, BROWN, move, up_in_ref=UP)
    expected = numerical(px[at], UP, offset[at], BROWN, BROWN, move)
    # Those that stretch beyond reason are replaced.
    values = np.linalg.svd(np.nan_to_num(expected), compute_uv=False)
    fine = (values[:, 0] < 3.9) & (values[:, 1] > 0.26)
    np.testing.assert_allclose(level[fine], expected[fine], rtol=1e-4, atol=1e-5)


def test_without_a_depth_the_turn_alone_is_taken() -> None:
    move = pose()
    px = pixels(BROWN)
    away = BROWN.project(BROWN.rays(px) @ move.rotation.T)
    # Towards where the point would be if the cameras had moved the other way: the rays meet behind ref.
    other = RelativePose(move.rotation, -move.translation, move.covariance)
    behind = through_plane(px, UP, np.full(len(px), -HEIGHT_M), BROWN, BROWN, other)
    expected = turned(px, BROWN, BROWN, move)
    for seen in (behind, away):
        for warp in predicted_affines(px, seen, BROWN, BROWN, move, up_in_ref=UP):
            assert np.isfinite(warp).all()
            # At infinity rounding decides whether there is a depth, and it is a very large one then.
            np.testing.assert_allclose(warp, expected, atol=1e-6)


def test_depths_beyond_reason_are_not_taken() -> None:
    move = pose((0.0, 0.0, 0.0), (0.0, 0.0, 4.0))
    px = np.array([[900.0, 800.0]])
    # A surface a hand's breadth before src: the patch would be ten times as large there.
    ray = PLAIN.rays(px)
    seen = PLAIN.project(ray * 4.3 + move.translation)
    np.testing.assert_allclose(
        predicted_affines(px, seen, PLAIN, PLAIN, move)[0], turned(px, PLAIN, PLAIN, move), atol=1e-6
    )


def test_ground_seen_from_below_or_edge_on_is_replaced_by_the_facing_surface() -> None:
    px = pixels(PLAIN)
    # Src stands below the ground.
    move = pose((0.0, 0.0, 0.0), (3.0, 40.0, 4.0))
    seen = through_plane(px, UP, np.full(len(px), -HEIGHT_M), PLAIN, PLAIN, move)
    at = np.isfinite(seen).all(axis=1)
    assert at.sum() > 10
    facing, level = predicted_affines(px[at], seen[at], PLAIN, PLAIN, move, up_in_ref=UP)
    np.testing.assert_array_equal(level, facing)
    # At the horizon, 20 deg above the axis.
    move = pose((0.0, 0.0, 0.0), (3.0, 0.0, 4.0))
    horizon = np.array([[700.0, 595.0 - 1118.0 * np.tan(np.radians(17.0))]])
    seen = through_plane(horizon, UP, np.array([-HEIGHT_M]), PLAIN, PLAIN, move)
    facing, level = predicted_affines(horizon, seen, PLAIN, PLAIN, move, up_in_ref=UP)
    np.testing.assert_array_equal(level, facing)


def test_pixels_without_a_ray_have_no_warp() -> None:
    folded = Camera("brown", 1600, 1200, 600.0, 600.0, 800.0, 600.0, (-0.3, 0.0, 0.0, 0.0, 0.0))
    px = np.array([[800.0, 600.0], [1599.0, 0.0]])
    (warp,) = predicted_affines(px, px, folded, folded, pose((0.0, 0.0, 0.0)))
    assert np.isfinite(warp[0]).all()
    assert np.isnan(warp[1]).all()


def test_inverses_are_numpys_and_singular_ones_not_finite() -> None:
    matrices = np.random.default_rng(1).normal(size=(50, 2, 2))
    np.testing.assert_allclose(inverse_2x2(matrices), np.linalg.inv(matrices), rtol=1e-9)
    assert not np.isfinite(inverse_2x2(np.ones((1, 2, 2)))).any()
