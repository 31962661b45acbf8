"""MAVLink telemetry logs (.tlog) of ground stations: one vehicle's positions, attitudes and camera events.

Source: https://mavlink.io/en/messages/common.html and https://mavlink.io/en/messages/ardupilotmega.html.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.sources.files import opened
from pipeline.sources.mavlink.attitudes import gimbal_device, mount_orientation, mount_status, vehicle_attitudes
from pipeline.sources.mavlink.camera import Placed, camera_feedback, camera_trigger, image_captured
from pipeline.sources.mavlink.frames import LATEST_STAMP_US, STAMP_BYTES, Rows, Telemetry, read_frames
from pipeline.sources.mavlink.positions import fused_positions, receiver_positions
from pipeline.sources.mavlink.vehicle import Vehicle, find_vehicle
from pipeline.sources.records import NS_PER_MS, NS_PER_S, Attitudes, Events, FlightLog, Nanoseconds, Positions, TimeBase

_KIND = "MAVLink telemetry"
_RECEIVER = ("time_usec", "fix_type", "lat", "lon", "alt", "alt_ellipsoid", "h_acc", "v_acc")
_WANTED = {
    "HEARTBEAT": ("type", "autopilot"),
    "SYSTEM_TIME": ("time_unix_usec", "time_boot_ms"),
    "GLOBAL_POSITION_INT": ("time_boot_ms", "lat", "lon", "alt", "relative_alt"),
    "GPS_RAW_INT": _RECEIVER,
    "GPS2_RAW": _RECEIVER,
    "ATTITUDE": ("time_boot_ms", "roll", "pitch", "yaw"),
    "ATTITUDE_QUATERNION": ("time_boot_ms", "q1", "q2", "q3", "q4"),
    "GIMBAL_DEVICE_ATTITUDE_STATUS": ("time_boot_ms", "flags", "q", "gimbal_device_id"),
    "MOUNT_ORIENTATION": ("time_boot_ms", "roll", "pitch", "yaw", "yaw_absolute"),
    "MOUNT_STATUS": ("pointing_a", "pointing_b", "pointing_c"),
    "CAMERA_FEEDBACK": ("time_usec", "img_idx", "cam_idx", "flags"),
    "CAMERA_IMAGE_CAPTURED": ("time_boot_ms", "image_index", "camera_id", "capture_result", "file_url"),
    "CAMERA_TRIGGER": ("time_usec", "seq"),
}
_MAGIC = (0xFE, 0xFD)
# 2000-01-01.
_EARLIEST_STAMP_US = 946_684_800_000_000


def is_format(head: bytes, name: str) -> bool:
    """Whether a file is a telemetry log: by its name, or by a stamp of this century before a MAVLink frame.

    Args:
        head: The file's first bytes.
        name: Path or URL.

    Returns:
        Whether `read` is for it.
    """
    if name.lower().endswith(".tlog"):
        return True
    stamp_us = int.from_bytes(head[:STAMP_BYTES], "big")
    dated = _EARLIEST_STAMP_US <= stamp_us < LATEST_STAMP_US
    return dated and len(head) > STAMP_BYTES and head[STAMP_BYTES] in _MAGIC


def read(location: str) -> FlightLog:
    """Reads a telemetry log.

    Args:
        location: Path or URL.

    Returns:
        What the log says of the vehicle with the most positions, on its autopilot's clock since boot.

    Raises:
        InputError: It is not there, or holds no MAVLink message.
        ResourceError: It may not be read.
    """
    with opened(location) as stream:
        telemetry = read_frames(stream, _WANTED)
    if not telemetry.counts:
        raise InputError(
            "E-TLOG-01",
            "no MAVLink message in a telemetry log",
            where=location,
            found=telemetry.losses[0] if telemetry.losses else "an empty file",
            expected="eight bytes of arrival time, then a MAVLink frame, over and over",
            hint="copy the log again from the ground station",
        )
    vehicle = find_vehicle(telemetry)
    if vehicle is None:
        losses = (*telemetry.losses, "no autopilot tells its time since boot: no streams")
        facts = {"mavlink_versions": telemetry.versions}
        return FlightLog(location, _KIND, telemetry.counts, TimeBase("boot"), losses=losses, facts=facts)
    gathered = _Gathered([*telemetry.losses, *vehicle.losses], _facts(telemetry, vehicle))
    gathered.add_positions(vehicle)
    gathered.add_attitudes(vehicle)
    gathered.add_events(vehicle)
    return FlightLog(
        location,
        _KIND,
        telemetry.counts,
        vehicle.base,
        tuple(gathered.positions),
        tuple(gathered.attitudes),
        tuple(gathered.events),
        losses=tuple(gathered.losses),
        facts=gathered.facts,
    )


@dataclass(slots=True)
class _Gathered:
    """A vehicle's streams as they come together."""

    losses: list[str]
    facts: dict[str, Any]
    positions: list[Positions] = field(default_factory=list)
    attitudes: list[Attitudes] = field(default_factory=list)
    events: list[Events] = field(default_factory=list)

    def add_positions(self, vehicle: Vehicle) -> None:
        """The receivers' positions, and before them the filter's, which borrows from the receivers."""
        for name in ("GPS_RAW_INT", "GPS2_RAW"):
            rows = vehicle.take_own(name)
            if rows is not None:
                stream, losses = receiver_positions(rows, name, vehicle.clock, vehicle.base)
                self.positions += [stream] if stream else []
                self.losses += losses
        rows = vehicle.take_own("GLOBAL_POSITION_INT")
        if rows is not None:
            stream, losses = fused_positions(rows, tuple(self.positions))
            self.positions[:0] = [stream] if stream else []
            self.losses += losses

    def add_attitudes(self, vehicle: Vehicle) -> None:
        """The vehicle's attitude and those of its gimbals."""
        body = vehicle_attitudes(vehicle.take_own("ATTITUDE"), vehicle.take_own("ATTITUDE_QUATERNION"))
        self.attitudes += [body] if body else []
        for label, own, rows in vehicle.take_parts("GIMBAL_DEVICE_ATTITUDE_STATUS", "gimbal_device_id"):
            streams, odd = gimbal_device(rows, self._time(vehicle, label, rows, own=own), label)
            self.attitudes += streams
            self.losses += [f"{odd} {label} messages name two frames at once and were left out"] if odd else []
        for label, own, rows in vehicle.take_parts("MOUNT_ORIENTATION"):
            self.attitudes += mount_orientation(rows, self._time(vehicle, label, rows, own=own), label)
        for label, _, rows in vehicle.take_parts("MOUNT_STATUS"):
            streams = mount_status(rows, vehicle.clock.of_arrival(rows), label, body)
            self.attitudes += streams
            if streams:
                undone = streams[0].frame == "body"
                seen = "its angles undo the vehicle's tilt" if undone else "the message does not say"
                self.facts.setdefault("gimbal_frames", {})[label] = f"{streams[0].frame}: {seen}"

    def add_events(self, vehicle: Vehicle) -> None:
        """Exposures and triggers."""
        clock, base = vehicle.clock, vehicle.base
        for label, _, rows in vehicle.take_parts("CAMERA_FEEDBACK", "cam_idx"):
            self._place(camera_feedback(rows, label, clock, base))
        for label, own, rows in vehicle.take_parts("CAMERA_IMAGE_CAPTURED", "camera_id"):
            self._place(image_captured(rows, label, clock, self._shift_ns(vehicle, label, rows, own=own)))
        for label, _, rows in vehicle.take_parts("CAMERA_TRIGGER"):
            self._place(camera_trigger(rows, label, clock, base))

    def _place(self, placed: Placed) -> None:
        self.events += placed.events
        self.losses += placed.losses

    def _time(self, vehicle: Vehicle, label: str, rows: Rows, *, own: bool) -> Nanoseconds:
        shift_ns = self._shift_ns(vehicle, label, rows, own=own)
        out: Nanoseconds = rows["time_boot_ms"].astype(np.int64) * NS_PER_MS + shift_ns
        return out

    def _shift_ns(self, vehicle: Vehicle, label: str, rows: Rows, *, own: bool) -> int:
        shift_ns = 0 if own else vehicle.clock_shift_ns(rows)
        if shift_ns:
            told = f"its own, {shift_ns / NS_PER_S:.2f} s behind the autopilot's by arrivals"
            self.facts.setdefault("component_clocks", {})[label] = told
        return shift_ns


def _facts(telemetry: Telemetry, vehicle: Vehicle) -> dict[str, Any]:
    from pymavlink.dialects.v20.ardupilotmega import enums  # noqa: PLC0415 - heavy

    facts: dict[str, Any] = {
        "system_id": vehicle.sender[0],
        "component_id": vehicle.sender[1],
        "mavlink_versions": telemetry.versions,
    }
    for key, enum, number in (
        ("autopilot", "MAV_AUTOPILOT", vehicle.autopilot),
        ("vehicle_type", "MAV_TYPE", vehicle.kind),
    ):
        if number >= 0:
            facts[key] = enums[enum][number].name if number in enums[enum] else f"{enum} {number}"
    return facts
