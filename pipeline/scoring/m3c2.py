"""Distances between two clouds that carry covariances, and which of them are more than the errors explain: M3C2-EP.

Fused points take part where the returns near them make a surface, which gives a normal. About core points spread evenly
over them, what of each cloud lies in a cylinder along the normal is averaged; the distance is that of the two means
along it, positive where the fused points lie above. Where the returns in the cylinder are no plane, there is none.

The variance is propagated from the covariances of the points in the cylinder, so that one point is enough and roughness
is not mistaken for noise. The distance is one-dimensional, and so is its test: a distance is significant when it is
more than 1.96 of its sigmas. (With the quantile of three dimensions, which py4dgeo 1.2 takes for M3C2-EP, 0.5 % of
unchanged distances would be significant, not 5 %.)

What the errors of neighbouring points have in common does not average away. How they correlate is not kept; where they
do, the mean of the covariances stands for that of the mean, which no correlation exceeds (and which py4dgeo takes
always).

Sources: Lague, Brodu, Leroux, "Accurate 3D comparison of complex topography with terrestrial laser scanner" (ISPRS
Journal 82, 2013), section 3: core points, cylinders, 1.96 sigmas. Winiwarter, Anders, Hoefle, "M3C2-EP: Pushing the
limits of 3D topographic point cloud change detection by error propagation" (ISPRS Journal 178, 2021), section 3:
covariances in place of roughness.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints
from pipeline.scoring.samples import Sample, cells, mixed
from pipeline.scoring.surface import NEIGHBOURS, flat, surface_at

CORE_M = 1.0
"""Edge of the cubes that have a core point each."""

DEPTH_M = 2.0
"""Half the cylinder's length: what is further apart is not the same surface."""

QUANTILE_95 = 1.959963984540054
"""Of the normal distribution, two-sided."""

# A cylinder of this radius holds a dozen returns; no less than so many metres, where returns are dense.
_RADIUS_SPACINGS, _LEAST_RADIUS_M = 2.0, 0.25
# The reference's mean is one of at least so many returns.
_LEAST_RETURNS = 4
# Core points whose cylinders are held at once.
_BLOCK = 2_000


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points with their covariances.

    Args:
        p_in_enu_m: (n, 3) m.
        covariance: (n, 3, 3) m^2, ENU.
        shared: Whether neighbouring points have errors in common, those of poses for instance.
    """

    p_in_enu_m: Floats
    covariance: Floats
    shared: bool

    def where(self, rows: AnyArray) -> Cloud:
        """Some of the points."""
        return Cloud(self.p_in_enu_m[rows], self.covariance[rows], self.shared)


@dataclass(frozen=True, slots=True)
class M3C2Sums:
    """Distances at core points; those of shards together are those of the flight, evenly drawn where they are many.

    Args:
        radius_m: Of the cylinders: the least and the largest of any shard, m.
        distances: One per core point: distance and level of detection, m.
    """

    radius_m: tuple[float, float]
    distances: Sample

    @staticmethod
    def total(parts: Iterable[M3C2Sums]) -> M3C2Sums | None:
        """The distances of several shards together; None of none."""
        listed = list(parts)
        if not listed:
            return None
        radii = [part.radius_m for part in listed if len(part.distances.key)] or [listed[0].radius_m]
        return M3C2Sums(
            (min(low for low, _ in radii), max(high for _, high in radii)),
            Sample.total((part.distances for part in listed), 2),
        )

    def metrics(self) -> dict[str, Any] | None:
        """The entry `m3c2_ep` of `metrics.json`; None where there is no core point."""
        d, lod = self.distances.values.astype(np.float64).T
        if not len(d):
            return None
        significant = float(np.mean(np.abs(d) > lod))
        return {
            "n": len(d),
            "median_m": float(np.median(d)),
            "mean_m": math.fsum(d) / len(d),
            "rms_m": math.sqrt(math.fsum(d**2) / len(d)),
            "lod95_median_m": float(np.median(lod)),
            "significant_share": significant,
            "within_lod_share": 1.0 - significant,
            "radius_m": self.radius_m[1],
            "normals": "reference",
        }


def m3c2_sums(
    points: Cloud, own: Bools, reference: Cloud, spacing_m: float, translation_covariance: Floats | None = None
) -> M3C2Sums:
    """The distances of one shard of frames.

    Args:
        points: All fused points near the frames, those of other shards included.
        own: (n,) which of them this shard judges; every point belongs to one shard.
        reference: All returns near the frames.
        spacing_m: Between neighbouring returns, m.
        translation_covariance: (3, 3) m^2, ENU, of a shift that was found between the two; None for none.
    """
    radius = max(_RADIUS_SPACINGS * spacing_m, _LEAST_RADIUS_M)
    if len(reference.p_in_enu_m) < NEIGHBOURS or not len(points.p_in_enu_m) or not np.isfinite(spacing_m):
        nothing = np.zeros(0, np.uint64)
        return M3C2Sums((radius, radius), Sample.of(nothing, nothing, np.zeros((0, 2))))
    tree = cKDTree(reference.p_in_enu_m)
    surface = surface_at(points.p_in_enu_m, reference.p_in_enu_m, tree, spacing_m)
    # A wall that the reference has no returns on would be averaged with the ground at its foot.
    points, own, normal = points.where(surface.sound), own[surface.sound], surface.normal[surface.sound]
    p = points.p_in_enu_m
    core = core_points(p)
    core = core[own[core]]
    normal = normal[core]
    ours = along_normals(points, cKDTree(p), p[core], normal, radius)
    theirs = along_normals(reference, tree, p[core], normal, radius)
    # The root mean square of a disc along one of its diameters is half its radius.
    one_surface = flat(theirs.spread_m, np.full(len(core), radius / 2.0))
    found = np.flatnonzero((ours.count >= 1) & (theirs.count >= _LEAST_RETURNS) & one_surface)
    variance = ours.variance + theirs.variance
    if translation_covariance is not None:
        variance = variance + np.einsum("ni,ij,nj->n", normal, translation_covariance, normal)
    values = np.column_stack([ours.mean_m - theirs.mean_m, QUANTILE_95 * np.sqrt(variance)])[found]
    key = mixed(cells(p[core[found]], CORE_M))
    return M3C2Sums((radius, radius), Sample.of(key, np.zeros_like(key), values))


def core_points(points_in_enu_m: Floats) -> Ints:
    """The point nearest to the centre of each cube of `CORE_M`.

    Args:
        points_in_enu_m: (n, 3) m.

    Returns:
        Rows, rising.
    """
    cube = cells(points_in_enu_m, CORE_M)
    off = np.sum((points_in_enu_m - (cube + 0.5) * CORE_M) ** 2, axis=1)
    order = np.lexsort((*points_in_enu_m.T, off, *cube.T))
    new = np.any(cube[order][1:] != cube[order][:-1], axis=1)
    out: Ints = np.sort(order[np.concatenate([[True], new])[: len(order)]])
    return out


@dataclass(frozen=True, slots=True)
class Means:
    """What of a cloud lies in cylinders.

    Args:
        count: (c,) points.
        mean_m: (c,) their mean along the normal, from the core point, m; 0 where there is none.
        variance: (c,) of that mean, m^2.
        spread_m: (c,) of the points about it, m.
    """

    count: Ints
    mean_m: Floats
    variance: Floats
    spread_m: Floats


def along_normals(cloud: Cloud, tree: cKDTree, core_in_enu_m: Floats, normal: Floats, radius_m: float) -> Means:
    """Means of a cloud's points in cylinders of half-length `DEPTH_M` about normals, and their variances.

    Args:
        cloud: The points.
        tree: Of them.
        core_in_enu_m: (c, 3) the cylinders' middles, ENU m.
        normal: (c, 3) their axes.
        radius_m: Their radius, m.
    """
    count = np.zeros(len(core_in_enu_m), np.int64)
    mean, square, variance = (np.zeros(len(core_in_enu_m)) for _ in range(3))
    for cylinder, point, along in _members(cloud.p_in_enu_m, tree, core_in_enu_m, normal, radius_m):
        axis = normal[cylinder]
        own = np.einsum("ni,nij,nj->n", axis, cloud.covariance[point], axis)
        count += np.bincount(cylinder, minlength=len(count))
        mean += np.bincount(cylinder, along, minlength=len(count))
        square += np.bincount(cylinder, along**2, minlength=len(count))
        variance += np.bincount(cylinder, own, minlength=len(count))
    some = np.maximum(count, 1)
    mean = mean / some
    spread = np.sqrt(np.maximum(square / some - mean**2, 0.0))
    return Means(count, mean, variance / (some if cloud.shared else some**2), spread)


def _members(
    points: Floats, tree: cKDTree, core: Floats, normal: Floats, radius: float
) -> Iterator[tuple[AnyArray, AnyArray, Floats]]:
    """The points of the cylinders, slab by slab: which cylinder, which point, and how far along its axis."""
    slabs = max(math.ceil(DEPTH_M / radius), 1)
    half = DEPTH_M / slabs
    for first in range(0, len(core), _BLOCK):
        some = slice(first, first + _BLOCK)
        for slab in range(slabs):
            middle = (2 * slab - slabs + 1) * half
            found: AnyArray = np.asarray(
                tree.query_ball_point(core[some] + middle * normal[some], math.hypot(radius, half)), object
            )
            lengths = np.array([len(rows) for rows in found], np.int64)
            cylinder = first + np.repeat(np.arange(len(lengths)), lengths)
            point = np.fromiter((row for rows in found for row in rows), np.int64, int(lengths.sum()))
            offset = points[point] - core[cylinder]
            along = np.einsum("ni,ni->n", offset, normal[cylinder])
            across = np.sum(offset**2, axis=1) - along**2
            # A point where slabs meet lies in one of them.
            inside = (across <= radius**2) & (np.floor((along + DEPTH_M) / (2.0 * half)) == slab)
            yield cylinder[inside], point[inside], along[inside]
