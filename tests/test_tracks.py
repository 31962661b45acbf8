"""Streams between their samples, and the camera on its vehicle."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from pipeline.geometry.rotations import (
    enu_from_cam,
    ned_from_frd,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)
from pipeline.tracks.mount import Mount, contradiction_deg, heading_only, ned_from_gimbal
from pipeline.tracks.series import bend, between, bracket, slerp, speed, turn_bend

NS = 1_000_000_000


def at(*seconds: float) -> np.ndarray:
    return np.rint(np.array(seconds) * NS).astype(np.int64)


class TestSeries:
    def test_between_samples_and_on_them(self) -> None:
        where = bracket(at(0, 1, 2, 3), np.zeros(4, np.int64), at(-0.1, 0.0, 0.25, 2.0, 3.0, 3.1), 1.5)
        values = between(np.array([0.0, 10.0, 30.0, 60.0]), where)
        assert where.known.tolist() == [False, True, True, True, True, False]
        assert values[1:5].tolist() == [0.0, 2.5, 30.0, 60.0]

    def test_never_across_a_gap_or_a_reset(self) -> None:
        times, segment = at(0, 1, 5, 6, 7), np.array([0, 0, 0, 1, 1])
        where = bracket(times, segment, at(0.5, 3.0, 5.5, 6.5, 5.0), 2.0)
        assert where.known.tolist() == [True, False, False, True, True]

    def test_a_missing_sample_spoils_only_what_needs_it(self) -> None:
        where = bracket(at(0, 1, 2), np.zeros(3, np.int64), at(0.0, 0.5, 2.0), 2.0)
        assert np.isnan(between(np.array([1.0, np.nan, 3.0]), where)).tolist() == [False, True, False]

    def test_an_empty_stream(self) -> None:
        assert not bracket(at(), np.empty(0, np.int64), at(1.0), 1.0).known.any()

    def test_slerp_against_scipy(self) -> None:
        rng = np.random.default_rng(1)
        samples = Rotation.random(6, rng=rng)
        times = np.arange(6.0)
        asked = rng.uniform(0.0, 5.0, 40)
        q_xyzw = samples.as_quat()
        # Half of the samples under their other name: the short way round has to be found.
        q_wxyz = np.roll(q_xyzw, 1, axis=1) * np.where(np.arange(6) % 2, -1.0, 1.0)[:, None]
        found = slerp(q_wxyz, bracket(at(*times), np.zeros(6, np.int64), at(*asked), 2.0))
        expected = Slerp(times, samples)(np.rint(asked * NS) / NS)
        apart = Rotation.from_quat(np.roll(found, -1, axis=1)) * expected.inv()
        assert np.abs(apart.magnitude()).max() < 1e-9

    def test_speed_and_bend_of_a_parabola(self) -> None:
        times = np.arange(0.0, 10.0, 0.5)
        values = np.column_stack([times**2, 3.0 * times])
        where = bracket(at(*times), np.zeros(len(times), np.int64), at(4.25), 1.0)
        assert speed(values, where)[0] == pytest.approx((8.5, 3.0))
        # The line from 4 to 4.5 misses the parabola by half the second difference's quarter.
        missed = between(values, where)[0, 0] - 4.25**2
        told = bend(values, at(*times), np.zeros(len(times), np.int64), where, 1.0)
        assert told[0] == pytest.approx((missed, 0.0))

    @pytest.mark.parametrize("odd", ["gap", "reset", "twice"])
    def test_bend_is_not_taken_across_what_is_no_curve(self, odd: str) -> None:
        times = np.arange(0.0, 10.0, 0.5)
        if odd == "twice":
            times[10] = times[9]
        values, segment = 3.0 * times[:, None], np.zeros(len(times), np.int64)
        if odd == "gap":
            times[10:] += 7.0
        if odd != "twice":
            values[10:] += 50.0
        if odd == "reset":
            segment[10:] = 1
        where = bracket(at(*times), segment, at(times[10] + 0.2, times[8] + 0.2), 1.5)
        assert where.known.all()
        assert np.abs(bend(values, at(*times), segment, where, 1.5)).max() == pytest.approx(0.0, abs=1e-9)

    def test_what_slerp_misses_of_a_turn_that_speeds_up(self) -> None:
        times = np.arange(0.0, 5.0, 0.5)
        q = quaternion_from_rotation(ned_from_frd(0.4 * times**2, np.zeros(10), np.zeros(10)))
        where = bracket(at(*times), np.zeros(10, np.int64), at(2.25), 1.0)
        yaw = 2.0 * np.arctan2(*slerp(q, where)[0, [3, 0]])
        missed = abs(yaw - 0.4 * 2.25**2)
        told = turn_bend(q, at(*times), np.zeros(10, np.int64), where, 1.0)[0]
        assert told == pytest.approx(missed)

    @given(st.lists(st.floats(-3.1, 3.1), min_size=3, max_size=3))
    def test_rotation_vectors_come_back(self, vector: list[float]) -> None:
        rotation = rotation_from_vector(np.array(vector))
        again = rotation_from_vector(vector_from_rotation(rotation))
        assert np.allclose(again, rotation, atol=1e-9)


class TestMount:
    def test_facts_a_pilot_can_check(self) -> None:
        # Heading east, level, camera straight down: the top of the image is east, its right edge south.
        body = ned_from_frd(np.radians(90.0), 0.0, 0.0)
        down = Mount((0.0, float(np.radians(-90.0)), 0.0)).body_from_camera
        assert down is not None
        axis, right, image_down = (body @ down).T
        assert np.allclose(axis, (0, 0, 1), atol=1e-12)
        assert np.allclose(right, (1, 0, 0) * np.array(-1.0), atol=1e-12)
        assert np.allclose(image_down, (0, -1, 0), atol=1e-12)

    def test_frames_of_a_gimbal(self) -> None:
        body = ned_from_frd(np.radians([30.0]), np.radians([8.0]), np.radians([-5.0]))
        gimbal = ned_from_frd(np.radians([10.0]), np.radians([-20.0]), np.radians([0.0]))
        assert ned_from_gimbal(gimbal, "ned", None) is gimbal
        heading = ned_from_gimbal(gimbal, "heading", body)
        assert heading is not None
        # Level with the horizon: only the vehicle's heading is added.
        assert np.allclose(heading, ned_from_frd(np.radians([40.0]), np.radians([-20.0]), np.radians([0.0])))
        full = ned_from_gimbal(gimbal, "body", body)
        assert full is not None
        assert np.allclose(full, body @ gimbal)
        assert ned_from_gimbal(gimbal, "heading", None) is None

    def test_heading_of_a_body_pointing_down(self) -> None:
        straight = ned_from_frd(np.radians([50.0]), np.radians([-90.0]), np.radians([0.0]))
        assert np.allclose(heading_only(straight), ned_from_frd(np.radians([50.0]), 0.0, 0.0), atol=1e-9)

    def test_contradiction(self) -> None:
        one = ned_from_frd(np.radians([0.0, 10.0, 20.0]), np.zeros(3), np.zeros(3))
        other = ned_from_frd(np.radians([30.0, 40.0, 50.0]), np.zeros(3), np.zeros(3))
        assert contradiction_deg(one, other) == pytest.approx(30.0)

    def test_a_mount_that_is_not_stated(self) -> None:
        assert Mount().body_from_camera is None

    def test_camera_axes_are_those_of_the_tables(self) -> None:
        # A gimbal's FRD axes and enu_from_cam tell the same camera.
        q = quaternion_from_rotation(enu_from_cam(0.3, -0.4, 0.1))
        assert np.allclose(rotation_from_quaternion(q), enu_from_cam(0.3, -0.4, 0.1))
