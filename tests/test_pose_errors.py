"""Errors of two cameras and of a flight's frames: against numerical derivatives, and through the tables and back."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refinement_scenes import CAMERA, COMMON, DEG, NONE, OWN, Errors, log_of, logged, named, placement, straight

from pipeline.flight import (
    placed_pairs_of,
    placement_row,
    placements_of,
    pose_errors_of,
    relative_poses_of,
)
from pipeline.geometry.arrays import Floats
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.geometry.poses import (
    PlacedPair,
    Placement,
    Pose,
    PoseSigmas,
    common_covariance,
    joint_covariance,
    own_covariance,
    relative_jacobian,
    relative_placement,
)
from pipeline.geometry.rotations import (
    gimbal_error_axes,
    rotation_from_quaternion,
    vector_from_rotation,
)
from pipeline.refinement.logged import as_logged
from pipeline.refinement.matched import Matched
from pipeline.refinement.rows import (
    FLIGHT,
    PAIR,
    Misses,
    RefinedFrame,
    RefinedPair,
    covariances_table,
    pair_row,
    poses_table,
)
from pipeline.refinement.rows import (
    NONE as AS_LOGGED,
)
from schemas import MATCHES, RELATIVE_POSES

angles = st.tuples(st.floats(-180.0, 180.0), st.floats(-90.0, 30.0), st.floats(-60.0, 60.0))
centres = st.tuples(*[st.floats(-50.0, 50.0)] * 3)


def derivative(function: Callable[[Floats], Floats], size: int, step: float = 1e-6) -> Floats:
    """(r, size) by central differences about zero."""
    return np.stack([(function(step * e) - function(-step * e)) / (2.0 * step) for e in np.eye(size)], axis=1)


def with_errors(at: Placement, gimbal_rad: Floats, shift_m: Floats) -> Placement:
    return at.moved(np.concatenate([gimbal_error_axes(at.rotation) @ gimbal_rad, shift_m]))


def moved_by(at: Placement, now: Placement) -> Floats:
    return np.concatenate([vector_from_rotation(now.rotation @ at.rotation.T), now.centre - at.centre])


def posed(at: Placement, own: PoseSigmas = OWN, common: PoseSigmas = COMMON) -> Pose:
    return Pose(at.rotation, at.centre, own, common)


@given(angles, angles, centres, centres)
def test_the_relative_pose_moves_with_both_cameras(
    ref_deg: tuple[float, ...], src_deg: tuple[float, ...], ref_m: tuple[float, ...], src_m: tuple[float, ...]
) -> None:
    ref, src = placement(ref_deg, ref_m), placement(src_deg, src_m)

    def seen(error: Floats) -> Floats:
        now = relative_placement(ref.moved(error[:6]), src.moved(error[6:]), np.eye(6))
        before = relative_placement(ref, src, np.eye(6))
        return np.concatenate([vector_from_rotation(now.rotation.T @ before.rotation), now.centre - before.centre])

    np.testing.assert_allclose(relative_jacobian(ref, src), derivative(seen, 12), atol=1e-6)


@given(angles, centres, st.tuples(*[st.floats(-0.5, 0.5)] * 6))
def test_a_moved_placement_turns_about_enu_s_axes(
    deg: tuple[float, ...], at_m: tuple[float, ...], error: tuple[float, ...]
) -> None:
    at, step = placement(deg, at_m), np.array(error)
    now = at.moved(step)
    np.testing.assert_allclose(moved_by(at, now), step, atol=1e-12)
    # What the camera sees ahead turns by the right-hand rule about the vector, in ENU.
    ahead, turn = at.rotation[:, 2], 1e-5 * step[:3]
    turned = at.moved(np.concatenate([turn, np.zeros(3)])).rotation[:, 2]
    np.testing.assert_allclose(turned - ahead, np.cross(turn, ahead), atol=1e-9)


@pytest.mark.parametrize("pitch_deg", [-90.0, -35.0, 0.0])
@pytest.mark.parametrize(("own", "common"), [(OWN, COMMON), (NONE, COMMON), (OWN, NONE)])
def test_the_joint_covariance_is_that_of_gimbal_errors_own_and_common(
    own: PoseSigmas, common: PoseSigmas, pitch_deg: float
) -> None:
    ref, src = placement((40.0, pitch_deg, 3.0), (3.0, -2.0, 30.0)), placement((130.0, -50.0, -2.0), (0.0, 1.0, 31.0))

    def errors(e: Floats) -> Floats:
        own_ref, own_src, both = e[:6], e[6:12], e[12:]
        now = (with_errors(at, *np.split(o + both, 2)) for at, o in ((ref, own_ref), (src, own_src)))
        return np.concatenate([moved_by(at, one) for at, one in zip((ref, src), now, strict=True)])

    sigmas = np.concatenate([np.concatenate([s.gimbal_rad, s.position_m]) for s in (own, own, common)])
    jacobian = derivative(errors, 18) * sigmas
    found = joint_covariance(posed(ref, own, common), posed(src, own, common))
    np.testing.assert_allclose(found, jacobian @ jacobian.T, atol=1e-8)
    np.testing.assert_array_equal(found, found.T)


def test_what_is_common_is_the_whole_of_what_two_frames_share() -> None:
    truth = straight(2)
    one, other = (posed(at) for at in truth.values())
    joint = joint_covariance(one, other)
    np.testing.assert_array_equal(joint[:6, 6:], common_covariance(one, other))
    np.testing.assert_allclose(joint[:6, :6] - own_covariance(one), common_covariance(one, one), atol=1e-18)
    # A common shift is wholly common; a common compass error turns both about the vertical.
    np.testing.assert_allclose(joint[3:6, 9:], np.diag(COMMON.position_m**2), atol=1e-18)
    yaw = PoseSigmas(np.zeros(3), np.array([1.0, 0.0, 0.0]) * DEG)
    shared = common_covariance(*(posed(at, NONE, yaw) for at in truth.values()))
    np.testing.assert_allclose(shared[:3, :3], np.diag([0.0, 0.0, DEG**2]), atol=1e-18)


# --- covariances between the frames of a flight ---


def block(seed: int) -> Floats:
    return np.random.default_rng(seed).normal(size=(6, 6))


def test_a_covariance_stands_for_its_transpose_too() -> None:
    own = {name: block(i) @ block(i).T for i, name in enumerate("abc")}
    known = [*((name, name, one) for name, one in own.items()), ("b", "a", block(7))]
    errors = PoseErrors.of("abc", known)
    np.testing.assert_array_equal(errors.between("b", "a"), block(7))
    np.testing.assert_array_equal(errors.between("a", "b"), block(7).T)
    np.testing.assert_array_equal(errors.between("c", "c"), own["c"])
    joint = errors.joint("a", "b")
    np.testing.assert_array_equal(joint, np.block([[own["a"], block(7).T], [block(7), own["b"]]]))
    np.testing.assert_array_equal(joint, joint.T)
    np.testing.assert_array_equal(errors.joint("b", "a")[:6, :6], own["b"])


def test_a_covariance_that_is_not_kept_is_no_zero() -> None:
    errors = PoseErrors.of("abc", [("a", "a", np.eye(6)), ("c", "c", np.eye(6))])
    with pytest.raises(KeyError, match="between a and c"):
        errors.between("a", "c")
    with pytest.raises(KeyError, match="between a and b"):
        errors.joint("a", "b")
    with pytest.raises(KeyError, match="x"):
        errors.between("a", "x")
    with pytest.raises(KeyError):
        PoseErrors.of("ab", [("a", "x", np.eye(6))])
    nothing = PoseErrors.of((), ())
    assert nothing.blocks.shape == (0, 6, 6)
    with pytest.raises(KeyError):
        nothing.between("a", "a")


@given(st.integers(0, 10**6), st.integers(1, 7))
def test_many_at_once_are_as_each_by_name(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    names = [f"f{i}" for i in range(n)]
    known = {}
    for i, j in rng.integers(0, n, (rng.integers(0, 2 * n), 2)):
        known.pop((j, i), None)
        known[i, j] = rng.normal(size=(6, 6))
    errors = PoseErrors.of(names, ((names[i], names[j], one) for (i, j), one in known.items()))
    one, other = rng.integers(0, n, (2, 5, 3))
    blocks, kept = errors.of_numbers(one, other)
    for i, j, found, is_kept in zip(one.flat, other.flat, blocks.reshape(-1, 6, 6), kept.flat, strict=True):
        want = known[i, j] if (i, j) in known else known[j, i].T if (j, i) in known else None
        assert is_kept == (want is not None)
        if want is not None:
            np.testing.assert_array_equal(found, want)
            np.testing.assert_array_equal(errors.between(names[i], names[j]), want)


def test_a_long_flight_s_covariances_are_as_small_as_what_is_kept() -> None:
    names = [f"f{i}" for i in range(1000)]
    known = [*zip(names, names, strict=True), *zip(names[1:], names[:-1], strict=True)]
    errors = PoseErrors.of(names, ((*couple, block(0)) for couple in known))
    assert len(known) * 6 * 6 * 8 < len(pickle.dumps(errors)) < 1.2 * len(known) * 6 * 6 * 8


def test_the_log_s_covariances_are_those_of_its_pairs() -> None:
    poses = logged(straight(4), Errors.none(4))
    errors = PoseErrors.of_log(poses, [("f00", "f01"), ("f01", "f03")])
    for one, other in (("f00", "f01"), ("f01", "f00"), ("f03", "f01")):
        np.testing.assert_array_equal(errors.joint(one, other), joint_covariance(poses[one], poses[other]))
    with pytest.raises(KeyError):
        errors.between("f00", "f03")


# --- through the tables and back ---


def of_pair(ref: str, src: str) -> Matched:
    return Matched.of(named(ref, src), MATCHES.empty(), {ref: CAMERA, src: CAMERA})


def a_refined(mode: str) -> RefinedPair:
    rng = np.random.default_rng(3)
    ref, src = straight(2, seed=4).values()
    root = rng.normal(size=(12, 12)) * np.tile([1e-3] * 3 + [0.1] * 3, 2)[:, None]
    placed = PlacedPair(ref, src, rng.normal(size=(12, 12)), root @ root.T)
    before, after = (Misses.of(np.array(px)) for px in ([1.0, 2.0, 6.0], [0.1, 0.2, 0.2]))
    return RefinedPair(placed, root @ root.T, mode, before, after, 1.5, "told")


@given(angles, centres)
def test_a_placement_comes_back(deg: tuple[float, ...], at_m: tuple[float, ...]) -> None:
    at = placement(deg, at_m)
    row = placement_row(at, "src_")
    assert all(name.startswith("src_") for name in row)
    rotation = rotation_from_quaternion(np.array([row[f"src_{q}"] for q in ("qw", "qx", "qy", "qz")]))
    np.testing.assert_allclose(rotation, at.rotation, atol=1e-14)
    assert [row[f"src_{axis}_m"] for axis in ("east", "north", "up")] == list(at_m)


def test_a_pair_refined_by_itself_comes_back_with_what_its_errors_are_made_of() -> None:
    found = a_refined(PAIR)
    table = RELATIVE_POSES.from_rows([pair_row(of_pair("f00", "f01"), found)])
    back = placed_pairs_of(table)["f00~f01"]
    np.testing.assert_array_equal(back.gain, found.placed.gain)
    np.testing.assert_array_equal(back.noise, found.placed.noise)
    for one, other in ((back.ref, found.placed.ref), (back.src, found.placed.src)):
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-14)
        np.testing.assert_array_equal(one.centre, other.centre)
    pose = relative_poses_of(table)["f00~f01"]
    jacobian = relative_jacobian(back.ref, back.src)
    np.testing.assert_allclose(pose.covariance, jacobian @ found.covariance @ jacobian.T, atol=1e-12)
    np.testing.assert_allclose(pose.rotation, back.src.rotation.T @ back.ref.rotation, atol=1e-14)
    np.testing.assert_allclose(pose.centre, back.ref.rotation.T @ (back.src.centre - back.ref.centre), atol=1e-12)
    row = table.to_pylist()[0]
    assert (row["n_inliers"], row["median_before_px"], row["median_after_px"]) == (3, 2.0, 0.2)
    assert row["rms_before_px"] == pytest.approx(np.sqrt(41.0 / 3.0))
    assert (row["mode"], row["moved_sigmas"], row["problem"]) == ("pair", 1.5, "told")


@pytest.mark.parametrize("mode", [FLIGHT, AS_LOGGED])
def test_any_other_pair_has_the_errors_of_its_frames(mode: str) -> None:
    table = RELATIVE_POSES.from_rows([pair_row(of_pair("f00", "f01"), a_refined(mode))])
    assert table.column("gain").null_count == table.column("noise").null_count == 1
    back = placed_pairs_of(table)["f00~f01"]
    np.testing.assert_array_equal(back.gain, np.eye(12))
    np.testing.assert_array_equal(back.noise, np.zeros((12, 12)))


def test_a_logged_pair_without_matches_has_a_row() -> None:
    poses = logged(straight(2), Errors.none(2))
    matched = of_pair("f00", "f01")
    row = pair_row(matched, as_logged(log_of(poses, [matched.pair]), matched))
    table = RELATIVE_POSES.from_rows([row])
    assert (row["n_matches"], row["n_inliers"], row["rms_before_px"], row["moved_sigmas"]) == (0, 0, None, None)
    assert row["problem"] == "no match agrees with the logged pose"
    back = placed_pairs_of(table)["f00~f01"]
    np.testing.assert_array_equal(back.src.centre, poses["f01"].centre)


def test_tables_of_no_rows_come_back() -> None:
    assert placed_pairs_of(RELATIVE_POSES.empty()) == {}
    assert placements_of(poses_table({})) == {}
    assert pose_errors_of(covariances_table(PoseErrors.of((), ()), ())).blocks.shape == (0, 6, 6)


def test_covariances_between_frames_come_back() -> None:
    poses = logged(straight(3), Errors.none(3))
    couples = [("f00", "f01"), ("f01", "f02")]
    errors = PoseErrors.of_log(poses, couples)
    back = pose_errors_of(covariances_table(errors, couples))
    assert list(back.index) == list(poses)
    for one, other in (*couples, ("f01", "f00"), ("f02", "f02")):
        np.testing.assert_array_equal(back.between(one, other), errors.between(one, other))
    with pytest.raises(KeyError):
        back.between("f00", "f02")


def test_poses_tell_sigmas_of_the_gimbal_and_the_position() -> None:
    poses = logged(straight(2), Errors.none(2))
    frames = {
        name: RefinedFrame(Placement(pose.rotation, pose.centre), own_covariance(pose) + common_covariance(pose, pose))
        for name, pose in poses.items()
    }
    table = poses_table(frames)
    for row in table.to_pylist():
        gimbal = [row[f"sigma_{name}_deg"] for name in ("yaw", "pitch", "roll")]
        position = [row[f"sigma_{name}_m"] for name in ("east", "north", "up")]
        np.testing.assert_allclose(gimbal, np.degrees(np.hypot(OWN.gimbal_rad, COMMON.gimbal_rad)), rtol=1e-9)
        np.testing.assert_allclose(position, np.hypot(OWN.position_m, COMMON.position_m), rtol=1e-12)
        np.testing.assert_array_equal(np.reshape(row["cov"], (6, 6)), frames[row["frame_id"]].covariance)
        assert (row["refined"], row["problem"]) == (False, "")
    for name, at in placements_of(table).items():
        np.testing.assert_allclose(at.rotation, poses[name].rotation, atol=1e-14)
        np.testing.assert_array_equal(at.centre, poses[name].centre)


def test_a_camera_rolled_on_its_side_has_sigmas_too() -> None:
    at = placement((10.0, 0.0, 90.0), (0.0, 0.0, 30.0))
    pose = posed(at)
    row = poses_table({"a": RefinedFrame(at, own_covariance(pose) + common_covariance(pose, pose))}).to_pylist()[0]
    sigmas = np.array([row[f"sigma_{name}_deg"] for name in ("yaw", "pitch", "roll")])
    assert np.all(np.isfinite(sigmas))
    assert np.all(sigmas < 2.0)
