"""Poses that belong to named images: COLMAP models, and tables with an image column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np

from pipeline.geometry.rotations import ENU_FROM_NED, FRD_FROM_RDF, gimbal_angles, rotation_from_quaternion
from pipeline.placing.pose import camera_in_local_frame
from pipeline.placing.timeline import Timeline, mount_of
from pipeline.sources.dji import Attitude, Fix, Position
from pipeline.sources.photos import PhotoRecord
from pipeline.tracks.mount import Mount


def by_name(records: Sequence[PhotoRecord], line: Timeline, mount: Mount, *, y_up: bool) -> list[PhotoRecord]:
    """Photos whose names a log's poses name, with those poses.

    Args:
        records: The photos.
        line: The log.
        mount: The camera on what is posed, as stated.
        y_up: Whether the y axis of a local frame points up.

    Returns:
        The photos that were found, placed.
    """
    if line.local is not None and line.local.image:
        return _local(records, line, mount, y_up=y_up)
    if line.positions is not None and line.positions.image:
        return _on_earth(records, line)
    return []


def _local(records: Sequence[PhotoRecord], line: Timeline, mount: Mount, *, y_up: bool) -> list[PhotoRecord]:
    poses = line.local
    if poses is None:
        return []
    rows = _rows(poses.image)
    centre_m, rotation = camera_in_local_frame(
        line, poses, poses.position_m, poses.q_wxyz, mount_of(line, mount), y_up=y_up
    )
    angles = np.degrees(gimbal_angles(rotation))
    out = []
    for record in records:
        row = _row_of(record, rows)
        if row is not None and np.all(np.isfinite(angles[row])):
            yaw, pitch, roll = angles[row].tolist()
            x, y, z = centre_m[row].tolist()
            out.append(
                replace(
                    record,
                    local_m=(x, y, z),
                    position=None,
                    attitude=Attitude(yaw, pitch, roll, f"{line.log.kind}: {poses.stream}"),
                    pose_problem="",
                    time_source=f"log name, {record.time_source}" if record.time else "log name",
                )
            )
    return out


def _on_earth(records: Sequence[PhotoRecord], line: Timeline) -> list[PhotoRecord]:
    positions, attitude = line.positions, line.gimbal
    if positions is None:
        return []
    rows = _rows(positions.image)
    turned = {} if attitude is None else _rows(attitude.image)
    out = []
    for record in records:
        row = _row_of(record, rows)
        if row is None:
            continue
        at = _row_of(record, turned)
        own = record.attitude
        if attitude is not None and at is not None:
            rotation = ENU_FROM_NED @ rotation_from_quaternion(attitude.q_wxyz[at]) @ FRD_FROM_RDF
            yaw, pitch, roll = np.degrees(gimbal_angles(rotation)).tolist()
            own = Attitude(yaw, pitch, roll, f"{line.log.kind}: {attitude.stream}")
        if own is None:
            continue
        heights = (positions.amsl_m[row], positions.above_home_m[row], positions.ellipsoidal_m[row])
        absolute, relative, ellipsoidal = (float(h) if np.isfinite(h) else None for h in heights)
        sigmas = (positions.sigma_horizontal_m[row], positions.sigma_vertical_m[row])
        horizontal, vertical = (float(s) if np.isfinite(s) else None for s in sigmas)
        out.append(
            replace(
                record,
                position=Position(
                    float(positions.latitude_deg[row]),
                    float(positions.longitude_deg[row]),
                    f"{line.log.kind}: {positions.stream}",
                ),
                attitude=own,
                absolute_m=absolute,
                relative_m=relative,
                ellipsoidal_m=ellipsoidal,
                fix=Fix(sigma_horizontal_m=horizontal, sigma_vertical_m=vertical),
                pose_problem="",
                time_source=f"log name, {record.time_source}" if record.time else "log name",
            )
        )
    return out


def _rows(names: Sequence[str]) -> dict[str, int]:
    """Row by file name, and by stem where that is unique."""
    out: dict[str, int] = {}
    stems: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        if name:
            out[PurePosixPath(name).name.lower()] = row
            stems.setdefault(PurePosixPath(name).stem.lower(), []).append(row)
    out.update({stem: rows[0] for stem, rows in stems.items() if len(rows) == 1})
    return out


def _row_of(record: PhotoRecord, rows: dict[str, int]) -> int | None:
    name = PurePosixPath(record.location.replace("\\", "/")).name.lower()
    return rows.get(name, rows.get(record.frame_id.lower()))
