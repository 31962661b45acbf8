"""The simulated flight as an ArduPilot autopilot logs it: a binary DataFlash log (.BIN)."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta

import numpy as np

from pipeline.clocks.gps import GPS_EPOCH, leap_seconds
from pipeline.geometry.arrays import AnyArray, Floats
from pipeline.simulation.recording import SIGMA_HORIZONTAL_M, SIGMA_VERTICAL_M, Recording

FIRMWARE = "ArduCopter V4.5.0 (simulated)"
# Type, format characters and fields of each message, those of the firmware's LogStructure.h.
MESSAGES: Mapping[str, tuple[int, str, str]] = {
    "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "MSG": (129, "QZ", "TimeUS,Message"),
    "PARM": (130, "QNff", "TimeUS,Name,Value,Default"),
    "GPS": (131, "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "GPA": (132, "QBCCCCfBIHeHH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta,AEl,RTCMFU,RTCMFD"),
    "POS": (133, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "ATT": (134, "QccccCCCCB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF"),
    "MNT": (135, "QBfffffffff", "TimeUS,I,DRoll,Roll,DPitch,Pitch,DYawB,YawB,DYawE,YawE,Dist"),
    "CAM": (136, "QBHIHLLeeeccC", "TimeUS,I,Img,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt,R,P,Y"),
}
# What a format character is stored as, and the units that a stored 1 stands for.
_STORED = {
    "B": ("u1", 1.0), "H": ("<u2", 1.0), "I": ("<u4", 1.0), "Q": ("<u8", 1.0), "f": ("<f4", 1.0), "n": ("S4", 1.0),
    "N": ("S16", 1.0), "Z": ("S64", 1.0), "c": ("<i2", 0.01), "C": ("<u2", 0.01), "e": ("<i4", 0.01),
    "L": ("<i4", 1e-7),
}  # fmt: skip
_HEAD = (("head", "S2"), ("kind", "u1"))
_MAGIC = b"\xa3\x95"
_FIX_3D = 3
# From the receiver's sample to the message, and from the exposure to its CAM.
_LATENCY_US, _FEEDBACK_US = 120_000, 8_000
_GPS_MS, _WEEK_MS = 200, 604_800_000
_SATELLITES, _HDOP = 17, 0.7
# The camera reports its exposures through this pin.
_PARAMETERS = (("CAM1_TYPE", 1.0), ("CAM1_FEEDBAK_PIN", 54.0), ("MNT1_TYPE", 1.0))


def dataflash(recording: Recording) -> bytes:
    """A DataFlash log of the simulated flight, times in whole microseconds since boot.

    As the firmware does: CAM has the exposure's time, and the position and attitude of the latest messages when it is
    written; one MNT more is written with it, under the same time.

    Args:
        recording: What the recorder sees.

    Returns:
        The file's bytes, the same for the same recording.

    Source: ArduPilot, LogStructure.h of AP_Logger, AP_GPS, AP_AHRS, AP_Camera and AP_Mount; AP_Camera_Logging.cpp.
    """
    position_us, attitude_us = (_microseconds(t) for t in (recording.position_s, recording.attitude_s))
    written_us = _microseconds(recording.trigger_s) + _FEEDBACK_US
    latest = np.clip(np.searchsorted(attitude_us, written_us, "right") - 1, 0, None)
    gimbal = _gimbal(attitude_us, recording.vehicle_rad, recording.gimbal_rad)
    with_photo = gimbal[latest]
    with_photo["TimeUS"] = written_us - _FEEDBACK_US
    fixes, accuracies = _receiver(recording)
    blocks = [
        (fixes["TimeUS"], fixes),
        (accuracies["TimeUS"], accuracies),
        (position_us, _positions(recording, position_us)),
        (attitude_us, _attitudes(recording, attitude_us)),
        (attitude_us, gimbal),
        (written_us, _camera(recording, written_us, latest, fixes)),
        (written_us, with_photo),
    ]
    began_us = int(min(times[0] for times, rows in blocks if len(rows)))
    return b"".join([*_formats(), *_beginning(began_us), *_in_order_of_writing(blocks)])


def records(name: str, **columns: AnyArray | float | bytes) -> AnyArray:
    """Messages as they are stored, in units of the fields' names.

    Args:
        name: The message.
        columns: Fields, (n,) or one for all; those left out are 0.

    Returns:
        (n,) records of the whole message, header included.
    """
    kind, letters, fields = MESSAGES[name]
    layout = [(field, *_STORED[letter]) for field, letter in zip(fields.split(","), letters, strict=True)]
    n = max(len(np.atleast_1d(np.asarray(column))) for column in columns.values())
    rows = np.zeros(n, np.dtype([*_HEAD, *((field, stored) for field, stored, _ in layout)]))
    rows["head"], rows["kind"] = _MAGIC, kind
    for field, stored, unit in layout:
        if field in columns:
            value = columns[field]
            whole = np.dtype(stored).kind in "iu"
            rows[field] = np.rint(np.asarray(value, np.float64) / unit) if whole and unit != 1.0 else value
    return rows


def _formats() -> list[bytes]:
    out = []
    for name, (kind, letters, fields) in MESSAGES.items():
        length = 3 + sum(np.dtype(_STORED[letter][0]).itemsize for letter in letters)
        texts = (text.encode() for text in (name, letters, fields))
        out.append(struct.pack("<2sBBB4s16s64s", _MAGIC, MESSAGES["FMT"][0], kind, length, *texts))
    return out


def _beginning(time_us: int) -> list[bytes]:
    told = [records("MSG", TimeUS=time_us, Message=FIRMWARE.encode())]
    told += [records("PARM", TimeUS=time_us, Name=n.encode(), Value=v, Default=0.0) for n, v in _PARAMETERS]
    return [rows.tobytes() for rows in told]


def _in_order_of_writing(blocks: Sequence[tuple[AnyArray, AnyArray]]) -> list[bytes]:
    written = [
        (int(time), number, row.tobytes())
        for number, (times, rows) in enumerate(blocks)
        for time, row in zip(times, rows, strict=True)
    ]
    return [message for _, _, message in sorted(written)]


def _microseconds(seconds: Floats) -> AnyArray:
    return np.rint(np.asarray(seconds) * 1e6).astype(np.int64)


def _receiver(recording: Recording) -> tuple[AnyArray, AnyArray]:
    which = np.array(recording.receiver)
    sample_s = recording.position_s[which]
    time_us = _microseconds(sample_s) + _LATENCY_US
    gps_ms = np.rint(recording.utc_ns(sample_s) / 1e6).astype(np.int64) + _gps_minus_unix_ms(recording.boot_utc_ns)
    north, east, down = recording.velocity_ned_m_s[which].T
    course = np.degrees(np.arctan2(east, north)) % 360.0
    fixes = records(
        "GPS", TimeUS=time_us, Status=_FIX_3D, GMS=gps_ms % _WEEK_MS, GWk=gps_ms // _WEEK_MS, NSats=_SATELLITES,
        HDop=_HDOP, Lat=recording.latitude_deg[which], Lng=recording.longitude_deg[which], Alt=recording.amsl_m[which],
        Spd=np.hypot(north, east), GCrs=course, VZ=down, U=1,
    )  # fmt: skip
    accuracies = records(
        "GPA", TimeUS=time_us, VDop=1.1, HAcc=SIGMA_HORIZONTAL_M, VAcc=SIGMA_VERTICAL_M, SAcc=0.1, VV=1,
        SMS=np.rint(sample_s * 1e3), Delta=_GPS_MS, AEl=recording.ellipsoidal_m[which],
    )  # fmt: skip
    return fixes, accuracies


def _gps_minus_unix_ms(utc_ns: int) -> int:
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=utc_ns // 1000)
    return 1000 * leap_seconds(moment) - round(GPS_EPOCH.timestamp() * 1000)


def _positions(recording: Recording, time_us: AnyArray) -> AnyArray:
    return records(
        "POS", TimeUS=time_us, Lat=recording.latitude_deg, Lng=recording.longitude_deg, Alt=recording.amsl_m,
        RelHomeAlt=recording.above_home_m, RelOriginAlt=recording.above_home_m,
    )  # fmt: skip


def _attitudes(recording: Recording, time_us: AnyArray) -> AnyArray:
    yaw, pitch, roll = np.degrees(recording.vehicle_rad).T
    return records(
        "ATT", TimeUS=time_us, DesRoll=roll, Roll=roll, DesPitch=pitch, Pitch=pitch, DesYaw=yaw % 360.0,
        Yaw=yaw % 360.0, AEKF=3,
    )  # fmt: skip


def _gimbal(time_us: AnyArray, vehicle_rad: Floats, gimbal_rad: Floats) -> AnyArray:
    yaw, pitch, roll = np.degrees(gimbal_rad).T
    from_nose = _wrapped(yaw - np.degrees(vehicle_rad[:, 0]))
    # The gimbal is pointed in the earth's frame, so there is no desired yaw from the nose.
    return records(
        "MNT", TimeUS=time_us, DRoll=roll, Roll=roll, DPitch=pitch, Pitch=pitch, DYawB=np.nan, YawB=from_nose,
        DYawE=_wrapped(yaw), YawE=_wrapped(yaw), Dist=np.nan,
    )  # fmt: skip


def _camera(recording: Recording, written_us: AnyArray, latest: AnyArray, fixes: AnyArray) -> AnyArray:
    position_us = _microseconds(recording.position_s)
    place = np.clip(np.searchsorted(position_us, written_us, "right") - 1, 0, None)
    fix = fixes[np.clip(np.searchsorted(fixes["TimeUS"], written_us, "right") - 1, 0, None)]
    yaw, pitch, roll = np.degrees(recording.vehicle_rad[latest]).T
    return records(
        "CAM", TimeUS=written_us - _FEEDBACK_US, Img=np.arange(1, len(written_us) + 1), GPSTime=fix["GMS"],
        GPSWeek=fix["GWk"], Lat=recording.latitude_deg[place], Lng=recording.longitude_deg[place],
        Alt=recording.amsl_m[place], RelAlt=recording.above_home_m[place], GPSAlt=fix["Alt"] * 0.01, R=roll, P=pitch,
        Y=yaw % 360.0,
    )  # fmt: skip


def _wrapped(degrees: Floats) -> Floats:
    out: Floats = (degrees + 180.0) % 360.0 - 180.0
    return out
