"""The simulated flight as a ground station logs it: MAVLink 2 frames behind their arrival times."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from pipeline.geometry.arrays import AnyArray, Floats
from pipeline.geometry.rotations import ned_from_frd, quaternion_from_rotation
from pipeline.simulation.recording import SIGMA_HORIZONTAL_M, SIGMA_VERTICAL_M, Recording

_SYSTEM, _AUTOPILOT = 1, 1
_QUADROTOR, _ARDUPILOT, _ARMED, _ACTIVE = 2, 3, 0x80, 4
_FIX_3D, _SATELLITES = 3, 19
_YAW_IN_EARTH_FRAME = 64
# The radio link: what every message takes, and by how much it varies.
_LATENCY_US, _JITTER_US = 40_000, 12_000
_SEED = 158

# When a message was sent, us since boot, and the message.
_Sent = tuple[int, Any]


def tlog(recording: Recording) -> bytes:
    """A telemetry log of the simulated flight.

    Times are whole milliseconds since boot, but those of the exposures, which are microseconds of UTC. The position
    and attitude in each CAMERA_FEEDBACK are those of the latest messages, as ArduPilot writes them: whoever takes them
    for the exposure's is late.

    Args:
        recording: What the recorder sees.

    Returns:
        The file's bytes, the same for the same recording.

    Source: https://mavlink.io/en/messages/ardupilotmega.html; MAVProxy, mavproxy.py, log_writer.
    """
    from pymavlink.dialects.v20 import ardupilotmega  # noqa: PLC0415 - heavy

    writer = ardupilotmega.MAVLink(None, srcSystem=_SYSTEM, srcComponent=_AUTOPILOT)
    streams = (_every_second, _positions, _receiver, _attitudes, _gimbal, _feedback)
    sent = sorted((item for stream in streams for item in stream(writer, recording)), key=lambda item: item[0])
    jitter_us = np.random.default_rng(_SEED).integers(0, _JITTER_US, len(sent))
    arrival_us = np.array([time_us for time_us, _ in sent]) + _LATENCY_US + jitter_us
    # A link keeps the order.
    arrival_us = recording.boot_utc_ns // 1000 + np.maximum.accumulate(arrival_us)
    out = []
    for stamp_us, (_, message) in zip(arrival_us.tolist(), sent, strict=True):
        out.append(struct.pack(">Q", stamp_us) + message.pack(writer))
        writer.seq = (writer.seq + 1) % 256
    return b"".join(out)


def _every_second(writer: Any, recording: Recording) -> Iterator[_Sent]:
    first, last = int(np.ceil(recording.attitude_s[0])), int(recording.attitude_s[-1])
    for second in range(first, last + 1):
        unix_us = recording.boot_utc_ns // 1000 + second * 1_000_000
        yield second * 1_000_000, writer.heartbeat_encode(_QUADROTOR, _ARDUPILOT, _ARMED, 0, _ACTIVE)
        yield second * 1_000_000, writer.system_time_encode(time_unix_usec=unix_us, time_boot_ms=second * 1000)


def _positions(writer: Any, recording: Recording) -> Iterator[_Sent]:
    velocity_cm_s = _whole(recording.velocity_ned_m_s, 100.0)
    heading_cdeg = _heading_cdeg(np.interp(recording.position_s, recording.attitude_s, recording.vehicle_rad[:, 0]))
    columns = {
        "lat": _whole(recording.latitude_deg, 1e7),
        "lon": _whole(recording.longitude_deg, 1e7),
        "alt": _whole(recording.amsl_m, 1000.0),
        "relative_alt": _whole(recording.above_home_m, 1000.0),
        "vx": velocity_cm_s[:, 0],
        "vy": velocity_cm_s[:, 1],
        "vz": velocity_cm_s[:, 2],
        "hdg": heading_cdeg,
    }
    for time_ms, values in _rows(recording.position_s, columns):
        yield time_ms * 1000, writer.global_position_int_encode(time_boot_ms=time_ms, **values)


def _receiver(writer: Any, recording: Recording) -> Iterator[_Sent]:
    here = np.array(recording.receiver)
    velocity = recording.velocity_ned_m_s[here]
    columns = {
        "lat": _whole(recording.latitude_deg[here], 1e7),
        "lon": _whole(recording.longitude_deg[here], 1e7),
        "alt": _whole(recording.amsl_m[here], 1000.0),
        "alt_ellipsoid": _whole(recording.ellipsoidal_m[here], 1000.0),
        "vel": _whole(np.hypot(velocity[:, 0], velocity[:, 1]), 100.0),
        "cog": _heading_cdeg(np.arctan2(velocity[:, 1], velocity[:, 0])),
    }
    constant = {
        "fix_type": _FIX_3D,
        "eph": 70,
        "epv": 110,
        "satellites_visible": _SATELLITES,
        "h_acc": round(SIGMA_HORIZONTAL_M * 1000),
        "v_acc": round(SIGMA_VERTICAL_M * 1000),
    }
    for time_ms, values in _rows(recording.position_s[here], columns):
        # ArduPilot tells the time of the fix since boot.
        yield time_ms * 1000, writer.gps_raw_int_encode(time_usec=time_ms * 1000, **constant, **values)


def _attitudes(writer: Any, recording: Recording) -> Iterator[_Sent]:
    angles = recording.vehicle_rad
    # At the few degrees of this flight the changes of the angles are the rates about the body's axes.
    rates = np.gradient(angles, recording.attitude_s, axis=0)
    columns = {
        "roll": angles[:, 2],
        "pitch": angles[:, 1],
        "yaw": np.arctan2(np.sin(angles[:, 0]), np.cos(angles[:, 0])),
        "rollspeed": rates[:, 2],
        "pitchspeed": rates[:, 1],
        "yawspeed": rates[:, 0],
    }
    for time_ms, values in _rows(recording.attitude_s, columns):
        yield time_ms * 1000, writer.attitude_encode(time_boot_ms=time_ms, **values)


def _gimbal(writer: Any, recording: Recording) -> Iterator[_Sent]:
    q_wxyz = quaternion_from_rotation(ned_from_frd(*recording.gimbal_rad.T))
    unknown = float("nan")
    for time_ms, values in _rows(recording.attitude_s, {"q": q_wxyz}):
        message = writer.gimbal_device_attitude_status_encode(
            target_system=0,
            target_component=0,
            time_boot_ms=time_ms,
            flags=_YAW_IN_EARTH_FRAME,
            angular_velocity_x=unknown,
            angular_velocity_y=unknown,
            angular_velocity_z=unknown,
            failure_flags=0,
            delta_yaw=unknown,
            delta_yaw_velocity=unknown,
            gimbal_device_id=1,
            **values,
        )
        yield time_ms * 1000, message


def _feedback(writer: Any, recording: Recording) -> Iterator[_Sent]:
    position = np.maximum(np.searchsorted(recording.position_s, recording.trigger_s, side="right") - 1, 0)
    attitude = np.maximum(np.searchsorted(recording.attitude_s, recording.trigger_s, side="right") - 1, 0)
    degrees = np.degrees(recording.vehicle_rad[attitude])
    unix_us = np.rint(recording.utc_ns(recording.trigger_s) / 1000.0).astype(np.int64)
    columns = {
        "time_usec": unix_us,
        "lat": _whole(recording.latitude_deg[position], 1e7),
        "lng": _whole(recording.longitude_deg[position], 1e7),
        "alt_msl": recording.amsl_m[position],
        "alt_rel": recording.above_home_m[position],
        "roll": degrees[:, 2],
        "pitch": degrees[:, 1],
        "yaw": degrees[:, 0] % 360.0,
        "img_idx": np.arange(len(unix_us)),
        "completed_captures": np.arange(1, len(unix_us) + 1),
    }
    for number, (_, values) in enumerate(_rows(recording.trigger_s, columns)):
        message = writer.camera_feedback_encode(target_system=_SYSTEM, cam_idx=0, foc_len=0.0, flags=0, **values)
        yield int(unix_us[number] - recording.boot_utc_ns // 1000), message


def _rows(time_s: Floats, columns: dict[str, AnyArray]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Milliseconds since boot and fields of each message."""
    lists = {name: values.tolist() for name, values in columns.items()}
    for index, time_ms in enumerate(_whole(time_s, 1000.0).tolist()):
        yield time_ms, {name: values[index] for name, values in lists.items()}


def _whole(values: Floats, per_unit: float) -> AnyArray:
    return np.rint(values * per_unit).astype(np.int64)


def _heading_cdeg(yaw_rad: Floats) -> AnyArray:
    return _whole(np.degrees(yaw_rad) % 360.0, 100.0) % 36_000
