"""Ground control points as OpenDroneMap's gcp_list.txt: surveyed places, and their pixels in the photos.

The first line names the CRS. Every other line is one point in one photo: x y z column row image [name]. x is east or
longitude, y north or latitude, whatever order the CRS itself has. Pixel (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from pyproj import CRS
from pyproj.exceptions import CRSError

from pipeline.engine.errors import InputError
from pipeline.sources.files import opened

_MAX_BYTES = 64 << 20
_NUMBER = re.compile(r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?")
# The short form of OpenDroneMap, which PROJ does not read.
_UTM = re.compile(r"WGS\s*84[\s/]+UTM(?:\s+zone)?\s+(0?[1-9]|[1-5]\d|60)\s*([NS])", re.IGNORECASE)
_COLUMNS = ("x", "y", "z", "column", "row")
_ROW = "x y z column row image [name], separated by blanks or tabs"


@dataclass(frozen=True, slots=True)
class ControlPoint:
    """A surveyed place.

    Args:
        name: As the list has it, else "point N" by order.
        xyz: East or longitude, north or latitude, up; in the units of the list's CRS.
    """

    name: str
    xyz: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Sighting:
    """A point in a photo.

    Args:
        point: Place of the point in the list's points.
        image: The photo's name as the list has it.
        u_px: Column; pixel (0, 0) is the centre of the top-left pixel.
        v_px: Row.
        line: Line of the file, from 1.
    """

    point: int
    image: str
    u_px: float
    v_px: float
    line: int


@dataclass(frozen=True, slots=True)
class ControlList:
    """A list of control points.

    Args:
        where: The file.
        crs: As its first line says, with or without a vertical part.
        points: In the order of their first rows.
        sightings: In the file's order.
    """

    where: str
    crs: CRS
    points: tuple[ControlPoint, ...]
    sightings: tuple[Sighting, ...]


@dataclass(frozen=True, slots=True)
class _Row:
    """A row as it stands; the name is empty where it has none."""

    line: int
    xyz: tuple[float, float, float]
    u_px: float
    v_px: float
    image: str
    name: str


def load_control_points(location: str) -> ControlList:
    """Reads a list of control points from a path or URL.

    Raises:
        InputError: It is not there, or not such a list.
        ResourceError: It may not be read.
    """
    with opened(location) as stream:
        return read_control_points(stream.read(_MAX_BYTES + 1), location)


def read_control_points(data: bytes, where: str = "") -> ControlList:
    """Reads a list of control points. Rows with the same coordinates are the same point, whatever else they say.

    Args:
        data: The file's bytes.
        where: The file's name, for messages.

    Returns:
        Points and sightings; at least one.

    Raises:
        InputError: The first line is no CRS, a row is no row, or two rows contradict one another.

    Source: OpenDroneMap documentation, "Ground Control Points".
    """
    if len(data) > _MAX_BYTES:
        raise _wrong(where, f"{len(data)} bytes", f"at most {_MAX_BYTES} bytes")
    lines = list(_lines(data.decode("utf-8-sig", "replace")))
    if not lines:
        raise _wrong(where, "an empty file", "a CRS, then rows of " + _ROW)
    crs = _crs(lines[0][1], f"{where}:{lines[0][0]}")
    rows = [_row(text, number, f"{where}:{number}", degrees=bool(crs.is_geographic)) for number, text in lines[1:]]
    if not rows:
        raise _wrong(where, "a CRS and no rows", "rows of " + _ROW)
    points = _points(rows, where)
    return ControlList(where, crs, tuple(points.values()), tuple(_sightings(rows, list(points), where)))


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Numbered lines that are neither blank nor comments."""
    for number, line in enumerate(text.splitlines(), 1):
        bare = line.strip(" \t\x00\ufeff")
        if bare and not bare.startswith("#"):
            yield number, bare


def _crs(text: str, where: str) -> CRS:
    if len(_numbers(text.split()[:5])) == 5:
        raise InputError(
            "E-CONTROL-02", "the control points do not say their CRS", where=where, found=text[:120],
            expected="EPSG:32617, a PROJ string, or WGS84 UTM 17N", hint="put the CRS on a line of its own, the first",
        )  # fmt: skip
    try:
        crs = CRS.from_user_input(_spelled_out(text))
        problem = "" if not crs.is_vertical or crs.is_compound else f"{crs.name} has heights alone"
    except CRSError as error:
        raise _not_a_crs(text, where, str(error)[:200]) from error
    if problem:
        raise _not_a_crs(text, where, problem)
    return crs


def _spelled_out(text: str) -> str:
    short = _UTM.fullmatch(text)
    if short is None:
        return text
    return f"EPSG:{(32600 if short[2] in 'Nn' else 32700) + int(short[1])}"


def _row(text: str, line: int, where: str, *, degrees: bool) -> _Row:
    fields = text.split(None, 5)
    if len(fields) < 6:
        raise _wrong(where, f"{len(fields)} columns: {text[:120]}", _ROW)
    values = _numbers(fields[:5])
    if len(values) < 5:
        raise _wrong(where, f"{_COLUMNS[len(values)]} = {fields[len(values)][:40]}", "finite numbers: " + _ROW)
    x, y, z, u, v = values
    if degrees and (abs(x) > 360.0 or abs(y) > 90.0):
        raise _wrong(where, f"x = {x}, y = {y}", "x the longitude and y the latitude, in degrees")
    # Names with blanks can be told apart only where tabs separate the columns.
    rest = [part.strip() for part in (fields[5].split("\t") if "\t" in fields[5] else fields[5].split())]
    return _Row(line, (x, y, z), u, v, rest[0], rest[1] if len(rest) > 1 else "")


def _numbers(fields: Iterable[str]) -> list[float]:
    """The numbers before the first field that is none."""
    out: list[float] = []
    for field in fields:
        if _NUMBER.fullmatch(field) is None or not math.isfinite(value := float(field)):
            break
        out.append(value)
    return out


def _points(rows: Iterable[_Row], where: str) -> dict[tuple[float, float, float], ControlPoint]:
    points: dict[tuple[float, float, float], ControlPoint] = {}
    named: dict[str, _Row] = {}
    for row in rows:
        if row.name:
            first = named.setdefault(row.name, row)
            if first.xyz != row.xyz:
                raise InputError(
                    "E-CONTROL-03", f"control point {row.name} lies at two places", where=f"{where}:{row.line}",
                    found=f"{row.xyz} here, {first.xyz} in line {first.line}",
                    expected="the same coordinates in all rows of a point",
                    hint="correct them, or give it another name",
                )  # fmt: skip
        known = points.get(row.xyz)
        if known is None or (row.name and known.name.startswith("point ")):
            number = len(points) + 1 if known is None else 0
            points[row.xyz] = ControlPoint(row.name or f"point {number}", row.xyz)
    return points


def _sightings(rows: Iterable[_Row], places: list[tuple[float, float, float]], where: str) -> Iterator[Sighting]:
    number = {xyz: i for i, xyz in enumerate(places)}
    seen: dict[tuple[int, str], _Row] = {}
    for row in rows:
        point = number[row.xyz]
        first = seen.setdefault((point, row.image), row)
        if (first.u_px, first.v_px) != (row.u_px, row.v_px):
            raise InputError(
                "E-CONTROL-04", "a control point has two pixels in one photo", where=f"{where}:{row.line}",
                found=f"{row.image}: column {row.u_px:g}, row {row.v_px:g} here; column {first.u_px:g}, "
                f"row {first.v_px:g} in line {first.line}",
                expected="one row for each point and photo", hint="correct the photo's name, or take one of them out",
            )  # fmt: skip
        if first is row:
            yield Sighting(point, row.image, row.u_px, row.v_px, row.line)


def _wrong(where: str, found: str, expected: str) -> InputError:
    return InputError(
        "E-CONTROL-01", "the list of control points cannot be read", where=where, found=found, expected=expected,
        hint="it is OpenDroneMap's gcp_list.txt; numbers have a decimal point",
    )  # fmt: skip


def _not_a_crs(text: str, where: str, why: str) -> InputError:
    return InputError(
        "E-CONTROL-05", "the first line of the control points is no CRS that PROJ knows", where=where,
        found=f"{text[:120]} ({why})", expected="EPSG:32617, a PROJ string, or WGS84 UTM 17N",
    )  # fmt: skip
