"""Cues of a subtitle file as columns of numbers."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import BinaryIO

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.sources.dji_logs import srt_dialects

_ARROW = re.compile(r"(\d{1,3}):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_LINE_BYTES = 1 << 16
# A cue is a few hundred characters; what a damaged file has beyond is not kept.
_CUE_CHARACTERS = 8192


@dataclass(slots=True)
class Cues:
    """Numbers of all cues so far, one growing column per name: no object per cue is kept.

    Args:
        count: Cues.
        columns: By name as `srt_dialects.fields` has them, and "start_ms" (time in the video), "local_us" (date line,
            since 1970), "utc" (1 where the date line says UTC); shorter than `count` where later cues lack the value.
        settings: First camera settings seen.
    """

    count: int = 0
    columns: dict[str, array[float]] = field(default_factory=dict)
    settings: dict[str, float] = field(default_factory=dict)

    @property
    def tells(self) -> bool:
        """Whether anything of a flight was found."""
        return bool(self.settings) or not self.columns.keys() <= {"start_ms", "local_us", "utc"}

    def add(self, start_ms: float | None, text: str) -> None:
        """Takes in a cue.

        Args:
            start_ms: Its start in the video; None where it cannot be read.
            text: Its lines.
        """
        values = srt_dialects.fields(text)
        if start_ms is not None:
            values["start_ms"] = start_ms
        written = srt_dialects.date(text)
        if written is not None:
            values["local_us"], values["utc"] = written[0], float(written[1])
        if len(self.settings) < srt_dialects.SETTINGS:
            self.settings = {**srt_dialects.settings(text), **self.settings}
        self._append(values)

    def _append(self, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            column = self.columns.setdefault(name, array("d"))
            if len(column) < self.count:
                column.extend([np.nan] * (self.count - len(column)))
            column.append(value)
        self.count += 1

    def column(self, *names: str) -> Floats:
        """(count,) the first of the named values that a cue has; NaN where it has none."""
        out = np.full(self.count, np.nan)
        for name in names:
            have = np.frombuffer(self.columns.get(name, array("d")), np.float64)
            head = out[: len(have)]
            missing = np.isnan(head)
            head[missing] = have[missing]
        return out


def read_cues(stream: BinaryIO) -> Cues:
    """Reads all cues of an open subtitle file."""
    cues = Cues()
    for start_ms, text in _split(stream):
        cues.add(start_ms, text)
    return cues


def _split(stream: BinaryIO) -> Iterator[tuple[float | None, str]]:
    """Start and text of each cue. It begins with its number after an empty line, or with its arrow line.

    One firmware has numbers and no arrow lines; a damaged file may lack either.
    """
    start_ms: float | None = None
    text: list[str] = []
    length = 0
    begun = timed = False
    blank = True
    for line in _lines(stream):
        number = blank and line.isascii() and line.isdigit()
        arrow = "-->" in line
        if number or (arrow and (timed or not begun)):
            if begun and (timed or text):
                yield start_ms, "\n".join(text)
            begun, timed, start_ms, text, length = True, False, None, [], 0
        if arrow:
            timed, start_ms = True, _start_ms(line)
        elif line and not number and begun and length < _CUE_CHARACTERS:
            text.append(line[:_CUE_CHARACTERS])
            length += len(line)
        blank = not line
    if begun and (timed or text):
        yield start_ms, "\n".join(text)


def _lines(stream: BinaryIO) -> Iterator[str]:
    for raw in iter(partial(stream.readline, _LINE_BYTES), b""):
        yield raw.decode("utf-8", "replace").strip("\ufeff\r\n\t \0")


def _start_ms(line: str) -> float | None:
    found = _ARROW.search(line)
    if found is None:
        return None
    hours, minutes, seconds = (int(part) for part in found.groups()[:3])
    return ((hours * 60 + minutes) * 60 + seconds) * 1000.0 + int(found[4].ljust(3, "0"))
