"""How far apart returns lie on surfaces of any direction: walls and ceilings as well as the ground."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeline.geometry.arrays import Floats

_NEIGHBOURS = 8
_MOST_IN_TREE, _ASKED = 500_000, 4_000


def surface_spacing_m(points_in_enu_m: Floats) -> float:
    """The typical distance between neighbouring returns on the surfaces they lie on.

    Args:
        points_in_enu_m: (n, 3) ENU, m; n >= 1.

    Returns:
        1 / sqrt(density), m, the density being that of the disc that holds the eight nearest returns, the median over
        some thousand returns; infinite for less than nine.
    """
    stride = -(-len(points_in_enu_m) // _MOST_IN_TREE)
    kept = points_in_enu_m[::stride]
    if len(kept) <= _NEIGHBOURS:
        return float("inf")
    asked = kept[:: -(-len(kept) // _ASKED)]
    # The first neighbour found is the return itself.
    distance = np.asarray(cKDTree(kept).query(asked, k=_NEIGHBOURS + 1)[0])[:, -1]
    # Of every so many returns one was kept, which thins a surface by as much.
    return float(np.median(distance) * np.sqrt(np.pi / _NEIGHBOURS / stride))
