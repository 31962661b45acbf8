"""Facts a pilot can check, and the rotation algebra against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from oracles import enu_from_gimbal
from scipy.spatial.transform import Rotation

from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import (
    ENU_FROM_NED,
    enu_from_cam,
    gimbal_angles,
    gimbal_error_axes,
    ned_from_frd,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    skew,
)

EAST, NORTH, UP = np.eye(3)
RIGHT, DOWN_IN_IMAGE, AXIS = 0, 1, 2
HALF = np.pi / 2.0

angles = st.floats(-np.pi, np.pi)
pitches = st.floats(-HALF, HALF)
vectors = hnp.arrays(np.float64, 3, elements=st.floats(-3.0, 3.0))
quaternions = hnp.arrays(np.float64, 4, elements=st.floats(-1.0, 1.0)).filter(lambda q: np.linalg.norm(q) > 1e-3)


@pytest.mark.parametrize(
    ("yaw", "pitch", "axis", "image_top", "image_right"),
    [
        (0.0, -90.0, -UP, NORTH, EAST),
        (90.0, -90.0, -UP, EAST, -NORTH),
        (0.0, 0.0, NORTH, UP, EAST),
        (90.0, 0.0, EAST, UP, -NORTH),
        (180.0, 0.0, -NORTH, UP, -EAST),
        (0.0, 90.0, UP, -NORTH, EAST),
    ],
)
def test_what_a_pilot_sees(yaw: float, pitch: float, axis: Floats, image_top: Floats, image_right: Floats) -> None:
    rotation = enu_from_cam(np.radians(yaw), np.radians(pitch), 0.0)
    np.testing.assert_allclose(rotation[:, AXIS], axis, atol=1e-15)
    np.testing.assert_allclose(-rotation[:, DOWN_IN_IMAGE], image_top, atol=1e-15)
    np.testing.assert_allclose(rotation[:, RIGHT], image_right, atol=1e-15)


def test_pitch_down_lowers_the_axis_and_keeps_the_heading() -> None:
    axis = enu_from_cam(np.radians(30.0), np.radians(-20.0), 0.0)[:, AXIS]
    assert axis[2] == pytest.approx(-np.sin(np.radians(20.0)))
    assert np.degrees(np.arctan2(axis[0], axis[1])) == pytest.approx(30.0)


def test_positive_roll_lowers_the_right_edge_and_keeps_the_axis() -> None:
    rotation = enu_from_cam(0.0, 0.0, np.radians(10.0))
    assert rotation[2, RIGHT] == pytest.approx(-np.sin(np.radians(10.0)))
    np.testing.assert_allclose(rotation[:, AXIS], NORTH, atol=1e-15)


@given(angles, angles, angles)
def test_the_roll_180_form_names_the_same_rotation(yaw: float, pitch: float, roll: float) -> None:
    other = enu_from_cam(yaw + np.pi, np.pi - pitch, roll + np.pi)
    np.testing.assert_allclose(other, enu_from_cam(yaw, pitch, roll), atol=1e-14)


def test_a_gimbal_tilted_backward_past_the_vertical_is_written_with_roll_180() -> None:
    backward = enu_from_cam(np.radians(40.0), np.radians(-120.0), 0.0)
    np.testing.assert_allclose(enu_from_cam(np.radians(220.0), np.radians(-60.0), np.pi), backward, atol=1e-14)
    # The image is upside down: its top edge looks below the axis.
    assert backward[2, DOWN_IN_IMAGE] > 0.0


@given(angles, pitches, angles)
def test_ned_from_frd_is_scipy_s_intrinsic_zyx(yaw: float, pitch: float, roll: float) -> None:
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    np.testing.assert_allclose(ned_from_frd(yaw, pitch, roll), expected, atol=1e-14)


@given(angles, pitches, angles)
def test_gimbal_angles_give_the_rotation_back(yaw: float, pitch: float, roll: float) -> None:
    rotation = enu_from_cam(yaw, pitch, roll)
    again = gimbal_angles(rotation)
    assert abs(again[1]) <= HALF
    # Near the vertical an arcsine keeps half the digits: 2e-8 rad is 2 micrometres at 100 m.
    np.testing.assert_allclose(enu_from_cam(*again), rotation, atol=3e-8)


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_away_from_the_vertical_the_angles_themselves_come_back(yaw: float, pitch: float, roll: float) -> None:
    np.testing.assert_allclose(gimbal_angles(enu_from_cam(yaw, pitch, roll)), (yaw, pitch, roll), atol=1e-12)


@pytest.mark.parametrize("pitch", [-HALF, HALF])
@pytest.mark.parametrize("roll", [0.0, 0.7, -2.0])
def test_straight_down_and_up_keep_the_rotation_and_say_roll_0(pitch: float, roll: float) -> None:
    rotation = enu_from_cam(1.1, pitch, roll)
    found = gimbal_angles(rotation)
    assert found[2] == 0.0
    np.testing.assert_allclose(enu_from_cam(*found), rotation, atol=1e-15)


@given(vectors)
def test_rotation_from_vector_is_scipy_s(v: Floats) -> None:
    np.testing.assert_allclose(rotation_from_vector(v), Rotation.from_rotvec(v).as_matrix(), atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-12, 1e-9, 9.9e-9, 1.01e-8, 1e-7, 1e-5, np.pi])
def test_rotation_from_small_and_half_turn_vectors(size: float) -> None:
    v = size * np.array([2.0, -1.0, 2.0]) / 3.0
    np.testing.assert_allclose(rotation_from_vector(v), Rotation.from_rotvec(v).as_matrix(), rtol=0, atol=1e-15)


@given(quaternions)
def test_rotation_from_quaternion_is_scipy_s_with_the_scalar_first(q: Floats) -> None:
    expected = Rotation.from_quat(q, scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotation_from_quaternion(q), expected, atol=1e-14)


@given(quaternions)
def test_quaternions_come_back_with_a_scalar_part_that_is_not_negative(q: Floats) -> None:
    unit = q / np.linalg.norm(q)
    found = quaternion_from_rotation(rotation_from_quaternion(q))
    assert found[0] >= 0.0
    assert np.linalg.norm(found) == pytest.approx(1.0)
    assert abs(found @ unit) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (0, -1, 1), (1, 1, 1)])
def test_half_turns_have_a_quaternion(axis: tuple[int, int, int]) -> None:
    unit = np.array(axis) / np.linalg.norm(axis)
    found = quaternion_from_rotation(2.0 * np.outer(unit, unit) - np.eye(3))
    assert abs(found[1:] @ unit) == pytest.approx(1.0)


def test_arrays_of_rotations_keep_their_shape() -> None:
    rng = np.random.default_rng(1)
    v = rng.normal(size=(4, 5, 3))
    rotations = rotation_from_vector(v)
    q = quaternion_from_rotation(rotations)
    assert (rotations.shape, q.shape) == ((4, 5, 3, 3), (4, 5, 4))
    np.testing.assert_allclose(rotation_from_quaternion(q), rotations, atol=1e-14)
    np.testing.assert_allclose(q[2, 3], quaternion_from_rotation(rotations[2, 3]), atol=1e-15)
    assert gimbal_angles(rotations).shape == (4, 5, 3)
    yaw, pitch, roll = np.moveaxis(gimbal_angles(rotations), -1, 0)
    np.testing.assert_allclose(enu_from_cam(yaw, pitch, roll), rotations, atol=1e-12)


@given(vectors, vectors)
def test_skew_is_the_cross_product(v: Floats, w: Floats) -> None:
    np.testing.assert_allclose(skew(v) @ w, np.cross(v, w), atol=1e-14)


@given(angles, st.floats(-3.0, 3.0), st.floats(-1.4, 1.4))
def test_gimbal_error_axes_are_the_derivatives_by_the_motors(yaw: float, pitch: float, roll: float) -> None:
    rotation, h = enu_from_gimbal(yaw, pitch, roll), 1e-6
    for axis, step in zip(gimbal_error_axes(rotation).T, h * np.eye(3), strict=True):
        later = enu_from_gimbal(yaw + step[0], pitch + step[1], roll + step[2])
        sooner = enu_from_gimbal(yaw - step[0], pitch - step[1], roll - step[2])
        np.testing.assert_allclose((later - sooner) / (2.0 * h) @ rotation.T, skew(axis), atol=1e-9)


@given(angles, pitches)
def test_without_roll_yaw_and_pitch_errors_are_those_of_the_angles(yaw: float, pitch: float) -> None:
    rotation, h = enu_from_cam(yaw, pitch, 0.0), 1e-6
    for axis, step in zip(gimbal_error_axes(rotation).T[:2], h * np.eye(3)[:2], strict=True):
        later, sooner = (enu_from_cam(yaw + s * step[0], pitch + s * step[1], 0.0) for s in (1.0, -1.0))
        np.testing.assert_allclose((later - sooner) / (2.0 * h) @ rotation.T, skew(axis), atol=1e-9)


@pytest.mark.parametrize("pitch", [0.0, -20.0, -90.0])
def test_roll_errors_tilt_the_horizon_and_keep_three_axes_apart_straight_down(pitch: float) -> None:
    axes = gimbal_error_axes(enu_from_cam(np.radians(70.0), np.radians(pitch), 0.0))
    yaw = np.radians(70.0)
    np.testing.assert_allclose(axes[:, 0], -UP)
    np.testing.assert_allclose(axes[:, 1], (np.cos(yaw), -np.sin(yaw), 0.0), atol=1e-12)
    np.testing.assert_allclose(axes[:, 2], (np.sin(yaw), np.cos(yaw), 0.0), atol=1e-12)


def test_a_camera_on_its_side_has_some_level_roll_axis() -> None:
    axes = gimbal_error_axes(np.stack([enu_from_cam(0.3, -0.2, np.pi / 2.0), enu_from_cam(0.0, 0.0, 0.0)]))
    assert axes.shape == (2, 3, 3)
    assert np.all(np.isfinite(axes))
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0, atol=1e-12)


def test_the_ned_and_enu_axes_are_a_proper_rotation() -> None:
    assert np.linalg.det(ENU_FROM_NED) == pytest.approx(1.0)
    np.testing.assert_array_equal(ENU_FROM_NED @ (1.0, 2.0, 3.0), (2.0, 1.0, -3.0))
