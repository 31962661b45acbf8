"""Merging tracks: which observations of a track agree, and their mean with its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.points.covariances import of_means, sums
from pipeline.points.observed import Observed
from pipeline.points.tracks import agreeing, least


@dataclass(frozen=True, slots=True)
class Merged:
    """One row per track.

    Args:
        xyz: (m, 3) in the dataset's CRS.
        covariance: (m, 3, 3) m^2, of the whole error.
        n_pairs: (m,) pairs that saw it.
        n_frames: (m,) frames whose images had a part in it.
        best: (m,) row of the observation with the least sigma.
    """

    xyz: Floats
    covariance: Floats
    n_pairs: Ints
    n_frames: Ints
    best: Ints


def surest_of_pairs(observed: Observed, track: Ints) -> Bools:
    """Which observations are the surest that their pair has of their track.

    Two pixels of one frame in one track are the same point found twice, or one of them is another; the two errors are
    the same, and a mean would gain nothing.
    """
    order = np.lexsort((observed.sigma_m, observed.pair, track))
    key = np.stack([track, observed.pair], axis=1)[order]
    out = np.empty(len(order), bool)
    out[order] = np.concatenate([[True], np.any(key[1:] != key[:-1], axis=1)])[: len(order)]
    return out


def agreed(observed: Observed, track: Ints, own: Floats, errors: PoseErrors) -> tuple[Bools, Bools]:
    """Which observations agree with their track's surest one, and in which tracks most do.

    Where most contradict the surest one, it is the mistake: the surest of those that do stands for the track instead,
    once. A track without a majority that agrees holds mistakes, and nothing tells which they are: of two that disagree
    neither is kept, for each of them is as likely the wrong one.

    Args:
        observed: The observations.
        track: (n,) 0 .. m - 1, none of them empty.
        own: (n, 3, 3) m^2, the observations' whole covariances.
        errors: Between the frames.

    Returns:
        (n,) of the observations and (m,) of the tracks.
    """
    count = np.bincount(track)
    best = least(observed.sigma_m, track)
    agree = np.ones(len(track), bool)

    def compare(rows: Ints) -> Bools:
        agree[rows] = agreeing(observed, rows, best[track[rows]], own, errors)
        sound: Bools = 2 * np.bincount(track, agree) > count
        return sound

    sound = compare(np.flatnonzero(count[track] > 1))
    against = np.flatnonzero(~sound[track] & ~agree)
    if len(against):
        best[np.unique(track[against])] = against[least(observed.sigma_m[against], track[against])]
        sound = compare(np.flatnonzero(~sound[track]))
    return agree, sound


def merge(observed: Observed, track: Ints, own: Floats, errors: PoseErrors) -> Merged:
    """The mean of each track, weighted by one over the depth's variance.

    The weights are scalars: inverse matrices would throw a mean of two long, nearly parallel ellipsoids out of both.
    And they are what `_weights` says, or what is too near by chance would count most.

    Args:
        observed: The observations.
        track: (n,) 0 .. m - 1, none of them empty.
        own: (n, 3, 3) m^2, the observations' whole covariances.
        errors: Between the frames.
    """
    weight = _weights(observed, track)
    return Merged(
        sums(observed.xyz * weight[:, None], track),
        of_means(observed, weight, track, own, errors),
        _distinct(track, observed.pair),
        _distinct(np.repeat(track, 2), observed.frames.reshape(-1)),
        least(observed.sigma_m, track),
    )


def _weights(observed: Observed, track: Ints) -> Floats:
    """Weights that add up to 1 in each track.

    A depth's sigma grows with its square: of two depths of one point the one that is too near by chance claims to be
    the surer. So sigmas are compared at one depth D of the track, (D / d)^2 sigma; and because it is the inverse depth
    whose error is symmetric, the mean is that of inverse depths, sum (w / d) d / sum (w / d). Together this makes
    (d / D)^3 / sigma^2.
    """
    plain = observed.sigma_m**-2.0
    middle = sums(observed.xyz * plain[:, None], track) / np.bincount(track, plain)[:, None]
    farther = np.sum((middle[track] - observed.xyz) * observed.sight, axis=1) / np.sum(observed.sight**2, axis=1)
    weight = np.clip(observed.depth_m / np.maximum(observed.depth_m + farther, 1e-9), 0.25, 4.0) ** 3 * plain
    out: Floats = weight / np.bincount(track, weight)[track]
    return out


def _distinct(group: Ints, values: Ints) -> Ints:
    """How many different values each group has."""
    keys = np.unique(group * (np.max(values, initial=0) + 1) + values)
    return np.bincount(keys // (np.max(values, initial=0) + 1))
