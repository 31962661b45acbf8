"""Relative poses: their definition, and their covariance against numerical derivatives and redraws."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import enu_from_gimbal

from pipeline.geometry.arrays import Floats
from pipeline.geometry.poses import Pose, PoseSigmas, RelativePose, relative_pose
from pipeline.geometry.rotations import enu_from_cam, gimbal_angles

DEG = np.pi / 180.0
NONE = PoseSigmas(np.zeros(3), np.zeros(3))
OWN = PoseSigmas(np.array([0.05, 0.07, 0.10]), np.array([0.25, 0.08, 0.10]) * DEG)
COMMON = PoseSigmas(np.array([1.5, 1.5, 3.0]), np.array([0.5, 0.2, 0.1]) * DEG)
REF_ANGLES, SRC_ANGLES = np.array([40.0, -20.0, 1.0]) * DEG, np.array([44.0, -23.0, -2.0]) * DEG
REF_CENTRE, SRC_CENTRE = np.array([10.0, -4.0, 31.0]), np.array([13.0, 0.5, 30.2])


def pose(angles: Floats, centre: Floats, own: PoseSigmas = OWN, common: PoseSigmas = COMMON) -> Pose:
    return Pose(enu_from_gimbal(*angles), centre, own, common)


def pair(own: PoseSigmas = OWN, common: PoseSigmas = COMMON) -> RelativePose:
    return relative_pose(pose(REF_ANGLES, REF_CENTRE, own, common), pose(SRC_ANGLES, SRC_CENTRE, own, common))


def error_seen_from_ref(found: RelativePose, expected: RelativePose) -> Floats:
    """(6,): the rotation vector by which src is turned on ref's axes, then the shift of its centre."""
    turn = found.rotation.T @ expected.rotation
    vector = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return np.concatenate([vector, found.centre - expected.centre])


def disturbed(errors: Floats) -> RelativePose:
    """The relative pose after errors (own of ref: gimbal, position; own of src; common: gimbal, position), (18,)."""
    ref, src, common = errors[:6], errors[6:12], errors[12:]
    return relative_pose(
        pose(REF_ANGLES + ref[:3] + common[:3], REF_CENTRE + ref[3:] + common[3:]),
        pose(SRC_ANGLES + src[:3] + common[:3], SRC_CENTRE + src[3:] + common[3:]),
    )


def sigmas(own: PoseSigmas, common: PoseSigmas) -> Floats:
    return np.concatenate([own.gimbal_rad, own.position_m] * 2 + [common.gimbal_rad, common.position_m])


@given(
    angles=st.tuples(*[st.floats(-3.0, 3.0)] * 6),
    centres=st.tuples(*[st.floats(-50.0, 50.0)] * 6),
    point=st.tuples(*[st.floats(-100.0, 100.0)] * 3),
)
def test_x_src_is_rotation_x_ref_plus_translation(
    angles: tuple[float, ...], centres: tuple[float, ...], point: tuple[float, ...]
) -> None:
    ref, src = pose(np.array(angles[:3]), np.array(centres[:3])), pose(np.array(angles[3:]), np.array(centres[3:]))
    found = relative_pose(ref, src)
    in_ref = ref.rotation.T @ (point - ref.centre)
    in_src = src.rotation.T @ (point - src.centre)
    np.testing.assert_allclose(found.rotation @ in_ref + found.translation, in_src, atol=1e-10)
    np.testing.assert_allclose(found.centre, ref.rotation.T @ (src.centre - ref.centre), atol=1e-11)


def test_it_is_the_composition_of_cam_from_world_transforms() -> None:
    def cam_from_enu(of: Pose) -> Floats:
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = of.rotation.T, -of.rotation.T @ of.centre
        return out

    composed = cam_from_enu(pose(SRC_ANGLES, SRC_CENTRE)) @ np.linalg.inv(cam_from_enu(pose(REF_ANGLES, REF_CENTRE)))
    found = pair()
    np.testing.assert_allclose(found.rotation, composed[:3, :3], atol=1e-14)
    np.testing.assert_allclose(found.translation, composed[:3, 3], atol=1e-12)


def test_a_pilot_s_pair() -> None:
    level = np.zeros(3)
    north = relative_pose(pose(level, np.zeros(3)), pose(level, np.array([0.0, 5.0, 0.0])))
    np.testing.assert_allclose(north.centre, (0.0, 0.0, 5.0), atol=1e-14)
    east = relative_pose(pose(level, np.zeros(3)), pose(level, np.array([5.0, 0.0, 0.0])))
    np.testing.assert_allclose(east.centre, (5.0, 0.0, 0.0), atol=1e-14)
    climbed = relative_pose(pose(level, np.zeros(3)), pose(level, np.array([0.0, 0.0, 5.0])))
    np.testing.assert_allclose(climbed.centre, (0.0, -5.0, 0.0), atol=1e-14)
    # src is turned to the right by 10 deg, so what is ahead of ref moves to the left in src.
    turned = relative_pose(pose(level, np.zeros(3)), pose(np.array([10.0 * DEG, 0.0, 0.0]), np.zeros(3)))
    assert (turned.rotation @ (0.0, 0.0, 1.0))[0] == pytest.approx(-np.sin(10.0 * DEG))


@pytest.mark.parametrize(("own", "common"), [(OWN, COMMON), (OWN, NONE), (NONE, COMMON)])
def test_the_covariance_is_that_of_numerical_derivatives(own: PoseSigmas, common: PoseSigmas) -> None:
    h, nominal = 1e-5, pair()
    jacobian = np.stack(
        [
            (error_seen_from_ref(disturbed(step), nominal) - error_seen_from_ref(disturbed(-step), nominal)) / (2.0 * h)
            for step in h * np.eye(18)
        ],
        axis=1,
    )
    # error_seen_from_ref measures src_from_ref^T: the turn of src on ref's axes.
    expected = (jacobian * sigmas(own, common) ** 2) @ jacobian.T
    found = pair(own, common).covariance
    scale = np.sqrt(np.diag(found) + 1e-20)
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6)


def test_redraws_spread_as_the_covariance_says() -> None:
    rng, n, nominal = np.random.default_rng(11), 4000, pair()
    draws = np.stack(
        [error_seen_from_ref(disturbed(e), nominal) for e in rng.normal(size=(n, 18)) * sigmas(OWN, COMMON)]
    )
    root = np.linalg.cholesky(nominal.covariance)
    whitened = np.linalg.solve(root, draws.T)
    # 4000 draws give each entry of the covariance to 1/sqrt(4000) = 1.6 %, a diagonal one to 2.2 %.
    spread = whitened @ whitened.T / n
    np.testing.assert_allclose(np.diag(spread), 1.0, atol=0.09)
    np.testing.assert_allclose(spread - np.diag(np.diag(spread)), 0.0, atol=0.07)


def test_the_common_position_error_cancels_and_common_angles_do_not() -> None:
    shifted = PoseSigmas(np.array([9.0, 9.0, 9.0]), np.zeros(3))
    np.testing.assert_allclose(pair(NONE, shifted).covariance, np.zeros((6, 6)), atol=1e-28)
    turned = PoseSigmas(np.zeros(3), np.array([1.0, 0.0, 0.0]) * DEG)
    covariance = pair(NONE, turned).covariance
    # A compass error common to both turns neither against the other, but swings src about ref by the level baseline.
    level = float(np.hypot(*(SRC_CENTRE - REF_CENTRE)[:2]))
    np.testing.assert_allclose(covariance[:3, :3], 0.0, atol=1e-20)
    assert np.sqrt(np.trace(covariance[3:, 3:])) == pytest.approx(level * DEG)


def test_own_heading_errors_of_both_add_up_about_the_vertical() -> None:
    heading = PoseSigmas(np.zeros(3), np.array([1.0, 0.0, 0.0]) * DEG)
    down_in_ref = enu_from_gimbal(*REF_ANGLES).T @ (0.0, 0.0, -1.0)
    turn = pair(heading, NONE).covariance[:3, :3]
    np.testing.assert_allclose(turn, 2.0 * DEG**2 * np.outer(down_in_ref, down_in_ref), atol=1e-18)


def test_own_position_errors_of_both_add_up() -> None:
    position = PoseSigmas(np.array([0.3, 0.3, 0.3]), np.zeros(3))
    np.testing.assert_allclose(pair(position, NONE).covariance[3:, 3:], 2.0 * 0.3**2 * np.eye(3), atol=1e-15)


@pytest.mark.parametrize("build", [pair, lambda: pair(OWN, NONE)])
def test_the_covariance_is_symmetric_and_positive(build: Callable[[], RelativePose]) -> None:
    covariance = build().covariance
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-18)
    scale = np.sqrt(np.diag(covariance))
    assert np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0] > 0.0


def test_straight_down_the_three_errors_stay_apart() -> None:
    down = np.array([70.0, -90.0, 0.0]) * DEG
    ref, src = pose(down, REF_CENTRE, OWN, NONE), pose(down, SRC_CENTRE, OWN, NONE)
    turn = relative_pose(ref, src).covariance[:3, :3]
    # On the camera's axes: pitch about right, roll about the image's up, yaw about the optical axis.
    np.testing.assert_allclose(turn, np.diag(2.0 * OWN.gimbal_rad[[1, 2, 0]] ** 2), atol=1e-18)


def test_the_roll_180_form_has_the_same_covariance() -> None:
    ref, src = pose(REF_ANGLES, REF_CENTRE), pose(SRC_ANGLES, SRC_CENTRE)
    yaw, pitch, roll = gimbal_angles(ref.rotation)
    other = Pose(enu_from_cam(yaw + np.pi, np.pi - pitch, roll + np.pi), REF_CENTRE, OWN, COMMON)
    np.testing.assert_allclose(relative_pose(other, src).covariance, relative_pose(ref, src).covariance, atol=1e-15)


def test_src_swings_about_ref_by_its_lever_arm() -> None:
    """Only ref's own roll: its axis is level and forward, and the src centre swings about it."""
    roll = PoseSigmas(np.zeros(3), np.array([0.0, 0.0, 1.0]) * DEG)
    found = relative_pose(pose(REF_ANGLES, REF_CENTRE, roll, NONE), pose(SRC_ANGLES, SRC_CENTRE, NONE, NONE))
    forward = DEG * enu_from_gimbal(*REF_ANGLES).T @ (np.sin(REF_ANGLES[0]), np.cos(REF_ANGLES[0]), 0.0)
    # Turning ref by a moves what it sees by -a x.
    swing = np.cross(found.centre, forward)
    np.testing.assert_allclose(found.covariance[3:, 3:], np.outer(swing, swing), atol=1e-15)
    np.testing.assert_allclose(found.covariance[:3, 3:], np.outer(-forward, swing), atol=1e-15)
