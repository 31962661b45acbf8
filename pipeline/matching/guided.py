"""Nearest neighbours among the features that the pose allows: mutual, and better than the second best.

Sorted by their angle about the baseline, a block of ref features has but few src features in reach.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats, Ints, Singles
from pipeline.matching.reach import EpipolarAngles, Reach

_REF_BLOCK = 128


@dataclass(frozen=True, slots=True)
class FoundMatches:
    """Index pairs of matched features.

    Args:
        ref: (m,) index into the ref features.
        src: (m,) index into the src features.
        score: (m,) 1 - ratio of the best to the second-best descriptor distance.
    """

    ref: Ints
    src: Ints
    score: Floats


def match_guided(ref_descriptors: Singles, src_descriptors: Singles, reach: Reach, *, ratio: float) -> FoundMatches:
    """Mutual nearest neighbours in reach that pass the ratio test there.

    Args:
        ref_descriptors: (n, d) float32 of unit length.
        src_descriptors: (m, d) float32 of unit length.
        reach: Of the n ref and m src features.
        ratio: Largest ratio of best to second-best distance.

    Returns:
        The matches, in order of the ref feature.
    """
    if not (len(ref_descriptors) and len(src_descriptors)):
        return FoundMatches(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))
    ref_order = _usable_order(reach.ref)
    best = _Best(ref_descriptors, src_descriptors)
    for start in range(0, len(ref_order), _REF_BLOCK):
        rows = ref_order[start : start + _REF_BLOCK]
        columns = reach.near(rows)
        if columns.size:
            allowed = reach.allows(rows[:, None], columns[None])
            similarity = ref_descriptors[rows] @ src_descriptors[columns].T
            best.update(rows, columns, np.where(allowed, similarity, -1.0))
    return best.matches(ratio)


def _usable_order(angles: EpipolarAngles) -> Ints:
    usable = np.flatnonzero(np.isfinite(angles.about))
    return usable[np.argsort(angles.about[usable], kind="stable")]


class _Best:
    """Best and second-best similarity of every ref feature, and the best ref feature of every src feature."""

    def __init__(self, ref_descriptors: Singles, src_descriptors: Singles) -> None:
        n_ref, n_src = len(ref_descriptors), len(src_descriptors)
        self.ref_descriptors, self.src_descriptors = ref_descriptors, src_descriptors
        self.first = np.full(n_ref, -1.0, np.float32)
        self.second = np.full(n_ref, -1.0, np.float32)
        self.column = np.full(n_ref, -1, np.int64)
        self.second_column = np.full(n_ref, -1, np.int64)
        self.src_first = np.full(n_src, -1.0, np.float32)
        self.src_row = np.full(n_src, -1, np.int64)

    def update(self, rows: Ints, columns: Ints, similarity: Singles) -> None:
        pick = np.argmax(similarity, axis=1)
        line = np.arange(len(rows))
        self.first[rows] = similarity[line, pick]
        self.column[rows] = columns[pick]
        back = np.argmax(similarity, axis=0)
        value = similarity[back, np.arange(len(columns))]
        better = value > self.src_first[columns]
        self.src_first[columns[better]] = value[better]
        self.src_row[columns[better]] = rows[back[better]]
        similarity[line, pick] = -1.0
        pick = np.argmax(similarity, axis=1)
        self.second[rows] = similarity[line, pick]
        self.second_column[rows] = columns[pick]

    def matches(self, ratio: float) -> FoundMatches:
        rows = np.flatnonzero(self.first > 0.0)
        columns = self.column[rows]
        mutual = self.src_row[columns] == rows
        rows, columns = rows[mutual], columns[mutual]
        alone = self.second[rows] <= 0.0
        near, far = self._distances(rows, columns), self._distances(rows, self.second_column[rows])
        far[alone] = 2.0
        score = 1.0 - near / np.maximum(far, 1e-12)
        good = score >= 1.0 - ratio
        return FoundMatches(rows[good], columns[good], score[good])

    def _distances(self, rows: Ints, columns: Ints) -> Floats:
        """Descriptor distances anew: the last digits of a matrix product depend on its blocks and threads."""
        ref, src = self.ref_descriptors[rows].astype(np.float64), self.src_descriptors[columns].astype(np.float64)
        out: Floats = np.sqrt(np.sum((ref - src) ** 2, axis=1))
        return out
