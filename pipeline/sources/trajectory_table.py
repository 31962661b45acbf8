"""Rows of a trajectory text as columns: TUM lines, or a CSV whose header names the columns."""

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

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Floats
from pipeline.sources.records import NS_PER_S, NS_PER_US, Nanoseconds, TimeBase, nothing
from pipeline.sources.time_bases import UTC_FROM_NS, unix_us

TUM_COLUMNS = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_GEODETIC = ("latitude_deg", "longitude_deg")
LOCAL = ("x_m", "y_m", "z_m")
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
_HEIGHTS = ("ellipsoidal_m", "amsl_m", "above_home_m")
SIGMAS = ("sigma_horizontal_m", "sigma_vertical_m")
_DELIMITERS = ",;\t"
_LONGEST_LINE = 1 << 16
# Eight hours at 100 Hz.
_MOST_ROWS = 3_000_000
_MOST_BAD_SHARE = 0.05
# The year 2255: larger numbers do not count in seconds.
_UNIX_TO_S = 9e9
_NOT_UNIT = 0.01


@dataclass(slots=True)
class Table:
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
class Rows:
    """Rows as they are read, in growing columns.

    Args:
        time_ns: One per row, 0 where no column holds times.
        values: The numbers of one row after another.
        image: Names; none where no column holds them.
    """

    time_ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))
    image: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Layout:
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
    def of(cls, header: str, where: str) -> Layout:
        """Chooses the columns of a header.

        Raises:
            InputError: Not enough of them.
        """
        delimiter, names = _cells_of(header)
        place = {name: index for index, name in reversed(list(enumerate(names)))}
        geodetic = set(_GEODETIC) <= place.keys()
        position = _GEODETIC if geodetic else LOCAL
        attitude = next((some for some in (QUATERNION, ANGLES) if set(some) <= place.keys()), ())
        missing = [name for name in position if name not in place]
        if not attitude and (not geodetic or {*QUATERNION, *ANGLES} & place.keys()):
            missing.append("qw, qx, qy, qz or yaw_deg, pitch_deg, roll_deg")
        if missing:
            raise InputError(
                "E-TRAJ-02", "columns of the trajectory are missing", where=where, found=", ".join(names)[:300],
                expected=", ".join(missing), hint="docs/conventions.md has the columns of a CSV trajectory",
            )  # fmt: skip
        wanted = tuple(name for name in (*_HEIGHTS, *SIGMAS) if geodetic and name in place)
        return cls(delimiter, place, (*position, *attitude), wanted)

    def row(self, line: str, rows: Rows) -> None:
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
            _check_unit([named[name] for name in QUATERNION])
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


def header_of(line: str) -> str:
    """The line, when it is the header of a CSV of poses; else empty."""
    names = set(_cells_of(line)[1])
    return line if names & {"image", "time"} and names & {"x_m", "latitude_deg"} else ""


def _cells_of(header: str) -> tuple[str, list[str]]:
    """The delimiter of a header and its names."""
    delimiter = max(_DELIMITERS, key=header.count)
    return delimiter, [name.strip().strip('"').lower() for name in header.split(delimiter)]


def pose_lines(text: io.TextIOWrapper) -> Iterator[tuple[int, str]]:
    """Lines that are neither empty nor comments, with their numbers; overlong ones in pieces, none of them a pose."""
    number = 0
    while line := text.readline(_LONGEST_LINE):
        number += 1
        line = line.strip(" \t\r\n\0")
        if line and not line.startswith("#"):
            yield number, line


def collect(
    location: str,
    lines: Iterator[tuple[int, str]],
    add: Callable[[str, Rows], None],
    columns: tuple[str, ...],
) -> Table:
    """The rows of a file, sorted by time; a few lines that are no pose are left out and told.

    Args:
        location: Path or URL, for messages.
        lines: Numbers and texts of the lines.
        add: Adds a line to the rows, or raises ValueError.
        columns: What `add` reads of each line.

    Raises:
        InputError: More than a few lines are no pose, an image has two rows, or there are too many lines.
    """
    rows = Rows()
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
    return Table(columns, values, time_ns, bool(np.any(time_ns)) or not image, image, losses)


def _check_names(location: str, image: tuple[str, ...]) -> None:
    twice = [name for name, rows in Counter(image).items() if rows > 1]
    if twice:
        raise _wrong(location, f"several rows for image {twice[0]}", "one row per image")


def tum_row(line: str, rows: Rows) -> None:
    """Adds a line of a TUM file.

    Raises:
        ValueError: It is no pose.
    """
    parts = line.split()
    if len(parts) != 1 + len(TUM_COLUMNS):
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


def _wrong(where: str, found: str, expected: str) -> InputError:
    return InputError(
        "E-TRAJ-01", "the trajectory cannot be read", where=where, found=found, expected=expected,
        hint="lines of `timestamp x y z qx qy qz qw`, or a CSV as in docs/conventions.md",
    )  # fmt: skip
