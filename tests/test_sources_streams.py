"""What all readers share: order, other instants, heights by the receiver, angles, and anchors to UTC."""

from __future__ import annotations

from bisect import bisect_right
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import rotation_from_quaternion
from pipeline.sources.mavlink.gimbal_flags import yaw_frames
from pipeline.sources.records import NS_PER_S, Nanoseconds, Positions, nothing
from pipeline.sources.streams import (
    borrowed,
    in_order,
    interpolated,
    is_place,
    is_rotation,
    ned_quaternions,
    segments,
    separation_m,
)
from pipeline.sources.time_bases import boot_time_base, unix_us


def seconds(*values: float) -> Nanoseconds:
    return np.rint(np.array(values) * NS_PER_S).astype(np.int64)


def receiver(time_ns: Nanoseconds, ellipsoidal_m: Floats, amsl_m: Floats) -> Positions:
    n = len(time_ns)
    unknown = nothing(n)
    return Positions(
        "GPS", time_ns, np.full(n, 47.0), np.full(n, 8.0), ellipsoidal_m, amsl_m, unknown, unknown, unknown, unknown,
        np.zeros(n, np.int64), fused=False,
    )  # fmt: skip


@given(st.lists(st.integers(0, 50), max_size=60))
def test_the_longest_run_in_order_is_kept(times: list[int]) -> None:
    kept = np.array(times, np.int64)[in_order(np.array(times, np.int64))]
    assert np.all(np.diff(kept) >= 0)
    tails: list[int] = []
    for value in times:
        place = bisect_right(tails, value)
        tails[place : place + 1] = [value]
    assert len(kept) == len(tails)


def test_segments_change_with_the_counter() -> None:
    assert segments(seconds(0, 1, 2, 3), np.array([7, 7, 3, 3])).tolist() == [0, 0, 1, 1]
    assert segments(seconds(0, 1)).tolist() == [0, 0]


def test_places_are_on_earth_and_not_where_there_is_no_fix() -> None:
    latitude, longitude = np.array([0.0, 0.0, 90.0, 91.0, np.nan]), np.array([0.0, 8.0, -180.0, 8.0, 8.0])
    assert is_place(latitude, longitude).tolist() == [False, True, True, False, False]


def test_other_instants_pass_over_what_is_not_known() -> None:
    values = np.array([1.0, np.nan, 3.0])
    at = seconds(-1, 1, 5)
    assert interpolated(seconds(0, 1, 2), values, at, ends_hold=True).tolist() == [1.0, 2.0, 3.0]
    assert np.isnan(interpolated(seconds(0, 1, 2), values, at, ends_hold=False)).tolist() == [True, False, True]
    assert np.isnan(interpolated(seconds(0), np.array([np.nan]), at, ends_hold=True)).all()


def test_the_separation_is_the_first_receivers_that_tells_one() -> None:
    silent = receiver(seconds(0, 1), nothing(2), np.array([400.0, 400.0]))
    # 300 m apart is another unit, or damage.
    telling = receiver(seconds(0, 1, 2), np.array([447.0, 700.0, 449.0]), np.array([400.0, 400.0, 400.0]))
    assert np.isnan(separation_m(telling)).tolist() == [False, True, False]
    assert borrowed([silent, telling], separation_m, seconds(1, 9)).tolist() == [48.0, 49.0]
    assert np.isnan(borrowed([silent], separation_m, seconds(1))).all()


def test_angles_are_those_a_pilot_reads() -> None:
    q_wxyz = ned_quaternions(*np.radians([[90.0, 0.0, np.nan], [0.0, -90.0, 0.0], [0.0, 0.0, 0.0]]))
    ahead = rotation_from_quaternion(q_wxyz[:2])[:, :, 0]
    assert ahead == pytest.approx(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), abs=1e-12)
    assert np.isnan(q_wxyz[2]).all()
    assert is_rotation(np.array([[1.0, 0, 0, 0], [0, 0, 0, 0], [np.nan, 0, 0, 1], [0, 0, 1e200, 0]])).tolist() == [
        True, False, False, False,
    ]  # fmt: skip


def test_flags_say_what_a_gimbals_yaw_is_measured_from() -> None:
    """Lock 16, vehicle frame 32, earth frame 64; an explicit frame comes before the lock, both at once are none."""
    from_north, from_heading = yaw_frames(np.array([0, 16, 32, 64, 16 | 32, 32 | 64]))
    assert from_north.tolist() == [False, True, False, True, False, False]
    assert from_heading.tolist() == [True, False, True, False, True, False]


def test_anchors_that_name_another_time_are_left_out_and_told() -> None:
    start_ns = 1_700_000_000 * NS_PER_S
    log_ns = seconds(3, 1, 2, 4)
    utc_ns = start_ns + log_ns
    utc_ns[2] += 18 * NS_PER_S
    base = boot_time_base(log_ns, utc_ns, "GPS", late=True)
    assert base.anchor_log_ns.tolist() == seconds(1, 3, 4).tolist()
    assert (base.anchor_utc_ns - base.anchor_log_ns == start_ns).all()
    assert base.problem == "1 of 4 GPS messages name another time and were left out"
    # Of two that disagree one stays: no median lies between them.
    assert len(boot_time_base(log_ns[1:3], utc_ns[1:3], "GPS", late=True).anchor_log_ns) == 1


def test_moments_are_exact_to_the_microsecond() -> None:
    assert unix_us(datetime(2024, 6, 1, 8, 12, 3, 250_001, tzinfo=UTC)) == 1_717_229_523_250_001
