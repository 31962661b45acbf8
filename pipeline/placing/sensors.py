"""Where a LiDAR on the vehicle was: the body's pose and the sensor's place on it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.clocks.fit import Nanoseconds
from pipeline.engine.errors import UndeterminedError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import ENU_FROM_NED, rotation_from_quaternion
from pipeline.placing.pose import (
    LONGEST_ATTITUDE_GAP_S,
    LONGEST_POSITION_GAP_S,
    Z_UP_FROM_Y_UP,
    level_track,
    vehicle_rotations,
)
from pipeline.placing.timeline import FRD_FROM_FLU, Timeline, root_of
from pipeline.sources.bags.frame_tree import transform_between
from pipeline.sources.records import LocalPoses, Positions, SweepStream
from pipeline.tracks.mount import Mount
from pipeline.tracks.series import between, bracket, slerp

PosesAt = Callable[[Nanoseconds], tuple[Floats, Floats]]


def sensor_poses(
    line: Timeline, sweeps: SweepStream, mount: Mount | None, origin: LocalFrame | None, *, y_up: bool
) -> PosesAt:
    """From instants on the log's clock to the sensor's poses.

    Args:
        line: The log that holds sweeps and poses.
        sweeps: The stream.
        mount: The sensor (axes forward-left-up) on the body, as the user states it; None to find it in the log.
        origin: The run's ENU frame; None in a local frame.
        y_up: Whether the y axis of a local frame points up.

    Returns:
        A function of (n,) ns to (n, 3, 3) world_from_sensor and (n, 3) m; NaN where not known.

    Raises:
        UndeterminedError: Nothing says how the sensor sits on the body.
    """
    rotation, translation_m = _on_body(line, sweeps, mount)
    body = _local_body(line.local, y_up=y_up) if line.local is not None else _body_on_earth(line, origin)

    def poses_at(at_ns: Nanoseconds) -> tuple[Floats, Floats]:
        world_from_body, centre_m = body(at_ns)
        return world_from_body @ rotation, centre_m + world_from_body @ translation_m

    return poses_at


def _on_body(line: Timeline, sweeps: SweepStream, mount: Mount | None) -> tuple[Floats, Floats]:
    """body_from_sensor, both FLU (or the body's own axes, where the log's transforms tell)."""
    if mount is not None:
        stated = mount.body_from_camera if mount.angles_rad is not None else np.eye(3)
        frd = np.eye(3) if stated is None else stated
        return FRD_FROM_FLU @ frd @ FRD_FROM_FLU, FRD_FROM_FLU @ np.array(mount.lever_arm_m)
    body = (
        line.local.child if line.local is not None and line.local.child else root_of(line.log.transforms, sweeps.frame)
    )
    known = {frame for transform in line.log.transforms for frame in (transform.parent, transform.child)}
    # A frame that no transform names would be its own root, and the LiDAR would sit in the middle of the body.
    found = transform_between(line.log.transforms, body, sweeps.frame) if sweeps.frame in known else None
    if found is None:
        raise UndeterminedError(
            "E-BAG-22", "nothing says how the LiDAR sits on the body", where=line.log.location,
            found=f"sweeps in the frame {sweeps.frame or '(not named)'}, and no transform to it",
            expected="a static transform (/tf_static) from the body to the sensor",
            hint="--set 'ingest.lidar_mount={lever_arm_m=[0.0,0.0,0.0]}' (forward, right, down from what is posed)",
        )  # fmt: skip
    return rotation_from_quaternion(found[1]), np.asarray(found[0])


def _local_body(poses: LocalPoses, *, y_up: bool) -> PosesAt:
    turn = Z_UP_FROM_Y_UP if y_up else np.eye(3)

    def at(at_ns: Nanoseconds) -> tuple[Floats, Floats]:
        where = bracket(poses.time_ns, poses.segment, at_ns, LONGEST_ATTITUDE_GAP_S)
        rotation = turn @ rotation_from_quaternion(slerp(poses.q_wxyz, where))
        return rotation, between(poses.position_m, where) @ turn.T

    return at


def _body_on_earth(line: Timeline, origin: LocalFrame | None) -> PosesAt:
    positions: Positions | None = line.positions
    if positions is None or line.vehicle is None or origin is None:
        raise UndeterminedError(
            "E-BAG-23", "the LiDAR's sweeps cannot be placed", where=line.log.location,
            found="no positions or no attitude of the vehicle", expected="both in the same bag",
            hint="leave score.lidar to tiles, or the section [score] out",
        )  # fmt: skip
    frame, track_m = level_track(positions)
    track_m = origin.enu_from_ecef(frame.ecef_from_enu(track_m))

    def at(at_ns: Nanoseconds) -> tuple[Floats, Floats]:
        where = bracket(positions.time_ns, positions.segment, at_ns, LONGEST_POSITION_GAP_S)
        body = vehicle_rotations(line, at_ns)
        return ENU_FROM_NED @ body @ FRD_FROM_FLU, between(track_m, where)

    return at
