"""Attitudes in MAVLink: of the vehicle, and of a gimbal by the three messages that tell it, each in its own frame.

Source: https://mavlink.io/en/messages/common.html and https://mavlink.io/en/messages/ardupilotmega.html.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np

from pipeline.geometry.arrays import Bools, Floats, Ints, Singles
from pipeline.sources.mavlink.clock import orderly
from pipeline.sources.mavlink.frames import Rows
from pipeline.sources.mavlink.gimbal_flags import yaw_frames
from pipeline.sources.records import NS_PER_MS, Attitudes, Nanoseconds
from pipeline.sources.streams import is_rotation, ned_quaternions, segments, unit

Frame = Literal["ned", "heading", "body"]
Quaternions = Floats | Singles

# A mount whose angles undo the vehicle's tilt tells them in the body's axes: change of one against change of the other
# near -1, seen over enough of it.
_MIRROR_SAMPLES, _MIRROR_SLOPE, _MIRROR_CORRELATION = 50, (-1.5, -0.5), -0.7
_TILT_RAD = 0.005


def vehicle_attitudes(angles: Rows | None, quaternions: Rows | None) -> Attitudes | None:
    """The vehicle's attitude by whichever message came more often.

    Args:
        angles: ATTITUDE.
        quaternions: ATTITUDE_QUATERNION.

    Returns:
        The stream; None where there is no sample.
    """
    if quaternions is not None and (angles is None or len(quaternions) > len(angles)):
        q = np.stack([quaternions[name] for name in ("q1", "q2", "q3", "q4")], axis=1)
        return _stream("ATTITUDE_QUATERNION", quaternions["at"], _boot_ns(quaternions), q, "vehicle", "ned")
    if angles is None:
        return None
    q = ned_quaternions(angles["yaw"], angles["pitch"], angles["roll"])
    return _stream("ATTITUDE", angles["at"], _boot_ns(angles), q, "vehicle", "ned")


def gimbal_device(rows: Rows, time_ns: Nanoseconds, label: str) -> tuple[list[Attitudes], int]:
    """A gimbal by GIMBAL_DEVICE_ATTITUDE_STATUS, whose flags say what its yaw is measured from.

    Args:
        rows: Of one device.
        time_ns: (n,) on the log's clock.
        label: Name of the stream.

    Returns:
        One stream per frame, and how many messages name both frames, which is not allowed.
    """
    ned, heading = yaw_frames(rows["flags"])
    streams = _by_frame(label, rows["at"], time_ns, rows["q"], (ned, heading))
    return list(streams), int(np.count_nonzero(~ned & ~heading))


def mount_orientation(rows: Rows, time_ns: Nanoseconds, label: str) -> list[Attitudes]:
    """A gimbal by MOUNT_ORIENTATION: roll and pitch against the horizon, yaw from north where told, else from the nose.

    Args:
        rows: Of one sender.
        time_ns: (n,) on the log's clock.
        label: Name of the stream.

    Returns:
        One stream per frame.
    """
    absolute = rows["yaw_absolute"].astype(np.float64)
    # A sender that ever tells the absolute yaw means 0 when it is 0; one that never does has no such field.
    told = np.isfinite(absolute) & bool(np.any(np.isfinite(absolute) & (absolute != 0.0)))
    yaw = np.where(told, absolute, rows["yaw"].astype(np.float64))
    q = ned_quaternions(*(np.radians(v) for v in (yaw, rows["pitch"], rows["roll"])))
    return list(_by_frame(label, rows["at"], time_ns, q, (told, ~told)))


def mount_status(rows: Rows, time_ns: Nanoseconds, label: str, vehicle: Attitudes | None) -> list[Attitudes]:
    """A gimbal by MOUNT_STATUS, which does not say what its angles are measured from.

    ArduPilot's servo mounts tell the servos' angles, in the body's axes, other mounts the gimbal's own against the
    horizon. The first undo the vehicle's roll and pitch, and are told by that.

    Args:
        rows: Of one sender.
        time_ns: (n,) on the log's clock.
        label: Name of the stream.
        vehicle: The vehicle's attitude.

    Returns:
        One stream or none.
    """
    pitch, roll, yaw = (np.radians(rows[f"pointing_{axis}"] / 100.0) for axis in "abc")
    frame: Frame = "body" if vehicle is not None and _mirrors(time_ns, pitch, roll, vehicle) else "heading"
    stream = _stream(label, rows["at"], time_ns, ned_quaternions(yaw, pitch, roll), "gimbal", frame)
    return [] if stream is None else [stream]


def _mirrors(time_ns: Nanoseconds, pitch_rad: Floats, roll_rad: Floats, vehicle: Attitudes) -> bool:
    """Whether a mount's changes of pitch and roll are those of the vehicle, reversed."""
    inside = (time_ns >= vehicle.time_ns[0]) & (time_ns <= vehicle.time_ns[-1])
    if np.count_nonzero(inside) < _MIRROR_SAMPLES:
        return False
    w, x, y, z = vehicle.q_wxyz.T
    body_pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    body_roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pairs = []
    for of_mount, of_body in ((pitch_rad, body_pitch), (roll_rad, body_roll)):
        body = np.interp(time_ns[inside], vehicle.time_ns, np.unwrap(of_body))
        pairs.append((np.diff(np.unwrap(of_mount[inside])), np.diff(body)))
    mount, body = (np.concatenate(values) for values in zip(*pairs, strict=True))
    energy = float(body @ body)
    if energy < len(body) * _TILT_RAD**2:
        return False
    along = float(mount @ body)
    low, high = _MIRROR_SLOPE
    return low < along / energy < high and along < _MIRROR_CORRELATION * np.sqrt(energy * float(mount @ mount))


def _by_frame(
    label: str, at: Ints, time_ns: Nanoseconds, q_wxyz: Quaternions, ned_and_heading: tuple[Bools, Bools]
) -> Iterator[Attitudes]:
    """One stream for each frame that the samples are told in; a stream ends where the other frame cuts in."""
    frames: tuple[Frame, Frame] = ("ned", "heading")
    for frame, here in zip(frames, ned_and_heading, strict=True):
        runs = np.cumsum(np.diff(here, prepend=False), dtype=np.int64)
        stream = _stream(label, at, time_ns, q_wxyz, "gimbal", frame, here, runs)
        if stream is not None:
            yield stream


def _stream(
    label: str,
    at: Ints,
    time_ns: Nanoseconds,
    q_wxyz: Quaternions,
    of: Literal["vehicle", "gimbal"],
    frame: Frame,
    here: Bools | None = None,
    runs: Ints | None = None,
) -> Attitudes | None:
    # NaN is how a gimbal says that it does not know.
    told = is_rotation(q_wxyz)
    good = np.flatnonzero(told if here is None else told & here)
    good = good[orderly(at[good], time_ns[good])]
    if not len(good):
        return None
    segment = segments(time_ns[good], None if runs is None else runs[good])
    return Attitudes(label, time_ns[good], unit(q_wxyz[good]), of, frame, segment)


def _boot_ns(rows: Rows) -> Nanoseconds:
    out: Nanoseconds = rows["time_boot_ms"].astype(np.int64) * NS_PER_MS
    return out
