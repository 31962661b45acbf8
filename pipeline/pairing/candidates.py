"""Candidate pairs by distance, found with a spatial index and never by trying all pairs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from pipeline.geometry.arrays import Floats, Ints

# Frames asked about at once: a hover, where every frame is near every other, stays within memory.
_BLOCK = 256


def pairs_within(centres: Floats, nearest_m: float, farthest_m: float) -> Iterator[Ints]:
    """All pairs of positions within limits of distance.

    Args:
        centres: (n, 3) m.
        nearest_m: Least distance, m.
        farthest_m: Largest distance, m.

    Yields:
        (m, 2) indices (later, earlier), later > earlier; in lexical order from block to block.
    """
    everywhere = cKDTree(centres)
    for start in range(0, len(centres), _BLOCK):
        here = cKDTree(centres[start : start + _BLOCK])
        found = here.sparse_distance_matrix(everywhere, farthest_m, output_type="ndarray")
        later, earlier = found["i"].astype(np.int64) + start, found["j"].astype(np.int64)
        wanted = (earlier < later) & (found["v"] >= nearest_m)
        pairs = np.stack([later[wanted], earlier[wanted]], axis=1)
        yield pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
