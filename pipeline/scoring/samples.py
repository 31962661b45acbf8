"""A sample of bounded size that is the same however the whole was cut into shards, and in whatever order they came.

Every item has a key by which it is told from others, and the key is as good as a random number. Those with the least
keys are kept: a draw without replacement, which two samples together make again from what each of them kept.

Source: Cohen, Kaplan, "Summarizing data using bottom-k sketches" (PODC 2007); the mixing of bits is that of Steele,
Lea, Flood, "Fast splittable pseudorandom number generators" (OOPSLA 2014), figure 16.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from pipeline.geometry.arrays import AnyArray, Floats, Ints, Singles

MOST_KEPT = 1 << 18
"""A share estimated from so many is good to 0.1 %; less than 10 MB."""

_WEYL, _MIX_1, _MIX_2 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


@dataclass(frozen=True, slots=True)
class Sample:
    """Drawn items.

    Args:
        key: (n,) uint64, distinct and rising.
        tie: (n,) uint64, which of several items of one key this is.
        values: (n, c) what is known of each.
    """

    key: AnyArray
    tie: AnyArray
    values: Singles

    @classmethod
    def of(cls, key: AnyArray, tie: AnyArray, values: AnyArray, most: int = MOST_KEPT) -> Self:
        """The sample of some items.

        Args:
            key: (n,) uint64, from `mixed`.
            tie: (n,) uint64; of equal keys the item with the least one is kept.
            values: (n, c).
            most: Items kept.
        """
        order = np.lexsort((*np.transpose(values), tie, key))
        first = np.concatenate([[True], key[order][1:] != key[order][:-1]])[: len(order)]
        kept = order[first][:most]
        return cls(key[kept], tie[kept], np.asarray(values[kept], np.float32))

    @classmethod
    def total(cls, parts: Iterable[Self], width: int, most: int = MOST_KEPT) -> Self:
        """The sample of the items of several together; of a stream of them few are held at a time.

        Args:
            parts: What was drawn of each part, with the same `most`.
            width: Number of values of an item.
            most: Items kept.
        """
        held = [cls(np.zeros(0, np.uint64), np.zeros(0, np.uint64), np.zeros((0, width), np.float32))]
        for part in parts:
            held.append(part)
            if sum(len(some.key) for some in held) > 4 * most:
                held = [cls._joined(held, most)]
        return cls._joined(held, most)

    @classmethod
    def _joined(cls, parts: list[Self], most: int) -> Self:
        key, tie, values = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("key", "tie", "values")
        )
        return cls.of(key, tie, values, most)


def mixed(numbers: Ints) -> AnyArray:
    """A key of each row of whole numbers: equal rows have equal ones, others look independent.

    Args:
        numbers: (n, c).

    Returns:
        (n,) uint64.
    """
    key = np.zeros(len(numbers), np.uint64)
    for column in np.transpose(numbers).astype(np.uint64):
        key = (key ^ column) + _WEYL
        key = (key ^ (key >> np.uint64(30))) * _MIX_1
        key = (key ^ (key >> np.uint64(27))) * _MIX_2
        key ^= key >> np.uint64(31)
    return key


def cells(p_in_enu_m: Floats, edge_m: float) -> Ints:
    """(n, 3) the cube of a grid about the origin that each of (n, 3) points, m, lies in."""
    out: Ints = np.floor(p_in_enu_m / edge_m).astype(np.int64)
    return out
