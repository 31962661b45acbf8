"""The surface that returns stand for, at points near it: a plane through the nearest ones, where they make one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.geometry.arrays import Bools, Floats

NEIGHBOURS = 16
"""Returns that a plane is fitted to: enough to see that it is no plane, and on which side of an edge they lie."""

# No return used may be further from the point's foot than this many distances between returns.
_REACH_SPACINGS = 3.5
# The returns surround the foot when their mean is not further off than this share of their own spread: all around it
# they are 0.25 off by chance, on one side of an edge 0.75.
_OFF_CENTRE = 0.5
# Returns nearly in one line fix no plane.
_LEAST_ROUNDNESS = 0.02
# Spread about the plane beyond which it is none: a share of the returns' lesser extent, but no less than LiDAR's noise.
_LARGEST_SPREAD, _NOISE_M = 0.15, 0.05
# To a point that lies off the plane, a return further along it may be the nearer one by so many sigmas of its noise.
_FAR_NOISES = 4.0
# Points whose neighbours are held at once: 20 MB.
_BLOCK = 50_000


@dataclass(frozen=True, slots=True)
class Surface:
    """The surface near points.

    Args:
        nearest_m: (n,) distance to the nearest return, m.
        signed_m: (n,) how far the point lies above the plane of the nearest returns along its normal, m.
        normal: (n, 3) the plane's, ENU, pointing up.
        sound: (n,) whether these returns make a surface: planar, and all around the point's foot.
    """

    nearest_m: Floats
    signed_m: Floats
    normal: Floats
    sound: Bools

    @property
    def distance_m(self) -> Floats:
        """(n,) to the surface; where there is none, to the nearest return, which is an upper bound."""
        return np.where(self.sound, np.abs(self.signed_m), self.nearest_m)


def surface_at(points_in_enu_m: Floats, returns_in_enu_m: Floats, tree: cKDTree, spacing_m: float) -> Surface:
    """The surface near points.

    Args:
        points_in_enu_m: (n, 3) ENU, m.
        returns_in_enu_m: (m, 3) ENU, m; m >= `NEIGHBOURS`.
        tree: Of the returns.
        spacing_m: Between neighbouring returns, m.
    """
    blocks = [
        _block(points_in_enu_m[first : first + _BLOCK], returns_in_enu_m, tree, spacing_m)
        for first in range(0, max(len(points_in_enu_m), 1), _BLOCK)
    ]
    return Surface(*(np.concatenate(parts) for parts in zip(*blocks, strict=True)))


def _block(points: Floats, returns: Floats, tree: cKDTree, spacing_m: float) -> tuple[Floats, Floats, Floats, Bools]:
    distance, rows = (np.asarray(found) for found in tree.query(points, k=NEIGHBOURS))
    near = returns[rows]
    centre = near.mean(axis=1)
    centred = near - centre[:, None, :]
    value, vector = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred) / NEIGHBOURS)
    normal = vector[:, :, 0] * np.where(vector[:, 2, 0] < 0.0, -1.0, 1.0)[:, None]
    offset = points - centre
    signed = np.einsum("ni,ni->n", offset, normal)
    aside = offset - signed[:, None] * normal
    foot = centre + aside
    extent = value[:, 1] + value[:, 2]
    spread = np.sqrt(np.maximum(value[:, 0], 0.0) * NEIGHBOURS / (NEIGHBOURS - 3))
    reach = np.sqrt((_REACH_SPACINGS * spacing_m) ** 2 + 2.0 * np.abs(signed) * _FAR_NOISES * spread)
    sound: Bools = flat(spread, np.sqrt(np.maximum(value[:, 1], 0.0)))
    sound &= value[:, 1] * value[:, 2] > (_LEAST_ROUNDNESS * extent) ** 2
    sound &= np.einsum("ni,ni->n", aside, aside) <= _OFF_CENTRE**2 * extent
    sound &= np.linalg.norm(near - foot[:, None, :], axis=2).max(axis=1) <= reach
    return distance[:, 0], signed, normal, sound


def flat(spread_m: Floats, extent_m: Floats) -> Bools:
    """Whether returns with such a spread about their plane make a plane.

    Args:
        spread_m: (n,) root mean square of their distances from it, m.
        extent_m: (n,) root mean square of how far they reach along it, in the direction where they reach least, m.
    """
    out: Bools = spread_m <= np.maximum(_LARGEST_SPREAD * extent_m, _NOISE_M)
    return out
