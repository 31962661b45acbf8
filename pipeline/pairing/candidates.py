"""Candidate pairs by distance, found with a spatial index and never by trying all pairs."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeline.geometry.arrays import Floats, Ints


def pairs_within(centres: Floats, reach_m: float) -> Ints:
    """All pairs of positions no farther apart than a reach.

    Args:
        centres: (n, 3) m.
        reach_m: Largest distance, m.

    Returns:
        (m, 2) indices (later, earlier), later > earlier, in lexical order.
    """
    if len(centres) < 2:
        return np.empty((0, 2), np.int64)
    found = cKDTree(centres).query_pairs(reach_m, output_type="ndarray").astype(np.int64)
    found = np.sort(found, axis=1)[:, ::-1]
    return found[np.lexsort((found[:, 1], found[:, 0]))]
