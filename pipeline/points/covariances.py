"""Covariances of sums and differences of observations, all that they share counted.

Every observation moves with the errors of its two frames and with an error of its own. A weighted sum of observations
moves with sum_f G_f e_f, G_f the weighted sum of their Jacobians by frame f, and so its covariance is

    sum over f, g of G_f Sigma_fg G_g^T  +  sum of w^2 times the independent parts

exact to first order for any weights: what all observations share cannot be averaged away. Where Sigma_fg is not kept,
the sum's covariance is bounded instead. For weights that add up to 1, Cov <= sum of w C_o with C_o the covariances of
the observations, whatever their correlation: the square of a mean is at most the mean of the squares (the argument of
covariance intersection). For the same reason Cov(a - b) <= 2 (C_a + C_b).
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.points.observed import Observed

# Numbers of the gathered covariances of a block of groups: 32 MiB.
_BLOCK = 4_000_000


def whole(observed: Observed, errors: PoseErrors) -> Floats:
    """(n, 3, 3) m^2 covariance of each observation by itself."""
    factors = observed.jacobian.reshape(-1, 3, 2, 6).transpose(0, 2, 1, 3)
    found, known = of_groups(factors, observed.frames, errors)
    if not known.all():
        # The frames of a pair themselves: twice the parts that each of the two makes.
        rows = np.flatnonzero(~known)
        parts = (of_groups(factors[rows, i : i + 1], observed.frames[rows, i : i + 1], errors)[0] for i in (0, 1))
        found[rows] = 2.0 * sum(parts)
    out: Floats = found + observed.independent
    return out


def of_differences(observed: Observed, one: Ints, other: Ints, own: Floats, errors: PoseErrors) -> Floats:
    """Covariances of the differences of observations.

    Args:
        observed: The observations.
        one: (m,) their rows.
        other: (m,) rows of those subtracted.
        own: (n, 3, 3) as `whole` gives.
        errors: Between the frames.

    Returns:
        (m, 3, 3) m^2.
    """
    factors = observed.jacobian.reshape(-1, 3, 2, 6).transpose(0, 2, 1, 3)
    both = np.concatenate([factors[one], -factors[other]], axis=1)
    found, known = of_groups(both, np.concatenate([observed.frames[one], observed.frames[other]], axis=1), errors)
    found += observed.independent[one] + observed.independent[other]
    return np.where(known[:, None, None], found, 2.0 * (own[one] + own[other]))


def of_means(observed: Observed, weight: Floats, group: Ints, own: Floats, errors: PoseErrors) -> Floats:
    """Covariances of weighted means of groups of observations.

    Args:
        observed: The observations.
        weight: (n,) those of a group add up to 1.
        group: (n,) 0 .. m - 1, none of them empty.
        own: (n, 3, 3) as `whole` gives.
        errors: Between the frames.

    Returns:
        (m, 3, 3) m^2.
    """
    n_frames = len(errors.index)
    key, of_key = np.unique((group[:, None] * n_frames + observed.frames).reshape(-1), return_inverse=True)
    factors = (observed.jacobian * weight[:, None, None]).reshape(-1, 3, 2, 6).transpose(0, 2, 1, 3)
    by_frame = sums(factors.reshape(-1, 3, 6), of_key.reshape(-1))
    of_group, frame = key // n_frames, key % n_frames
    first, count = np.unique(of_group, return_index=True, return_counts=True)[1:]
    common = np.empty((len(first), 3, 3))
    known = np.empty(len(first), bool)
    for size in np.unique(count):
        some = np.flatnonzero(count == size)
        rows = first[some][:, None] + np.arange(size)
        common[some], known[some] = of_groups(by_frame[rows], frame[rows], errors)
    exact = common + sums(observed.independent * (weight**2)[:, None, None], group)
    if known.all():
        return exact
    return np.where(known[:, None, None], exact, sums(own * weight[:, None, None], group))


def sums(values: Floats, group: Ints) -> Floats:
    """Sums of the rows of each group.

    Args:
        values: (n, ...).
        group: (n,) 0 .. m - 1.

    Returns:
        (m, ...).
    """
    flat = values.reshape(len(values), math.prod(values.shape[1:]))
    columns = [np.bincount(group, flat[:, i]).astype(np.float64) for i in range(flat.shape[1])]
    return np.stack(columns, axis=1).reshape(-1, *values.shape[1:])


def squares(vectors: Floats, covariance: Floats) -> Floats:
    """(n,) squared lengths of vectors (n, 3) in units of their covariances (n, 3, 3)."""
    out: Floats = np.sum(vectors * np.linalg.solve(covariance, vectors[:, :, None])[:, :, 0], axis=1)
    return out


def of_groups(factors: Floats, frames: Ints, errors: PoseErrors) -> tuple[Floats, Bools]:
    """Covariance of sum_k factors_k e_k for groups of equally many frames' errors.

    Args:
        factors: (m, k, 3, 6).
        frames: (m, k) numbers of the frames; one may come twice.
        errors: Between the frames.

    Returns:
        (m, 3, 3), and (m,) whether every covariance between them is kept; where not, the first is no number of use.
    """
    m, k = frames.shape
    found, known = np.empty((m, 3, 3)), np.empty(m, bool)
    step = max(_BLOCK // (36 * k * k), 1)
    for start in range(0, m, step):
        part = slice(start, start + step)
        first, alike = _alike(frames[part], len(errors.index))
        of = frames[part][first]
        blocks, kept = errors.of_numbers(*np.broadcast_arrays(of[:, :, None], of[:, None, :]))
        known[part] = np.all(kept[alike], axis=(1, 2))
        between = blocks.transpose(0, 1, 3, 2, 4).reshape(-1, 6 * k, 6 * k)[alike]
        flat = factors[part].transpose(0, 2, 1, 3).reshape(-1, 3, 6 * k)
        found[part] = flat @ between @ np.swapaxes(flat, 1, 2)
    return found, known


def _alike(frames: Ints, n_frames: int) -> tuple[Ints, Ints]:
    """Rows (u,) of the different groups of frames (m, k), and which of them each group is (m,): few among many."""
    first = alike = np.zeros(len(frames), np.int64)
    for column in frames.T:
        first, alike = np.unique(alike * n_frames + column, return_index=True, return_inverse=True)[1:]
    return first, alike.reshape(-1)
