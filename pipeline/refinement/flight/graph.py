"""The factor graph of one linearisation: stars, logged poses, shared unknowns; its solution and its covariances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import SuperLU, splu

from pipeline.geometry.arrays import Floats, Ints

_LEAST = 1e-12
# Unknowns whose columns of the inverse are held at a time.
_AT_A_TIME = 32


@dataclass(slots=True)
class Graph:
    """Gaussian factors on numbered unknowns; numbers are handed out by whoever fills it.

    Args:
        units: What one of each unknown's components is, by number. Matches fix turns to a microradian and leave a
            flight free by metres; in units of what the log leaves open, elimination keeps its digits.
        factors: gtsam's.
    """

    units: Mapping[int, Floats]
    factors: gtsam.GaussianFactorGraph = field(default_factory=gtsam.GaussianFactorGraph)

    def add_rows(self, terms: Sequence[tuple[int, Floats]], right: Floats) -> None:
        """Whitened rows sum A x = right.

        Args:
            terms: Numbers of unknowns and their (r, size) blocks.
            right: (r,).
        """
        # A conditional is the one factor that the wrapper makes of any number of unknowns.
        unit = gtsam.noiseModel.Unit.Create(len(right))
        in_units = [(key, block * self.units[key]) for key, block in terms]
        self.factors.push_back(gtsam.GaussianConditional(in_units, 1, right, unit))

    def add_quadratic(self, keys: Sequence[int], sizes: Sequence[int], information: Floats, gradient: Floats) -> None:
        """A quadratic x^T H x / 2 + g . x, of which g has to lie in the range of H."""
        scale = 1.0 / np.sqrt(np.maximum(np.diag(information), _LEAST))
        values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
        seen = values > 1e-10 * max(float(values[-1]), _LEAST)
        if not np.any(seen):
            return
        root = np.sqrt(values[seen])
        rows = (vectors[:, seen] * root / scale[:, None]).T
        right = -(vectors[:, seen] / root).T @ (scale * gradient)
        ends = np.cumsum(sizes)
        blocks = [(key, rows[:, end - size : end]) for key, size, end in zip(keys, sizes, ends, strict=True)]
        self.add_rows(blocks, right)

    def minimum(self) -> dict[int, Floats]:
        """The values of all unknowns at the minimum."""
        # By orthogonal turns: Cholesky in gtsam takes any large step between two pivots for a singular system.
        tree = self.factors.eliminateMultifrontal(gtsam.Ordering.OrderingType.COLAMD, gtsam.EliminateQR)
        values = tree.optimize()
        return {key: np.asarray(values.at(key), np.float64) * self.units[key] for key in self._keys}

    def covariances(self) -> Covariances:
        """What is left open at the minimum."""
        rows, columns, values = self.factors.sparseJacobian_()
        ends = np.cumsum([len(self.units[key]) for key in self._keys])
        part = {
            key: slice(int(end) - len(self.units[key]), int(end)) for key, end in zip(self._keys, ends, strict=True)
        }
        # Rows and columns count from 1, and the last column is the right-hand side.
        at = (rows.astype(np.int64) - 1, columns.astype(np.int64) - 1)
        jacobian = csc_array(coo_array((values, at), shape=(int(rows.max()), int(ends[-1]) + 1)))[:, : int(ends[-1])]
        information = csc_array(jacobian.T @ jacobian)
        factors = splu(information, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        return Covariances(self.units, part, factors)

    @property
    def _keys(self) -> list[int]:
        return sorted(int(key) for key in self.factors.keyVector())


@dataclass(frozen=True, slots=True)
class Covariances:
    """The inverse of a graph's information, column by column as it is asked for.

    Args:
        units: As in `Graph`.
        part: Where each unknown stands.
        factors: Of the information, in those units.
    """

    units: Mapping[int, Floats]
    part: Mapping[int, slice]
    factors: SuperLU

    def of(self, key: int) -> Floats:
        """The covariance of an unknown."""
        return self.couples(np.array([(key, key)]))[0]

    def couples(self, couples: Ints) -> list[Floats]:
        """The covariances between two unknowns each, couples (m, 2)."""
        out: list[Floats] = [np.empty(0)] * len(couples)
        order = np.argsort(couples[:, 0], kind="stable")
        firsts, ordered = np.unique(couples[:, 0]), couples[order, 0]
        for some in np.array_split(firsts, max(1, len(firsts) // _AT_A_TIME)):
            places = np.cumsum([0, *(len(self.units[int(key)]) for key in some)])
            wanted = np.zeros((self.factors.shape[0], int(places[-1])))
            for key, start, end in zip(some, places[:-1], places[1:], strict=True):
                wanted[self.part[int(key)], start:end] = np.eye(end - start)
            found = self.factors.solve(wanted)
            for key, start, end in zip(some, places[:-1], places[1:], strict=True):
                low, high = np.searchsorted(ordered, (key, key + 1))
                for row in order[low:high]:
                    other = int(couples[row, 1])
                    block = found[self.part[other], start:end].T
                    out[row] = block * np.outer(self.units[int(key)], self.units[other])
        return out
