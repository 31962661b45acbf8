"""Progress on stderr: a bar on a terminal, a JSON line every five seconds elsewhere."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

INTERVAL_S = 5.0


def counted(number: int, noun: str) -> str:
    """A number with its noun: "1 pair", "2 pairs"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


class Meter(Protocol):
    """Counts items done."""

    def advance(self, items: int) -> None:
        """Adds finished items."""


class Reporter:
    """Tells a person or a program how far the work is.

    Args:
        stream: Where to write; stderr by default.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._console = Console(file=self._stream, highlight=False)

    def say(self, text: str) -> None:
        """One line for people."""
        self._console.print(text, soft_wrap=True, markup=False)

    @contextmanager
    def meter(self, stage: str, label: str, total: int) -> Iterator[Meter]:
        """A meter of `total` items for as long as the block runs."""
        if self._console.is_terminal:
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
            with Progress(*columns, console=self._console, transient=True) as bars:
                yield _BarMeter(bars, f"{stage}: {label}", total)
        else:
            lines = _LineMeter(self._stream, stage, label, total)
            lines.start()
            try:
                yield lines
            finally:
                lines.stop()


class _BarMeter:
    def __init__(self, bars: Progress, description: str, total: int) -> None:
        self._bars = bars
        self._task = bars.add_task(description, total=total)

    def advance(self, items: int) -> None:
        self._bars.advance(self._task, items)


class _LineMeter(threading.Thread):
    def __init__(self, stream: TextIO, stage: str, label: str, total: int) -> None:
        super().__init__(daemon=True)
        self._stream, self._stage, self._label, self._total = stream, stage, label, total
        self._done, self._began, self._stopped = 0, time.monotonic(), threading.Event()

    def advance(self, items: int) -> None:
        self._done += items

    def run(self) -> None:
        while not self._stopped.wait(INTERVAL_S):
            elapsed = round(time.monotonic() - self._began, 1)
            line = {"stage": self._stage, "items": self._label, "done": self._done, "total": self._total}
            self._stream.write(json.dumps({**line, "elapsed_s": elapsed}) + "\n")
            self._stream.flush()

    def stop(self) -> None:
        self._stopped.set()
        self.join()
