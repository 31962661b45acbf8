"""Merging the observations that fall into one voxel, by inverse variance and without counting an error twice."""

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


def merge_voxels(xyz: Floats, own: Floats, common: Floats, pair: Ints, ref: Ints, voxel_m: float) -> Merged:
    """Merges observations by voxel.

    Points of one pair share that pair's pose error, so within a pair positions are averaged and the covariance is not
    divided. Pairs are combined by inverse variance; those of one ref frame share its error and together count as one.
    The common part is that of the best observation and never shrinks.

    Args:
        xyz: (n, 3) in the dataset's CRS, m.
        own: (n, 3, 3) m^2.
        common: (n, 3, 3) m^2.
        pair: (n,) number of the pair.
        ref: (n,) number of the pair's ref frame.
        voxel_m: Edge of a voxel.

    Returns:
        One row per occupied voxel, in order of the voxel's indices.
    """
    voxels = np.floor(xyz / voxel_m).astype(np.int64)
    _, voxel = np.unique(voxels, axis=0, return_inverse=True)
    voxel = voxel.reshape(-1)
    _, first, of_pair = np.unique(np.stack([voxel, pair], axis=1), axis=0, return_index=True, return_inverse=True)
    pair_xyz, pair_own = _average(xyz, own, of_pair.reshape(-1))
    pair_voxel, pair_ref = voxel[first], ref[first]
    information = np.linalg.inv(pair_own)
    weighted = np.einsum("nij,nj->ni", information, pair_xyz)
    total, pulled = _sum(information, pair_voxel), _sum(weighted, pair_voxel)
    n_pairs = np.bincount(pair_voxel)
    n_refs = np.bincount(np.unique(np.stack([pair_voxel, pair_ref], axis=1), axis=0)[:, 0])
    covariance = np.linalg.inv(total)
    best = _least(np.trace(own, axis1=1, axis2=2), voxel)
    return Merged(
        np.einsum("nij,nj->ni", covariance, pulled),
        covariance * (n_pairs / n_refs)[:, None, None] + common[best],
        n_pairs,
        best,
    )


def _average(xyz: Floats, own: Floats, group: Ints) -> tuple[Floats, Floats]:
    weight = 1.0 / np.trace(own, axis1=1, axis2=2)
    total = np.bincount(group, weight)
    share = weight / total[group]
    return _sum(xyz * share[:, None], group), _sum(own * share[:, None, None], group)


def _sum(values: AnyArray, group: Ints) -> Floats:
    """Sums of the rows of each group."""
    flat = values.reshape(len(values), -1)
    columns = [np.bincount(group, flat[:, i]).astype(np.float64) for i in range(flat.shape[1])]
    return np.stack(columns, axis=1).reshape(-1, *values.shape[1:])


def _least(value: Floats, group: Ints) -> Ints:
    """The row with the least value of each group."""
    order = np.lexsort((value, group))
    return order[np.unique(group[order], return_index=True)[1]]
