"""Trajectories as text: TUM files, and a plain CSV with named columns that anything can be converted to.

TUM: one pose per line, `timestamp x y z qx qy qz qw`, seconds and metres, `#` before comments. The format does not
say what is posed; as in the benchmark that it comes from, it is the camera (RDF), in a world of its own.

CSV: a header line names the columns, in any order; comma, semicolon or tab between them; points in numbers.

    image             file name, and/or
    time              ISO 8601 with its zone, or seconds (since 1970, or since any start)
    latitude_deg, longitude_deg, and of ellipsoidal_m, amsl_m, above_home_m those there are; or
    x_m, y_m, z_m     of the camera in a local frame
    qw, qx, qy, qz    world_from_cam, camera RDF (the world is ENU where positions are geodetic); or
    yaw_deg, pitch_deg, roll_deg    gimbal angles (docs/conventions.md; a local frame is then ENU)
    sigma_horizontal_m, sigma_vertical_m    where they are known, with geodetic positions

A list of 4x4 or 3x4 matrices (KITTI and its kin) names neither times nor images: which row is whose has to be added,
in a CSV.
"""

from __future__ import annotations

import io
from itertools import chain
from pathlib import PurePosixPath

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.rotations import (
    ENU_FROM_NED,
    FRD_FROM_RDF,
    enu_from_cam,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from pipeline.sources.files import opened
from pipeline.sources.records import Attitudes, FlightLog, LocalPoses, Positions, nothing
from pipeline.sources.streams import ned_quaternions, unit
from pipeline.sources.trajectory_table import (
    ANGLES,
    LOCAL,
    QUATERNION,
    SIGMAS,
    TUM_COLUMNS,
    Layout,
    Table,
    collect,
    header_of,
    pose_lines,
    tum_row,
)


def is_format(head: bytes, name: str) -> bool:  # noqa: ARG001 - the readers' common signature
    """Whether a text is a TUM file (eight numbers in a line) or a CSV with columns named as here."""
    text = head.decode("utf-8-sig", "replace")
    first = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    if header_of(first):
        return True
    try:
        return len([float(part) for part in first.split()]) == 1 + len(TUM_COLUMNS)
    except ValueError:
        return False


def read(location: str) -> FlightLog:
    """Reads a trajectory.

    Args:
        location: Path or URL.

    Returns:
        Poses in a local frame, or geodetic positions with attitudes of the optical axis; sorted by time where rows
        have one.

    Raises:
        InputError: It is not there, columns are missing, an image has two rows, or more than one line in twenty is no
            pose.
        ResourceError: It may not be read.

    Source: TUM RGB-D benchmark, "File Formats", "Ground-truth trajectories"; the CSV is this project's own.
    """
    with opened(location) as stream:
        text = io.TextIOWrapper(stream, "utf-8-sig", errors="replace")
        numbered = pose_lines(text)
        number, first = next(numbered, (1, ""))
        header = header_of(first)
        if header:
            layout = Layout.of(header, f"{location}:{number}")
            table = collect(location, numbered, layout.row, layout.columns)
            log = _of_csv(location, table)
        else:
            table = collect(location, chain([(number, first)], numbered), tum_row, TUM_COLUMNS)
            log = _of_tum(location, table)
        # Otherwise the wrapper would close what is closed elsewhere.
        text.detach()
    return log


def _of_tum(location: str, table: Table) -> FlightLog:
    poses = _poses(location, table, unit(table.of("qw", "qx", "qy", "qz")))
    return FlightLog(location, "TUM trajectory", {"poses": len(table.values)}, table.base(), poses=(poses,),
                     losses=table.losses)  # fmt: skip


def _of_csv(location: str, table: Table) -> FlightLog:
    kind, counts, base = "CSV trajectory", {"poses": len(table.values)}, table.base()
    if "x_m" in table.columns:
        poses = _poses(location, table, _world_from_cam(table))
        return FlightLog(location, kind, counts, base, poses=(poses,), losses=table.losses)
    attitudes = _attitudes(location, table)
    return FlightLog(location, kind, counts, base, positions=(_positions(location, table),), attitudes=attitudes,
                     losses=table.losses)  # fmt: skip


def _world_from_cam(table: Table) -> Floats:
    if "qw" in table.columns:
        return unit(table.of(*QUATERNION))
    return quaternion_from_rotation(enu_from_cam(*np.radians(table.of(*ANGLES)).T))


def _poses(location: str, table: Table, q_wxyz: Floats) -> LocalPoses:
    return LocalPoses(
        stream=_name(location), time_ns=table.time_ns, position_m=table.of(*LOCAL), q_wxyz=q_wxyz, parent="world",
        child="camera", of="camera", axes="rdf", image=table.image, segment=_one_segment(table),
    )  # fmt: skip


def _positions(location: str, table: Table) -> Positions:
    horizontal, vertical = (np.where(table.one(name) > 0.0, table.one(name), np.nan) for name in SIGMAS)
    return Positions(
        _name(location), table.time_ns, table.one("latitude_deg"), table.one("longitude_deg"),
        table.one("ellipsoidal_m"), table.one("amsl_m"), table.one("above_home_m"), nothing(len(table.values)),
        horizontal, vertical, _one_segment(table), fused=True, image=table.image,
    )  # fmt: skip


def _attitudes(location: str, table: Table) -> tuple[Attitudes, ...]:
    if "qw" in table.columns:
        enu = rotation_from_quaternion(unit(table.of(*QUATERNION)))
        q_wxyz = quaternion_from_rotation(ENU_FROM_NED.T @ enu @ FRD_FROM_RDF.T)
    elif "yaw_deg" in table.columns:
        q_wxyz = ned_quaternions(*np.radians(table.of(*ANGLES)).T)
    else:
        return ()
    return (Attitudes(_name(location), table.time_ns, q_wxyz, "gimbal", "ned", _one_segment(table), image=table.image),)


def _one_segment(table: Table) -> Ints:
    return np.zeros(len(table.values), np.int64)


def _name(location: str) -> str:
    return PurePosixPath(location).name
