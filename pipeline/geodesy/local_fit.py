"""A CRS brought to the local frame by polynomials that were checked against PROJ: for millions of points at once."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np

from pipeline.engine.errors import UndeterminedError
from pipeline.geodesy.transform import FrameTransform
from pipeline.geometry.arrays import Bools, Floats, Ints

LARGEST_ERROR_M = 1e-4
# Over a box of 2 km what a quadratic leaves of the earth's curvature and of a projection is some micrometres.
_NODES, _LEVEL_NODES = 5, 3
# Where the error is looked at: none of them is a node, the corners and edges excepted, where it is largest.
_CHECKS = np.array([-1.0, -0.77, -0.25, 0.31, 0.83, 1.0])
# Halvings of a box before PROJ itself is asked in what is left: across the seams of a geoid grid no polynomial holds.
_MOST_HALVINGS = 4
# Points at once: their terms stay in the processor's cache.
_BLOCK = 16_384


@dataclass(frozen=True, slots=True)
class LocalFit:
    """From a CRS to the local frame, within a box of the CRS.

    Args:
        lower: (3,) lower corner of the box, CRS.
        upper: (3,) upper corner.
        pieces: Parts of the box along each of x and y.
        terms: (pieces, pieces, 3, 10) east, north and up as quadratics of the place in its piece, m; NaN where none is
            good enough.
    """

    lower: Floats
    upper: Floats
    pieces: int
    terms: Floats

    @classmethod
    def of(cls, transform: FrameTransform, lower: Floats, upper: Floats) -> Self:
        """Fits PROJ at nodes of a grid, and checks it at other points.

        Args:
            transform: The way that PROJ knows.
            lower: (3,) lower corner of the box, in the transform's CRS and units.
            upper: (3,) upper corner; above the lower one on every axis.

        Returns:
            The fit, off by no more than `LARGEST_ERROR_M` wherever it was checked.

        Raises:
            UndeterminedError: A height datum or the geoid between two is not known.
        """
        for halvings in range(_MOST_HALVINGS + 1):
            pieces = 2**halvings
            terms = np.stack(
                [
                    _quadratic(transform, *_piece(lower, upper, pieces, column, row))
                    for column, row in product(range(pieces), repeat=2)
                ]
            ).reshape(pieces, pieces, 3, -1)
            if np.all(np.isfinite(terms)):
                break
        return cls(np.array(lower, np.float64), np.array(upper, np.float64), pieces, terms)

    @property
    def everywhere(self) -> bool:
        """Whether the polynomials hold in the whole box."""
        return bool(np.all(np.isfinite(self.terms)))

    def enu_from(self, p_in_crs: Floats, transform: FrameTransform) -> Floats:
        """Points of the CRS in the local frame; one row per axis, which is how so many are quickest.

        Args:
            p_in_crs: (3, n) CRS and its units.
            transform: Asked for the points that the fit does not reach: outside its box, or where it was not good.

        Returns:
            (3, n) ENU, m.

        Raises:
            UndeterminedError: A point that the fit does not reach lies outside the geoid grid.
        """
        terms = self.terms.reshape(self.pieces**2, 3, -1)
        if self.pieces == 1 and self.everywhere and self._holds_all(p_in_crs):
            return _evaluated(p_in_crs, terms[0], *_piece(self.lower, self.upper, 1, 0, 0))
        out = np.empty_like(p_in_crs)
        piece = self._piece_of(p_in_crs)
        for number in np.unique(piece):
            rows = np.flatnonzero(piece == number)
            if number >= 0 and np.all(np.isfinite(terms[number])):
                box = _piece(self.lower, self.upper, self.pieces, *divmod(int(number), self.pieces))
                out[:, rows] = _evaluated(p_in_crs[:, rows], terms[number], *box)
            else:
                out[:, rows] = transform.enu_from(p_in_crs[:, rows].T).T
        return out

    def _holds_all(self, points: Floats) -> bool:
        if not points.shape[1]:
            return True
        return bool(np.all(points.min(axis=1) >= self.lower) and np.all(points.max(axis=1) <= self.upper))

    def _piece_of(self, points: Floats) -> Ints:
        """(n,) number of the piece each point lies in; -1 outside the box."""
        share = (points - self.lower[:, None]) / (self.upper - self.lower)[:, None]
        inside: Bools = np.all((share >= 0.0) & (share <= 1.0), axis=0)
        place = np.clip(np.where(inside, share[:2] * self.pieces, 0.0).astype(np.int64), 0, self.pieces - 1)
        return np.where(inside, place[0] * self.pieces + place[1], -1)


def _piece(lower: Floats, upper: Floats, pieces: int, column: int, row: int) -> tuple[Floats, Floats]:
    """Middle and half the size of a piece."""
    size = np.append((upper - lower)[:2] / pieces, (upper - lower)[2])
    return lower + size * (np.array([column, row, 0.0]) + 0.5), 0.5 * size


def _quadratic(transform: FrameTransform, middle: Floats, half: Floats) -> Floats:
    """(3, 10) least-squares quadratics, NaN where they are off by too much or PROJ has no answer."""
    even = np.linspace(-1.0, 1.0, _NODES)
    nodes = _lattice(even, even, np.linspace(-1.0, 1.0, _LEVEL_NODES))
    checks = _lattice(_CHECKS, _CHECKS, _CHECKS)
    nothing = np.full((3, 10), np.nan)
    try:
        known, true = (transform.enu_from(middle + half * at) for at in (nodes, checks))
    except UndeterminedError:
        # Outside the geoid grid, say: PROJ is asked about the points themselves, of which none may be there.
        return nothing
    if not np.all(np.isfinite(known)):
        return nothing
    terms = np.asarray(np.linalg.lstsq(_terms(nodes.T).T, known, rcond=None)[0].T, np.float64)
    error = np.abs((terms @ _terms(checks.T)).T - true).max()
    # A comparison with NaN is false.
    return terms if error <= LARGEST_ERROR_M else nothing


def _lattice(x: Floats, y: Floats, z: Floats) -> Floats:
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)


def _evaluated(points: Floats, terms: Floats, middle: Floats, half: Floats) -> Floats:
    out = np.empty_like(points)
    for start in range(0, points.shape[1], _BLOCK):
        block = slice(start, start + _BLOCK)
        out[:, block] = terms @ _terms((points[:, block] - middle[:, None]) / half[:, None])
    return out


def _terms(place: Floats) -> Floats:
    """(10, n) the terms of a quadratic at (3, n) places."""
    x, y, z = place
    return np.stack([np.ones_like(x), x, y, z, x * x, x * y, y * y, x * z, y * z, z * z])
