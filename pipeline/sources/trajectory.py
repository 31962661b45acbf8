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

import csv
import io
import math
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from decimal import Decimal, InvalidOperation
from itertools import chain
from pathlib import PurePosixPath

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.rotations import (
    ENU_FROM_NED,
    FRD_FROM_RDF,
    enu_from_cam,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from pipeline.sources.files import opened
from pipeline.sources.records import (
    NS_PER_S,
    NS_PER_US,
    Attitudes,
    FlightLog,
    LocalPoses,
    Nanoseconds,
    Positions,
    TimeBase,
    nothing,
)
from pipeline.sources.streams import ned_quaternions, unit
from pipeline.sources.time_bases import UTC_FROM_NS, unix_us

_TUM_COLUMNS = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_GEODETIC = ("latitude_deg", "longitude_deg")
_LOCAL = ("x_m", "y_m", "z_m")
_QUATERNION = ("qw", "qx", "qy", "qz")
_ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
_HEIGHTS = ("ellipsoidal_m", "amsl_m", "above_home_m")
_SIGMAS = ("sigma_horizontal_m", "sigma_vertical_m")
_DELIMITERS = ",;\t"
_LONGEST_LINE = 1 << 16
# Eight hours at 100 Hz.
_MOST_ROWS = 3_000_000
_MOST_BAD_SHARE = 0.05
# The year 2255: larger numbers do not count in seconds.
_UNIX_TO_S = 9e9
_NOT_UNIT = 0.01


def is_format(head: bytes, name: str) -> bool:  # noqa: ARG001 - the readers' common signature
    """Whether a text is a TUM file (eight numbers in a line) or a CSV with columns named as here."""
    text = head.decode("utf-8-sig", "replace")
    first = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    if _header(first):
        return True
    try:
        return len([float(part) for part in first.split()]) == 1 + len(_TUM_COLUMNS)
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
        numbered = _lines(text)
        number, first = next(numbered, (1, ""))
        header = _header(first)
        if header:
            layout = _Layout.of(header, f"{location}:{number}")
            table = _collect(location, numbered, layout.row, layout.columns)
            log = _of_csv(location, table)
        else:
            table = _collect(location, chain([(number, first)], numbered), _tum_row, _TUM_COLUMNS)
            log = _of_tum(location, table)
        # Otherwise the wrapper would close what is closed elsewhere.
        text.detach()
    return log


@dataclass(slots=True)
class _Table:
    """Rows of a trajectory, by column.

    Args:
        columns: Names of `values`.
        values: (n, k), NaN where a cell is empty.
        time_ns: (n,), zeros where no column holds times.
        timed: Whether one does.
        image: (n,) names, or empty.
        losses: Lines left out.
    """

    columns: tuple[str, ...]
    values: Floats
    time_ns: Nanoseconds
    timed: bool
    image: tuple[str, ...]
    losses: tuple[str, ...]

    def of(self, *names: str) -> Floats:
        """Columns side by side, (n, len(names))."""
        return self.values[:, [self.columns.index(name) for name in names]]

    def one(self, name: str) -> Floats:
        """A column; NaN where there is none."""
        return self.values[:, self.columns.index(name)] if name in self.columns else nothing(len(self.values))

    def base(self) -> TimeBase:
        """What the times count from."""
        if not self.timed:
            return TimeBase("boot", problem="no times in the file, image names only")
        unix = float(np.median(self.time_ns)) > UTC_FROM_NS
        source = "seconds since 1970, or ISO 8601" if unix else "seconds from a start that the file does not tell"
        return TimeBase("utc" if unix else "boot", source=source)


@dataclass(slots=True)
class _Rows:
    """Rows as they are read."""

    time_ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))
    image: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where a CSV's columns are.

    Args:
        delimiter: Between cells.
        place: Column number by name.
        needed: Columns whose cells must hold numbers.
        wanted: Columns whose cells may be empty.
    """

    delimiter: str
    place: dict[str, int]
    needed: tuple[str, ...]
    wanted: tuple[str, ...]

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns of numbers."""
        return self.needed + self.wanted

    @classmethod
    def of(cls, header: str, where: str) -> _Layout:
        """Chooses the columns of a header.

        Raises:
            InputError: Not enough of them.
        """
        delimiter, names = _cells_of(header)
        place = {name: index for index, name in reversed(list(enumerate(names)))}
        geodetic = set(_GEODETIC) <= place.keys()
        position = _GEODETIC if geodetic else _LOCAL
        attitude = next((some for some in (_QUATERNION, _ANGLES) if set(some) <= place.keys()), ())
        missing = [name for name in position if name not in place]
        if not attitude and (not geodetic or {*_QUATERNION, *_ANGLES} & place.keys()):
            missing.append("qw, qx, qy, qz or yaw_deg, pitch_deg, roll_deg")
        if missing:
            raise InputError(
                "E-TRAJ-02", "columns of the trajectory are missing", where=where, found=", ".join(names)[:300],
                expected=", ".join(missing), hint="docs/conventions.md has the columns of a CSV trajectory",
            )  # fmt: skip
        wanted = tuple(name for name in (*_HEIGHTS, *_SIGMAS) if geodetic and name in place)
        return cls(delimiter, place, (*position, *attitude), wanted)

    def row(self, line: str, rows: _Rows) -> None:
        """Adds a line.

        Raises:
            ValueError: It is no pose.
        """
        cells = next(csv.reader([line], delimiter=self.delimiter))
        if len(cells) <= max(self.place.values()):
            raise ValueError(f"{len(cells)} columns")
        cells = [cell.strip() for cell in cells]
        values = [float(cells[self.place[name]]) for name in self.needed]
        named = dict(zip(self.needed, values, strict=True))
        if not all(map(math.isfinite, values)):
            raise ValueError("a number that is not finite")
        if abs(named.get("latitude_deg", 0.0)) > 90.0 or abs(named.get("longitude_deg", 0.0)) > 180.0:
            raise ValueError("no latitude and longitude in degrees")
        if "qw" in named:
            _check_unit([named[name] for name in _QUATERNION])
        image = cells[self.place["image"]] if "image" in self.place else ""
        if "image" in self.place and not image:
            raise ValueError("no image name")
        time_ns = _time_ns(cells[self.place["time"]]) if "time" in self.place else 0
        extra = [float(cells[self.place[name]] or "nan") for name in self.wanted]
        if any(map(math.isinf, extra)):
            raise ValueError("a number that is not finite")
        rows.time_ns.append(time_ns)
        rows.values.extend(values + extra)
        if image:
            rows.image.append(image)


def _header(line: str) -> str:
    """The line, when it is a header of such a CSV; else nothing."""
    names = set(_cells_of(line)[1])
    return line if names & {"image", "time"} and names & {"x_m", "latitude_deg"} else ""


def _cells_of(header: str) -> tuple[str, list[str]]:
    """The delimiter of a header and its names."""
    delimiter = max(_DELIMITERS, key=header.count)
    return delimiter, [name.strip().strip('"').lower() for name in header.split(delimiter)]


def _lines(text: io.TextIOWrapper) -> Iterator[tuple[int, str]]:
    """Lines that are neither empty nor comments, with their numbers; overlong ones in pieces, none of them a pose."""
    number = 0
    while line := text.readline(_LONGEST_LINE):
        number += 1
        line = line.strip(" \t\r\n\0")
        if line and not line.startswith("#"):
            yield number, line


def _collect(
    location: str,
    lines: Iterator[tuple[int, str]],
    add: Callable[[str, _Rows], None],
    columns: tuple[str, ...],
) -> _Table:
    """The rows of a file, sorted by time; a few lines that are no pose are left out and told."""
    rows = _Rows()
    bad: list[str] = []
    reason, count = "", 0
    for number, line in lines:
        count += 1
        if count > _MOST_ROWS:
            raise _wrong(location, f"more than {_MOST_ROWS} lines", "a trajectory")
        try:
            add(line, rows)
        except (ValueError, OverflowError, csv.Error) as error:
            bad.append(str(number))
            reason = reason or f"{location}:{number}: {error}"
    # The last line of a file that was cut is one, however short the file.
    if not rows.time_ns or len(bad) > max(1.0, _MOST_BAD_SHARE * count):
        raise _wrong(reason.partition(": ")[0] or location, f"{len(bad)} of {count} lines are no poses: "
                     f"{reason.partition(': ')[2] or 'nothing there'}", "one pose per line")  # fmt: skip
    order = np.argsort(np.frombuffer(rows.time_ns, np.int64), kind="stable")
    values = np.frombuffer(rows.values, np.float64).reshape(-1, len(columns))[order]
    image = tuple(rows.image[index] for index in order) if rows.image else ()
    _check_names(location, image)
    told = ", ".join(bad[:10]) + (", ..." if len(bad) > 10 else "")
    losses = (f"{len(bad)} of {count} lines are no poses and were left out: {told}",) if bad else ()
    time_ns = np.frombuffer(rows.time_ns, np.int64)[order]
    return _Table(columns, values, time_ns, bool(np.any(time_ns)) or not image, image, losses)


def _check_names(location: str, image: tuple[str, ...]) -> None:
    twice = [name for name, rows in Counter(image).items() if rows > 1]
    if twice:
        raise _wrong(location, f"several rows for image {twice[0]}", "one row per image")


def _tum_row(line: str, rows: _Rows) -> None:
    parts = line.split()
    if len(parts) != 1 + len(_TUM_COLUMNS):
        raise ValueError(f"{len(parts)} columns")
    values = [float(part) for part in parts[1:]]
    if not all(map(math.isfinite, values)):
        raise ValueError("a number that is not finite")
    _check_unit(values[3:])
    rows.time_ns.append(_time_ns(parts[0]))
    rows.values.extend(values)


def _check_unit(quaternion: list[float]) -> None:
    if abs(math.hypot(*quaternion) - 1.0) > _NOT_UNIT:
        raise ValueError(f"a quaternion of length {math.hypot(*quaternion):.3g}")


def _time_ns(text: str) -> int:
    """A time in ns: seconds to the last digit written, or ISO 8601 to the microsecond."""
    try:
        seconds = float(text)
    except ValueError:
        instant = datetime.fromisoformat(text)
        if instant.tzinfo is None:
            raise ValueError(f"time {text[:40]} without its zone") from None
        return unix_us(instant) * NS_PER_US
    if not 0.0 <= seconds < _UNIX_TO_S:
        raise ValueError(f"time {text[:40]} is not in seconds")
    try:
        # A double holds seconds since 1970 to a quarter of a microsecond only.
        return round(Decimal(text.replace("_", "")) * NS_PER_S)
    except InvalidOperation:
        return round(seconds * NS_PER_S)


def _of_tum(location: str, table: _Table) -> FlightLog:
    poses = _poses(location, table, unit(table.of("qw", "qx", "qy", "qz")))
    return FlightLog(location, "TUM trajectory", {"poses": len(table.values)}, table.base(), poses=(poses,),
                     losses=table.losses)  # fmt: skip


def _of_csv(location: str, table: _Table) -> FlightLog:
    kind, counts, base = "CSV trajectory", {"poses": len(table.values)}, table.base()
    if "x_m" in table.columns:
        poses = _poses(location, table, _world_from_cam(table))
        return FlightLog(location, kind, counts, base, poses=(poses,), losses=table.losses)
    attitudes = _attitudes(location, table)
    return FlightLog(location, kind, counts, base, positions=(_positions(location, table),), attitudes=attitudes,
                     losses=table.losses)  # fmt: skip


def _world_from_cam(table: _Table) -> Floats:
    if "qw" in table.columns:
        return unit(table.of(*_QUATERNION))
    return quaternion_from_rotation(enu_from_cam(*np.radians(table.of(*_ANGLES)).T))


def _poses(location: str, table: _Table, q_wxyz: Floats) -> LocalPoses:
    return LocalPoses(
        stream=_name(location), time_ns=table.time_ns, position_m=table.of(*_LOCAL), q_wxyz=q_wxyz, parent="world",
        child="camera", of="camera", axes="rdf", image=table.image, segment=_one_segment(table),
    )  # fmt: skip


def _positions(location: str, table: _Table) -> Positions:
    horizontal, vertical = (np.where(table.one(name) > 0.0, table.one(name), np.nan) for name in _SIGMAS)
    return Positions(
        _name(location), table.time_ns, table.one("latitude_deg"), table.one("longitude_deg"),
        table.one("ellipsoidal_m"), table.one("amsl_m"), table.one("above_home_m"), nothing(len(table.values)),
        horizontal, vertical, _one_segment(table), fused=True, image=table.image,
    )  # fmt: skip


def _attitudes(location: str, table: _Table) -> tuple[Attitudes, ...]:
    if "qw" in table.columns:
        enu = rotation_from_quaternion(unit(table.of(*_QUATERNION)))
        q_wxyz = quaternion_from_rotation(ENU_FROM_NED.T @ enu @ FRD_FROM_RDF.T)
    elif "yaw_deg" in table.columns:
        q_wxyz = ned_quaternions(*np.radians(table.of(*_ANGLES)).T)
    else:
        return ()
    return (Attitudes(_name(location), table.time_ns, q_wxyz, "gimbal", "ned", _one_segment(table), image=table.image),)


def _one_segment(table: _Table) -> Ints:
    return np.zeros(len(table.values), np.int64)


def _name(location: str) -> str:
    return PurePosixPath(location).name


def _wrong(where: str, found: str, expected: str) -> InputError:
    return InputError(
        "E-TRAJ-01", "the trajectory cannot be read", where=where, found=found, expected=expected,
        hint="lines of `timestamp x y z qx qy qz qw`, or a CSV as in docs/conventions.md",
    )  # fmt: skip
