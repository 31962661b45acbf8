"""Logs as rows of `tracks` and `clocks`, in pieces: a flight's attitudes alone may be millions of samples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.geometry.arrays import AnyArray, Floats
from pipeline.geometry.rotations import ENU_FROM_NED, FRD_FROM_RDF, gimbal_angles, rotation_from_quaternion
from pipeline.placing.timeline import Timeline, clock_problem
from pipeline.sources.files import relative_to
from pipeline.sources.records import Attitudes, LocalPoses, Positions
from schemas import TRACKS

_PIECE = 131_072
_NUMBERS = (
    *("latitude_deg", "longitude_deg", "height_m", "amsl_m", "above_takeoff_m", "barometric_m", "x_m", "y_m", "z_m"),
    *("yaw_deg", "pitch_deg", "roll_deg", "qw", "qx", "qy", "qz"),
)


def track_pieces(line: Timeline, root: str) -> Iterator[pa.Table]:
    """All streams of a log as pieces of `tracks`.

    Args:
        line: The log.
        root: Folder that sources are named relative to.

    Yields:
        Tables of at most some hundred thousand rows.
    """
    source = relative_to(line.log.location, root)
    for positions in line.log.positions:
        for part in _parts(len(positions.time_ns)):
            yield _piece(line, source, positions.stream, "vehicle", positions.time_ns[part], _places(positions, part))
    for attitudes in line.log.attitudes:
        what = attitudes.of if attitudes.frame == "ned" else f"{attitudes.of} against {attitudes.frame}"
        for part in _parts(len(attitudes.time_ns)):
            yield _piece(line, source, attitudes.stream, what, attitudes.time_ns[part], _turns(attitudes, part))
    for poses in line.log.poses:
        for part in _parts(len(poses.time_ns)):
            yield _piece(line, source, poses.stream, poses.of, poses.time_ns[part], _local(poses, part))


def clock_row(line: Timeline, root: str) -> Mapping[str, Any]:
    """A log's own clock as a row of `clocks`."""
    clock, base = line.clock, line.log.time_base
    told = base.source or ("the log's times are UTC" if base.epoch == "utc" else "nothing")
    return {
        "clock_id": relative_to(line.log.location, root),
        "source": line.log.kind,
        "method": f"{told}{' (arrivals: the earliest count)' if base.late else ''}",
        "offset_s": 0.0 if clock is None else clock.offset_ns / 1e9,
        "sigma_s": None if clock is None else clock.sigma_s,
        "drift_ppm": 0.0 if clock is None else 1e6 * clock.drift,
        "residual_s": None if clock is None else clock.residual_s,
        "anchors": 0 if clock is None else clock.anchors,
        "problem": clock_problem(line.log, clock),
    }


def _parts(n: int) -> Iterator[slice]:
    return (slice(begin, min(begin + _PIECE, n)) for begin in range(0, n, _PIECE))


def _piece(
    line: Timeline, source: str, stream: str, what: str, log_ns: AnyArray, values: Mapping[str, AnyArray]
) -> pa.Table:
    n = len(log_ns)
    utc_ns = None if line.clock is None else pa.array(line.utc_ns(log_ns)).cast(pa.timestamp("ns", tz="UTC"))
    columns: dict[str, object] = {
        "source": pa.repeat(source, n),
        "stream": pa.repeat(stream, n),
        "what": pa.repeat(what, n),
        "time": pa.nulls(n, pa.timestamp("ns", tz="UTC")) if utc_ns is None else utc_ns,
        "log_ns": pa.array(log_ns),
        "height_datum": pa.array(values["height_datum"]) if "height_datum" in values else pa.repeat("", n),
    }
    for name in _NUMBERS:
        known = values.get(name)
        columns[name] = pa.nulls(n, pa.float64()) if known is None else pa.array(known, mask=~np.isfinite(known))
    return TRACKS.from_columns(columns)


def _places(positions: Positions, part: slice) -> dict[str, AnyArray]:
    """Each height with its datum, the best known as `height_m`."""
    height = np.full(len(positions.time_ns[part]), np.nan)
    datum = np.full(len(height), "", dtype=object)
    order = (
        ("ellipsoidal", positions.ellipsoidal_m),
        ("amsl", positions.amsl_m),
        ("takeoff", positions.above_home_m),
        ("barometric", positions.barometric_m),
    )
    for name, values in order:
        fills = ~np.isfinite(height) & np.isfinite(values[part])
        height[fills], datum[fills] = values[part][fills], name
    return {
        "latitude_deg": positions.latitude_deg[part],
        "longitude_deg": positions.longitude_deg[part],
        "height_m": height,
        "height_datum": datum,
        "amsl_m": positions.amsl_m[part],
        "above_takeoff_m": positions.above_home_m[part],
        "barometric_m": positions.barometric_m[part],
    }


def _turns(attitudes: Attitudes, part: slice) -> dict[str, AnyArray]:
    # The angles of an FRD body in NED are those of a camera whose optical axis is the body's forward axis.
    rotation = ENU_FROM_NED @ rotation_from_quaternion(attitudes.q_wxyz[part]) @ FRD_FROM_RDF
    angles: Floats = np.degrees(gimbal_angles(rotation))
    return dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), angles.T, strict=True))


def _local(poses: LocalPoses, part: slice) -> dict[str, AnyArray]:
    out = dict(zip(("x_m", "y_m", "z_m"), poses.position_m[part].T, strict=True))
    return out | dict(zip(("qw", "qx", "qy", "qz"), poses.q_wxyz[part].T, strict=True))
