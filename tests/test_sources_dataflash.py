"""ArduPilot DataFlash: the library's own iteration as oracle, columns against the recording, damage of all kinds."""

import contextlib
import io
import math
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from big_logs import write_dataflash
from fuzzing import check, mutations_wanted, survives
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.DFReader import DFReader_binary

from pipeline.engine.errors import InputError
from pipeline.geometry.rotations import ned_from_frd, rotation_from_quaternion
from pipeline.simulation.flight import CONSUMER_DRONE, fly, logged_poses
from pipeline.simulation.logs.dataflash import FIRMWARE, MESSAGES, dataflash
from pipeline.simulation.recording import SIGMA_HORIZONTAL_M, Recording, record
from pipeline.simulation.site import Site
from pipeline.sources.dataflash import walk as dataflash_walk
from pipeline.sources.dataflash.fields import WANTED, Found
from pipeline.sources.dataflash.reader import is_format, read
from pipeline.sources.records import FlightLog

REAL = "data/logs/ardupilot_bin/3.BIN"
HEAD = b"\xa3\x95"
S = 1_000_000
POS = ("QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt")
GPS = ("QBBIHBcLLe", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt")
GPA = ("QBCCIe", "TimeUS,I,HAcc,VAcc,SMS,AEl")
ATT = ("QccC", "TimeUS,Roll,Pitch,Yaw")
MNT = ("QBffff", "TimeUS,I,Roll,Pitch,YawB,YawE")
CAM = ("QBH", "TimeUS,I,Img")
PARM = ("QNf", "TimeUS,Name,Value")
CODES = {
    "B": "B", "H": "H", "I": "I", "Q": "Q", "f": "f", "c": "h", "C": "H", "e": "i", "L": "i", "N": "16s", "i": "i",
    "h": "h", "n": "4s", "Z": "64s", "b": "b",
}  # fmt: skip


def fmt(kind: int, name: str, letters: str, columns: str, length: int | None = None) -> bytes:
    """An FMT message; its length is the fields' unless another is said."""
    size = 3 + struct.calcsize("<" + "".join(CODES[letter] for letter in letters))
    texts = (text.encode() for text in (name, letters, columns))
    return HEAD + struct.pack("<BBB4s16s64s", 128, kind, size if length is None else length, *texts)


def rows_of(kind: int, letters: str, rows: list[tuple]) -> list[bytes]:
    code = "<" + "".join(CODES[letter] for letter in letters)
    return [HEAD + bytes([kind]) + struct.pack(code, *row) for row in rows]


def log_of(messages: dict[str, tuple[tuple[str, str], list[tuple]]]) -> bytes:
    """A log of messages given as (format, rows of stored numbers), one kind after another."""
    out = [fmt(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
    out += [fmt(140 + n, name, *form) for n, (name, (form, _)) in enumerate(messages.items())]
    for n, ((letters, _), rows) in enumerate(messages.values()):
        out += rows_of(140 + n, letters, rows)
    return b"".join(out)


def read_bytes(folder: Path, data: bytes, name: str = "flight.BIN") -> FlightLog:
    path = folder / name
    path.write_bytes(data)
    log = read(str(path))
    check(log)
    return log


def library(path: Path) -> dict[str, list[Any]]:
    """All messages that pymavlink delivers."""
    reader = DFReader_binary(str(path))
    out: dict[str, list[Any]] = {}
    while (message := reader.recv_msg()) is not None:
        out.setdefault(message.get_type(), []).append(message)
    reader.close()
    return out


def counts_of(messages: dict[str, list[Any]]) -> dict[str, int]:
    return {name: len(found) for name, found in messages.items()}


def stream(log: FlightLog, name: str) -> Any:
    (found,) = (s for s in (*log.positions, *log.attitudes, *log.events) if s.stream == name)
    return found


@pytest.fixture(scope="module")
def recording() -> Recording:
    site = Site.seeded(7)
    return record(site, logged_poses(fly(site.terrain, 24, 7), CONSUMER_DRONE, 7))


@pytest.fixture(scope="module")
def simulated(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "flight.BIN"
    path.write_bytes(dataflash(recording))
    return path


# The real file


@pytest.mark.real
def test_counts_of_a_real_log_are_the_librarys(shared: Path) -> None:
    log = read(str(shared / REAL))
    check(log)
    assert log.counts == counts_of(library(shared / REAL))
    # The vehicle was cut off while it wrote: the library's index counts that ATT, its iteration does not.
    assert log.losses == ("the log ends in the middle of a message",)
    assert log.facts == {"firmware": "ArduCopter V3.2.1 (36b405fb)", "parameters": 417}


@pytest.mark.real
def test_numbers_of_a_real_log_are_the_librarys(shared: Path) -> None:
    log, messages = read(str(shared / REAL)), library(shared / REAL)
    gps, att, backup = (stream(log, name) for name in ("GPS", "ATT", "AHR2"))
    fixes = messages["GPS"]
    assert np.array_equal(gps.time_ns, [m.T * 1_000_000 for m in fixes])
    assert np.array_equal(gps.latitude_deg, [m.Lat for m in fixes])
    assert np.array_equal(gps.longitude_deg, [m.Lng for m in fixes])
    assert np.array_equal(gps.amsl_m, [m.Alt for m in fixes])
    assert np.array_equal(gps.above_home_m, [m.RelAlt for m in fixes])
    assert np.isnan(gps.ellipsoidal_m).all()
    assert not gps.fused
    # Old firmware has no POS: the backup's estimate is told, but not preferred.
    assert not backup.fused
    assert np.array_equal(backup.amsl_m, [m.Alt for m in messages["AHR2"]])
    turns = messages["ATT"]
    expected = ned_from_frd(*(np.radians([getattr(m, f) for m in turns]) for f in ("Yaw", "Pitch", "Roll")))
    assert np.allclose(rotation_from_quaternion(att.q_wxyz), expected, atol=1e-12)
    assert (att.of, att.frame) == ("vehicle", "ned")
    assert np.array_equal(att.time_ns, [m.TimeMS * 1_000_000 for m in turns])
    inside = [t - 106_411_000_000 >= 0 and t <= 251_274_000_000 for t in gps.time_ns]
    barometer = np.interp(gps.time_ns, [m.TimeMS * 1e6 for m in messages["BARO"]], [m.Alt for m in messages["BARO"]])
    assert np.allclose(gps.barometric_m[inside], barometer[inside], atol=1e-9)


@pytest.mark.real
def test_time_of_a_real_log(shared: Path) -> None:
    base = read(str(shared / REAL)).time_base
    assert (base.epoch, base.late, base.problem) == ("boot", True, "")
    # GPS week 1851 began on 2015-06-28; 19,166.2 s into it, 16 leap seconds before UTC.
    began = np.datetime64("2015-06-28T05:19:10.200", "ns").astype(np.int64)
    assert base.anchor_utc_ns[0] == began
    assert base.anchor_log_ns[0] == 106_422_000_000
    # The receiver was silent for eight seconds: nothing may be interpolated across.
    gps = read(str(shared / REAL)).positions[0]
    (after,) = np.flatnonzero(np.diff(gps.segment)) + 1
    assert gps.time_ns[after] - gps.time_ns[after - 1] == 8_215_000_000


@pytest.mark.real
def test_a_text_dump_reads_as_its_binary(shared: Path, tmp_path: Path) -> None:
    binary, messages = read(str(shared / REAL)), library(shared / REAL)
    lines = []
    reader = DFReader_binary(str(shared / REAL))
    while (message := reader.recv_msg()) is not None:
        values = [getattr(message, name) for name in message._fieldnames]
        lines.append(", ".join([message.get_type(), *(v if isinstance(v, str) else repr(v) for v in values)]))
    reader.close()
    text = read_bytes(tmp_path, "\n".join(lines).encode(), "flight.log")
    assert text.counts == counts_of(messages)
    assert (text.losses, text.facts) == ((), binary.facts)
    assert text.kind == "ArduPilot DataFlash (text)"
    for ours, other in zip((*text.positions, *text.attitudes), (*binary.positions, *binary.attitudes), strict=True):
        assert (ours.stream, len(ours.time_ns)) == (other.stream, len(other.time_ns))
        for name in ours.__slots__:
            value = getattr(ours, name)
            if isinstance(value, np.ndarray):
                np.testing.assert_array_equal(value, getattr(other, name), err_msg=f"{ours.stream} {name}")
    assert np.array_equal(text.time_base.anchor_utc_ns, binary.time_base.anchor_utc_ns)
    assert np.array_equal(text.time_base.anchor_log_ns, binary.time_base.anchor_log_ns)


# The simulated file


def test_the_library_reads_what_the_simulation_writes(simulated: Path, recording: Recording) -> None:
    messages = library(simulated)
    log = read(str(simulated))
    check(log)
    assert log.counts == counts_of(messages)
    assert set(log.counts) == set(MESSAGES)
    assert log.losses == ()
    assert log.facts == {"firmware": FIRMWARE, "parameters": 3}
    cam, pos = messages["CAM"], messages["POS"]
    assert [m.Img for m in cam] == list(range(1, len(recording.trigger_s) + 1))
    # CAM's own place is that of the latest POS when it is written, not of its time.
    written = [max((p for p in pos if p.TimeUS <= m.TimeUS + 8000), key=lambda p: p.TimeUS) for m in cam]
    assert [(m.Lat, m.Lng) for m in cam] == [(p.Lat, p.Lng) for p in written]
    reader = DFReader_binary(str(simulated))
    # The library's own clock: GPS week and GPS's time of writing, 0.12 s after the sample.
    assert abs(reader.clock.timebase + 0.12 - recording.boot_utc_ns / 1e9) < 0.001
    reader.close()


def test_positions_are_the_recordings(simulated: Path, recording: Recording) -> None:
    log = read(str(simulated))
    pos, gps = stream(log, "POS"), stream(log, "GPS")
    assert (log.positions[0].stream, pos.fused, gps.fused) == ("POS", True, False)
    assert np.array_equal(pos.time_ns, np.rint(recording.position_s * 1e6) * 1e3)
    assert np.allclose(pos.latitude_deg, recording.latitude_deg, rtol=0, atol=0.51e-7)
    assert np.allclose(pos.longitude_deg, recording.longitude_deg, rtol=0, atol=0.51e-7)
    assert np.allclose(pos.amsl_m, recording.amsl_m, rtol=0, atol=2e-5)
    assert np.allclose(pos.above_home_m, recording.above_home_m, rtol=0, atol=1e-5)
    # The receiver logs centimetres, so the separation is right to one.
    assert np.allclose(pos.ellipsoidal_m, recording.ellipsoidal_m, rtol=0, atol=0.0101)
    assert np.allclose(pos.sigma_horizontal_m, SIGMA_HORIZONTAL_M, rtol=0, atol=1e-9)
    which = list(recording.receiver)
    assert np.array_equal(gps.time_ns, np.rint(recording.position_s[which] * 1e6) * 1e3 + 120_000_000)
    assert np.allclose(gps.ellipsoidal_m, recording.ellipsoidal_m[which], rtol=0, atol=0.0051)
    assert np.allclose(gps.latitude_deg, recording.latitude_deg[which], rtol=0, atol=0.51e-7)
    assert set(pos.segment.tolist()) == set(gps.segment.tolist()) == {0}


def test_attitudes_are_the_recordings(simulated: Path, recording: Recording) -> None:
    log = read(str(simulated))
    for name, of, expected, tolerance_deg in (
        ("ATT", "vehicle", recording.vehicle_rad, 0.01),
        ("MNT", "gimbal", recording.gimbal_rad, 1e-4),
    ):
        turned = stream(log, name)
        assert (turned.of, turned.frame) == (of, "ned")
        # The MNT that is written with each CAM, under the exposure's time but with later angles, is not among them.
        assert np.array_equal(turned.time_ns, np.rint(recording.attitude_s * 1e6) * 1e3)
        between = np.swapaxes(ned_from_frd(*expected.T), -1, -2) @ rotation_from_quaternion(turned.q_wxyz)
        angle = np.degrees(np.arccos(np.clip((np.trace(between, axis1=-2, axis2=-1) - 1.0) / 2.0, -1.0, 1.0)))
        assert angle.max() < tolerance_deg


def test_events_and_time_are_the_recordings(simulated: Path, recording: Recording) -> None:
    log = read(str(simulated))
    (cam,) = log.events
    assert np.array_equal(cam.time_ns, np.rint(recording.trigger_s * 1e6) * 1e3)
    assert np.array_equal(cam.number, np.arange(1, len(recording.trigger_s) + 1))
    assert (cam.stream, cam.feedback, cam.sigma_s) == ("CAM", True, 0.001)
    base = log.time_base
    assert (base.epoch, base.late, base.source, base.problem) == ("boot", True, "GPS (GPA.SMS)", "")
    assert len(base.anchor_log_ns) == len(recording.receiver)
    # GMS and SMS are whole milliseconds.
    assert np.abs(base.anchor_utc_ns - base.anchor_log_ns - recording.boot_utc_ns).max() <= 1_000_000


# What firmware and receivers do


def second(n: int, us: int = S) -> list[int]:
    return [n0 * us for n0 in range(1, n + 1)]


def gps_row(time_us: int, *, instance: int = 0, status: int = 3, week: int = 2317, lat: int = 480000000) -> tuple:
    return (time_us, instance, status, time_us // 1000, week, 17, 70, lat, 110000000, 52000)


def test_gps_alone_is_the_position_stream(tmp_path: Path) -> None:
    log = read_bytes(tmp_path, log_of({"GPS": (GPS, [gps_row(t) for t in second(5)])}))
    (gps,) = log.positions
    assert gps.latitude_deg[0] == 48.0
    assert np.isnan(gps.ellipsoidal_m).all()
    assert log.time_base.source == "GPS (as written)"
    assert log.time_base.late


@pytest.mark.parametrize("unknown", [-(2**31), 5_000_000])
def test_heights_above_the_ellipsoid(tmp_path: Path, unknown: int) -> None:
    """INT32_MIN says unknown; 50 km from sea level is another unit, and is said to be left out."""
    heights = [56650, unknown, 56660]
    gpa = [(t, 0, 40, 0, t // 1000, h) for t, h in zip(second(3), heights, strict=True)]
    pos = [(t + 1000, 480000000, 110000000, 530.0, 10.0, 10.0) for t in second(3)]
    log = read_bytes(
        tmp_path, log_of({"GPS": (GPS, [gps_row(t) for t in second(3)]), "GPA": (GPA, gpa), "POS": (POS, pos)})
    )
    gps = stream(log, "GPS")
    assert np.array_equal(gps.ellipsoidal_m, [566.5, np.nan, 566.6], equal_nan=True)
    assert np.allclose(stream(log, "POS").ellipsoidal_m, 530.0 + np.array([46.5, 46.55, 46.6]), rtol=0, atol=1e-3)
    assert np.array_equal(gps.sigma_horizontal_m, [0.4] * 3)
    assert np.isnan(gps.sigma_vertical_m).all()
    assert bool(log.losses) == (unknown > 0)


def test_undulation_of_older_firmware(tmp_path: Path) -> None:
    gpa = (("QBf", "TimeUS,I,Und"), [(t, 0, -46.5) for t in second(3)])
    log = read_bytes(tmp_path, log_of({"GPS": (GPS, [gps_row(t) for t in second(3)]), "GPA": gpa}))
    assert np.allclose(log.positions[0].ellipsoidal_m, 566.5)


def test_two_receivers_are_two_streams(tmp_path: Path) -> None:
    rows = [gps_row(t, instance=i, lat=480000000 + i) for t in second(4) for i in (0, 1)]
    log = read_bytes(tmp_path, log_of({"GPS": (GPS, rows)}))
    assert [p.stream for p in log.positions] == ["GPS[0]", "GPS[1]"]
    assert [p.latitude_deg[0] for p in log.positions] == [48.0, 48.0000001]
    assert log.time_base.source == "GPS[0] (as written)"


def test_a_receiver_without_a_fix_is_said_and_not_used(tmp_path: Path) -> None:
    rows = [gps_row(t, instance=i, status=1 if i == 0 else 3) for t in second(4) for i in (0, 1)]
    log = read_bytes(tmp_path, log_of({"GPS": (GPS, rows)}))
    assert [p.stream for p in log.positions] == ["GPS[1]"]
    assert log.losses == ("no GPS fix in GPS[0]",)
    assert log.time_base.source == "GPS[1] (as written)"


def test_a_lost_fix_and_a_jump_break_the_stream(tmp_path: Path) -> None:
    fixes = [gps_row(t, status=1 if t == 3 * S else 3) for t in second(5)]
    jump = [(n * S // 2, 480000000 + (n >= 4) * 6000, 110000000, 530.0, 10.0, 10.0) for n in range(1, 7)]
    log = read_bytes(tmp_path, log_of({"GPS": (GPS, fixes), "POS": (POS, jump)}))
    assert stream(log, "GPS").segment.tolist() == [0, 0, 1, 1]
    # 6000e-7 deg are 67 m; 49 m would be flight.
    assert stream(log, "POS").segment.tolist() == [0, 0, 0, 1, 1, 1]
    slow = [(n * S // 2, 480000000 + (n >= 4) * 4400, 110000000, 530.0, 10.0, 10.0) for n in range(1, 7)]
    assert set(read_bytes(tmp_path, log_of({"POS": (POS, slow)})).positions[0].segment.tolist()) == {0}


def test_without_gps_time_there_is_boot_time_only(tmp_path: Path) -> None:
    rows = [gps_row(t, week=0) for t in second(3)]
    base = read_bytes(tmp_path, log_of({"GPS": (GPS, rows)})).time_base
    assert not len(base.anchor_log_ns)
    assert base.problem == "boot time only: no GPS time in the log"


def test_a_damaged_week_is_no_anchor(tmp_path: Path) -> None:
    rows = [gps_row(t, week=2317 if t != 4 * S else 2445) for t in second(9)]
    base = read_bytes(tmp_path, log_of({"GPS": (GPS, rows)})).time_base
    assert len(base.anchor_log_ns) == 8
    assert np.ptp(base.anchor_utc_ns - base.anchor_log_ns) == 0


@pytest.mark.parametrize(
    ("yaw_e", "frame", "yaw_deg"), [([10.0, 20.0], "ned", 20.0), ([math.nan, math.nan], "heading", 5.0)]
)
def test_gimbal_yaw_from_north_or_from_the_nose(tmp_path: Path, yaw_e: list[float], frame: str, yaw_deg: float) -> None:
    rows = [(t, 0, 1.0, -80.0, 5.0, yaw) for t, yaw in zip(second(2), yaw_e, strict=True)]
    (mount,) = read_bytes(tmp_path, log_of({"MNT": (MNT, rows)})).attitudes
    assert (mount.of, mount.frame) == ("gimbal", frame)
    expected = ned_from_frd(*np.radians([yaw_deg, -80.0, 1.0]))
    assert np.allclose(rotation_from_quaternion(mount.q_wxyz[1]), expected, atol=1e-6)


def test_a_gimbal_without_yaw_is_said(tmp_path: Path) -> None:
    rows = [(t, 0, 1.0, -80.0, math.nan, math.nan) for t in second(2)]
    log = read_bytes(tmp_path, log_of({"MNT": (MNT, rows), "ATT": (ATT, attitudes(3))}))
    assert [a.stream for a in log.attitudes] == ["ATT"]
    assert log.losses == ("MNT has no yaw: its 2 messages were left out",)


SHOTS = [1_234_567, 3_000_001, 4_750_113, 6_401_999, 9_999_990]
TICKS = [1_003_000, 3_023_000, 4_743_000, 6_403_000, 9_983_000]


@pytest.mark.parametrize(
    ("names", "pin", "feedback", "sigma_s"),
    [
        (("CAM",), 54.0, True, 0.001),
        (("CAM",), -1.0, False, 0.05),
        (("CAM",), None, True, 0.001),
        (("TRIG",), 54.0, False, 0.05),
        (("CAM", "TRIG"), -1.0, True, 0.001),
    ],
)
def test_feedback_or_command(
    tmp_path: Path, names: tuple[str, ...], pin: float | None, feedback: bool, sigma_s: float
) -> None:
    """Without a feedback pin the firmware writes CAM when it commands the shutter (AP_Camera_Backend::log_picture)."""
    messages: dict[str, Any] = {name: (CAM, [(t, 0, n) for n, t in enumerate(SHOTS)]) for name in names}
    if pin is not None:
        messages["PARM"] = (PARM, [(1, b"CAM1_FEEDBAK_PIN", pin)])
    events = read_bytes(tmp_path, log_of(messages)).events
    assert [e.stream for e in events] == list(names)
    assert (events[0].feedback, events[0].sigma_s) == (feedback, sigma_s)
    assert events[0].time_ns.tolist() == [t * 1000 for t in SHOTS]
    assert events[0].number.tolist() == list(range(len(SHOTS)))


@pytest.mark.parametrize(("times_us", "ticks"), [(TICKS, True), (TICKS[:4], False), (SHOTS, False)])
def test_old_firmware_looked_at_the_pin_fifty_times_a_second(tmp_path: Path, times_us: list[int], ticks: bool) -> None:
    old = (("QIHLL", "TimeUS,GPSTime,GPSWeek,Lat,Lng"), [(t, 0, 0, 0, 0) for t in times_us])
    (cam,) = read_bytes(tmp_path, log_of({"CAM": old})).events
    assert cam.sigma_s == (0.020 / math.sqrt(12) if ticks else 0.001)
    assert set(cam.number.tolist()) == {-1}


def test_events_that_are_dated_back_come_in_order(tmp_path: Path) -> None:
    rows = [(2 * S, 0, 1), (2 * S - 30_000, 0, 2), (3 * S, 0, 3)]
    (cam,) = read_bytes(tmp_path, log_of({"CAM": (CAM, rows)})).events
    assert cam.number.tolist() == [2, 1, 3]


def test_events_without_a_time_are_said(tmp_path: Path) -> None:
    old = (("IHLL", "GPSTime,GPSWeek,Lat,Lng"), [(1000, 1851, 1, 1)])
    log = read_bytes(tmp_path, log_of({"CAM": old, "GPS": (GPS, [gps_row(S)])}))
    assert log.events == ()
    assert log.losses == ("no field of CAM could be read: its 1 messages were left out",)


def test_nothing_with_a_time_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="GPS has no TimeUS or TimeMS") as caught:
        read_bytes(tmp_path, log_of({"GPS": (("BLLe", "Status,Lat,Lng,Alt"), [(3, 1, 1, 1)] * 3)}))
    assert str(tmp_path) in caught.value.where
    assert caught.value.code == "E-DATAFLASH-02"


# Damage


def attitudes(n: int) -> list[tuple]:
    return [(t, t // 1000 % 3000, -400, t // 700 % 36000) for t in second(n, 20_000)]


def test_lost_bytes_cost_one_message_and_are_counted(tmp_path: Path) -> None:
    data = log_of({"ATT": (ATT, attitudes(50))})
    begin = len(data) - 50 * 17
    cut = data[: begin + 10 * 17 + 5] + data[begin + 10 * 17 + 9 :]
    log = read_bytes(tmp_path, cut)
    assert log.counts["ATT"] == 49
    assert log.losses == (f"13 of {len(cut)} bytes are damaged and were skipped",)


def test_a_header_within_a_message_is_no_message(tmp_path: Path) -> None:
    """Numbers that look like headers of a longer and of an undefined type."""
    odd = int.from_bytes(HEAD + bytes([140]) + HEAD + bytes([99]), "little")
    rows = [(n * S, 1, odd & 0xFFFFFFFF) for n in range(1, 20)]
    messages = {"POS": (POS, []), "XXXX": (("QBI", "TimeUS,A,B"), rows), "ATT": (ATT, attitudes(3))}
    log = read_bytes(tmp_path, log_of(messages))
    assert (log.counts["XXXX"], log.counts["ATT"], log.counts.get("POS", 0)) == (19, 3, 0)
    assert log.losses == ()


@pytest.mark.parametrize(("stated", "read_too"), [(40, True), (16, True), (2, True)])
def test_where_the_stated_length_is_wrong_the_bytes_decide(tmp_path: Path, stated: int, read_too: bool) -> None:
    head = fmt(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns") + fmt(140, "ATT", *ATT, stated)
    head += fmt(141, "POS", *POS)
    pos = rows_of(141, POS[0], [(t, 480000000, 110000000, 530.0, 10.0, 10.0) for t in second(50, 20_000)])
    data = head + b"".join(a + p for a, p in zip(rows_of(140, ATT[0], attitudes(50)), pos, strict=True))
    log = read_bytes(tmp_path, data)
    assert log.counts == {"FMT": 3, "ATT": 50, "POS": 50}
    assert log.losses == (f"the format of ATT states {stated} bytes and fields of 17; its messages are 17 bytes long",)
    assert len(log.attitudes[0].time_ns) == 50


def test_where_the_fields_are_wrong_they_are_not_read(tmp_path: Path) -> None:
    """A flipped letter in the format: the length still leads from message to message, but says nothing of fields."""
    good = log_of({"ATT": (ATT, attitudes(50)), "POS": (POS, [(t, 1, 1, 1.0, 1.0, 1.0) for t in second(3)])})
    log = read_bytes(tmp_path, good.replace(b"QccC\0", b"QccB\0", 1))
    assert log.counts["ATT"] == 50
    assert log.attitudes == ()
    assert log.losses[0] == (
        "the format of ATT states 17 bytes and fields of 16; its messages are 17 bytes long; their fields were not read"
    )
    log = read_bytes(tmp_path, good.replace(b"QccC\0", b"QccW\0", 1))
    assert "fields of unknown size" in log.losses[0]


def test_a_format_may_be_defined_anew(tmp_path: Path) -> None:
    first = log_of({"ATT": (ATT, attitudes(5))})
    again = fmt(140, "ATT", "QBcccC", "TimeUS,X,Pitch,Roll,Z,Yaw")
    rows = rows_of(140, "QBcccC", [(S + t, 9, -400, 100, 0, 300) for t in second(5)])
    log = read_bytes(tmp_path, first + again + b"".join(rows))
    assert log.counts == {"FMT": 3, "ATT": 10}
    expected = ned_from_frd(*np.radians([3.0, -4.0, 1.0]))
    assert np.allclose(rotation_from_quaternion(log.attitudes[0].q_wxyz[-1]), expected, atol=1e-12)


def test_padding_after_the_last_message_is_no_loss(tmp_path: Path) -> None:
    data = log_of({"ATT": (ATT, attitudes(5))})
    for padding in (b"\0" * 300, b"\xff" * 300):
        assert read_bytes(tmp_path, data + padding).losses == ()
    assert read_bytes(tmp_path, data[:-4]).losses == ("the log ends in the middle of a message",)
    assert read_bytes(tmp_path, b"noise" + data).losses == (f"5 of {len(data) + 5} bytes are damaged and were skipped",)


def test_a_time_far_in_the_future_costs_one_sample(tmp_path: Path) -> None:
    rows = attitudes(50)
    rows[20] = (2**50, *rows[20][1:])
    rows[30] = (2**33, *rows[30][1:])
    log = read_bytes(tmp_path, log_of({"ATT": (ATT, rows)}))
    assert len(log.attitudes[0].time_ns) == 48
    assert log.losses == (
        "1 of 50 ATT messages hold no sound values and were left out",
        "1 of 49 ATT messages are out of order in time and were left out",
    )


def test_damaged_lines_of_a_text_log_are_said(tmp_path: Path) -> None:
    lines = [
        b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        b"FMT, 140, 17, ATT, QccC, TimeUS,Roll,Pitch,Yaw",
        b"FMT, 141, 75, MSG, QZ, TimeUS,Message",
        b"MSG, 5, ArduPlane V4.5.7, with a comma",
        *(f"ATT, {t}, 1.5, -4.0, 3.0".encode() for t in second(5)),
        b"ATT, 6000000, 1.5",
        b"ATT, 7000000, 1.5, x, 3.0",
        b"\xa3\x95\x80",
    ]
    log = read_bytes(tmp_path, b"\r\n".join(lines), "flight.log")
    assert len(log.attitudes[0].time_ns) == 5
    assert log.facts["firmware"] == "ArduPlane V4.5.7, with a comma"
    assert log.losses == (
        "2 lines are damaged and were skipped",
        "1 of 6 ATT messages hold no sound values and were left out",
    )


def test_blocks_do_not_show(simulated: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A log in blocks of a few messages reads as one in a single block."""
    whole = read(str(simulated))
    monkeypatch.setattr(dataflash_walk, "_BLOCK_BYTES", 1500)
    pieces = read(str(simulated))
    assert (pieces.counts, pieces.losses) == (whole.counts, ())
    for ours, other in zip(pieces.positions, whole.positions, strict=True):
        assert np.array_equal(ours.latitude_deg, other.latitude_deg)


FEW = log_of({"ATT": (ATT, attitudes(4)), "POS": (POS, [(S, 480000000, 110000000, 530.0, 1.0, 1.0)])})


@given(st.lists(st.one_of(st.sampled_from([FEW, FEW[:-3], HEAD, HEAD + b"\x80", b"FMT, 1,"]), st.binary(max_size=90))))
def test_any_bytes(parts: list[bytes]) -> None:
    """No byte is read twice, and no order of pieces raises anything but an InputError."""
    data = b"".join(parts)
    found = Found()
    with contextlib.suppress(InputError):
        dataflash_walk.walk(io.BytesIO(data), found, "flight.BIN")
    claimed = 89 * found.counts["FMT"] + 17 * found.counts["ATT"] + 31 * found.counts["POS"]
    assert claimed <= len(data)
    for name in ("ATT", "POS"):
        assert len(found.take(name).get("TimeUS", ())) <= found.counts[name]


def test_which_files_are_logs() -> None:
    assert is_format(FEW[:4096], "x.BIN")
    assert is_format(b"\0" * 40 + FEW[:4000], "x.BIN")
    assert is_format(b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n", "x.log")
    assert is_format(b"FMT,128,89,FMT,BBnNZ,Type,Length,Name,Format,Columns\n", "x.log")
    # A COLMAP model's cameras.bin begins with the number of cameras; a tlog and a text with other things.
    for head in (struct.pack("<QIi", 1, 1, 4), b"", b"1\n00:00:00,000 --> 00:00:01,000\nFMT", b"\xa3\x95", bytes(4096)):
        assert not is_format(head, "cameras.bin")


def test_every_wanted_field_is_of_one_message() -> None:
    assert all(len(set(fields)) == len(fields) for fields in WANTED.values())


# Fuzzing and size


@pytest.mark.real
def test_fuzz_of_a_real_log(shared: Path, tmp_path: Path) -> None:
    data = (shared / REAL).read_bytes()
    wanted = mutations_wanted()
    part = survives(read, data[:40_000], tmp_path / "part.BIN", wanted)
    whole = survives(read, data, tmp_path / "whole.BIN", max(wanted // 50, 3), seed=1)
    assert part["partial"] + part["refused"] > 0.5 * wanted
    assert sum(whole.values()) == max(wanted // 50, 3)


def test_fuzz_of_a_simulated_log(simulated: Path, tmp_path: Path) -> None:
    wanted = mutations_wanted()
    outcomes = survives(read, simulated.read_bytes()[:60_000], tmp_path / "part.BIN", wanted, seed=2)
    assert outcomes["refused"] < 0.2 * wanted


def test_fuzz_of_a_text_log(tmp_path: Path) -> None:
    lines = ["FMT, 140, 17, ATT, QccC, TimeUS,Roll,Pitch,Yaw", "FMT, 141, 31, POS, QLLf, TimeUS,Lat,Lng,Alt"]
    for t in second(200, 20_000):
        lines += [f"ATT, {t}, 1.5, -4.0, 3.0", f"POS, {t}, 48.0, 11.0, 530.5"]
    wanted = mutations_wanted()
    outcomes = survives(read, "\n".join(lines).encode(), tmp_path / "flight.log", wanted, seed=3)
    assert outcomes["refused"] < 0.2 * wanted


@pytest.mark.slow
def test_a_big_log_takes_little_memory(tmp_path: Path) -> None:
    """60 MB, of which a process may hold less than half beyond what it begins with."""
    path = tmp_path / "big.BIN"
    write_dataflash(path, 60_000_000)
    # VmHWM and not ru_maxrss, which begins with what the process that started this one had.
    program = (
        "import re, sys; import pymavlink.DFReader; from pipeline.sources.dataflash.reader import read;"
        "peak = lambda: int(re.search('VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1]);"
        "a = peak(); log = read(sys.argv[1]); b = peak();"
        "print(b - a, sum(log.counts.values()), len(log.losses))"
    )
    done = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True)
    grown_kib, messages, losses = map(int, done.stdout.split())
    assert grown_kib < 60_000
    assert losses == 0
    seconds = (messages - len(MESSAGES) - 2) / 1346
    assert seconds == int(seconds)
