"""One topic of a ULog as columns, its fields found by the names of all firmware versions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints
from pipeline.sources.records import nothing
from pipeline.sources.streams import in_order

# Microseconds later than this on any clock are damage: the year 2096.
_LAST_US = 4_000_000_000_000_000


@dataclass(frozen=True, slots=True)
class Topic:
    """One instance of a topic.

    Args:
        label: Name, with the instance where it is not the first.
        name: Without.
        columns: Fields by name, (n,) each; elements of arrays as "q[0]".
    """

    label: str
    name: str
    columns: Mapping[str, AnyArray]

    def __len__(self) -> int:
        return len(self.columns["timestamp"])

    def raw(self, *names: str) -> AnyArray | None:
        """(n,) the first of these fields that the firmware logged."""
        return next((self.columns[name] for name in names if name in self.columns), None)

    def scaled(self, name: str, whole: str, per_unit: float) -> Floats:
        """(n,) a field, or the older one in whole parts of its unit; NaN when neither is there."""
        values = self.raw(name, whole)
        if values is None:
            return nothing(len(self))
        # Damage makes signalling NaNs.
        with np.errstate(invalid="ignore"):
            return np.asarray(values, np.float64) / (per_unit if np.issubdtype(values.dtype, np.integer) else 1.0)

    def number(self, name: str) -> Floats:
        """(n,) a field; NaN when it is not there."""
        return self.scaled(name, name, 1.0)

    def quaternions(self) -> Floats:
        """(n, 4) of the field q, w first."""
        return np.stack([self.number(f"q[{index}]") for index in range(4)], axis=-1)

    def flag(self, name: str) -> Bools:
        """(n,) a flag, which older firmware does not log: then all is good."""
        values = self.raw(name)
        return np.ones(len(self), np.bool_) if values is None else np.asarray(values != 0)

    def changes(self, *counters: str) -> Ints:
        """(n,) how often any of these counters had changed."""
        out = np.zeros(len(self), np.int64)
        for name in counters:
            values = self.raw(name)
            if values is not None:
                out[1:] += np.cumsum(values[1:] != values[:-1])
        return out

    def time_us(self, *, sampled: bool = False) -> Ints:
        """(n,) times, 0 where they are none; of the measurement where the firmware logged it and it is asked for."""
        stamps = self.columns["timestamp"]
        samples = self.raw("timestamp_sample")
        if sampled and samples is not None and samples.dtype == stamps.dtype:
            stamps = np.where((samples > 0) & (samples <= stamps), samples, stamps)
        return np.where(stamps < _LAST_US, stamps, 0).astype(np.int64)

    def kept(self, time_us: Ints, good: Bools, losses: list[str]) -> Ints:
        """Indices of samples that are good and in order of time; the others are told of.

        Args:
            time_us: (m,) of some of the samples.
            good: (m,).
            losses: Gets a sentence when any is left out.
        """
        index = np.flatnonzero(good & (time_us > 0))
        index = index[in_order(time_us[index])]
        lost = len(good) - len(index)
        if lost:
            losses.append(
                f"{lost} of {len(good)} {self.label} records hold impossible values or times and were left out"
            )
        return index


def labelled(name: str, instance: int) -> str:
    """A topic's name, with its instance where that is not the first."""
    return f"{name}[{instance}]" if instance else name


def named(topics: Iterable[Topic], *names: str) -> list[Topic]:
    """All instances of topics, in the order of the names."""
    return [topic for name in names for topic in topics if topic.name == name]
