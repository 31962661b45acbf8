"""Names and units of the columns in flight CSVs of DJI drones, for each program that writes them.

AirData is checked against a real export. DatCon and the flight record converters are not: no file of them was at hand,
and their names are those of their documentation and of scripts that read them.

Source: AirData export (header of 2024); DatCon, "V3 .CSV column descriptions" (datfile.net/DatCon/fieldsV3.html), which
writes GPS:Lat in one generation and GPS(0):Lat[degrees] in the next; PhantomHelp's log viewer, TXTlogToCSVtool and
dji-log-parser, which share the names of the flight record (OSD., GIMBAL., CAMERA., CUSTOM.).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

_BRACKETS = re.compile(r"^([^\[]+?)\s*\[(.*)\]$")
_PARENTHESES = re.compile(r"^(.+?)\s*\(([^()]*)\)$")
# DatCon marks computed and derived columns: IMU_ATTI(0):roll:C.
_MARK = re.compile(r":[CD]$", re.IGNORECASE)
_FOOT_M = 0.3048

Dimension = Literal["time", "length", "angle", "none"]
_UNITS: dict[Dimension, dict[str, float]] = {
    "time": {"": 1.0, "s": 1.0, "sec": 1.0, "seconds": 1.0, "millisecond": 1e-3, "milliseconds": 1e-3, "ms": 1e-3},
    "length": {
        "": 1.0, "m": 1.0, "meter": 1.0, "meters": 1.0, "metres": 1.0,
        "ft": _FOOT_M, "foot": _FOOT_M, "feet": _FOOT_M,
    },
    "angle": {"": 1.0, "deg": 1.0, "degree": 1.0, "degrees": 1.0, "360": 1.0, "radians": 57.29577951308232},
    "none": {"": 1.0},
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Place:
    """Columns of one position stream; each entry lists the names that mean the same.

    Args:
        stream: Name of the stream.
        latitude: deg.
        longitude: deg.
        amsl: m or ft.
        above_home: m or ft.
        barometric: m or ft.
        fused: Whether it is the flight controller's estimate.
    """

    stream: str
    latitude: tuple[str, ...]
    longitude: tuple[str, ...]
    amsl: tuple[str, ...]
    above_home: tuple[str, ...]
    barometric: tuple[str, ...]
    fused: bool


@dataclass(frozen=True, slots=True)
class Turn:
    """Columns of one attitude stream.

    Args:
        stream: Name of the stream.
        of: "vehicle" or "gimbal".
        yaw: deg from north.
        pitch: deg.
        roll: deg.
    """

    stream: str
    of: Literal["vehicle", "gimbal"]
    yaw: tuple[str, ...]
    pitch: tuple[str, ...]
    roll: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Layout:
    """One program's columns.

    Args:
        kind: For people.
        time: Since the start.
        moment: Date and time of day.
        places: Position streams.
        turns: Attitude streams.
        photo: Rises when a photo is taken; empty where there is none.
        held: Whether rows come faster than the receiver measures, so that positions are repeated.
    """

    kind: str
    time: tuple[str, ...]
    moment: tuple[str, ...]
    places: tuple[Place, ...]
    turns: tuple[Turn, ...]
    photo: tuple[str, ...]
    held: bool


@dataclass(frozen=True, slots=True)
class Column:
    """A column found in a header.

    Args:
        index: Its place in the row.
        scale: Factor to s, m or deg.
        unit: As the header writes it.
    """

    index: int
    scale: float
    unit: str


AIRDATA = Layout(
    kind="AirData CSV",
    time=("time",),
    moment=("datetime",),
    places=(
        Place(
            "AirData", ("latitude",), ("longitude",), ("altitude_above_sealevel",), ("height_above_takeoff",), (), True
        ),
    ),
    turns=(
        Turn("AirData compass", "vehicle", ("compass_heading",), ("pitch",), ("roll",)),
        Turn("AirData gimbal", "gimbal", ("gimbal_heading",), ("gimbal_pitch",), ("gimbal_roll",)),
    ),
    photo=("isphoto",),
    held=False,
)
FLIGHT_RECORD = Layout(
    kind="DJI flight record CSV",
    time=("osd.flytime",),
    moment=("custom.datetime",),
    places=(Place("OSD", ("osd.latitude",), ("osd.longitude",), ("osd.altitude",), ("osd.height",), (), True),),
    turns=(
        Turn("OSD", "vehicle", ("osd.yaw",), ("osd.pitch",), ("osd.roll",)),
        Turn("GIMBAL", "gimbal", ("gimbal.yaw",), ("gimbal.pitch",), ("gimbal.roll",)),
    ),
    photo=("camera.isphoto", "custom.isphoto"),
    held=False,
)
_HOME = ("general:relativeheight", "osd_data:relativeheight", "imu_atti(0):relativeheight")
DATCON = Layout(
    kind="DatCon CSV",
    time=("clock:offsettime", "offsettime"),
    moment=("gps:datetimestamp",),
    places=(
        Place(
            "IMU_ATTI(0)", ("imu_atti(0):latitude",), ("imu_atti(0):longitude",), (), _HOME,
            ("imu_atti(0):barometer:smooth", "imu_atti(0):barometer:raw"), True,
        ),
        Place(
            "GPS", ("gps(0):lat", "gps:lat"), ("gps(0):long", "gps:long"), ("gps(0):heightmsl", "gps:heightmsl"),
            _HOME, (), False,
        ),
    ),
    turns=(
        Turn("IMU_ATTI(0)", "vehicle", ("imu_atti(0):yaw",), ("imu_atti(0):pitch",), ("imu_atti(0):roll",)),
        Turn("Gimbal", "gimbal", ("gimbal:yaw",), ("gimbal:pitch",), ("gimbal:roll",)),
    ),
    photo=(),
    held=True,
)  # fmt: skip
LAYOUTS = (AIRDATA, FLIGHT_RECORD, DATCON)


@dataclass(frozen=True, slots=True)
class Header:
    """A header row: names without units, in lower case.

    Args:
        names: One per column.
        units: One per column, as written, lower case; empty where there is none.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]

    def find(self, names: Sequence[str], dimension: Dimension) -> Column | None:
        """The column of a quantity.

        Args:
            names: Names that mean it, the preferred one first.
            dimension: Of what; a column in another unit does not count.

        Returns:
            The column, one with its unit stated before one without; None where there is none.
        """
        known = _UNITS[dimension]
        for name in names:
            found = [i for i, here in enumerate(self.names) if here == name and self._unit(i, dimension) in known]
            found.sort(key=lambda i: self.units[i] in {"", "360"})
            if found:
                unit = self._unit(found[0], dimension)
                return Column(found[0], known[unit], self.units[found[0]])
        return None

    def foreign(self, names: Sequence[str], dimension: Dimension) -> str:
        """How a column of these names is written that exists only in a unit nobody here knows; else empty."""
        if self.find(names, dimension) is not None:
            return ""
        return next((f"{n} [{u}]" for n, u in zip(self.names, self.units, strict=True) if n in names), "")

    def _unit(self, index: int, dimension: Dimension) -> str:
        # "degrees [-180;180]" is degrees; moments and flags have no units, only remarks ("utc").
        return "" if dimension == "none" else self.units[index].partition("[")[0].strip()


def header_of(cells: Sequence[str]) -> Header:
    """Splits names and units: "height(feet)", "OSD.height [ft]", "GPS(0):Lat[degrees]", " pitch(degrees)"."""
    names, units = [], []
    for cell in cells:
        name = _MARK.sub("", cell.strip().strip('"').strip())
        # GPS(0) alone is no name with a unit: DatCon's parentheses are followed by a colon.
        split = _BRACKETS.match(name) or _PARENTHESES.match(name)
        names.append((split[1] if split else name).strip().lower())
        units.append((split[2] if split else "").strip().lower())
    return Header(tuple(names), tuple(units))


def layout_of(header: Header) -> Layout | None:
    """Which program wrote a header; None where none of the known ones did.

    A long header may be cut off: its first columns suffice.
    """
    names = set(header.names)
    if {"latitude", "longitude", "time"} <= names and header.find(("time",), "time") is not None:
        timed = header.units[header.names.index("time")]
        return AIRDATA if timed.startswith("millisecond") else None
    if {"osd.latitude", "osd.longitude"} <= names:
        return FLIGHT_RECORD
    if any(name in names for name in DATCON.time) and any(
        name.startswith(("imu_atti(", "gps(", "gps:", "imucalcs(")) for name in names
    ):
        return DATCON
    return None
