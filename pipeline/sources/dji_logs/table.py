"""Rows of a DJI flight CSV as columns of numbers, only those that are wanted."""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from typing import BinaryIO

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Floats
from pipeline.sources.dji_logs.columns import Column, Dimension, Header, Layout, header_of, layout_of
from pipeline.sources.time_bases import unix_us

_LINE_BYTES = 1 << 20
_TRUE = frozenset({"true", "yes"})


@dataclass(slots=True)
class Table:
    """The wanted columns of a CSV, growing; no object per row is kept.

    Args:
        layout: Whose columns they are.
        width: Cells that a whole row has at most.
        columns: By quantity: "time_s", "photo", and "position 0 latitude", "attitude 1 yaw" and so on.
        moment: Column of date and time of day.
        losses: Sentences.
        rows: Rows, unreadable ones too.
        short: Rows with too few cells.
        values: As `columns`, in s, m, deg.
        changed_s: Times of the rows in which the moment changed.
        changed_us: Those moments, since 1970.
        stated: Whether the moments are UTC, by the header or by their own mark.
        first_moment: The first moment's text.
    """

    layout: Layout
    width: int
    columns: dict[str, Column]
    moment: Column | None
    losses: list[str]
    rows: int = 0
    short: int = 0
    values: dict[str, array[float]] = field(default_factory=dict)
    changed_s: array[float] = field(default_factory=lambda: array("d"))
    changed_us: array[float] = field(default_factory=lambda: array("d"))
    stated: bool = False
    first_moment: str = ""
    _whole: int = 0
    _moment: str = ""

    def add(self, cells: Sequence[str]) -> None:
        """Takes in a row. Rows shorter than the first are cut off or have lost a cell: nothing in them is sure."""
        self.rows += 1
        needed = 1 + max(column.index for column in self.columns.values())
        if len(cells) < max(self._whole, needed):
            self.short += 1
            return
        self._whole = self._whole or min(len(cells), self.width)
        for name, column in self.columns.items():
            self.values[name].append(_number(cells[column.index]) * column.scale)
        if self.moment is not None and self.moment.index < len(cells):
            self._see(cells[self.moment.index].strip())

    def _see(self, moment: str) -> None:
        if moment == self._moment:
            return
        self._moment = moment
        self.first_moment = self.first_moment or moment[:40]
        told = _moment_us(moment)
        if told is not None:
            self.changed_s.append(self.values["time_s"][-1])
            self.changed_us.append(told[0])
            self.stated = self.stated or told[1]

    def column(self, name: str) -> Floats:
        """(n,) a quantity; NaN where the file lacks it."""
        n = len(self.values["time_s"])
        return np.frombuffer(self.values[name], np.float64) if name in self.values and n else np.full(n, np.nan)


def recognised(head: str) -> bool:
    """Whether a file begins with the header row of a known program; the row may be cut off."""
    lines = iter(head.lstrip("\ufeff").split("\n"))
    return layout_of(_header(lines)[0]) is not None


def read_table(location: str, stream: BinaryIO) -> Table:
    """Reads an open CSV.

    Args:
        location: Its path or URL, for messages.
        stream: Its bytes.

    Returns:
        The wanted columns.

    Raises:
        InputError: The header is of no known program.
    """
    lines = _lines(stream)
    header, delimiter = _header(lines)
    layout = layout_of(header)
    if layout is None:
        raise InputError(
            "E-DJI-01", "not the header of a DJI flight CSV", where=location,
            found=", ".join(header.names)[:120] or "no header",
            expected="columns of AirData (time(millisecond), latitude, ..), DatCon (Clock:offsetTime, GPS:Lat, ..) or "
            "a flight record (OSD.latitude, ..)",
            hint="export it again, with its header row",
        )  # fmt: skip
    table = _table(location, layout, header)
    for line in lines:
        if line.strip():
            table.add(_cells(line, delimiter))
    return table


def _table(location: str, layout: Layout, header: Header) -> Table:
    wanted = _wanted(layout)
    found = {name: header.find(names, dimension) for name, (names, dimension) in wanted.items()}
    columns = {name: column for name, column in found.items() if column is not None}
    if "time_s" not in columns:
        raise InputError(
            "E-DJI-02", "the flight CSV has no time column", where=location,
            found=", ".join(header.names)[:120], expected=" or ".join(layout.time), hint="export it again with times",
        )  # fmt: skip
    foreign = sorted({text for names, dimension in wanted.values() if (text := header.foreign(names, dimension))})
    moment = header.find(layout.moment, "none")
    return Table(
        layout=layout, width=len(header.names), columns=columns, moment=moment,
        losses=[f"a column is in a unit that is not known here and was left out: {text}" for text in foreign],
        values={name: array("d") for name in columns},
        stated=moment is not None and moment.unit in {"utc", "gmt"},
    )  # fmt: skip


def _wanted(layout: Layout) -> dict[str, tuple[tuple[str, ...], Dimension]]:
    """Names and dimension of every quantity of a layout."""
    out: dict[str, tuple[tuple[str, ...], Dimension]] = {"time_s": (layout.time, "time")}
    if layout.photo:
        out["photo"] = (layout.photo, "none")
    for i, place in enumerate(layout.places):
        out[f"position {i} latitude"] = (place.latitude, "angle")
        out[f"position {i} longitude"] = (place.longitude, "angle")
        out[f"position {i} amsl"] = (place.amsl, "length")
        out[f"position {i} above_home"] = (place.above_home, "length")
        out[f"position {i} barometric"] = (place.barometric, "length")
    for i, turn in enumerate(layout.turns):
        out[f"attitude {i} yaw"] = (turn.yaw, "angle")
        out[f"attitude {i} pitch"] = (turn.pitch, "angle")
        out[f"attitude {i} roll"] = (turn.roll, "angle")
    return out


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 1.0 if text.strip().lower() in _TRUE else math.nan


def _moment_us(text: str) -> tuple[float, bool] | None:
    """Microseconds since 1970, and whether the text states its offset from UTC."""
    try:
        moment = datetime.fromisoformat(text)
        stated = moment.tzinfo is not None
        since_us = unix_us(moment if stated else moment.replace(tzinfo=UTC))
    except (ValueError, OverflowError):
        return None
    return float(since_us), stated


def _lines(stream: BinaryIO) -> Iterator[str]:
    for number, raw in enumerate(iter(partial(stream.readline, _LINE_BYTES), b"")):
        line = raw.decode("utf-8", "replace").rstrip("\r\n\0")
        yield line if number else line.lstrip("\ufeff")


def _header(lines: Iterator[str]) -> tuple[Header, str]:
    """The header row and the delimiter; spreadsheets are told of the latter in a line "sep=," before it."""
    line, delimiter = next(lines, ""), ","
    if line.strip().lower().startswith("sep="):
        line, delimiter = next(lines, ""), line.strip()[4:5] or ","
    return header_of(_cells(line.strip(), delimiter)), delimiter


def _cells(line: str, delimiter: str) -> list[str]:
    """Cells of one line, read alone so that a stray quote cannot swallow the rest of the file."""
    if '"' not in line:
        return line.split(delimiter)
    try:
        return next(csv.reader([line], delimiter=delimiter), [])
    except (csv.Error, TypeError):
        # A delimiter that csv does not take, or a cell past its limit.
        return line.split(delimiter)
