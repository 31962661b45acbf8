"""MAVLink telemetry logs: frames, damage, which vehicle and which boot, clocks, frames of gimbals, events."""

import contextlib
import io
import struct
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzzing import check, mutations_wanted, survives
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from pipeline.engine.errors import InputError
from pipeline.geometry.rotations import ned_from_frd, rotation_from_quaternion
from pipeline.simulation.flight import CONSUMER_DRONE, fly, logged_poses
from pipeline.simulation.logs.tlog import tlog
from pipeline.simulation.recording import SIGMA_HORIZONTAL_M, Recording, record
from pipeline.simulation.site import Site
from pipeline.sources.logs import read_log
from pipeline.sources.mavlink import frames as mavlink_frames
from pipeline.sources.mavlink.frames import Sender
from pipeline.sources.mavlink.tlog import is_format, read
from pipeline.sources.records import FlightLog

REAL = "data/logs/ardupilot_tlog/flight.tlog"
# The ground station's clock when the vehicle of the hand-made logs boots, us.
BOOT_US = 1_700_000_000_000_000
NAN = float("nan")


class Link:
    """A log in the making: messages lie in it in the order of their arrival, 50 ms after they were sent."""

    def __init__(self) -> None:
        self.records: list[tuple[int, bytes]] = []
        self.boot_us = BOOT_US
        self.senders: dict[Sender, Any] = {}

    def send(self, kind: str, at_s: float, sender: Sender = (1, 1), *, old: bool = False, **fields: Any) -> None:
        """One message, sent `at_s` after the vehicle's boot."""
        writer = self.senders.setdefault(sender, mavlink.MAVLink(None, srcSystem=sender[0], srcComponent=sender[1]))
        message = getattr(writer, f"{kind}_encode")(**fields)
        stamp_us = self.boot_us + round(at_s * 1e6) + 50_000
        self.records.append((stamp_us, struct.pack(">Q", stamp_us) + message.pack(writer, force_mavlink1=old)))

    @property
    def data(self) -> bytes:
        """The file."""
        return b"".join(record for _, record in sorted(self.records, key=lambda item: item[0]))

    def heartbeat(self, at_s: float, sender: Sender = (1, 1), autopilot: int = 3, kind: int = 2) -> None:
        self.send(
            "heartbeat", at_s, sender, type=kind, autopilot=autopilot, base_mode=0, custom_mode=0, system_status=4
        )

    def position(self, at_s: float, sender: Sender = (1, 1), **changed: Any) -> None:
        fields = {"time_boot_ms": round(at_s * 1000), "lat": 451234567, "lon": 71234567, "alt": 300_000} | changed
        rest = {"relative_alt": 50_000, "vx": 0, "vy": 0, "vz": 0, "hdg": 0}
        self.send("global_position_int", at_s, sender, **(rest | fields))

    def attitude(self, at_s: float, yaw: float = 0.3, pitch: float = 0.0, roll: float = 0.0) -> None:
        rates = {"rollspeed": 0.0, "pitchspeed": 0.0, "yawspeed": 0.0}
        self.send("attitude", at_s, time_boot_ms=round(at_s * 1000), roll=roll, pitch=pitch, yaw=yaw, **rates)

    def system_time(self, at_s: float, utc_minus_stamp_s: float = 0.0) -> None:
        unix_us = self.boot_us + round((at_s + utc_minus_stamp_s) * 1e6)
        self.send("system_time", at_s, time_unix_usec=unix_us, time_boot_ms=round(at_s * 1000))

    def gps(self, at_s: float, **changed: Any) -> None:
        fields = {"time_usec": round(at_s * 1e6), "fix_type": 3, "lat": 451234567, "lon": 71234567, "alt": 300_000}
        rest = {"eph": 70, "epv": 90, "vel": 0, "cog": 0, "satellites_visible": 12}
        self.send("gps_raw_int", at_s, **(fields | rest | changed))

    def gimbal(self, at_s: float, flags: int, q: Any, sender: Sender = (1, 1), own_s: float = 0.0) -> None:
        rates = dict.fromkeys(("angular_velocity_x", "angular_velocity_y", "angular_velocity_z"), 0.0)
        self.send(
            "gimbal_device_attitude_status", at_s, sender, target_system=0, target_component=0,
            time_boot_ms=round((at_s + own_s) * 1000), flags=flags, q=q, failure_flags=0, **rates,
        )  # fmt: skip

    def flight(self, begin_s: float, end_s: float, step_s: float = 0.2) -> None:
        """Heartbeats, positions and attitudes."""
        for at_s in np.arange(begin_s, end_s, step_s).tolist():
            self.heartbeat(at_s)
            self.position(at_s)
            self.attitude(at_s + 0.01)

    def read(self, folder: Path) -> FlightLog:
        path = folder / "made.tlog"
        path.write_bytes(self.data)
        log = read(str(path))
        check(log)
        return log


def flown(begin_s: float = 10.0, end_s: float = 20.0) -> Link:
    link = Link()
    link.flight(begin_s, end_s)
    for at_s in np.arange(begin_s, end_s).tolist():
        link.system_time(at_s)
    return link


def library_counts(path: Path) -> dict[str, int]:
    """What the library's own loop over the file finds."""
    connection = mavutil.mavlink_connection(str(path))
    counts: Counter[str] = Counter()
    while (message := connection.recv_match()) is not None:
        counts[message.get_type()] += 1
    connection.close()
    counts.pop("BAD_DATA", None)
    return dict(counts)


def utc_minus_log_s(log: FlightLog) -> np.ndarray:
    return (log.time_base.anchor_utc_ns - log.time_base.anchor_log_ns) / 1e9 - BOOT_US / 1e6


@pytest.fixture(scope="module")
def recording() -> Recording:
    site = Site.seeded(7)
    return record(site, logged_poses(fly(site.terrain, 12, 7), CONSUMER_DRONE, 7))


@pytest.fixture(scope="module")
def written(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tlog") / "flight.tlog"
    path.write_bytes(tlog(recording))
    return path


@pytest.mark.real
def test_counts_are_those_of_the_library(shared: Path) -> None:
    log = read_log(str(shared / REAL))
    check(log)
    assert dict(log.counts) == library_counts(shared / REAL)
    names = ("GLOBAL_POSITION_INT", "ATTITUDE", "GPS_RAW_INT", "MOUNT_STATUS")
    assert [log.counts[name] for name in names] == [2833, 2829, 2858, 2825]


@pytest.mark.real
def test_a_real_flight_restarts_once(shared: Path) -> None:
    log = read(str(shared / REAL))
    assert log.losses == (
        "1314 messages with a wrong checksum were skipped (RESOURCE_REQUEST 1314): damaged, or of another dialect",
        "the last message is cut short: 19 bytes",
        "the autopilot restarted once: 491 positions of its other boots were left out",
    )
    fused = log.positions[0]
    # 2833 less 149 at (0, 0) and 491 of the first boot.
    assert (len(fused.time_ns), fused.time_ns[0], fused.time_ns[-1]) == (2193, 18_925_000_000, 816_146_000_000)
    # Heights count from the start until the home is set, 19 messages in.
    assert (fused.segment == (np.arange(2193) > 18)).all()
    assert (log.time_base.source, log.time_base.late, log.time_base.problem) == ("SYSTEM_TIME", False, "")
    offset_s = (log.time_base.anchor_utc_ns - log.time_base.anchor_log_ns) / 1e9
    assert np.ptp(offset_s) < 0.1
    assert abs(np.median(offset_s) - 1436056240.5) < 0.1
    facts = {key: log.facts[key] for key in ("system_id", "autopilot", "vehicle_type", "mavlink_versions")}
    assert facts == {
        "system_id": 1,
        "autopilot": "MAV_AUTOPILOT_ARDUPILOTMEGA",
        "vehicle_type": "MAV_TYPE_QUADROTOR",
        "mavlink_versions": [1],
    }


@pytest.mark.real
def test_a_real_mount_tells_its_angles_in_the_body(shared: Path) -> None:
    """Its servos undo the vehicle's tilt: the mount stays level though its own angles swing."""
    vehicle, mount = read(str(shared / REAL)).attitudes
    assert (vehicle.frame, mount.frame, len(mount.time_ns)) == ("ned", "body", 2186)
    nearest = np.clip(np.searchsorted(vehicle.time_ns, mount.time_ns), 0, len(vehicle.time_ns) - 1)
    body, of_mount = (rotation_from_quaternion(q) for q in (vehicle.q_wxyz[nearest], mount.q_wxyz))
    own_down, true_down = of_mount[:, 2, 0], (body @ of_mount)[:, 2, 0]
    assert 6.0 < np.degrees(np.std(own_down)) < 7.2
    # What is left is the link: a mount's message is placed to a tenth of a second.
    assert 1.0 < np.degrees(np.std(true_down)) < 2.0


def test_the_library_reads_what_is_written(recording: Recording, written: Path) -> None:
    counts = library_counts(written)
    assert counts == dict(read(str(written)).counts)
    assert counts["GLOBAL_POSITION_INT"] == len(recording.position_s)
    assert counts["CAMERA_FEEDBACK"] == len(recording.trigger_s)
    assert counts["GIMBAL_DEVICE_ATTITUDE_STATUS"] == counts["ATTITUDE"] == len(recording.attitude_s)
    assert written.read_bytes() == tlog(recording)


def test_a_written_flight_comes_back(recording: Recording, written: Path) -> None:
    log = read(str(written))
    check(log)
    assert not log.losses
    fused, receiver = log.positions
    assert (fused.fused, receiver.fused) == (True, False)
    assert np.array_equal(fused.time_ns, np.rint(recording.position_s * 1e9).astype(np.int64))
    assert np.array_equal(receiver.time_ns, fused.time_ns[list(recording.receiver)])
    for name, resolution in (("latitude_deg", 1e-7), ("longitude_deg", 1e-7), ("amsl_m", 1e-3), ("above_home_m", 1e-3)):
        assert np.max(np.abs(getattr(fused, name) - getattr(recording, name))) < 0.51 * resolution
    # AMSL and the separation are rounded to a millimetre each.
    assert np.max(np.abs(fused.ellipsoidal_m - recording.ellipsoidal_m)) < 0.002
    assert np.allclose(fused.sigma_horizontal_m, SIGMA_HORIZONTAL_M)
    vehicle, gimbal = log.attitudes
    for stream, angles in ((vehicle, recording.vehicle_rad), (gimbal, recording.gimbal_rad)):
        assert stream.frame == "ned"
        assert np.array_equal(stream.time_ns, np.rint(recording.attitude_s * 1e9).astype(np.int64))
        assert np.max(np.abs(rotation_from_quaternion(stream.q_wxyz) - ned_from_frd(*angles.T))) < 1e-6
    (events,) = log.events
    assert events.feedback
    assert events.number.tolist() == list(range(len(recording.trigger_s)))
    assert np.max(np.abs(events.time_ns / 1e9 - recording.trigger_s)) < 0.6e-6
    assert np.max(np.abs(log.time_base.anchor_utc_ns - log.time_base.anchor_log_ns - recording.boot_utc_ns)) == 0


def test_feedback_holds_the_latest_pose_and_arrives_late(recording: Recording, written: Path) -> None:
    connection = mavutil.mavlink_connection(str(written))
    position, seen, late_s = None, 0, []
    while (message := connection.recv_match()) is not None:
        kind = message.get_type()
        if kind == "GLOBAL_POSITION_INT":
            position = message
            late_s.append(message._timestamp - recording.boot_utc_ns / 1e9 - message.time_boot_ms / 1e3)
        elif kind == "CAMERA_FEEDBACK":
            assert position is not None
            assert (message.lat, message.lng) == (position.lat, position.lon)
            seen += 1
    connection.close()
    assert seen == len(recording.trigger_s)
    assert min(late_s) > 0.0399
    assert 0.04 < np.mean(late_s) < 0.06
    assert np.ptp(late_s) > 0.005


def test_two_vehicles_stay_apart(tmp_path: Path) -> None:
    """The one with more positions is read; its own component belongs to it, the ground station to none."""
    link = Link()
    for step in range(60):
        at_s = 10.0 + 0.2 * step
        link.heartbeat(at_s, (2, 1), autopilot=12)
        link.position(at_s, (2, 1), lat=470000000)
        if step < 50:
            link.heartbeat(at_s)
            link.position(at_s, old=step % 2 == 0)
            link.attitude(at_s)
        link.heartbeat(at_s, (255, 190), autopilot=8, kind=6)
        link.gimbal(at_s, 64, (1.0, 0.0, 0.0, 0.0), (2, 154))
        link.gimbal(at_s, 64, (0.0, 1.0, 0.0, 0.0), (1, 154))
    log = link.read(tmp_path)
    assert (log.facts["system_id"], log.facts["autopilot"]) == (2, "MAV_AUTOPILOT_PX4")
    assert np.unique(log.positions[0].latitude_deg).tolist() == [47.0]
    assert [(stream.stream, stream.q_wxyz[0, 0]) for stream in log.attitudes] == [
        ("GIMBAL_DEVICE_ATTITUDE_STATUS", 1.0)
    ]
    (loss,) = log.losses
    assert "system 1 component 1, was left out" in loss
    assert "ATTITUDE 50, GLOBAL_POSITION_INT 50" in loss
    assert log.counts["GLOBAL_POSITION_INT"] == 110
    assert log.facts["mavlink_versions"] == [1, 2]


def test_of_two_equal_vehicles_the_lower_number_is_read(tmp_path: Path) -> None:
    link = Link()
    for step in range(20):
        for system in (7, 3):
            link.heartbeat(step, (system, 1))
            link.position(step, (system, 1))
    assert link.read(tmp_path).facts["system_id"] == 3


def test_a_restart_is_another_boot(tmp_path: Path) -> None:
    link = flown(100.0, 110.0)
    link.boot_us += 115_000_000
    link.flight(3.0, 33.0)
    for at_s in range(3, 33):
        link.system_time(at_s)
    log = link.read(tmp_path)
    assert log.losses == ("the autopilot restarted once: 50 positions of its other boots were left out",)
    for stream in (*log.positions, *log.attitudes):
        assert len(stream.time_ns) == 150
        assert stream.time_ns[-1] < 33.1e9
    assert np.allclose(utc_minus_log_s(log), 115.0)


def test_a_later_start_behind_a_gap_is_another_boot(tmp_path: Path) -> None:
    """Two flights in one file: the second's clock is ahead of the first's, but hours have passed."""
    link = flown(10.0, 20.0)
    link.boot_us += 7_200_000_000
    link.flight(300.0, 330.0)
    log = link.read(tmp_path)
    assert log.positions[0].time_ns[0] == 300_000_000_000
    assert "restarted once: 50 positions" in log.losses[0]


def test_what_is_no_restart(tmp_path: Path) -> None:
    """A gap in reception, a ground station's clock set in flight, packets that overtake others, a link heard twice."""
    link = flown(10.0, 20.0)
    link.flight(80.0, 90.0)
    link.boot_us += 3_600_000_000
    link.flight(90.0, 100.0)
    link.position(100.0, time_boot_ms=100_000)
    link.position(100.1, time_boot_ms=99_500)
    link.position(100.2, time_boot_ms=100_000)
    log = link.read(tmp_path)
    assert not log.losses
    # Those of the three flights, 100.0 once, and 99.5 though it came late.
    assert len(log.positions[0].time_ns) == 152
    assert log.positions[0].time_ns[0] == 10_000_000_000


def test_a_few_messages_of_another_boot(tmp_path: Path) -> None:
    link = flown(100.0, 110.0)
    link.position(111.0, time_boot_ms=2000)
    link.position(111.2, time_boot_ms=2200)
    log = link.read(tmp_path)
    assert log.losses == ("2 messages of another boot of the autopilot were left out",)
    assert log.positions[0].time_ns[0] == 100_000_000_000


FLAGS = [(0, "heading"), (16, "ned"), (32, "heading"), (48, "heading"), (64, "ned"), (80, "ned"), (96, None),
         (12, "heading"), (28, "ned"), (128 + 64, "ned"), (512 + 32 + 16, "heading")]  # fmt: skip


@pytest.mark.parametrize(("flags", "frame"), FLAGS)
def test_flags_of_a_gimbal_say_its_frame(tmp_path: Path, flags: int, frame: str | None) -> None:
    link = flown()
    turned = np.array([0.5, 0.5, 0.5, 0.5])
    for step in range(10):
        link.gimbal(10.0 + step, flags, turned)
    log = link.read(tmp_path)
    gimbals = [stream for stream in log.attitudes if stream.of == "gimbal"]
    assert [stream.frame for stream in gimbals] == ([frame] if frame else [])
    assert bool(log.losses) == (frame is None)
    if frame:
        assert np.allclose(gimbals[0].q_wxyz, turned)


def test_flags_that_change_make_a_stream_for_each_frame(tmp_path: Path) -> None:
    link = flown()
    for step, flags in enumerate((32, 32, 64, 64, 32, 32, 64)):
        link.gimbal(10.0 + step, flags, (1.0, 0.0, 0.0, 0.0))
    link.gimbal(18.0, 64, (NAN,) * 4)
    _, ned, heading = link.read(tmp_path).attitudes
    assert (ned.frame, ned.time_ns.tolist()) == ("ned", [12 * 10**9, 13 * 10**9, 16 * 10**9])
    assert (heading.frame, len(heading.time_ns)) == ("heading", 4)
    # No interpolation across the time that the other frame was told in.
    assert len(np.unique(heading.segment[:2])) == 1
    assert heading.segment[1] != heading.segment[2]


def test_a_gimbal_with_a_clock_of_its_own(tmp_path: Path) -> None:
    link = flown(10.0, 40.0)
    for step in range(120):
        link.gimbal(10.0 + step * 0.2, 64, (1.0, 0.0, 0.0, 0.0), (1, 154), own_s=-8.25)
    log = link.read(tmp_path)
    assert np.max(np.abs(log.attitudes[1].time_ns / 1e9 - (10.0 + 0.2 * np.arange(120)))) < 0.02
    assert "-8." not in log.facts["component_clocks"]["GIMBAL_DEVICE_ATTITUDE_STATUS"]
    assert "8.2" in log.facts["component_clocks"]["GIMBAL_DEVICE_ATTITUDE_STATUS"]


@pytest.mark.parametrize(
    ("absolute", "frame", "yaw"), [(None, "heading", 20.0), (75.0, "ned", 75.0), (NAN, "heading", 20.0)]
)
def test_a_mount_with_and_without_absolute_yaw(tmp_path: Path, absolute: float | None, frame: str, yaw: float) -> None:
    link = flown()
    extension = {} if absolute is None else {"yaw_absolute": absolute}
    for at_s in range(10, 20):
        link.send("mount_orientation", at_s, time_boot_ms=at_s * 1000, roll=1.0, pitch=-40.0, yaw=20.0, **extension)
    mount = link.read(tmp_path).attitudes[1]
    assert (mount.frame, len(mount.time_ns)) == (frame, 10)
    expected = ned_from_frd(*np.radians((yaw, -40.0, 1.0)))
    assert np.allclose(rotation_from_quaternion(mount.q_wxyz), expected, atol=1e-6)


@pytest.mark.parametrize(("share", "frame"), [(-1.0, "body"), (0.0, "heading"), (1.0, "heading")])
def test_a_mount_that_undoes_the_tilt_is_in_the_body(tmp_path: Path, share: float, frame: str) -> None:
    link = Link()
    for step in range(200):
        at_s = 10.0 + 0.2 * step
        pitch, roll = 0.1 * np.sin(at_s), 0.08 * np.sin(0.7 * at_s + 1.0)
        link.heartbeat(at_s)
        link.position(at_s)
        link.attitude(at_s, pitch=pitch, roll=roll)
        angles = (share * np.degrees((pitch, roll)) + (-30.0, 2.0)) * 100.0
        link.send(
            "mount_status", at_s, target_system=0, target_component=0, pointing_a=round(angles[0]),
            pointing_b=round(angles[1]), pointing_c=0,
        )  # fmt: skip
    mount = link.read(tmp_path).attitudes[1]
    assert (mount.stream, mount.frame) == ("MOUNT_STATUS", frame)
    # The autopilot's messages around it hold it to the instant.
    assert np.max(np.abs(mount.time_ns / 1e9 - (10.0 + 0.2 * np.arange(200))[-len(mount.time_ns) :])) < 0.02


def test_clock_by_the_receiver(tmp_path: Path) -> None:
    link = Link()
    link.flight(10.0, 30.0)
    early = Link()
    for at_s in np.arange(10.0, 30.0, 0.5).tolist():
        early.flight(at_s, at_s + 0.5)
        early.gps(at_s + 0.45, time_usec=BOOT_US + round((at_s + 0.3) * 1e6))
    log = early.read(tmp_path)
    assert (log.time_base.source, log.time_base.late) == ("GPS_RAW_INT", True)
    # Told 0.15 s after the fix, and placed between its neighbours.
    assert np.max(utc_minus_log_s(log)) == pytest.approx(-0.15, abs=0.06)
    receiver = next(stream for stream in log.positions if not stream.fused)
    assert len(receiver.time_ns) == 40
    assert link.read(tmp_path).time_base.source == "ground station's clock at arrival"


def test_clock_by_arrivals_takes_the_least_late(tmp_path: Path) -> None:
    link = Link()
    for step in range(900):
        link.heartbeat(10.0 + 0.2 * step)
        # Up to 0.23 s late, 0.05 s at best.
        link.position(10.0 + 0.2 * step + 0.02 * (step % 10), time_boot_ms=10_000 + 200 * step)
    base = link.read(tmp_path).time_base
    assert (base.late, len(base.anchor_log_ns)) == (False, 4)
    assert np.allclose((base.anchor_utc_ns - base.anchor_log_ns) / 1e9 - BOOT_US / 1e6, 0.05, atol=1e-6)
    assert "link's delay" in base.problem


def test_a_clock_that_was_set_in_flight(tmp_path: Path) -> None:
    link = Link()
    link.flight(10.0, 40.0)
    for at_s in range(10, 40):
        link.system_time(at_s, -86_400.0 if at_s < 20 else 0.0)
    base = link.read(tmp_path).time_base
    assert len(base.anchor_log_ns) == 20
    assert base.problem == "10 of 30 SYSTEM_TIME messages name another time and were left out"


def feedback(link: Link, at_s: float, number: int, time_usec: int, flags: int = 0) -> None:
    names = ("lat", "lng", "alt_msl", "alt_rel", "roll", "pitch", "yaw", "foc_len")
    fields = dict.fromkeys(names, 0) | {"target_system": 1, "cam_idx": 0, "img_idx": number}
    link.send("camera_feedback", at_s, time_usec=time_usec, flags=flags, **fields)


def test_events_in_both_kinds_of_time(tmp_path: Path) -> None:
    link = flown(10.0, 60.0)
    for number, at_s in enumerate((20.123456, 25.5, 30.75)):
        feedback(link, at_s + 0.4, number, BOOT_US + round(at_s * 1e6))
        feedback(link, at_s + 0.9, number, BOOT_US + round(at_s * 1e6))
        link.send("camera_trigger", at_s, time_usec=round(at_s * 1e6) - 1000, seq=number + 7)
    feedback(link, 31.0, 3, 31_000_000, flags=4)
    feedback(link, 32.0, 4, 32_000_000, flags=1)
    feedback(link, 33.0, 5, 0)
    feedback(link, 34.0, 6, BOOT_US + 7_200_000_000)
    log = link.read(tmp_path)
    taken, asked, triggers = log.events
    assert taken.time_ns.tolist() == [20_123_456_000, 25_500_000_000, 30_750_000_000]
    assert (taken.number.tolist(), taken.feedback, taken.sigma_s) == ([0, 1, 2], True, 0.001)
    assert (asked.time_ns.tolist(), asked.feedback) == ([31_000_000_000], False)
    assert triggers.time_ns.tolist() == [20_122_456_000, 25_499_000_000, 30_749_000_000]
    assert (triggers.number.tolist(), triggers.feedback, triggers.sigma_s) == ([7, 8, 9], False, 0.05)
    assert log.losses == ("2 of 9 CAMERA_FEEDBACK messages have a time that cannot be tied to the autopilot's clock",)


def test_dated_events_without_the_autopilots_word_are_less_sure(tmp_path: Path) -> None:
    link = Link()
    link.flight(10.0, 60.0)
    feedback(link, 30.4, 1, BOOT_US + 30_000_000)
    (events,) = link.read(tmp_path).events
    # By the ground station's clock, which reads 0.05 s more at arrival.
    assert events.time_ns.tolist() == [29_950_000_000]
    assert events.sigma_s == 0.2


def test_images_captured_by_a_camera_of_its_own(tmp_path: Path) -> None:
    link = flown(10.0, 60.0)
    for number, result in enumerate((1, 1, 0, 1)):
        for again in (0.2, 5.0):
            link.send(
                "camera_image_captured", 20.0 + 3 * number + again, (1, 100), time_boot_ms=20_000 + 3000 * number,
                time_utc=0, camera_id=0, lat=0, lon=0, alt=0, relative_alt=0, q=(1.0, 0.0, 0.0, 0.0),
                image_index=number, capture_result=result, file_url=f"http://10.0.0.1/DCIM/IMG_{number}.JPG".encode(),
            )  # fmt: skip
    log = link.read(tmp_path)
    (events,) = log.events
    assert events.number.tolist() == [0, 1, 3]
    assert events.image == tuple(f"http://10.0.0.1/DCIM/IMG_{number}.JPG" for number in (0, 1, 3))
    assert log.losses == ("2 CAMERA_IMAGE_CAPTURED messages tell of a capture that failed",)


def test_heights_and_sigmas_come_from_the_receiver(tmp_path: Path) -> None:
    link = flown(10.0, 20.0)
    for step, at_s in enumerate(np.arange(10.0, 20.0, 0.5).tolist()):
        link.gps(at_s, alt_ellipsoid=347_500, h_acc=800, v_acc=1200, fix_type=2 if step in {7, 8} else 3)
    log = link.read(tmp_path)
    fused, receiver = log.positions
    assert np.allclose(fused.ellipsoidal_m - fused.amsl_m, 47.5)
    assert (fused.sigma_horizontal_m[0], fused.sigma_vertical_m[0]) == (0.8, 1.2)
    assert log.losses == ("2 GPS_RAW_INT messages without a 3D fix were left out",)
    assert (receiver.segment == np.where(np.arange(18) < 7, 0, receiver.segment[-1])).all()
    assert receiver.segment[-1] > 0


def test_no_fix_and_no_place(tmp_path: Path) -> None:
    link = Link()
    for at_s in range(10, 20):
        link.heartbeat(at_s)
        link.position(at_s, lat=0, lon=0)
        link.attitude(at_s)
        link.gps(at_s, fix_type=1)
    log = link.read(tmp_path)
    assert not log.positions
    assert log.losses[:2] == (
        "no GPS fix: none of 10 GPS_RAW_INT messages has one",
        "10 GLOBAL_POSITION_INT messages without a position (0, 0) were left out",
    )


def test_only_a_ground_station(tmp_path: Path) -> None:
    link = Link()
    link.heartbeat(1.0, (255, 190), autopilot=8, kind=6)
    log = link.read(tmp_path)
    assert dict(log.counts) == {"HEARTBEAT": 1}
    assert log.losses == ("no autopilot tells its time since boot: no streams",)


def test_damage_costs_what_it_hits(recording: Recording, tmp_path: Path) -> None:
    data = tlog(recording)
    begin = len(data) // 2
    path = tmp_path / "damaged.tlog"
    whole = sum(read_frames(data).counts.values())
    # Noise with magic bytes amid the file, cutting one message; then the rest.
    path.write_bytes(data[:begin] + b"\xfd\x09\xfe\x00" * 500 + data[begin:] + data[:30])
    log = read(str(path))
    assert whole - 2 <= sum(log.counts.values()) < whole
    assert log.losses[0].endswith("bytes in 1 damaged places were skipped, the first at " + log.losses[0].split()[-1])
    assert log.losses[1] == "the last message is cut short: 30 bytes"


def read_frames(data: bytes) -> mavlink_frames.Telemetry:
    return mavlink_frames.read_frames(io.BytesIO(data), {"ATTITUDE": ("yaw", "time_boot_ms"), "HEARTBEAT": ("type",)})


def test_frames_the_dialect_does_not_know_and_signed_ones() -> None:
    link = Link()
    link.heartbeat(1.0)
    link.heartbeat(2.0)
    begin = len(link.data) // 2
    foreign = bytearray(link.data[begin:])
    foreign[8 + 7 : 8 + 10] = (50_999).to_bytes(3, "little")
    signed = bytearray(link.data[begin:])
    signed[8 + 2] = 1
    size = len(signed) - 2
    signed[size:] = mavlink.x25crc(bytes(signed[9:size]) + b"\x32").crc.to_bytes(2, "little") + bytes(13)
    telemetry = read_frames(link.data + bytes(foreign) + bytes(signed) + link.data)
    assert telemetry.counts == {"HEARTBEAT": 5, "UNKNOWN_50999": 1}
    assert not telemetry.losses


@given(st.integers(1, 700), st.integers(0, 40_000), st.binary(max_size=40))
@settings(max_examples=30)
def test_where_a_chunk_ends_does_not_matter(chunk: int, at: int, noise: bytes) -> None:
    data = flown().data
    data = data[:at] + noise + data[at:]
    expected = read_frames(data)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mavlink_frames, "_CHUNK_BYTES", chunk)
        found = read_frames(data)
    assert (found.counts, found.losses) == (expected.counts, expected.losses)
    assert all(np.array_equal(found.rows[key], rows) for key, rows in expected.rows.items())


@given(st.one_of(st.binary(max_size=200), st.binary(max_size=60).map(lambda noise: flown(10.0, 12.0).data + noise)))
@settings(max_examples=60)
def test_any_bytes(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.tlog"
    path.write_bytes(data)
    with contextlib.suppress(InputError):
        check(read(str(path)))


@pytest.mark.parametrize(
    ("head", "name", "known"),
    [
        (b"", "flight.TLOG", True),
        (BOOT_US.to_bytes(8, "big") + b"\xfd\x09", "flight", True),
        (BOOT_US.to_bytes(8, "big") + b"\xfe\x09", "flight.log", True),
        (BOOT_US.to_bytes(8, "big") + b"\xfc\x09", "flight", False),
        (BOOT_US.to_bytes(8, "little") + b"\xfd\x09", "flight", False),
        ((4_200_000_000_000_000).to_bytes(8, "big") + b"\xfd", "flight", False),
        (b"\x00\x05", "flight", False),
        (b"", "flight", False),
    ],
)
def test_is_format(head: bytes, name: str, known: bool) -> None:
    assert is_format(head, name) is known


@pytest.mark.parametrize("data", [b"", b"\0" * 5000, b"not a log at all, but some text" * 9])
def test_no_message_is_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "x.tlog"
    path.write_bytes(data)
    with pytest.raises(InputError, match="E-TLOG-01") as caught:
        read(str(path))
    assert str(path) in caught.value.where


def test_fuzz_of_a_written_log(tmp_path: Path) -> None:
    """Every kind of message, in both versions, damaged anywhere."""
    link = flown(10.0, 24.0)
    for step in range(60):
        at_s = 10.0 + 0.2 * step
        link.gps(at_s, alt_ellipsoid=347_500, h_acc=800)
        link.gimbal(at_s, (32, 64, 0, 16)[step % 4], (1.0, 0.0, 0.0, 0.0), (1, 154), own_s=3.0)
        link.send("mount_status", at_s, target_system=0, target_component=0, pointing_a=1, pointing_b=2, pointing_c=3)
        feedback(link, at_s, step, BOOT_US + round(at_s * 1e6))
    outcomes = survives(read, link.data, tmp_path / "fuzzed.tlog", mutations_wanted())
    assert outcomes["partial"] > 0.5 * sum(outcomes.values())


@pytest.mark.real
def test_fuzz_of_a_real_log(shared: Path, tmp_path: Path) -> None:
    data = (shared / REAL).read_bytes()
    outcomes = survives(read, data[500_000:540_000], tmp_path / "crop.tlog", mutations_wanted(), seed=1)
    outcomes.update({f"whole file {key}": n for key, n in survives(read, data, tmp_path / "all.tlog", 6).items()})
    assert outcomes["partial"] + outcomes["whole"] > 0.9 * mutations_wanted()
