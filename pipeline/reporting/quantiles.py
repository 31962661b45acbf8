"""Quantiles of more values than memory holds: a histogram of their logarithms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import AnyArray, Ints

# Bins of 0.58 %: far below what a median in a report is read to.
_PER_DECADE = 400
_DECADES = (-6, 6)
_BINS = (_DECADES[1] - _DECADES[0]) * _PER_DECADE


@dataclass(frozen=True, slots=True)
class Spread:
    """How positive values spread.

    Args:
        counts: (4800,) values per bin of the logarithm, 1e-6 to 1e6; what lies outside is in the outermost ones.
    """

    counts: Ints

    @staticmethod
    def of(values: AnyArray) -> Spread:
        """The spread of some values; those that are not finite and positive are left out."""
        found = np.asarray(values, np.float64)
        found = found[np.isfinite(found) & (found > 0.0)]
        bins = np.floor((np.log10(found) - _DECADES[0]) * _PER_DECADE).astype(np.int64)
        return Spread(np.bincount(np.clip(bins, 0, _BINS - 1), minlength=_BINS))

    def __add__(self, other: Spread) -> Spread:
        return Spread(self.counts + other.counts)

    def quantile(self, share: float) -> float | None:
        """The value below which a share of the values lies; None of nothing."""
        total = int(self.counts.sum())
        if not total:
            return None
        index = int(np.searchsorted(np.cumsum(self.counts), share * total))
        return float(10.0 ** ((min(index, _BINS - 1) + 0.5) / _PER_DECADE + _DECADES[0]))
