"""DataFlash logs as text: one message a line, its fields in the order of the FMT line of its name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import BinaryIO

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.sources.dataflash.fields import WANTED, Found

_BLOCK_BYTES = 4 << 20
# A line longer than this is no message.
_LONGEST_LINE = 1 << 16
_MOST_NAMES = 512
_LONGEST_NAME = 16


def read_lines(stream: BinaryIO, found: Found, where: str) -> None:
    """Reads the wanted messages of a text log; its numbers are in the units of the field's names already.

    Args:
        stream: The log, read block by block.
        found: Where messages, counts and losses are put.
        where: The log's name, for messages.

    Raises:
        InputError: There is no FMT line.

    Source: ArduPilot, "Downloading and Analyzing Data Logs in Mission Planner"; pymavlink, DFReader.py (DFReader_text).
    """
    reader = _Lines(found)
    rest = b""
    while fresh := stream.read(_BLOCK_BYTES):
        data = rest + fresh
        cut = data.rfind(b"\n") + 1
        reader.block(data[:cut])
        rest = data[cut:]
        if len(rest) > _LONGEST_LINE:
            reader.bad += 1
            rest = b""
    reader.block(rest)
    reader.finish(where)


class _Lines:
    """The formats so far, and what was wrong."""

    def __init__(self, found: Found) -> None:
        self._found = found
        self._columns: dict[str, tuple[str, ...]] = {}
        self.bad = 0

    def block(self, data: bytes) -> None:
        """Reads whole lines."""
        waiting: dict[str, list[bytes]] = {}
        for line in data.split(b"\n"):
            name = line[: line.find(b",")].strip().decode("latin-1")
            if name in WANTED:
                waiting.setdefault(name, []).append(line)
            elif name == "FMT":
                self._keep(waiting)
                waiting = {}
                self._define(line)
            elif name in {"MSG", "PARM"}:
                self._keep_text(name, line)
            if name in self._columns or name == "FMT":
                self._found.counts[name] += 1
            elif line.strip():
                self.bad += 1
        self._keep(waiting)

    def finish(self, where: str) -> None:
        """Says what was lost.

        Raises:
            InputError: There was no FMT line.
        """
        if not self._columns:
            raise InputError(
                "E-DATAFLASH-01",
                "the DataFlash log holds no message",
                where=where,
                found="no whole FMT line",
                expected="a line FMT before the first of each message",
                hint="download the log again from the vehicle",
            )
        if self.bad:
            self._found.losses.append(f"{self.bad} lines are damaged and were skipped")

    def _define(self, line: bytes) -> None:
        parts = [part.strip().decode("latin-1") for part in line.split(b",")]
        if len(parts) >= 6 and len(parts[3]) <= _LONGEST_NAME and len(self._columns) < _MOST_NAMES:
            self._columns[parts[3]] = tuple(parts[5:])

    def _keep(self, waiting: dict[str, list[bytes]]) -> None:
        for name, lines in waiting.items():
            columns = self._columns.get(name)
            if columns is None:
                # Counted as damaged already.
                continue
            places = {field: columns.index(field) + 1 for field in WANTED[name] if field in columns}
            rows = [line.split(b",") for line in lines]
            whole = [row for row in rows if len(row) == len(columns) + 1]
            self.bad += len(rows) - len(whole)
            if whole and places:
                self._found.add(name, {field: (_numbers(whole, at), 1.0) for field, at in places.items()})

    def _keep_text(self, name: str, line: bytes) -> None:
        columns = self._columns.get(name, ())
        # Only the last field may hold commas.
        cells = [cell.strip() for cell in line.split(b",", len(columns))][1:]
        row = dict(zip(columns, cells, strict=False))
        if name == "MSG" and "Message" in row:
            self._found.say(row["Message"].decode("utf-8", "replace"))
        elif "Name" in row and "Value" in row:
            self._found.set(row["Name"].decode("latin-1"), _number(row["Value"]))


def _numbers(rows: Sequence[Sequence[bytes]], at: int) -> np.ndarray:
    """A column of cells as (n,) floats; NaN where a cell is no number."""
    try:
        return np.array([float(row[at]) for row in rows], np.float64)
    except ValueError:
        return np.array([_number(row[at]) for row in rows], np.float64)


def _number(cell: bytes) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")
