"""Metrics in bins of how far a point is and of the parallax it was seen under."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipeline.geometry.arrays import Bools, Floats
from pipeline.scoring.metrics import GroupedSums

PARALLAX_EDGES_DEG = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, math.inf)
_MOST_RANGES = 10


def range_edges_m(max_range_m: float) -> tuple[float, ...]:
    """Edges of at most ten bins up to the largest range, at multiples of 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(max_range_m / _MOST_RANGES))
    # Rounding must not make an eleventh bin of 0.3 / 0.1.
    counts = ((f * power, math.ceil(max_range_m / (f * power) - 1e-9)) for f in (1.0, 2.0, 5.0, 10.0))
    step, count = next((step, count) for step, count in counts if count <= _MOST_RANGES)
    return (*(k * step for k in range(count)), max_range_m)


@dataclass(frozen=True, slots=True)
class BinnedSums:
    """One method's sums by bins of a quantity.

    Args:
        edges: (k + 1,) of the bins, which have their lower edge in them and the last one both.
        kept: Over the pixels the method keeps.
        common: Over those every method keeps.
    """

    edges: tuple[float, ...]
    kept: GroupedSums
    common: GroupedSums

    @staticmethod
    def of(
        quantity: Floats, edges: tuple[float, ...], depth_m: Floats, reference_m: Floats, kept: Bools, common: Bools
    ) -> BinnedSums:
        """The sums of one method.

        Args:
            quantity: (n,) what is binned; NaN or outside the edges is in no bin.
            edges: Of the bins.
            depth_m: (n,) as of `MethodSums.of`.
            reference_m: (n,) as of `MethodSums.of`.
            kept: (n,) which the method keeps.
            common: (n,) which every method keeps.
        """
        count = len(edges) - 1
        place = np.searchsorted(edges, quantity, side="right") - 1
        place[quantity == edges[-1]] = count - 1
        # NaN is sorted behind the last edge.
        place[place >= count] = -1
        sums = (GroupedSums.of(depth_m[of], reference_m[of], place[of], count) for of in (kept, common))
        return BinnedSums(edges, *sums)

    @staticmethod
    def total(parts: Iterable[BinnedSums]) -> BinnedSums:
        """The sums of several sets with the same edges; at least one set."""
        listed = list(parts)
        kept, common = (GroupedSums.total(getattr(part, name) for part in listed) for name in ("kept", "common"))
        return BinnedSums(listed[0].edges, kept, common)

    def metrics(self) -> list[dict[str, object]]:
        """One entry per bin: `from`, `to` (None where there is no upper edge), `all` and `common`."""
        spans = pairwise(self.edges)
        rows = zip(spans, self.kept.metrics(), self.common.metrics(), strict=True)
        return [
            {"from": low, "to": high if math.isfinite(high) else None, "all": kept, "common": common}
            for (low, high), kept, common in rows
        ]
