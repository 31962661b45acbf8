"""Intervals of the metrics: clusters of pixels drawn anew, from the clusters' sums alone."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import Bools, Floats
from pipeline.scoring.metrics import NAMES, GroupedSums, values

DRAWS = 2000
# Of 4 clusters there are 35 different samples, which have no tail of 1 in 40; of 5 there are 126. Such an interval is
# still too short: at 5 clusters it holds the truth in some 80 % of cases, at 20 in 92 %.
LEAST_CLUSTERS = 5
_SEED = 0
_TAILS = (0.025, 0.975)


def counts_of_draws(clusters: int) -> Floats:
    """(2000, clusters) how often each cluster is in each draw; the same for the same number of clusters."""
    drawn = np.random.default_rng(_SEED).integers(clusters, size=(DRAWS, clusters))
    place = drawn + clusters * np.arange(DRAWS)[:, None]
    return np.bincount(place.ravel(), minlength=DRAWS * clusters).reshape(DRAWS, clusters).astype(np.float64)


def intervals(clusters: GroupedSums) -> Floats | None:
    """95 % percentile intervals of the metrics.

    Pixels of one cluster share an error (a frame's pose, a neighbourhood's match), so whole clusters are drawn, with
    replacement, as many as there are. A draw's metrics follow from how often each cluster is in it and from the
    clusters' sums. What all clusters have in common - of frames, a shift of the whole flight - is not in the interval.

    Args:
        clusters: Their sums; those without a pixel do not take part.

    Returns:
        (8, 2) low and high, in the order of `NAMES`; None with fewer than 5 clusters.

    Source: Efron, Tibshirani, "An introduction to the bootstrap" (1993), section 13.3 (percentile interval); Davison,
    Hinkley, "Bootstrap methods and their application" (1997), section 3.8 (clusters).
    """
    drawn = _drawn(clusters, clusters.n > 0)
    return None if drawn is None else np.quantile(drawn, _TAILS, axis=0).T


def difference(one: GroupedSums, other: GroupedSums) -> Floats | None:
    """95 % percentile intervals of the metrics of one method less those of another on the same pixels.

    Both are taken from the same draws: what a cluster does to both alike is not in their difference.

    Args:
        one: Sums per cluster.
        other: Of the same pixels.

    Returns:
        As of `intervals`.
    """
    full = one.n > 0
    mine, theirs = _drawn(one, full), _drawn(other, full)
    return None if mine is None or theirs is None else np.quantile(mine - theirs, _TAILS, axis=0).T


def by_name(bounds: Floats | None) -> dict[str, list[float]] | None:
    """Intervals (8, 2) by the metric's name."""
    return None if bounds is None else dict(zip(NAMES, bounds.tolist(), strict=True))


def _drawn(clusters: GroupedSums, rows: Bools) -> Floats | None:
    """(2000, 8) the metrics of each draw."""
    n, sums = clusters.n[rows], clusters.sums[rows]
    if len(n) < LEAST_CLUSTERS:
        return None
    columns = np.ascontiguousarray(np.column_stack([n, sums]).T)
    # einsum and not a matrix product: how that one adds up depends on the threads it is given.
    drawn = np.einsum("dk,mk->dm", counts_of_draws(len(n)), columns)
    return values(drawn[:, 0], drawn[:, 1:])
