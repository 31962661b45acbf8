"""Photos made of real logs, their clocks and places hidden, brought back to them; real tracks between their samples."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import rotation_from_quaternion, vector_from_rotation
from pipeline.placing.place import place
from pipeline.placing.pose import LONGEST_ATTITUDE_GAP_S, LONGEST_POSITION_GAP_S, level_track
from pipeline.placing.timeline import Timeline, timeline
from pipeline.sources.dji import Position
from pipeline.sources.logs import read_log
from pipeline.sources.photos import PhotoRecord
from pipeline.tracks.mount import Mount
from pipeline.tracks.series import bend, between, bracket, slerp, turn_bend

pytestmark = pytest.mark.real

AIRDATA = "logs/dji_csv/Jan-4th-2024-02-19PM-Flight-Airdata.csv"
DATAFLASH = "logs/ardupilot_bin/3.BIN"
TLOG = "logs/ardupilot_tlog/flight.tlog"
HUSKY = "bags/robot_localization/test1.bag"
DOWN = Mount((0.0, float(np.radians(-90.0)), 0.0))


def line_of(shared: Path, name: str) -> Timeline:
    return timeline(read_log(str(shared / "data" / name)))


def photos(utc_ns: np.ndarray, fast_s: float, tick_s: float, places: Sequence[Position | None]) -> list[PhotoRecord]:
    """Photos that a camera with a wrong clock would have taken."""
    shown_s = np.floor((utc_ns / 1e9 - fast_s) / tick_s + 1e-6) * tick_s
    return [
        PhotoRecord(
            f"IMG_{k + 1:04d}.JPG", f"IMG_{k + 1:04d}", width=4000, height=3000, make="A", model="B",
            time=datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=round(float(s), 3)),
            time_source="exif (zone unknown)", position=at, pose_problem="no GPS position" if at is None else "",
        )
        for k, (s, at) in enumerate(zip(shown_s, places, strict=True))
    ]  # fmt: skip


class TestClocks:
    @pytest.mark.parametrize("lost", [(), (0,), (3, 7), (15,)])
    def test_photos_of_airdata_find_their_rows(self, shared: Path, lost: tuple[int, ...]) -> None:
        """The aircraft's own list of its photos, against whole EXIF seconds of an unknown zone."""
        line = line_of(shared, AIRDATA)
        events = line.events[0]
        kept = np.delete(np.arange(len(events.time_ns)), lost)
        taken = photos(line.utc_ns(events.time_ns[kept]), -18_000.4, 1.0, [None] * len(kept))
        found = place(taken, [line], {}, Mount(), clock_offset_s=None, y_up=False)
        placed = [k for k, record in enumerate(found.records) if record.time_source == "log event"]
        assert len(placed) >= len(kept) - 2
        for k in placed:
            time = found.records[k].time
            assert time is not None
            at_ns = (time - datetime(1970, 1, 1, tzinfo=UTC)) / timedelta(microseconds=1) * 1000
            assert abs(at_ns - int(line.utc_ns(events.time_ns[kept[k : k + 1]])[0])) < 2e6
        assert all(record.problem for k, record in enumerate(found.records) if k not in placed)
        assert found.clocks[0]["offset_s"] == pytest.approx(-18_000.4, abs=0.6)

    @pytest.mark.parametrize(("name", "count"), [(AIRDATA, 40), (DATAFLASH, 40), (TLOG, 60), (HUSKY, 40)])
    def test_photos_with_rounded_places_tell_the_offset(self, shared: Path, name: str, count: int) -> None:
        line = line_of(shared, name)
        positions = line.positions
        assert positions is not None
        n = len(positions.time_ns)
        rows = np.linspace(0.1 * n, 0.9 * n, count).astype(np.int64)
        places = [
            Position(round(float(positions.latitude_deg[k]), 5), round(float(positions.longitude_deg[k]), 5), "exif")
            for k in rows
        ]
        taken = photos(line.utc_ns(positions.time_ns[rows]), 7_203.7, 0.001, places)
        found = place(taken, [line], {}, DOWN, clock_offset_s=None, y_up=False)
        row = found.clocks[0]
        assert "positions of" in row["method"]
        assert abs(row["offset_s"] - 7_203.7) < max(4.0 * row["sigma_s"], 0.3)
        assert row["sigma_s"] < 1.0


def every_second(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(0, count, 2), np.arange(1, count - 1, 2)


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


class TestBetweenSamples:
    """Every second sample is dropped and told by its neighbours: the error against what `bend` says of it."""

    @pytest.mark.parametrize("name", [AIRDATA, TLOG, HUSKY])
    def test_positions(self, shared: Path, name: str) -> None:
        positions = line_of(shared, name).positions
        assert positions is not None
        _, track_m = level_track(positions)
        keep, asked = every_second(len(track_m))
        time_ns, segment = positions.time_ns[keep], positions.segment[keep]
        where = bracket(time_ns, segment, positions.time_ns[asked], LONGEST_POSITION_GAP_S)
        known = where.known & (where.step_s > 0.0)
        error_m = (between(track_m[keep], where) - track_m[asked])[known]
        told_m = bend(track_m[keep], time_ns, segment, where, LONGEST_POSITION_GAP_S)[known]
        # The dropped sample has noise of its own, which is no error of the line: 3 cm, the last digit and a little.
        assert 0.4 < rms(error_m) / np.hypot(rms(told_m), 0.01) < 3.0

    @pytest.mark.parametrize(("name", "gimbal"), [(DATAFLASH, False), (TLOG, False), (AIRDATA, True), (HUSKY, False)])
    def test_attitudes(self, shared: Path, name: str, gimbal: bool) -> None:
        line = line_of(shared, name)
        stream = line.gimbal if gimbal else line.vehicle
        assert stream is not None
        keep, asked = every_second(len(stream.time_ns))
        q, time_ns, segment = stream.q_wxyz[keep], stream.time_ns[keep], stream.segment[keep]
        where = bracket(time_ns, segment, stream.time_ns[asked], LONGEST_ATTITUDE_GAP_S)
        known = where.known & (where.step_s > 0.0)
        found, true = (
            rotation_from_quaternion(slerp(q, where)[known]),
            rotation_from_quaternion(stream.q_wxyz[asked])[known],
        )
        error = np.linalg.norm(vector_from_rotation(found @ np.swapaxes(true, -1, -2)), axis=1)
        told = turn_bend(q, time_ns, segment, where, LONGEST_ATTITUDE_GAP_S)[known]
        ratio = rms(error) / rms(told)
        assert 0.4 < ratio < 2.5
