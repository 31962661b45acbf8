"""The simulated flight as a PX4 autopilot logs it: a ULog with positions, GPS, attitudes, gimbal and captures."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from pipeline.geometry.arrays import AnyArray, Floats
from pipeline.geometry.rotations import ned_from_frd, quaternion_from_rotation
from pipeline.simulation.recording import SIGMA_HORIZONTAL_M, SIGMA_VERTICAL_M, Recording

_MAGIC = b"ULog\x01\x12\x35\x01"
_TYPES = {"u8": "uint64_t", "u4": "uint32_t", "u2": "uint16_t", "u1": "uint8_t", "i4": "int32_t", "i1": "int8_t",
          "f8": "double", "f4": "float", "b1": "bool"}  # fmt: skip
# Fields and their order are those of PX4 1.15: larger types first.
_TOPICS: dict[str, list[tuple[Any, ...]]] = {
    "home_position": [
        ("timestamp", "u8"), ("lat", "f8"), ("lon", "f8"), ("alt", "f4"), ("x", "f4"), ("y", "f4"), ("z", "f4"),
        ("yaw", "f4"), ("valid_alt", "b1"), ("valid_hpos", "b1"), ("valid_lpos", "b1"), ("manual_home", "b1"),
    ],
    "vehicle_global_position": [
        ("timestamp", "u8"), ("timestamp_sample", "u8"), ("lat", "f8"), ("lon", "f8"), ("alt", "f4"),
        ("alt_ellipsoid", "f4"), ("delta_alt", "f4"), ("eph", "f4"), ("epv", "f4"), ("terrain_alt", "f4"),
        ("lat_lon_reset_counter", "u1"), ("alt_reset_counter", "u1"), ("terrain_alt_valid", "b1"),
        ("dead_reckoning", "b1"),
    ],
    "sensor_gps": [
        ("timestamp", "u8"), ("timestamp_sample", "u8"), ("latitude_deg", "f8"), ("longitude_deg", "f8"),
        ("altitude_msl_m", "f8"), ("altitude_ellipsoid_m", "f8"), ("time_utc_usec", "u8"), ("device_id", "u4"),
        ("eph", "f4"), ("epv", "f4"), ("vel_n_m_s", "f4"), ("vel_e_m_s", "f4"), ("vel_d_m_s", "f4"),
        ("timestamp_time_relative", "i4"), ("fix_type", "u1"), ("vel_ned_valid", "b1"), ("satellites_used", "u1"),
    ],
    "vehicle_attitude": [
        ("timestamp", "u8"), ("timestamp_sample", "u8"), ("q", "f4", 4), ("delta_q_reset", "f4", 4),
        ("quat_reset_counter", "u1"),
    ],
    "gimbal_device_attitude_status": [
        ("timestamp", "u8"), ("q", "f4", 4), ("angular_velocity_x", "f4"), ("angular_velocity_y", "f4"),
        ("angular_velocity_z", "f4"), ("failure_flags", "u4"), ("delta_yaw", "f4"), ("delta_yaw_velocity", "f4"),
        ("device_flags", "u2"), ("target_system", "u1"), ("target_component", "u1"), ("gimbal_device_id", "u1"),
        ("received_from_mavlink", "b1"),
    ],
    "camera_capture": [
        ("timestamp", "u8"), ("timestamp_utc", "u8"), ("lat", "f8"), ("lon", "f8"), ("seq", "u4"), ("alt", "f4"),
        ("ground_distance", "f4"), ("q", "f4", 4), ("result", "i1"),
    ],
}  # fmt: skip
_INFO = (("char[3] sys_name", b"PX4"), ("char[11] ver_hw", b"PX4_FMU_V6C"), ("uint32_t ver_sw_release", 0x010F00FF))
# The camera reports its exposures by the hot shoe.
_PARAMETER = ("int32_t CAM_CAP_FBACK", 1)
_YAW_IN_EARTH_FRAME = 64
_FIX_3D = 3
# The filter publishes this long after the instant that its output is of.
_PUBLISHED_AFTER_US = 450


def ulog(recording: Recording) -> bytes:
    """A ULog of the simulated flight, times in whole microseconds since boot.

    The position and attitude in each camera_capture are those of the latest messages, as PX4 writes them: whoever
    takes them for the exposure's is late.

    Args:
        recording: What the recorder sees.

    Returns:
        The file's bytes, the same for the same recording.

    Source: PX4 user guide, "ULog File Format", and the uORB message reference of PX4 1.15.
    """
    records = {
        "home_position": _home(recording),
        "vehicle_global_position": _global_positions(recording),
        "sensor_gps": _receiver(recording),
        "vehicle_attitude": _attitudes("vehicle_attitude", recording.attitude_s, recording.vehicle_rad),
        "gimbal_device_attitude_status": _gimbal(recording),
        "camera_capture": _captures(recording),
    }
    first_us = min(int(rows["timestamp"][0]) for rows in records.values() if len(rows))
    head = [_MAGIC + struct.pack("<Q", first_us), _message("B", bytes(40))]
    formats = [_message("F", f"{topic}:{_definition(topic)}".encode()) for topic in records]
    names = [_message("A", struct.pack("<BH", 0, n) + topic.encode()) for n, topic in enumerate(records)]
    values = [*(_value("I", *info) for info in _INFO), _value("P", *_PARAMETER)]
    return b"".join([*head, *formats, *values, *names, *_in_time_order(records)])


def _in_time_order(records: dict[str, AnyArray]) -> list[bytes]:
    data = []
    for number, rows in enumerate(records.values()):
        head = struct.pack("<HBH", rows.dtype.itemsize + 2, ord("D"), number)
        data += [(int(row["timestamp"]), number, head + row.tobytes()) for row in rows]
    return [message for _, _, message in sorted(data)]


def _message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


def _value(kind: str, key: str, value: bytes | int) -> bytes:
    content = value if isinstance(value, bytes) else struct.pack("<I", value)
    return _message(kind, bytes([len(key)]) + key.encode() + content)


def _definition(topic: str) -> str:
    fields = ((name, _TYPES[code], count) for name, code, *count in _TOPICS[topic])
    return "".join(f"{kind}[{count[0]}] {name};" if count else f"{kind} {name};" for name, kind, count in fields)


def _rows(topic: str, time_us: AnyArray) -> AnyArray:
    """Records of a topic, all zero but their times."""
    dtype = np.dtype([(name, f"<{code}", *count) for name, code, *count in _TOPICS[topic]])
    rows = np.zeros(len(time_us), dtype)
    rows["timestamp"] = time_us
    return rows


def _microseconds(seconds: Floats) -> AnyArray:
    return np.rint(np.asarray(seconds) * 1e6).astype(np.uint64)


def _home(recording: Recording) -> AnyArray:
    rows = _rows("home_position", _microseconds(recording.position_s[:1]))
    rows["lat"], rows["lon"] = recording.latitude_deg[0], recording.longitude_deg[0]
    rows["alt"] = recording.amsl_m[0] - recording.above_home_m[0]
    rows["valid_alt"] = rows["valid_hpos"] = True
    return rows


def _global_positions(recording: Recording) -> AnyArray:
    sampled = _microseconds(recording.position_s)
    rows = _rows("vehicle_global_position", sampled + np.uint64(_PUBLISHED_AFTER_US))
    rows["timestamp_sample"] = sampled
    rows["lat"], rows["lon"] = recording.latitude_deg, recording.longitude_deg
    rows["alt"], rows["alt_ellipsoid"] = recording.amsl_m, recording.ellipsoidal_m
    rows["eph"], rows["epv"] = SIGMA_HORIZONTAL_M, SIGMA_VERTICAL_M
    return rows


def _receiver(recording: Recording) -> AnyArray:
    which = list(recording.receiver)
    rows = _rows("sensor_gps", _microseconds(recording.position_s[which]))
    rows["latitude_deg"], rows["longitude_deg"] = recording.latitude_deg[which], recording.longitude_deg[which]
    rows["altitude_msl_m"], rows["altitude_ellipsoid_m"] = recording.amsl_m[which], recording.ellipsoidal_m[which]
    rows["vel_n_m_s"], rows["vel_e_m_s"], rows["vel_d_m_s"] = recording.velocity_ned_m_s[which].T
    rows["time_utc_usec"] = (recording.boot_utc_ns // 1000) + rows["timestamp"].astype(np.int64)
    rows["eph"], rows["epv"] = SIGMA_HORIZONTAL_M, SIGMA_VERTICAL_M
    rows["fix_type"], rows["satellites_used"], rows["vel_ned_valid"] = _FIX_3D, 17, True
    return rows


def _quaternions(angles_rad: Floats) -> Floats:
    return quaternion_from_rotation(ned_from_frd(*angles_rad.T))


def _attitudes(topic: str, seconds: Floats, angles_rad: Floats) -> AnyArray:
    sampled = _microseconds(seconds)
    rows = _rows(topic, sampled + np.uint64(_PUBLISHED_AFTER_US))
    rows["timestamp_sample"], rows["q"] = sampled, _quaternions(angles_rad)
    return rows


def _gimbal(recording: Recording) -> AnyArray:
    rows = _rows("gimbal_device_attitude_status", _microseconds(recording.attitude_s))
    rows["q"], rows["device_flags"] = _quaternions(recording.gimbal_rad), _YAW_IN_EARTH_FRAME
    rows["delta_yaw"] = rows["delta_yaw_velocity"] = np.nan
    return rows


def _captures(recording: Recording) -> AnyArray:
    rows = _rows("camera_capture", _microseconds(recording.trigger_s))
    at = np.maximum(np.searchsorted(recording.position_s, recording.trigger_s, side="right") - 1, 0)
    rows["lat"], rows["lon"] = recording.latitude_deg[at], recording.longitude_deg[at]
    rows["alt"], rows["ground_distance"] = recording.amsl_m[at], -1.0
    turned = np.maximum(np.searchsorted(recording.attitude_s, recording.trigger_s, side="right") - 1, 0)
    rows["q"] = _quaternions(recording.vehicle_rad[turned])
    rows["timestamp_utc"] = (recording.boot_utc_ns // 1000) + rows["timestamp"].astype(np.int64)
    rows["seq"], rows["result"] = np.arange(len(rows)), 1
    return rows
