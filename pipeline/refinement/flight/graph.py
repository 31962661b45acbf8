"""The factor graph of one linearisation: stars, logged poses, shared unknowns; its solution and its covariances."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from pipeline.geometry.arrays import Floats, Ints

_LEAST = 1e-12


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

    def solved(self) -> Solution:
        """Eliminates everything."""
        # By orthogonal turns: Cholesky in gtsam takes any large step between two pivots for a singular system.
        tree = self.factors.eliminateMultifrontal(gtsam.Ordering.OrderingType.COLAMD, gtsam.EliminateQR)
        return Solution(self.units, tree, tree.optimize())


@dataclass(frozen=True, slots=True)
class Solution:
    """An eliminated graph.

    Args:
        units: As in `Graph`.
        tree: The Bayes tree.
        values: The minimum.
    """

    units: Mapping[int, Floats]
    tree: gtsam.GaussianBayesTree
    values: gtsam.VectorValues

    def at(self, key: int) -> Floats:
        """The value of an unknown."""
        out: Floats = np.asarray(self.values.at(key), np.float64) * self.units[key]
        return out

    def covariance(self, keys: Iterable[int]) -> Floats:
        """The joint covariance of some unknowns, in the order of their numbers as given."""
        listed = list(keys)
        joint = self.tree.jointMarginalCovariance(listed)
        return np.block([[self._between(joint, a, b) for b in listed] for a in listed])

    def couples(self, couples: Ints) -> Iterable[Floats]:
        """The covariance between two unknowns each, couples (m, 2) sorted by the first."""
        order = np.argsort(couples[:, 0], kind="stable")
        starts = np.flatnonzero(np.diff(couples[order, 0], prepend=-1))
        out: list[Floats] = [np.empty(0)] * len(couples)
        for rows in np.split(order, starts[1:]):
            first = int(couples[rows[0], 0])
            others = [int(other) for other in couples[rows, 1]]
            joint = self.tree.jointMarginalCovariance(sorted({first, *others}))
            for row, other in zip(rows, others, strict=True):
                out[row] = self._between(joint, first, other)
        return out

    def _between(self, joint: gtsam.JointMarginal, one: int, other: int) -> Floats:
        out: Floats = np.asarray(joint.at(one, other), np.float64) * np.outer(self.units[one], self.units[other])
        return out
