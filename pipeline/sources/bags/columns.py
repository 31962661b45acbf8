"""Columns that grow message by message, and the one clock that all of a bag's streams end up on."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.sources.records import NS_PER_S, Nanoseconds
from pipeline.sources.streams import in_order
from pipeline.sources.time_bases import UTC_FROM_NS

# A message this far from its neighbours in the file is not merely late.
_LATE_NS = 10 * NS_PER_S


class Columns:
    """Header stamps, log times and numbers of one stream.

    Args:
        width: Numbers per message.
    """

    def __init__(self, width: int) -> None:
        self.width = width
        self._times = array("q")
        self._values = array("d")

    def add(self, stamp_ns: int, log_ns: int, values: Iterable[float] = ()) -> None:
        """Appends a message, or nothing of it.

        Raises:
            TypeError, OverflowError: A value is no number, or a time is out of range.
        """
        times, row = array("q", (stamp_ns, log_ns)), array("d", values)
        if len(row) != self.width:
            raise TypeError(f"{len(row)} numbers where {self.width} are expected")
        self._times.extend(times)
        self._values.extend(row)

    def __len__(self) -> int:
        return len(self._times) // 2

    @property
    def times_ns(self) -> Nanoseconds:
        """(n, 2) header stamps and log times."""
        return np.frombuffer(self._times, np.int64).reshape(-1, 2)

    @property
    def values(self) -> Floats:
        """(n, width)."""
        return np.frombuffer(self._values, np.float64).reshape(len(self), self.width)


@dataclass(frozen=True, slots=True)
class Timed:
    """A stream in the order of time.

    Args:
        time_ns: (n,) never decreasing.
        values: (n, width).
        note: What to distrust of the times; empty when nothing.
        dropped: Messages that were left out because their time is no time.
    """

    time_ns: Nanoseconds
    values: Floats
    note: str
    dropped: int


def epoch_of(streams: Iterable[Columns]) -> Literal["utc", "boot"]:
    """Whether a bag's times count from 1970: by the stamps of most streams, by log times where no message has one."""
    utc = boot = logged = 0
    for samples in streams:
        stamps, log = samples.times_ns.T
        stamps = stamps[stamps > 0]
        if len(stamps):
            if int(np.median(stamps)) >= UTC_FROM_NS:
                utc += 1
            else:
                boot += 1
        elif len(log) and int(np.median(log)) >= UTC_FROM_NS:
            logged += 1
    if utc or boot:
        return "utc" if utc >= boot else "boot"
    return "utc" if logged else "boot"


def of_epoch(time_ns: Nanoseconds | int, epoch: Literal["utc", "boot"]) -> Bools:
    """Whether times can be of a clock of this kind, (n,) or a single one."""
    return np.asarray((np.asarray(time_ns) >= UTC_FROM_NS) == (epoch == "utc"))


def timed(samples: Columns, epoch: Literal["utc", "boot"], good: Bools | None = None) -> Timed:
    """A stream by its header stamps; by log times where stamps are missing or of another clock than the bag's.

    Args:
        samples: As they came.
        epoch: Of the bag.
        good: (n,) samples to use; all by default.

    Returns:
        In order. Late messages are put in their place, those whose time cannot be are dropped.
    """
    stamps, log = samples.times_ns.T
    stamped = (stamps > 0) & of_epoch(stamps, epoch)
    time_ns = np.where(stamped, stamps, log)
    asked = np.ones(len(samples), np.bool_) if good is None else good
    index = np.flatnonzero(asked & (stamped | of_epoch(log, epoch)))
    index = index[_near(time_ns[index])]
    index = index[np.argsort(time_ns[index], kind="stable")]
    dropped = int(np.count_nonzero(asked)) - len(index)
    return Timed(time_ns[index], samples.values[index], _note(stamps[index], stamped[index]), dropped)


def _note(stamps: Nanoseconds, stamped: Bools) -> str:
    missing = int(np.count_nonzero(~stamped))
    if not missing:
        return ""
    if missing == len(stamped):
        return "log time: no header stamps" if not np.any(stamps > 0) else "log time: header stamps of another clock"
    return f"log time for {missing} of {len(stamped)} messages: header stamps missing or of another clock"


def _near(time_ns: Nanoseconds) -> Bools:
    """Columns whose time fits those around them in the file."""
    kept = in_order(time_ns)
    if np.all(kept):
        return kept
    index: Ints = np.arange(len(time_ns))
    around = np.interp(index, index[kept], time_ns[kept].astype(np.float64))
    near: Bools = np.abs(time_ns - around) < _LATE_NS
    return kept | near
