"""One log as a timeline: its clock against UTC, and the streams that tell where and how the camera was."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import TypeVar

import numpy as np

from pipeline.clocks.fit import ClockFit, Nanoseconds, fit_clock
from pipeline.clocks.gps import TABLE_HOLDS_UNTIL
from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import (
    ENU_FROM_NED,
    FRD_FROM_RDF,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from pipeline.sources.bags.frame_tree import transform_between
from pipeline.sources.records import Attitudes, Events, FixedTransform, FlightLog, LocalPoses, Positions
from pipeline.sources.time_bases import UNIX_EPOCH
from pipeline.tracks.mount import Mount

# Forward-left-up (ROS, REP 103) and forward-right-down differ by half a turn about forward.
FRD_FROM_FLU: Floats = np.diag([1.0, -1.0, -1.0])
# Parents of poses whose axes are east, north, up by convention (REP 105 for "map").
_EARTH_FRAMES = frozenset({"enu", "map", "earth", "world_enu"})
# A tenth of a millimetre: less than any log's last digit.
_LEAST_STEP_DEG = 1e-9
_ALIKE = 0.8

Stream = TypeVar("Stream", Positions, Attitudes, LocalPoses)


@dataclass(frozen=True, slots=True)
class Timeline:
    """A log, ready to be asked for poses.

    Args:
        log: What was read.
        clock: From the log's clock to UTC; None when nothing ties it.
        positions: The best stream of positions on earth: a filter's before a receiver's; or None.
        vehicle: The best stream of the vehicle's attitude, or None.
        gimbal: The best stream of the camera's attitude by its gimbal, or None.
        local: The stream of poses in a local frame, or None.
        events: Camera events, feedback before triggers, longest first.
        body_from_camera: (3, 3) FRD of both, from the log's fixed transforms; None when it holds none.
        lever_arm_m: (3,) from the log's transforms, body FRD; None when it holds none.
    """

    log: FlightLog
    clock: ClockFit | None
    positions: Positions | None
    vehicle: Attitudes | None
    gimbal: Attitudes | None
    local: LocalPoses | None
    events: tuple[Events, ...]
    body_from_camera: Floats | None = None
    lever_arm_m: Floats | None = None

    def utc_ns(self, log_ns: Nanoseconds) -> Nanoseconds:
        """Instants on UTC, or unchanged where nothing ties the clock to it."""
        return self.clock.apply(log_ns) if self.clock is not None else np.asarray(log_ns, np.int64)

    def log_ns(self, utc_ns: Nanoseconds) -> Nanoseconds:
        """From UTC, or the time shared where nothing ties the clock to it, back to the log's own clock."""
        if self.clock is None:
            return utc_ns
        guess = utc_ns - self.clock.offset_ns
        # The drift is parts per million: one step is exact to a nanosecond.
        return guess - (self.clock.apply(guess) - utc_ns)

    def utc(self, log_ns: int) -> datetime | None:
        """The UTC of one instant; None where nothing ties the clock to it."""
        if self.clock is None:
            return None
        return UNIX_EPOCH + timedelta(microseconds=int(self.utc_ns(np.array([log_ns], np.int64))[0]) / 1000)

    @property
    def names_images(self) -> bool:
        """Whether its poses belong to named images, not to instants."""
        stream = self.local if self.local is not None else self.positions
        return stream is not None and any(stream.image)

    @property
    def places(self) -> bool:
        """Whether it holds positions at all."""
        return self.positions is not None or self.local is not None


def timeline(log: FlightLog, pose_topic: str | None = None, camera_frame: str | None = None) -> Timeline:
    """Chooses the streams of a log.

    Args:
        log: What was read.
        pose_topic: The stream of local poses to use; None for the longest.
        camera_frame: Name of the camera's frame where the log names frames.

    Returns:
        The timeline.
    """
    frame = camera_frame or _camera_frame(log)
    positions = _liveliest([p for p in log.positions if p.fused]) or _liveliest(log.positions)
    vehicle = _longest([a for a in log.attitudes if a.of == "vehicle"])
    gimbal = _best_gimbal(log)
    carried = _longest([p for p in log.poses if frame and p.child == frame and p.parent])
    local = _local(log, pose_topic, carried)
    body_from_camera, lever = _extrinsics(log, frame, local)
    if positions is not None and local is not None and pose_topic is None:
        if vehicle is None and local.parent.lower() in _EARTH_FRAMES and local.of == "body":
            vehicle = _vehicle_from(local)
        local = None
    if carried is not None and gimbal is None and vehicle is not None:
        gimbal, lever = _gimbal_from(carried), np.median(carried.position_m, axis=0) @ FRD_FROM_FLU.T
    return Timeline(
        log,
        log_clock(log),
        None if pose_topic is not None and local is not None else positions,
        vehicle,
        gimbal,
        local,
        tuple(sorted(log.events, key=lambda e: (not e.feedback, -len(e.time_ns), e.stream))),
        body_from_camera,
        lever,
    )


def log_clock(log: FlightLog) -> ClockFit | None:
    """From a log's clock to UTC; None when nothing ties it."""
    base = log.time_base
    if base.epoch == "utc":
        return ClockFit(0, sigma_s=0.001)
    return fit_clock(base.anchor_log_ns, base.anchor_utc_ns, late=base.late)


def clock_problem(log: FlightLog, clock: ClockFit | None) -> str:
    """What to distrust of a log's clock; empty when nothing."""
    told = [log.time_base.problem] if log.time_base.problem else []
    if clock is None and not told:
        told.append("boot time only: nothing in the log says UTC")
    if clock is not None and clock.left_out:
        told.append(f"{clock.left_out} anchors were glitches")
    if clock is not None and log.time_base.epoch == "boot" and len(log.time_base.anchor_utc_ns):
        last_s = float(np.median(log.time_base.anchor_utc_ns)) / 1e9
        if last_s > TABLE_HOLDS_UNTIL.timestamp():
            told.append(f"leap seconds are known until {TABLE_HOLDS_UNTIL:%Y-%m-%d} only")
    return "; ".join(told)


def mount_of(line: Timeline, stated: Mount) -> Mount:
    """The mount that holds: what the user states before what the log's transforms say."""
    if any(stated.lever_arm_m) or line.lever_arm_m is None:
        return stated
    x, y, z = (float(value) for value in line.lever_arm_m)
    return Mount(stated.angles_rad, (x, y, z))


def _longest(streams: Iterable[Stream]) -> Stream | None:
    """The stream of most samples; of equals the first by name."""
    listed = [stream for stream in streams if len(stream.time_ns)]
    return min(listed, key=lambda stream: (-len(stream.time_ns), stream.stream)) if listed else None


def _liveliest(streams: Iterable[Positions]) -> Positions | None:
    """The stream whose position changes most often; of near equals the one that repeats itself least.

    A stream that repeats a slower one's fixes holds steps, not more. Where nothing tells (a hover, named images) it is
    that of most samples.
    """
    listed = [(stream, _moves(stream)) for stream in streams if len(stream.time_ns)]
    most = max((moves for _, moves in listed), default=0)
    lively = [(stream, moves / len(stream.time_ns)) for stream, moves in listed if moves >= _ALIKE * most]
    return min(lively, key=lambda p: (-p[1], -len(p[0].time_ns), p[0].stream))[0] if lively else None


def _moves(positions: Positions) -> int:
    steps_deg = np.maximum(np.abs(np.diff(positions.latitude_deg)), np.abs(np.diff(positions.longitude_deg)))
    return int(np.count_nonzero(steps_deg > _LEAST_STEP_DEG))


def _best_gimbal(log: FlightLog) -> Attitudes | None:
    """The gimbal stream of most samples; one against the horizon and north before one that needs the vehicle's."""
    streams = [a for a in log.attitudes if a.of == "gimbal" and len(a.time_ns)]
    most = max((len(a.time_ns) for a in streams), default=0)
    full = [a for a in streams if len(a.time_ns) >= most / 2]
    return min(full, key=_gimbal_order) if full else None


def _gimbal_order(stream: Attitudes) -> tuple[int, int, str]:
    return ("ned", "heading", "body").index(stream.frame), -len(stream.time_ns), stream.stream


def _camera_frame(log: FlightLog) -> str:
    """The frame of the log's images, or of its calibration where images went to a card; empty when not named."""
    frames = [stream.frame for stream in log.images] + [stream.frame for stream in log.cameras]
    return next((frame for frame in frames if frame), "")


def _local(log: FlightLog, pose_topic: str | None, carried: LocalPoses | None) -> LocalPoses | None:
    """The named stream, else the longest that is not an edge of /tf, else the longest."""
    if pose_topic is not None:
        return next((poses for poses in log.poses if poses.stream == pose_topic), None)
    streams = [poses for poses in log.poses if poses is not carried]
    return _longest(p for p in streams if not p.stream.startswith("/tf ")) or _longest(streams)


def _extrinsics(log: FlightLog, frame: str, local: LocalPoses | None) -> tuple[Floats | None, Floats | None]:
    """Camera on body from the fixed transforms, FRD: rotation and lever arm."""
    if not frame or not log.transforms:
        return None, None
    body = local.child if local is not None and local.child else root_of(log.transforms, frame)
    found = transform_between(log.transforms, body, frame)
    if found is None:
        return None, None
    translation, q_wxyz = found
    rotation = FRD_FROM_FLU @ rotation_from_quaternion(q_wxyz) @ FRD_FROM_RDF.T
    return rotation, FRD_FROM_FLU @ translation


def root_of(transforms: Sequence[FixedTransform], frame: str) -> str:
    """The frame that everything in a frame's tree hangs from.

    Args:
        transforms: Fixed transforms.
        frame: Where to begin.

    Returns:
        The root; `frame` itself where nothing holds it.
    """
    parents = {transform.child: transform.parent for transform in transforms}
    for _ in range(len(parents)):
        if frame not in parents:
            break
        frame = parents[frame]
    return frame


def _vehicle_from(poses: LocalPoses) -> Attitudes:
    """A body's attitude in a frame of east, north, up as the vehicle's in NED."""
    body = np.eye(3) if poses.axes == "frd" else FRD_FROM_FLU
    rotation = ENU_FROM_NED.T @ rotation_from_quaternion(poses.q_wxyz) @ body.T
    q_wxyz = quaternion_from_rotation(rotation)
    return Attitudes(poses.stream, poses.time_ns, q_wxyz, "vehicle", "ned", poses.segment)


def _gimbal_from(carried: LocalPoses) -> Attitudes:
    """A moving camera frame on the body as a gimbal measured against the body."""
    rotation = FRD_FROM_FLU @ rotation_from_quaternion(carried.q_wxyz) @ FRD_FROM_RDF.T
    q_wxyz = quaternion_from_rotation(rotation)
    return Attitudes(carried.stream, carried.time_ns, q_wxyz, "gimbal", "body", carried.segment)
