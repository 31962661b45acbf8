"""Which frames may see the same points: those near one another in the graph of pairs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array, csr_array

from pipeline.flight import PairRow

# A point that two matches tie together joins frames two pairs apart; tracks of matches reach farther.
_HOPS = 4


def together(frames: Sequence[str], pairs: Sequence[PairRow], hops: int = _HOPS) -> list[tuple[str, str]]:
    """The different frames that a few pairs connect, two by two.

    Args:
        frames: All frames, in the flight's order.
        pairs: The selected pairs.
        hops: Over how many pairs.

    Returns:
        Each couple once, the earlier frame first, in order.
    """
    index = {name: i for i, name in enumerate(frames)}
    ends = np.array([(index[pair.ref], index[pair.src]) for pair in pairs], np.int64).reshape(-1, 2)
    n = len(frames)
    ones = np.ones(2 * len(ends) + n, np.int64)
    rows = np.concatenate([ends[:, 0], ends[:, 1], np.arange(n)])
    columns = np.concatenate([ends[:, 1], ends[:, 0], np.arange(n)])
    step = csr_array(coo_array((ones, (rows, columns)), shape=(n, n)))
    step.data[:] = 1
    reached = step
    for _ in range(hops - 1):
        reached = csr_array(reached @ step)
        reached.data[:] = 1
    i, j = reached.nonzero()
    found = sorted((int(a), int(b)) for a, b in zip(i, j, strict=True) if a < b)
    return [(frames[a], frames[b]) for a, b in found]
