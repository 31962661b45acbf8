"""How near the fused points lie to the reference, and how much of the reference they cover, at several tolerances.

The measures are those of the ETH3D benchmark, accuracy and completeness by tolerance and their harmonic mean, taken
over small cubes so that places with many points count no more than others. LiDAR from the air asks for three changes:

* Returns lie decimetres apart, so the distance to the nearest one says nothing below that. Points are held against the
  plane of the nearest returns where these make one.
* No scanner positions are at hand that would tell free space from unobserved space. A survey from above has seen
  everything down to its surface: a point above all returns around its column is in free space, and one below all of
  them underground, and either is as wrong as it is far from the nearest return. Between the two, where returns make no
  surface (on walls, in crowns), and where there are no returns, points are left out and counted. A scan from among the
  surfaces is dense: there the nearest return stands where no plane does, and what is far from both is left out.
* A return is asked for where frames see it. Several do; it counts once.

Source: Schoeps et al., "A multi-view stereo benchmark with high-resolution images and multi-camera videos" (CVPR 2017),
where its evaluation is laid down; the ETH3D multi-view evaluation program, whose cubes are 1 cm (--voxel_size).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from pipeline.geometry.arrays import Bools, Floats
from pipeline.scoring.samples import Sample, cells, mixed
from pipeline.scoring.surface import NEIGHBOURS, surface_at

TOLERANCES_M = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)

VOXEL_M = 0.2
"""Edge of the cubes: about a return each."""

# A point on a surface has a return within this many distances between returns.
_CLOSE_SPACINGS = 1.5
# Returns that say how high and how low a column reaches.
_IN_COLUMN = 8
# Two returns nearer than this are one, seen by two frames.
_SAME_RETURN_M = 1e-3


@dataclass(frozen=True, slots=True)
class CloudSums:
    """Sums from which the shares follow; those of shards add up to those of the flight.

    Args:
        tolerances_m: In rising order, m.
        n_points: Points that were held against the reference.
        n_unobserved: Points left out: the reference says nothing of where they are.
        weight: Sum of the points' weights; a point of a cube with k points weighs 1 / k.
        within: (t,) sum of the weights of those within each tolerance.
        seen: One return per cube that a frame sees, with the number of tolerances that are too small for it.
    """

    tolerances_m: tuple[float, ...]
    n_points: int
    n_unobserved: int
    weight: float
    within: Floats
    seen: Sample

    @staticmethod
    def total(parts: Iterable[CloudSums]) -> CloudSums | None:
        """The sums of several shards together; None of none."""
        listed = list(parts)
        if not listed:
            return None
        return CloudSums(
            listed[0].tolerances_m,
            sum(part.n_points for part in listed),
            sum(part.n_unobserved for part in listed),
            math.fsum(part.weight for part in listed),
            np.array([math.fsum(column) for column in zip(*(part.within for part in listed), strict=True)]),
            Sample.total((part.seen for part in listed), 1),
        )

    def metrics(self) -> dict[str, Any]:
        """The entry `cloud` of `metrics.json`; a share of nothing is None."""
        accuracy = [float(x) / self.weight if self.weight else None for x in self.within]
        missed = self.seen.values[:, 0]
        covered = [float(np.mean(missed <= i)) if len(missed) else None for i in range(len(self.tolerances_m))]
        return {
            "tolerances_m": list(self.tolerances_m),
            "accuracy": accuracy,
            "completeness": covered,
            "f1": [_harmonic(a, c) for a, c in zip(accuracy, covered, strict=True)],
            "n_points": self.n_points,
            "n_reference": len(missed),
            "n_unobserved": self.n_unobserved,
        }


def cloud_sums(
    points_in_enu_m: Floats,
    own: Bools,
    reference_in_enu_m: Floats,
    seen_in_enu_m: Floats,
    spacing_m: float,
    *,
    from_above: bool,
    tolerances_m: Sequence[float] = TOLERANCES_M,
) -> CloudSums:
    """The sums of one shard of frames.

    Args:
        points_in_enu_m: (n, 3) all fused points near the frames, those of other shards included, ENU m.
        own: (n,) which of them this shard judges; every point belongs to one shard.
        reference_in_enu_m: (m, 3) all returns near the frames.
        seen_in_enu_m: (k, 3) those that its frames see; one may come several times.
        spacing_m: Between neighbouring returns, m.
        from_above: Whether the reference is a survey from the air.
        tolerances_m: In rising order, m.
    """
    tolerances = tuple(tolerances_m)
    cube, size = np.unique(mixed(cells(points_in_enu_m, VOXEL_M)), return_inverse=True, return_counts=True)[1:]
    weight = 1.0 / size[cube.reshape(-1)][own]
    distance, observed = _to_reference(
        points_in_enu_m[own], reference_in_enu_m, spacing_m, tolerances[-1], from_above=from_above
    )
    weight, distance = weight[observed], distance[observed]
    return CloudSums(
        tolerances,
        int(observed.sum()),
        int((~observed).sum()),
        math.fsum(weight),
        np.array([math.fsum(weight[distance <= tolerance]) for tolerance in tolerances]),
        _covered(seen_in_enu_m, points_in_enu_m, tolerances),
    )


def _to_reference(
    points: Floats, returns: Floats, spacing: float, furthest: float, *, from_above: bool
) -> tuple[Floats, Bools]:
    """Distance of each point to the reference, and whether this says where it should be."""
    if len(returns) < NEIGHBOURS or not np.isfinite(spacing):
        return np.full(len(points), np.nan), np.zeros(len(points), np.bool_)
    surface = surface_at(points, returns, cKDTree(returns), spacing)
    near = surface.nearest_m <= _CLOSE_SPACINGS * spacing
    if not from_above:
        return surface.distance_m, near | (surface.sound & (np.abs(surface.signed_m) <= furthest))
    observed: Bools = near & surface.sound
    rest = np.flatnonzero(~observed)
    observed[rest] = _beyond_column(points[rest], returns, _CLOSE_SPACINGS * spacing)
    return surface.distance_m, observed


def _beyond_column(points: Floats, returns: Floats, close: float) -> Bools:
    """Which points are above, or below, all returns around their column."""
    if not len(points):
        return np.zeros(0, np.bool_)
    distance, rows = (np.asarray(found) for found in cKDTree(returns[:, :2]).query(points[:, :2], k=_IN_COLUMN))
    up = returns[rows, 2]
    out: Bools = (distance[:, 0] <= close) & ((points[:, 2] > up.max(axis=1)) | (points[:, 2] < up.min(axis=1)))
    return out


def _covered(seen: Floats, points: Floats, tolerances: tuple[float, ...]) -> Sample:
    """One return of each cube, drawn by chance, and how many tolerances a fused point is too far from it for."""
    distance = np.full(len(seen), np.inf)
    if len(points) and len(seen):
        distance = np.asarray(cKDTree(points).query(seen, distance_upper_bound=math.nextafter(tolerances[-1], 9e9))[0])
    missed = np.searchsorted(np.array(tolerances), distance, side="left")
    one = mixed(np.rint(seen / _SAME_RETURN_M).astype(np.int64))
    return Sample.of(mixed(cells(seen, VOXEL_M)), one, missed[:, None])


def _harmonic(one: float | None, other: float | None) -> float | None:
    if one is None or other is None:
        return None
    return 2.0 * one * other / (one + other) if one + other else 0.0
