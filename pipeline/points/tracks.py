"""Tracks: all observations of one physical point, whichever pairs made them.

A *star* is all observations of one pixel of one ref frame. Pairs go one way, from ref to src: that two stars of
different frames are the same point shows where a pixel that one was matched to is the pixel of the other. It is so to
within a pixel or so, because sub-pixel matching moves the src pixel away from that frame's own keypoint. Two stars that
were matched to the same pixel of a third frame are linked in the same way.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.points.covariances import of_differences, squares
from pipeline.points.observed import Observed

# How far sub-pixel matching may move a pixel from the keypoint it started at, with the keypoint's own error, px.
REACH_PX = 1.5
# Chi-square with 3 degrees of freedom: one of a thousand right observations is beyond.
LIMIT = 16.27
# A point and its neighbour of a pixel aside are as far apart as a pixel is wide, or three times that on ground seen at
# 20 degrees: one sigma of the distance between points that are taken as one.
_FOOTPRINTS = 1.5


def tracks(observed: Observed, own: Floats, errors: PoseErrors) -> Ints:
    """The track of each observation.

    Args:
        observed: The observations.
        own: (n, 3, 3) m^2, their whole covariances.
        errors: Between the frames.

    Returns:
        (n,) 0 .. number of tracks - 1.
    """
    star = stars(observed)
    best = least(observed.sigma_m, star)
    one, star_of_other, distance = (np.concatenate(parts) for parts in zip(*_links(observed, star), strict=True))
    agree = agreeing(observed, one, best[star_of_other], own, errors)
    one, star_of_other, distance = one[agree], star_of_other[agree], distance[agree]
    # Of several stars of one frame that claim the same star, the nearest has it: they are different points.
    order = np.lexsort((one, distance, observed.frames[one, 0], star_of_other))
    claim = np.stack([star_of_other, observed.frames[one, 0]], axis=1)[order]
    kept = order[np.concatenate([[True], np.any(claim[1:] != claim[:-1], axis=1)])[: len(order)]]
    n = len(best)
    graph = coo_array((np.ones(len(kept), np.int8), (star[one[kept]], star_of_other[kept])), shape=(n, n))
    label = connected_components(graph, directed=False)[1].astype(np.int64)
    return np.unique(label[star], return_inverse=True)[1].reshape(-1)


def stars(observed: Observed) -> Ints:
    """The star of each observation: (n,), numbered by ref frame and pixel."""
    keys = np.column_stack([observed.ref_px[:, ::-1], observed.frames[:, 0]])
    order = np.lexsort(keys.T)
    new = np.any(keys[order][1:] != keys[order][:-1], axis=1)
    out = np.empty(len(order), np.int64)
    out[order] = np.concatenate([[0], np.cumsum(new)])[: len(order)]
    return out


def least(value: Floats, group: Ints) -> Ints:
    """The row with the least value of each group: (m,); the first of equals."""
    order = np.lexsort((value, group))
    return order[np.unique(group[order], return_index=True)[1]]


def agreeing(observed: Observed, one: Ints, other: Ints, own: Floats, errors: PoseErrors) -> Bools:
    """Whether observations may be of the same point, by all that is known of the difference.

    Args:
        observed: The observations.
        one: (m,) rows.
        other: (m,) rows.
        own: (n, 3, 3) m^2, their whole covariances.
        errors: Between the frames.
    """
    covariance = of_differences(observed, one, other, own, errors)
    footprint = _FOOTPRINTS * np.maximum(observed.footprint_m[one], observed.footprint_m[other])
    covariance += (footprint**2)[:, None, None] * np.eye(3)
    agree: Bools = squares(observed.xyz[one] - observed.xyz[other], covariance) <= LIMIT
    return agree


def _links(observed: Observed, star: Ints) -> Iterator[tuple[Ints, Ints, Floats]]:
    """Observations, the stars that their src pixels are nearest to, and how far, px; frame by frame."""
    ref, src = observed.frames.T
    yield np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    for frame in np.unique(src):
        ends, home = np.flatnonzero(src == frame), np.flatnonzero(ref == frame)
        free = ends
        if len(home):
            here, first = np.unique(star[home], return_index=True)
            tree = cKDTree(observed.ref_px[home[first]])
            nearby = tree.query(observed.src_px[ends], distance_upper_bound=REACH_PX)
            distance, nearest = np.asarray(nearby[0]), np.asarray(nearby[1])
            found = np.isfinite(distance)
            yield ends[found], here[nearest[found]], distance[found]
            free = ends[~found]
        yield from _by_a_third(observed, star, free)


def _by_a_third(observed: Observed, star: Ints, ends: Ints) -> Iterator[tuple[Ints, Ints, Floats]]:
    """Links between observations that end in one pixel of a frame which has no star there."""
    if len(ends) < 2:
        return
    couples = ends[cKDTree(observed.src_px[ends]).query_pairs(REACH_PX, output_type="ndarray")]
    one, other = couples[observed.frames[couples[:, 0], 0] != observed.frames[couples[:, 1], 0]].T
    distance = np.linalg.norm(observed.src_px[one] - observed.src_px[other], axis=1)
    # Each takes the nearest of every other frame.
    order = np.lexsort((other, distance, observed.frames[other, 0], one))
    claim = np.stack([one, observed.frames[other, 0]], axis=1)[order]
    kept = order[np.concatenate([[True], np.any(claim[1:] != claim[:-1], axis=1)])[: len(order)]]
    yield one[kept], star[other[kept]], distance[kept]
