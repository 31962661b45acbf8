"""Points that stand alone where their neighbours do not: mismatches that no second pair has confirmed.

How far a point is from its neighbours says nothing by itself, for density falls with range and with texture. What is
compared is how far it is from them and how far they are from theirs (the idea of the local outlier factor: Breunig et
al., "LOF: Identifying Density-Based Local Outliers", SIGMOD 2000).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeline.geometry.arrays import Bools, Floats, Ints

# Enough that two mismatches side by side do not confirm each other, few enough for the foot of a pole.
NEIGHBOURS = 8
# The end of a row of points is up to twice as far from its neighbours as they are from theirs, and the corner of a
# sparse patch beside a dense one three to four times.
_RATIO = 5.0
# A distance that the point's own error explains is noise, and its covariance tells of it.
_SIGMAS = 3.0
# A mistake is hardly made twice alike: what three images agree on stands, however far from the rest.
_FRAMES = 3


def isolated(xyz: Floats, sigma_m: Floats, n_frames: Ints) -> Bools:
    """Which points stand alone.

    Args:
        xyz: (n, 3) m.
        sigma_m: (n,) along the point's worst axis.
        n_frames: (n,) frames that had a part in it.

    Returns:
        (n,).
    """
    if len(xyz) <= NEIGHBOURS:
        return np.zeros(len(xyz), bool)
    distance, near = (np.asarray(found)[:, 1:] for found in cKDTree(xyz).query(xyz, k=NEIGHBOURS + 1))
    mean = np.mean(distance, axis=1)
    usual = np.median(mean[near], axis=1)
    out: Bools = (mean > _RATIO * usual) & (mean > _SIGMAS * sigma_m) & (n_frames < _FRAMES)
    return out
