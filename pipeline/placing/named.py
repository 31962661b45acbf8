"""Poses that belong to named images: COLMAP models, and tables with an image column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

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
    rows = _rows(records, poses.image)
    centre_m, rotation = camera_in_local_frame(
        line, poses, poses.position_m, poses.q_wxyz, mount_of(line, mount), y_up=y_up
    )
    angles = np.degrees(gimbal_angles(rotation))
    out = []
    for record in records:
        row = rows.get(record.location)
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
    rows = _rows(records, positions.image)
    turned = {} if attitude is None else _rows(records, attitude.image)
    out = []
    for record in records:
        row = rows.get(record.location)
        if row is None:
            continue
        at = turned.get(record.location)
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


def _rows(records: Sequence[PhotoRecord], names: Sequence[str]) -> dict[str, int]:
    """The row of each photo, by its location: that of its file name, or of its stem; folders tell namesakes apart.

    Card folders count from DJI_0001 anew: where the names do not tell which of two a photo is, it has no row.
    """
    by_stem: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        if name:
            by_stem.setdefault(_stem(_parts(name)[0]), []).append(row)
    claims: dict[int, list[tuple[int, str]]] = {}
    for record in records:
        own = _parts(record.location)
        rows = by_stem.get(_stem(own[0]), [])
        agree = {row: _agreement(own, _parts(names[row])) for row in rows}
        best = max(agree.values(), default=0)
        chosen = [row for row in rows if agree[row] == best]
        if len(chosen) == 1:
            claims.setdefault(chosen[0], []).append((best, record.location))
    out: dict[str, int] = {}
    for row, claimed in claims.items():
        best = max(agreed for agreed, _ in claimed)
        nearest = [location for agreed, location in claimed if agreed == best]
        if len(nearest) == 1:
            out[nearest[0]] = row
    return out


def _stem(name: str) -> str:
    return name.rpartition(".")[0] or name


def _parts(name: str) -> list[str]:
    """A path from its end: file name, folder, folder's folder."""
    return name.replace("\\", "/").lower().split("/")[::-1]


def _agreement(own: Sequence[str], other: Sequence[str]) -> int:
    """How many parts from the end are the same; 0 where only the stems are."""
    return next((k for k, (a, b) in enumerate(zip(own, other, strict=False)) if a != b), min(len(own), len(other)))
