"""The camera's pose at instants of a log: interpolated streams, mount and lever arm, and how fast it all changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from pipeline.clocks.fit import Nanoseconds
from pipeline.geodesy.enu import LocalFrame
from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.rotations import (
    ENU_FROM_NED,
    FRD_FROM_RDF,
    gimbal_error_axes,
    rotation_from_quaternion,
    vector_from_rotation,
)
from pipeline.placing.timeline import FRD_FROM_FLU, Timeline, mount_of
from pipeline.sources.records import Attitudes, LocalPoses, Positions
from pipeline.tracks.mount import CONTRADICTION_DEG, Mount, contradiction_deg, ned_from_gimbal
from pipeline.tracks.series import Bracket, bend, between, bracket, slerp, turn_bend

# Positions come at 1 to 50 Hz, attitudes at 2 Hz and more; over longer gaps a drone may have done anything.
LONGEST_POSITION_GAP_S = 2.5
LONGEST_ATTITUDE_GAP_S = 1.5
# A frame whose y axis points up (Motive's default) as one whose z axis does: a quarter turn about x.
Z_UP_FROM_Y_UP: Floats = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
# Half the time over which speed and turning are taken.
_HALF_NS = 50_000_000

Path = Callable[[Nanoseconds], tuple[Floats, Floats]]


@dataclass(frozen=True, slots=True)
class CameraPoses:
    """Poses of the camera at k instants, and what an error of the instants does to them.

    Args:
        rotation: (k, 3, 3) enu_from_cam (RDF), against the place's own north, or a local frame's axes; NaN if unknown.
        centre_m: (k, 3) camera centres, m: in `frame`, or in the local frame, z up.
        frame: What `centre_m` is in; None in a local frame.
        ellipsoidal_m: (k,) heights of the camera; NaN where not logged, as the next two.
        amsl_m: (k,).
        above_home_m: (k,).
        sigma_horizontal_m: (k,) as logged; NaN where not.
        sigma_vertical_m: (k,) as logged; NaN where not.
        velocity_m_s: (k, 3) east, north, up.
        turning_rad_s: (k, 3) about the yaw, pitch and roll axes of `gimbal_error_axes`.
        bend_m: (k, 3) what straight lines between samples may miss.
        bend_rad: (k,) what turning evenly between samples may miss.
        outside: (k,) whether the instant lies before or after the stream altogether.
        reason: Per instant, why there is no pose; empty where there is one.
        source: Streams used, for people.
        notes: What to tell the user.
    """

    rotation: Floats
    centre_m: Floats
    frame: LocalFrame | None
    ellipsoidal_m: Floats
    amsl_m: Floats
    above_home_m: Floats
    sigma_horizontal_m: Floats
    sigma_vertical_m: Floats
    velocity_m_s: Floats
    turning_rad_s: Floats
    bend_m: Floats
    bend_rad: Floats
    outside: Bools
    reason: tuple[str, ...]
    source: str
    notes: tuple[str, ...] = ()


def camera_poses(line: Timeline, at_ns: Nanoseconds, mount: Mount, *, y_up: bool = False) -> CameraPoses:
    """The camera's poses at instants of a log's own clock.

    Args:
        line: The log; it holds positions or local poses.
        at_ns: (k,) instants on the log's clock.
        mount: As the user states it; the log's own transforms and gimbal fill in what is not stated.
        y_up: Whether a local frame's y axis points up (motion capture) instead of z.

    Returns:
        The poses.
    """
    mount = mount_of(line, mount)
    if line.local is not None:
        return _in_local_frame(line, line.local, at_ns, mount, y_up=y_up)
    if line.positions is None:
        raise ValueError("a log without positions places nothing")
    return _on_earth(line, line.positions, at_ns, mount)


def _on_earth(line: Timeline, positions: Positions, at_ns: Nanoseconds, mount: Mount) -> CameraPoses:
    where = bracket(positions.time_ns, positions.segment, at_ns, LONGEST_POSITION_GAP_S)
    frame, track_m = level_track(positions)
    path = partial(_path_on_earth, line, positions, track_m, mount)
    centre_m, rotation = path(at_ns)
    lever_up_m = centre_m[:, 2] - between(track_m, where)[:, 2]
    names = ("ellipsoidal_m", "amsl_m", "above_home_m")
    ellipsoidal_m, amsl_m, above_home_m = (between(getattr(positions, name), where) + lever_up_m for name in names)
    velocity, turning = _changes(path, at_ns, rotation)
    streams = (positions, line.gimbal if mount.angles_rad is None and line.gimbal is not None else line.vehicle)
    return CameraPoses(
        rotation,
        centre_m,
        frame,
        ellipsoidal_m,
        amsl_m,
        above_home_m,
        between(positions.sigma_horizontal_m, where),
        between(positions.sigma_vertical_m, where),
        velocity,
        turning,
        bend(track_m, positions.time_ns, positions.segment, where, LONGEST_POSITION_GAP_S),
        _turn_bend(line, mount, at_ns),
        _outside(at_ns, positions.time_ns),
        _reasons(at_ns, where, positions, rotation, _unaimed(line, mount), centre_m),
        f"{line.log.kind}: {' + '.join(stream.stream for stream in streams if stream is not None)}",
        tuple(_contradictions(line, mount, at_ns)),
    )


def _turn_bend(line: Timeline, mount: Mount, at_ns: Nanoseconds) -> Floats:
    """What the attitudes that aim the camera may miss between their samples, (k,) rad."""
    by_gimbal = mount.angles_rad is None and line.gimbal is not None
    needs_body = not by_gimbal or (line.gimbal is not None and line.gimbal.frame != "ned")
    out = np.zeros(len(at_ns))
    for stream in (line.gimbal if by_gimbal else None, line.vehicle if needs_body else None):
        if stream is not None:
            where = bracket(stream.time_ns, stream.segment, at_ns, LONGEST_ATTITUDE_GAP_S)
            missed = turn_bend(stream.q_wxyz, stream.time_ns, stream.segment, where, LONGEST_ATTITUDE_GAP_S)
            out = np.hypot(out, missed)
    return out


def level_track(positions: Positions) -> tuple[LocalFrame, Floats]:
    """A stream's positions as metres east, north, up, (n, 3), in a frame at its middle.

    The height is the one that the stream holds most of, lines over what is missing; zero where it has none.
    """
    middle = len(positions.time_ns) // 2
    height = max(
        (positions.ellipsoidal_m, positions.amsl_m, positions.above_home_m),
        key=lambda h: np.count_nonzero(np.isfinite(h)),
    )
    known = np.isfinite(height)
    row = np.arange(len(height))
    height = np.interp(row, row[known], height[known]) if known.any() else np.zeros(len(height))
    frame = LocalFrame(
        float(positions.latitude_deg[middle]), float(positions.longitude_deg[middle]), float(height[middle])
    )
    return frame, frame.enu_from_geodetic(positions.latitude_deg, positions.longitude_deg, height)


def _path_on_earth(
    line: Timeline, positions: Positions, track_m: Floats, mount: Mount, at_ns: Nanoseconds
) -> tuple[Floats, Floats]:
    where = bracket(positions.time_ns, positions.segment, at_ns, LONGEST_POSITION_GAP_S)
    antenna_m = between(track_m, where)
    body = None if line.vehicle is None else _rotations(line.vehicle, at_ns)
    aimed = _aimed(line, mount, body, at_ns)
    lever_m = np.zeros((len(at_ns), 3))
    if any(mount.lever_arm_m):
        # Without the body's attitude nobody knows where the arm points: the centre is then NaN.
        body = np.full((len(at_ns), 3, 3), np.nan) if body is None else body
        lever_m = body @ np.array(mount.lever_arm_m) @ ENU_FROM_NED.T
    return antenna_m + lever_m, ENU_FROM_NED @ aimed @ FRD_FROM_RDF


def _aimed(line: Timeline, mount: Mount, body: Floats | None, at_ns: Nanoseconds) -> Floats:
    """ned_from_camera (FRD), (k, 3, 3): a stated mount first, then the gimbal, then the log's own transforms."""
    nothing = np.full((len(at_ns), 3, 3), np.nan)
    stated = mount.body_from_camera
    if stated is not None:
        return nothing if body is None else body @ stated
    if line.gimbal is not None:
        found = ned_from_gimbal(_rotations(line.gimbal, at_ns), line.gimbal.frame, body)
        return nothing if found is None else found
    if line.body_from_camera is not None and body is not None:
        out: Floats = body @ line.body_from_camera
        return out
    return nothing


def _unaimed(line: Timeline, mount: Mount) -> str:
    """Why no instant has an attitude; empty when the log and the mount give one."""
    if mount.angles_rad is not None or line.body_from_camera is not None or line.gimbal is not None:
        needs_body = line.gimbal is None or line.gimbal.frame != "ned" or mount.angles_rad is not None
        missing = f"{line.log.kind} holds no attitude of the vehicle: name the log that has it in ingest.logs"
        return missing if needs_body and line.vehicle is None else ""
    if line.vehicle is None:
        return (
            f"{line.log.kind} holds no attitude at all: name the log that has it in ingest.logs, or photos with their "
            "own tags"
        )
    return (
        "the log has the vehicle's attitude but no gimbal, and nothing says how the camera is mounted: "
        "--set 'ingest.mount={pitch_deg=-90}' (straight down), or {pitch_deg=-20} and so on"
    )


def _contradictions(line: Timeline, mount: Mount, at_ns: Nanoseconds) -> list[str]:
    """What the gimbal says against a stated mount."""
    if mount.angles_rad is None or line.gimbal is None or line.vehicle is None:
        return []
    body = _rotations(line.vehicle, at_ns)
    gimbal = ned_from_gimbal(_rotations(line.gimbal, at_ns), line.gimbal.frame, body)
    stated = mount.body_from_camera
    if gimbal is None or stated is None:
        return []
    apart = contradiction_deg(body @ stated, gimbal)
    if not apart > CONTRADICTION_DEG:
        return []
    told = (
        f"the gimbal's stream {line.gimbal.stream} contradicts ingest.mount by {apart:.1f} deg (median); the mount as "
        "stated is used (leave its angles out to use the gimbal)"
    )
    return [told]


def _in_local_frame(line: Timeline, poses: LocalPoses, at_ns: Nanoseconds, mount: Mount, *, y_up: bool) -> CameraPoses:
    where = bracket(poses.time_ns, poses.segment, at_ns, LONGEST_ATTITUDE_GAP_S)
    path = partial(_path_in_local_frame, line, poses, mount, y_up)
    centre_m, rotation = path(at_ns)
    velocity, turning = _changes(path, at_ns, rotation)
    unknown = np.full(len(at_ns), np.nan)
    needs = poses.of == "body" and mount.angles_rad is None and line.body_from_camera is None
    missing = (
        f"the poses of {poses.stream} are a body's, and nothing says how the camera sits on it: "
        "--set 'ingest.mount={pitch_deg=0}' (looking forward), or a bag with /tf_static"
        if needs
        else ""
    )
    return CameraPoses(
        rotation, centre_m, None, unknown, unknown, unknown, unknown, unknown, velocity, turning,
        bend(poses.position_m, poses.time_ns, poses.segment, where, LONGEST_ATTITUDE_GAP_S),
        turn_bend(poses.q_wxyz, poses.time_ns, poses.segment, where, LONGEST_ATTITUDE_GAP_S),
        _outside(at_ns, poses.time_ns),
        _reasons(at_ns, where, poses, rotation, missing, centre_m),
        f"{line.log.kind}: {poses.stream}",
    )  # fmt: skip


def _path_in_local_frame(
    line: Timeline, poses: LocalPoses, mount: Mount, y_up: bool, at_ns: Nanoseconds
) -> tuple[Floats, Floats]:
    where = bracket(poses.time_ns, poses.segment, at_ns, LONGEST_ATTITUDE_GAP_S)
    return camera_in_local_frame(
        line, poses, between(poses.position_m, where), slerp(poses.q_wxyz, where), mount, y_up=y_up
    )


def camera_in_local_frame(
    line: Timeline, poses: LocalPoses, position_m: Floats, q_wxyz: Floats, mount: Mount, *, y_up: bool
) -> tuple[Floats, Floats]:
    """The camera's centre and rotation from samples of a local stream.

    Args:
        line: The log, for its transforms.
        poses: The stream, for what it poses.
        position_m: (k, 3) of the child in the stream's frame.
        q_wxyz: (k, 4) parent_from_child.
        mount: The mount that holds.
        y_up: Whether the frame's y axis points up.

    Returns:
        (k, 3) m, z up, and (k, 3, 3) world_from_cam (RDF).
    """
    turn = Z_UP_FROM_Y_UP if y_up else np.eye(3)
    rotation = turn @ rotation_from_quaternion(q_wxyz)
    centre_m = position_m @ turn.T
    if poses.of == "body":
        frd = rotation @ (np.eye(3) if poses.axes == "frd" else FRD_FROM_FLU)
        centre_m = centre_m + frd @ np.array(mount.lever_arm_m)
        camera = mount.body_from_camera if mount.angles_rad is not None else line.body_from_camera
        aimed = np.full((3, 3), np.nan) if camera is None else camera
        rotation = frd @ aimed @ FRD_FROM_RDF
    return centre_m, rotation


def vehicle_rotations(line: Timeline, at_ns: Nanoseconds) -> Floats:
    """ned_from_body (FRD) at instants, (k, 3, 3); NaN where not known."""
    return np.full((len(at_ns), 3, 3), np.nan) if line.vehicle is None else _rotations(line.vehicle, at_ns)


def _rotations(stream: Attitudes, at_ns: Nanoseconds) -> Floats:
    where = bracket(stream.time_ns, stream.segment, at_ns, LONGEST_ATTITUDE_GAP_S)
    return rotation_from_quaternion(slerp(stream.q_wxyz, where))


def _changes(path: Path, at_ns: Nanoseconds, rotation: Floats) -> tuple[Floats, Floats]:
    """Velocity (k, 3) m/s, and turning (k, 3) rad/s about the gimbal's error axes.

    At an end of a stream, and beside a gap or a reset, by the side that is known; a lone sample moves as fast as the
    fastest of the others.
    """
    seconds = 2.0 * _HALF_NS / 1e9
    (before_m, before), (here_m, here), (after_m, after) = (path(at_ns + side * _HALF_NS) for side in (-1, 0, 1))
    velocity = (after_m - before_m) / seconds
    for one_side in (after_m - here_m, here_m - before_m):
        velocity = np.where(np.isfinite(velocity), velocity, 2.0 * one_side / seconds)
    turned = _turned(after, before)
    for other in (_turned(after, here), _turned(here, before)):
        turned = np.where(np.isfinite(turned), turned, 2.0 * other)
    axes = gimbal_error_axes(np.nan_to_num(rotation))
    about = np.abs(np.einsum("kij,ki->kj", axes, turned)) / seconds
    return _filled(velocity), _filled(about)


def _turned(after: Floats, before: Floats) -> Floats:
    """Rotation vectors between attitudes, (k, 3); NaN where one is not known."""
    apart = after @ np.swapaxes(before, -1, -2)
    known = np.all(np.isfinite(apart), axis=(-2, -1))
    out: Floats = np.where(
        known[:, None], vector_from_rotation(np.where(known[:, None, None], apart, np.eye(3))), np.nan
    )
    return out


def _filled(values: Floats) -> Floats:
    """The greatest known of each column where a value is not known; 0 where none is."""
    known = np.isfinite(values)
    most = np.max(np.abs(np.where(known, values, 0.0)), axis=0, initial=0.0)
    out: Floats = np.where(known, values, most)
    return out


def _outside(at_ns: Nanoseconds, time_ns: Nanoseconds) -> Bools:
    out: Bools = (at_ns < time_ns[0]) | (at_ns > time_ns[-1]) if len(time_ns) else np.ones(len(at_ns), np.bool_)
    return out


def _reasons(
    at_ns: Nanoseconds,
    where: Bracket,
    stream: Positions | LocalPoses,
    rotation: Floats,
    unaimed: str,
    centre_m: Floats,
) -> tuple[str, ...]:
    out = []
    first, last = (stream.time_ns[0], stream.time_ns[-1]) if len(stream.time_ns) else (0, 0)
    for k, instant in enumerate(at_ns.tolist()):
        if instant < first:
            out.append(f"exposed {(first - instant) / 1e9:.1f} s before {stream.stream} begins")
        elif instant > last:
            out.append(f"exposed {(instant - last) / 1e9:.1f} s after {stream.stream} ends")
        elif not where.known[k]:
            out.append(f"exposed in a gap of {where.step_s[k]:.1f} s, or across a reset, of {stream.stream}")
        elif unaimed:
            out.append(unaimed)
        elif not np.all(np.isfinite(rotation[k])):
            out.append("exposed in a gap of the attitude")
        elif not np.all(np.isfinite(centre_m[k])):
            out.append("the lever arm needs the vehicle's attitude, which the log does not hold at this instant")
        else:
            out.append("")
    return tuple(out)
