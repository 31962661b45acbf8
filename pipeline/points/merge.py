"""Merging the observations in a voxel by inverse variance, without counting a shared pose error twice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import AnyArray, Floats, Ints


@dataclass(frozen=True, slots=True)
class Merged:
    """One row per voxel.

    Args:
        xyz: (m, 3) in the dataset's CRS.
        covariance: (m, 3, 3) m^2, the common part included.
        n_pairs: (m,) pairs that saw it.
        best: (m,) row of the observation with the least variance.
    """

    xyz: Floats
    covariance: Floats
    n_pairs: Ints
    best: Ints


def merge_voxels(xyz: Floats, own: Floats, common: Floats, pair: Ints, frames: Ints, voxel_m: float) -> Merged:
    """Merges observations by voxel.

    Every mean is weighted by one over the variance (the trace), not by the inverse matrix: that would throw a mean of
    two long, nearly parallel ellipsoids out of the voxel they were found in. Points of one pair share that pair's pose
    error, so within a pair the covariance is not divided. Pairs that share frames share their errors: they count as no
    more independent ones than they have ref frames, src frames, or half their frames. The common part is that of the
    best observation and never shrinks.

    Args:
        xyz: (n, 3) in the dataset's CRS, m.
        own: (n, 3, 3) m^2.
        common: (n, 3, 3) m^2.
        pair: (n,) number of the pair.
        frames: (n, 2) numbers of the pair's ref and src frame.
        voxel_m: Edge of a voxel.

    Returns:
        One row per occupied voxel, in order of the voxel's indices.
    """
    voxels = np.floor(xyz / voxel_m).astype(np.int64)
    _, voxel = np.unique(voxels, axis=0, return_inverse=True)
    voxel = voxel.reshape(-1)
    _, first, of_pair = np.unique(np.stack([voxel, pair], axis=1), axis=0, return_index=True, return_inverse=True)
    of_pair = of_pair.reshape(-1)
    share = _shares(own, of_pair)
    pair_xyz, pair_own = _sum(xyz * share[:, None], of_pair), _sum(own * share[:, None, None], of_pair)
    pair_voxel = voxel[first]
    share = _shares(pair_own, pair_voxel)
    covariance = _sum(pair_own * (share**2)[:, None, None], pair_voxel)
    n_pairs = np.bincount(pair_voxel)
    either = _distinct(np.tile(voxel, 2), frames.T.reshape(-1))
    independent = np.minimum(np.minimum(_distinct(voxel, frames[:, 0]), _distinct(voxel, frames[:, 1])), either / 2.0)
    best = _least(np.trace(own, axis1=1, axis2=2), voxel)
    return Merged(
        _sum(pair_xyz * share[:, None], pair_voxel),
        covariance * (n_pairs / independent)[:, None, None] + common[best],
        n_pairs,
        best,
    )


def _shares(own: Floats, group: Ints) -> Floats:
    """Weights by one over the trace that add up to 1 in each group."""
    weight = 1.0 / np.trace(own, axis1=1, axis2=2)
    out: Floats = weight / np.bincount(group, weight)[group]
    return out


def _distinct(group: Ints, values: Ints) -> Ints:
    """How many different values each group has."""
    return np.bincount(np.unique(np.stack([group, values], axis=1), axis=0)[:, 0])


def _sum(values: AnyArray, group: Ints) -> Floats:
    """Sums of the rows of each group."""
    flat = values.reshape(len(values), -1)
    columns = [np.bincount(group, flat[:, i]).astype(np.float64) for i in range(flat.shape[1])]
    return np.stack(columns, axis=1).reshape(-1, *values.shape[1:])


def _least(value: Floats, group: Ints) -> Ints:
    """The row with the least value of each group."""
    order = np.lexsort((value, group))
    return order[np.unique(group[order], return_index=True)[1]]
