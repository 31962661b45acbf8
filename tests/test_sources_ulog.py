"""PX4 ULog: counts against the library's own full read, every column against the recording, damage of every kind."""

import struct
from pathlib import Path

import numpy as np
import pytest
from fuzzing import check, mutations_wanted, survives
from hypothesis import given
from hypothesis import strategies as st
from pyulog import ULog

from pipeline.engine.errors import InputError
from pipeline.geometry.rotations import ned_from_frd, rotation_from_quaternion
from pipeline.simulation.flight import CONSUMER_DRONE, fly, logged_poses
from pipeline.simulation.logs.ulog import ulog
from pipeline.simulation.recording import EXTRA_TRIGGERS_S, Recording, record
from pipeline.simulation.site import Site
from pipeline.sources.px4.ulog import is_format, read
from pipeline.sources.records import Attitudes, FlightLog, Positions

REAL = ("foxglove/test_ulog.ulg", "pyulog/sample_log_small.ulg")
MAGIC = b"ULog\x01\x12\x35\x01" + bytes(8)
GPS_OLD = (
    "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;int32_t alt_ellipsoid;"
    "float eph;float epv;int32_t timestamp_time_relative;uint8_t fix_type;uint8_t[3] _padding0;"
)
GLOBAL = "uint64_t timestamp;double lat;double lon;float alt;uint8_t lat_lon_reset_counter;uint8_t alt_reset_counter;"
ATTITUDE = "uint64_t timestamp;float[4] q;uint8_t quat_reset_counter;"
GIMBAL = "uint64_t timestamp;uint16_t device_flags;float[4] q;"
CAPTURE = "uint64_t timestamp;uint32_t seq;int8_t result;"
TRIGGER = "uint64_t timestamp;uint32_t seq;bool feedback;"
S = 1_000_000


def message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


def log_of(topics: dict[str, tuple[str, str, list[tuple]]], extra: bytes = b"") -> bytes:
    """A ULog of topics given as (definition, struct code, records)."""
    names = [label.partition("#")[0] for label in topics]
    instances = [int(label.partition("#")[2] or 0) for label in topics]
    formats = dict(zip(names, (definition for definition, _, _ in topics.values()), strict=True))
    out = [MAGIC, extra, *(message("F", f"{name}:{text}".encode()) for name, text in formats.items())]
    for number, (name, instance) in enumerate(zip(names, instances, strict=True)):
        out.append(message("A", struct.pack("<BH", instance, number) + name.encode()))
    for number, (_, code, rows) in enumerate(topics.values()):
        out += [message("D", struct.pack("<H", number) + struct.pack(f"<{code}", *row)) for row in rows]
    return b"".join(out)


def read_bytes(folder: Path, data: bytes) -> FlightLog:
    path = folder / "flight.ulg"
    path.write_bytes(data)
    log = read(str(path))
    check(log)
    return log


def compact(data: bytes) -> bytes:
    """A log without the parameters and texts that nobody reads here, so that damage hits the rest."""
    out, at = [data[:16]], 16
    while at < len(data):
        after = at + 3 + int.from_bytes(data[at : at + 2], "little")
        out += [data[at:after]] if data[at + 2] not in b"PMQL" else []
        at = after
    return b"".join(out)


def gps_row(second: float, **changed: float) -> tuple:
    row = {
        "timestamp": int(second * S), "utc": 1_700_000_000 * S + int(second * S) - 120_000, "lat": 473_000_000,
        "lon": 85_000_000, "alt": 400_000, "ellipsoid": 447_500, "eph": 0.8, "epv": 1.1, "relative": 0, "fix": 3,
    } | changed  # fmt: skip
    return (*row.values(), b"")


@pytest.fixture(scope="module")
def recording() -> Recording:
    site = Site.seeded(7)
    return record(site, logged_poses(fly(site.terrain, 12, 7), CONSUMER_DRONE, 7))


@pytest.fixture(scope="module")
def written(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ulog") / "flight.ulg"
    path.write_bytes(ulog(recording))
    return path


@pytest.mark.real
@pytest.mark.parametrize("name", REAL)
def test_counts_are_those_of_the_library(shared: Path, name: str) -> None:
    path = shared / "data/logs/px4_ulg" / name
    whole = ULog(str(path))
    expected = {
        f"{data.name}[{data.multi_id}]" if data.multi_id else data.name: len(data.data["timestamp"])
        for data in whole.data_list
    }
    log = read(str(path))
    check(log)
    assert dict(log.counts) == expected
    assert log.facts["dropouts"] == len(whole.dropouts)
    for stream in (*log.positions, *log.attitudes):
        # Every record of the real files is good: none is lost on the way.
        assert len(stream.time_ns) == expected[stream.stream]
        data = next(d for d in whole.data_list if d.name == stream.stream and d.multi_id == 0).data
        sampled = data.get("timestamp_sample", np.zeros(1, np.uint64))
        stamps = sampled if sampled.any() else data["timestamp"]
        assert np.array_equal(stream.time_ns, stamps.astype(np.int64) * 1000)
    (attitude,) = log.attitudes
    data = whole.get_dataset("vehicle_attitude").data
    assert np.allclose(attitude.q_wxyz, np.stack([data[f"q[{i}]"] for i in range(4)], -1), atol=1e-6)


@pytest.mark.real
def test_a_real_flight_in_old_names(shared: Path) -> None:
    log = read(str(shared / "data/logs/px4_ulg" / REAL[0]))
    assert [(p.stream, len(p.time_ns), p.fused) for p in log.positions] == [
        ("vehicle_global_position", 34, True),
        ("sensor_gps", 6, False),
        ("vehicle_gps_position", 13, False),
    ]
    fused, _, gps = log.positions
    assert gps.latitude_deg[0] == pytest.approx(36.3691378, abs=1e-12)
    assert gps.ellipsoidal_m[0] - gps.amsl_m[0] == pytest.approx(19.992, abs=1e-9)
    # The filter's own ellipsoidal height lags behind by a decimetre, and is in the receiver's datum.
    assert 0.0 < np.abs(fused.ellipsoidal_m - fused.amsl_m - 19.992).max() < 0.25
    # Home moved once, in mid-flight (50.84 to 51.33 m).
    assert fused.above_home_m[:2] == pytest.approx(fused.amsl_m[:2] - 50.842648, abs=1e-5)
    assert fused.above_home_m[-1] == pytest.approx(fused.amsl_m[-1] - 51.328587, abs=1e-5)
    assert np.isfinite(fused.barometric_m[:-1]).all()
    base = log.time_base
    assert (base.epoch, base.late, base.source) == ("boot", True, "vehicle_gps_position.time_utc_usec")
    # 2025-12-10 by the receiver; arrivals scatter by 30 ms, though timestamp_time_relative is logged (as 0).
    offset_ns = base.anchor_utc_ns - base.anchor_log_ns
    assert 0.01e9 < np.ptp(offset_ns) < 0.05e9
    assert log.facts["firmware"] == "v1.14.3"
    assert log.facts["hardware"] == "PX4_FMU_V6C"
    assert log.losses == ()


@pytest.mark.real
def test_the_loggers_own_gaps_are_told(shared: Path) -> None:
    path = str(shared / "data/logs/px4_ulg" / REAL[1])
    assert [gap.duration for gap in ULog(path).dropouts] == [30]
    assert read(path).losses == ("the logger itself lost data 1 times, 0.030 s in all",)


def test_the_library_reads_what_is_written(recording: Recording, written: Path) -> None:
    whole = ULog(str(written), disable_str_exceptions=False)
    assert not whole.file_corruption
    assert {data.name: len(data.data["timestamp"]) for data in whole.data_list} == dict(read(str(written)).counts)
    captures = whole.get_dataset("camera_capture").data
    assert len(captures["timestamp"]) == 12 + len(EXTRA_TRIGGERS_S)
    assert whole.get_version_info_str() == "v1.15.0"
    stamps = whole.get_dataset("vehicle_global_position").data
    # The message's own position is that of the latest fix: up to 0.1 s old, never the exposure's.
    late_s = [t - stamps["timestamp_sample"][stamps["timestamp_sample"] <= t].max() for t in captures["timestamp"]]
    assert 0 <= min(late_s) <= max(late_s) <= 100_000
    assert ulog(recording) == written.read_bytes()


def test_the_recording_comes_back(recording: Recording, written: Path) -> None:
    log = read(str(written))
    check(log)
    assert log.losses == ()
    fused, gps = log.positions
    assert (fused.stream, fused.fused, gps.stream, gps.fused) == ("vehicle_global_position", True, "sensor_gps", False)
    for stream, rows in ((fused, slice(None)), (gps, list(recording.receiver))):
        assert np.abs(stream.time_ns / 1e9 - recording.position_s[rows]).max() < 0.6e-6
        assert np.array_equal(stream.latitude_deg, recording.latitude_deg[rows])
        assert np.array_equal(stream.longitude_deg, recording.longitude_deg[rows])
        assert np.abs(stream.ellipsoidal_m - recording.ellipsoidal_m[rows]).max() < 1e-5
        assert np.abs(stream.amsl_m - recording.amsl_m[rows]).max() < 1e-5
        assert stream.sigma_horizontal_m == pytest.approx(0.26)
        assert not np.any(stream.segment)
    above = recording.above_home_m + (recording.amsl_m - recording.above_home_m - recording.amsl_m[0])
    assert np.abs(fused.above_home_m - above - recording.above_home_m[0]).max() < 2e-5
    for attitude, angles, of in zip(
        log.attitudes, (recording.vehicle_rad, recording.gimbal_rad), ("vehicle", "gimbal"), strict=True
    ):
        assert (attitude.of, attitude.frame) == (of, "ned")
        assert np.abs(attitude.time_ns / 1e9 - recording.attitude_s).max() < 0.6e-6
        turned = rotation_from_quaternion(attitude.q_wxyz) - ned_from_frd(*angles.T)
        assert 1e-9 < np.abs(turned).max() < 3e-7
    (events,) = log.events
    assert (events.stream, events.feedback, events.sigma_s) == ("camera_capture", True, 0.001)
    assert np.abs(events.time_ns / 1e9 - recording.trigger_s).max() < 0.6e-6
    assert np.array_equal(events.number, np.arange(len(recording.trigger_s)))
    base = log.time_base
    assert np.array_equal(
        base.anchor_utc_ns - base.anchor_log_ns, np.full(len(recording.receiver), recording.boot_utc_ns)
    )
    assert log.facts == {"autopilot": "PX4", "hardware": "PX4_FMU_V6C", "firmware": "v1.15.0", "dropouts": 0}


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3, 0.5, 0.77, 0.999])
def test_a_cut_log_gives_what_came_before_the_cut(written: Path, tmp_path: Path, share: float) -> None:
    data = written.read_bytes()
    cut = read_bytes(tmp_path, data[: int(len(data) * share)])
    whole = read(str(written))
    kept = sum(cut.counts.values()) / sum(whole.counts.values())
    assert kept == pytest.approx(share, abs=0.02)
    for a, b in zip(cut.attitudes, whole.attitudes, strict=True):
        assert np.array_equal(a.q_wxyz, b.q_wxyz[: len(a.q_wxyz)])


@pytest.mark.parametrize("length", range(16))
def test_no_header_no_log(tmp_path: Path, length: int) -> None:
    with pytest.raises(InputError, match=r"E-ULOG-01(.|\n)*flight\.ulg"):
        read_bytes(tmp_path, MAGIC[:length])


def test_a_cut_in_the_definitions_leaves_nothing(written: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no records; the last message is cut short"):
        read_bytes(tmp_path, written.read_bytes()[:500])


def test_a_hole_costs_only_what_was_in_it(written: Path, tmp_path: Path) -> None:
    """The library alone loses all behind a hole that took no sync mark with it, or says nothing."""
    data = bytearray(written.read_bytes())
    data[40_000:41_000] = bytes(1000)
    log = read_bytes(tmp_path, bytes(data))
    lost = sum(read(str(written)).counts.values()) - sum(log.counts.values())
    assert 12 <= lost <= 22
    (loss,) = log.losses
    assert "in 1 damaged places were skipped" in loss
    assert 1000 <= int(loss.split()[0]) <= 1120


def test_a_lying_length_does_not_swallow_what_follows(written: Path, tmp_path: Path) -> None:
    data = bytearray(written.read_bytes())
    at = data.index(struct.pack("<HBH", 56, ord("D"), 4), 60_000)
    data[at : at + 2] = struct.pack("<H", 60_000)
    log = read_bytes(tmp_path, bytes(data))
    assert sum(read(str(written)).counts.values()) - sum(log.counts.values()) == 1
    assert log.losses == ("59 bytes in 1 damaged places were skipped",)


def test_a_damaged_definition_costs_its_topic(written: Path, tmp_path: Path) -> None:
    log = read_bytes(tmp_path, written.read_bytes().replace(b"vehicle_attitude:uint64_t", b"vehicle_attitude:uint99_t"))
    assert [a.of for a in log.attitudes] == ["gimbal"]
    assert len(log.positions) == 2
    assert any("all vehicle_attitude records are lost" in loss for loss in log.losses)
    renamed = read_bytes(
        tmp_path,
        written.read_bytes().replace(
            b"double lat;double lon;float alt;float alt_e", b"double xat;double lon;float alt;float alt_e"
        ),
    )
    assert [p.stream for p in renamed.positions] == ["sensor_gps"]
    n = renamed.counts["vehicle_global_position"]
    assert f"vehicle_global_position has no latitude and longitude: its {n} records were left out" in renamed.losses


def test_a_definition_without_end_is_refused(tmp_path: Path) -> None:
    bomb = b"".join(
        message("F", f"bomb{n}:{'uint8_t' if n == 0 else f'bomb{n - 1}'}[9999] x;".encode()) for n in range(6)
    ) + message("F", b"loop:loop x;")
    add = message("A", struct.pack("<BH", 0, 7) + b"bomb5") + message("A", struct.pack("<BH", 0, 8) + b"loop")
    data = log_of({"vehicle_attitude": (ATTITUDE, "Q4fB", [(S, 1, 0, 0, 0, 0)])}, bomb)
    at = data.index(message("D", b"")[2:3] + b"\0\0") - 2
    log = read_bytes(tmp_path, data[:at] + add + data[at:])
    assert len(log.attitudes[0].time_ns) == 1
    assert len(log.losses) == 2


def test_later_flags_are_refused(tmp_path: Path) -> None:
    flags = message("B", bytes(8) + b"\x02" + bytes(31))
    with pytest.raises(InputError, match="incompatible flags 02"):
        read_bytes(tmp_path, log_of({"vehicle_attitude": (ATTITUDE, "Q4fB", [(S, 1, 0, 0, 0, 0)])}, flags))


def test_data_appended_after_a_crash(tmp_path: Path) -> None:
    """What was dumped lies at an offset that the flags tell, in the middle of a message cut short."""
    rows = [(n * S, 1, 0, 0, 0, 0) for n in range(1, 9)]
    flags = message("B", bytes(8) + b"\x01" + bytes(7) + b"24 bytes for the offsets")
    plain = log_of({"vehicle_attitude": (ATTITUDE, "Q4fB", rows)}, flags)
    size = 2 + 25 + 3
    offset = len(plain) - 3 * size - 11
    data = plain[:offset] + plain[-3 * size :]
    data = data.replace(b"24 bytes for the offsets", struct.pack("<3Q", offset, 0, 0))
    log = read_bytes(tmp_path, data)
    assert (log.attitudes[0].time_ns // 10**9).tolist() == [1, 2, 3, 4, 6, 7, 8]
    assert log.losses == ()


def test_positions_break_where_the_estimator_was_reset(tmp_path: Path) -> None:
    resets = [(0, 0), (0, 0), (1, 0), (1, 0), (1, 1), (1, 1), (2, 1)]
    rows = [(n * S, 47.0, 8.0, 400.0, *reset) for n, reset in enumerate(resets, 1)]
    (stream,) = read_bytes(tmp_path, log_of({"vehicle_global_position": (GLOBAL, "QddfBB", rows)})).positions
    assert stream.segment.tolist() == [0, 0, 1, 1, 2, 2, 3]
    assert np.isnan(stream.ellipsoidal_m).all()
    turns = [(n * S, 1.0, 0.0, 0.0, 0.0, reset) for n, reset in enumerate((255, 255, 0, 0), 1)]
    (attitude,) = read_bytes(tmp_path, log_of({"vehicle_attitude": (ATTITUDE, "Q4fB", turns)})).attitudes
    assert attitude.segment.tolist() == [0, 0, 1, 1]


def test_the_receivers_geoid_stands_in_for_a_missing_ellipsoidal_height(tmp_path: Path) -> None:
    log = read_bytes(
        tmp_path,
        log_of(
            {
                "vehicle_global_position": (GLOBAL, "QddfBB", [(n * S, 47.3, 8.5, 401.5, 0, 0) for n in range(1, 5)]),
                "vehicle_gps_position": (GPS_OLD, "QQiiiiffiB3s", [gps_row(n) for n in (1.0, 2.0, 3.0)]),
            }
        ),
    )
    fused, gps = log.positions
    assert fused.ellipsoidal_m == pytest.approx(449.0)
    assert (gps.latitude_deg[0], gps.amsl_m[0], gps.ellipsoidal_m[0]) == pytest.approx((47.3, 400.0, 447.5))
    assert np.isnan(fused.sigma_horizontal_m).all()


def test_a_lost_fix_breaks_the_receivers_positions_and_is_no_damage(tmp_path: Path) -> None:
    rows = [
        gps_row(1.0),
        gps_row(2.0),
        gps_row(3.0, fix=2, lat=0, lon=0),
        gps_row(4.0),
        gps_row(5.0, lat=2_000_000_000),
    ]
    log = read_bytes(
        tmp_path,
        log_of({"sensor_gps": (GPS_OLD, "QQiiiiffiB3s", rows), "sensor_gps#1": (GPS_OLD, "QQiiiiffiB3s", rows[:1])}),
    )
    first, second = log.positions
    assert (first.stream, second.stream) == ("sensor_gps", "sensor_gps[1]")
    assert (first.time_ns // 10**9).tolist() == [1, 2, 4]
    assert first.segment.tolist() == [0, 0, 1]
    assert log.losses == ("1 of 5 sensor_gps records hold impossible values or times and were left out",)
    assert dict(log.counts) == {"sensor_gps": 5, "sensor_gps[1]": 1}


def test_utc_comes_with_the_time_the_message_names(tmp_path: Path) -> None:
    rows = [gps_row(1.0, utc=0), gps_row(2.0, relative=-50_000), gps_row(3.0)]
    base = read_bytes(tmp_path, log_of({"sensor_gps": (GPS_OLD, "QQiiiiffiB3s", rows)})).time_base
    assert base.anchor_log_ns.tolist() == [1_950_000_000, 3_000_000_000]
    assert base.anchor_utc_ns.tolist() == [1_700_000_001_880_000_000, 1_700_000_002_880_000_000]
    assert base.problem == ""
    jumps = [gps_row(1.0), gps_row(2.0, utc=1_700_000_010 * S)]
    base = read_bytes(tmp_path, log_of({"sensor_gps": (GPS_OLD, "QQiiiiffiB3s", jumps)})).time_base
    assert base.anchor_log_ns.tolist() == [1_000_000_000]
    assert base.problem == "1 of 2 sensor_gps.time_utc_usec messages name another time and were left out"
    nothing = read_bytes(tmp_path, log_of({"sensor_gps": (GPS_OLD, "QQiiiiffiB3s", rows[:1])})).time_base
    assert not len(nothing.anchor_log_ns)
    assert "no receiver gave UTC" in nothing.problem


@pytest.mark.parametrize(
    ("flags", "frame"),
    [
        (64, "ned"),
        (32, "heading"),
        (16, "ned"),
        (0, "heading"),
        (16 | 32, "heading"),
        (12 | 64, "ned"),
        (12, "heading"),
    ],
)
def test_the_gimbals_frame_is_told_by_its_flags(tmp_path: Path, flags: int, frame: str) -> None:
    half = np.sqrt(0.5)
    rows = [(n * S, flags, half, 0.0, -half, 0.0) for n in (1, 2)]
    (stream,) = read_bytes(tmp_path, log_of({"gimbal_device_attitude_status": (GIMBAL, "QH4f", rows)})).attitudes
    assert (stream.of, stream.frame) == ("gimbal", frame)
    # Straight down: x, the optical axis, along +z of NED.
    assert rotation_from_quaternion(stream.q_wxyz[0]) @ (1.0, 0.0, 0.0) == pytest.approx((0.0, 0.0, 1.0), abs=1e-6)


def test_a_gimbal_that_changes_its_frame_is_two_streams(tmp_path: Path) -> None:
    rows = [(n * S, flags, 1.0, 0.0, 0.0, 0.0) for n, flags in enumerate((64, 64, 32, 32, 64), 1)]
    log = read_bytes(tmp_path, log_of({"gimbal_device_attitude_status": (GIMBAL, "QH4f", rows)}))
    assert [(a.frame, a.segment.tolist()) for a in log.attitudes] == [("ned", [0, 0, 1]), ("heading", [0, 0])]


def test_captures_and_triggers(tmp_path: Path) -> None:
    topics = {
        "camera_capture": (CAPTURE, "QIb", [(1 * S, 0, 1), (3 * S, 1, 0), (5 * S, 2, 1)]),
        "camera_trigger": (TRIGGER, "QI?", [(1 * S, 0, False), (1 * S + 30, 0, True), (5 * S, 2, False)]),
    }
    log = read_bytes(tmp_path, log_of(topics))
    told = [(e.stream, e.feedback, e.sigma_s, e.number.tolist(), e.time_ns.tolist()) for e in log.events]
    assert told == [
        ("camera_capture", True, 0.001, [0, 2], [10**9, 5 * 10**9]),
        ("camera_trigger (feedback)", True, 0.001, [0], [10**9 + 30_000]),
        ("camera_trigger", False, 0.05, [0, 2], [10**9, 5 * 10**9]),
    ]
    assert log.losses == ("1 camera_capture records tell of a capture that failed",)
    # With the feedback switched off a capture is published for every trigger, whatever the camera did.
    off = message("P", bytes([21]) + b"int32_t CAM_CAP_FBACK" + bytes(4))
    echo = read_bytes(tmp_path, log_of({"camera_capture": topics["camera_capture"]}, off)).events[0]
    assert (echo.feedback, echo.sigma_s) == (False, 0.05)


def test_one_flipped_time_costs_one_record(tmp_path: Path) -> None:
    times = [1, 2, 3, 2**40, 5, 6]
    rows = [(t * S, 1, 0, 0, 0, 0) for t in times]
    log = read_bytes(tmp_path, log_of({"vehicle_attitude": (ATTITUDE, "Q4fB", rows)}))
    assert (log.attitudes[0].time_ns // 10**9).tolist() == [1, 2, 3, 5, 6]
    assert log.losses == ("1 of 6 vehicle_attitude records hold impossible values or times and were left out",)


def test_the_format_is_told_by_its_magic(written: Path) -> None:
    assert is_format(written.read_bytes()[:4096], "renamed.dat")
    assert not is_format(b"", "flight.ulg")
    assert not is_format(b"\xa3\x95\x80", "flight.ulg")


@given(st.binary(max_size=200), st.integers(0, 400))
def test_any_bytes_in_a_log(written: Path, tmp_path_factory: pytest.TempPathFactory, junk: bytes, at: int) -> None:
    data = written.read_bytes()[:12_000]
    place = 2000 + at * 20
    log = read_bytes(tmp_path_factory.getbasetemp(), data[:place] + junk + data[place:])
    assert sum(log.counts.values()) >= sum(read_bytes(tmp_path_factory.getbasetemp(), data).counts.values()) - 2


@pytest.mark.real
@pytest.mark.parametrize("name", REAL)
def test_fuzz_a_real_log(shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    data = (shared / "data/logs/px4_ulg" / name).read_bytes()
    crop = compact(data)[:60_000]
    outcomes = survives(read, crop, tmp_path / "flight.ulg", mutations_wanted())
    whole = survives(read, data, tmp_path / "flight.ulg", 10, seed=1)
    assert outcomes["partial"] > outcomes["refused"]
    assert whole["partial"] + whole["whole"] >= 8
    assert capsys.readouterr().out == ""


def test_fuzz_a_written_log(written: Path, tmp_path: Path) -> None:
    outcomes = survives(read, written.read_bytes()[:20_000], tmp_path / "flight.ulg", mutations_wanted())
    assert outcomes["partial"] > outcomes["refused"]


def test_streams_are_of_the_promised_types(written: Path) -> None:
    log = read(str(written))
    for stream in (*log.positions, *log.attitudes):
        assert isinstance(stream, Positions | Attitudes)
        for name in stream.__slots__:
            value = getattr(stream, name)
            if isinstance(value, np.ndarray):
                assert value.dtype == (np.int64 if name in {"time_ns", "segment"} else np.float64), name
