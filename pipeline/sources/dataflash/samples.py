"""Columns of DataFlash messages as streams: with times, split by instance, in order, free of what damage left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints
from pipeline.sources.dataflash.fields import Found
from pipeline.sources.records import NS_PER_MS, NS_PER_S, NS_PER_US, Nanoseconds, nothing
from pipeline.sources.streams import in_order

# Times since boot, and what makes nanoseconds of them; GPS.T is the old firmware's "milliseconds since boot" where
# its TimeMS is that of the GPS week.
_CLOCKS = (("TimeUS", NS_PER_US), ("T", NS_PER_MS), ("TimeMS", NS_PER_MS))
# No vehicle runs for as long without a boot: 30 years.
_LATEST_NS = 30 * 366 * 86_400 * NS_PER_S
# Messages are written by several threads, and a camera's feedback is dated back: so much disorder is no damage.
_DISORDER_NS = NS_PER_S


@dataclass(frozen=True, slots=True)
class Samples:
    """One stream's messages.

    Args:
        stream: The message, with the instance where there are several.
        instance: The instance as logged, 0 where not.
        time_ns: (n,) since boot, never decreasing.
        columns: Fields, (n,) each.
    """

    stream: str
    instance: int
    time_ns: Nanoseconds
    columns: Mapping[str, Floats]

    def first(self, *names: str) -> Floats:
        """(n,) of the first of these fields that is there, NaN when none is."""
        return next((self.columns[name] for name in names if name in self.columns), nothing(len(self.time_ns)))

    def pick(self, which: AnyArray) -> Samples:
        """Some of the samples, by mask or indices."""
        columns = {name: values[which] for name, values in self.columns.items()}
        return Samples(self.stream, self.instance, self.time_ns[which], columns)


def samples(found: Found, name: str, needed: Sequence[str]) -> list[Samples]:
    """The messages of a name as one stream per instance.

    Args:
        found: What the walk found; the message's columns are taken out of it.
        name: The message.
        needed: Fields without which the message says nothing; a sample lacking one is left out.

    Returns:
        Streams in the order of their instances; none when there is no such message.
    """
    columns = found.take(name)
    if not columns:
        if found.counts[name]:
            found.losses.append(f"no field of {name} could be read: its {found.counts[name]} messages were left out")
        return []
    # A TimeMS beside a Week is that of the GPS week, not of the boot.
    own = [known for known in _CLOCKS if known[0] in columns and (known[0] != "TimeMS" or "Week" not in columns)]
    lacking = [field for field in needed if field not in columns]
    if not own or lacking:
        lacks = ", ".join(lacking) or "TimeUS or TimeMS"
        found.losses.append(f"{name} has no {lacks}: its {found.counts[name]} messages were left out")
        return []
    clock, unit_ns = own[0]
    time_ns, good = _nanoseconds(columns.pop(clock), unit_ns)
    for field in needed:
        good &= np.isfinite(columns[field])
    bad = int(np.count_nonzero(~good))
    if bad:
        found.losses.append(f"{bad} of {len(good)} {name} messages hold no sound values and were left out")
    instance = columns.pop("I", np.zeros(len(good)))
    numbers = np.unique(instance[good & np.isfinite(instance)]).astype(np.int64).tolist()
    streams = []
    for number in numbers:
        every = Samples(f"{name}[{number}]" if len(numbers) > 1 else name, number, time_ns, columns)
        streams.append(_ordered(every.pick(good & (instance == number)), found.losses))
    return streams


def _nanoseconds(counted: Floats, unit_ns: int) -> tuple[Nanoseconds, Bools]:
    good = np.isfinite(counted) & (counted >= 0.0) & (counted <= _LATEST_NS / unit_ns)
    return np.where(good, counted, 0.0).astype(np.int64) * unit_ns, good


def _ordered(stream: Samples, losses: list[str]) -> Samples:
    if len(stream.time_ns) < 2:
        return stream
    behind_ns = int(np.max(np.maximum.accumulate(stream.time_ns) - stream.time_ns))
    if behind_ns == 0:
        return stream
    if behind_ns <= _DISORDER_NS:
        return stream.pick(np.argsort(stream.time_ns, kind="stable"))
    kept = in_order(stream.time_ns)
    losses.append(
        f"{np.count_nonzero(~kept)} of {len(kept)} {stream.stream} messages are out of order in time and were left out"
    )
    return stream.pick(kept)


def nearest(time_ns: Nanoseconds, wanted_ns: Nanoseconds, within_ns: int) -> Ints:
    """Of each wanted instant the index of the nearest sample, -1 where none is near enough.

    Args:
        time_ns: (n,) samples, in order.
        wanted_ns: (m,) instants.
        within_ns: How far away a sample may be.

    Returns:
        (m,).
    """
    if not len(time_ns):
        return np.full(len(wanted_ns), -1, np.int64)
    after = np.clip(np.searchsorted(time_ns, wanted_ns), 0, len(time_ns) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(time_ns[before] - wanted_ns) <= np.abs(time_ns[after] - wanted_ns)
    index = np.where(closer, before, after)
    return np.where(np.abs(time_ns[index] - wanted_ns) <= within_ns, index, -1).astype(np.int64)
