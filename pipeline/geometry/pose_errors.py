"""Covariances between the pose errors of frames that may see the same points.

A frame's error is a turn (rotation vector, rad) and a shift (m) in ENU. Frames share a part of it: a GNSS bias, a
misaligned gimbal, or, once they are refined together, whatever the images could not tell. Points made from several
frames are as uncertain as those covariances say; adding variances as if they were independent would promise too much.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.poses import Pose, common_covariance, own_covariance

UNKNOWN = -1


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """The 6 x 6 covariances between frames.

    Args:
        index: Number of each frame by its name.
        couples: (m,) the couples whose covariances are kept, rising: the first frame's number times that of all frames,
            plus the second's, which is not less.
        blocks: (m, 6, 6): turn and shift of the first frame by those of the second; the transpose is not kept.
    """

    index: Mapping[str, int]
    couples: Ints
    blocks: Floats

    @classmethod
    def of(cls, frames: Sequence[str], known: Iterable[tuple[str, str, Floats]]) -> PoseErrors:
        """From blocks by frame names; each stands for its transpose too.

        Args:
            frames: Names.
            known: First frame, second frame, (6, 6); a frame with itself among them.
        """
        index = {name: i for i, name in enumerate(frames)}
        blocks: dict[int, Floats] = {}
        for one, other, block in known:
            i, j = index[one], index[other]
            blocks[min(i, j) * len(index) + max(i, j)] = block if i <= j else block.T
        couples = np.array(sorted(blocks), np.int64)
        return cls(index, couples, np.array([blocks[couple] for couple in couples.tolist()]).reshape(-1, 6, 6))

    @classmethod
    def of_log(cls, poses: Mapping[str, Pose], together: Iterable[tuple[str, str]]) -> PoseErrors:
        """As the log's own and common sigmas say.

        Args:
            poses: Logged poses by frame.
            together: The different frames whose covariance is wanted, two by two.
        """
        own = [(name, name, own_covariance(pose) + common_covariance(pose, pose)) for name, pose in poses.items()]
        shared = [(one, other, common_covariance(poses[one], poses[other])) for one, other in together]
        return cls.of(tuple(poses), [*own, *shared])

    def rows(self, one: Ints, other: Ints) -> Ints:
        """Where the covariances of frames are kept, whichever of the two comes first.

        Args:
            one: (...) numbers of frames.
            other: (...) numbers of frames.

        Returns:
            (...) rows of `blocks`; UNKNOWN where the covariance is not kept.
        """
        wanted = np.minimum(one, other) * len(self.index) + np.maximum(one, other)
        if not len(self.couples):
            return np.full_like(wanted, UNKNOWN)
        found = np.minimum(np.searchsorted(self.couples, wanted), len(self.couples) - 1)
        return np.where(self.couples[found] == wanted, found, UNKNOWN)

    def of_numbers(self, one: Ints, other: Ints) -> tuple[Floats, Bools]:
        """Covariances between many frames.

        Args:
            one: (...) numbers of frames.
            other: (...) numbers of frames.

        Returns:
            (..., 6, 6) turn and shift of the one by those of the other, and (...) whether they are kept; where not, the
            first is no number of use.
        """
        rows = self.rows(one, other)
        known = rows != UNKNOWN
        if not len(self.blocks):
            return np.zeros((*rows.shape, 6, 6)), known
        blocks = self.blocks[rows]
        turned = one > other
        blocks[turned] = blocks[turned].swapaxes(1, 2)
        return blocks, known

    def between(self, one: str, other: str) -> Floats:
        """(6, 6) covariance between two frames.

        Raises:
            KeyError: A frame is unknown, or the covariance is not kept.
        """
        i, j = self.index[one], self.index[other]
        row = int(self.rows(np.array(i), np.array(j)))
        if row == UNKNOWN:
            raise KeyError(f"no covariance is kept between {one} and {other}")
        block: Floats = self.blocks[row] if i <= j else self.blocks[row].T
        return block

    def joint(self, ref: str, src: str) -> Floats:
        """(12, 12) of two frames: turn and shift of ref, then of src."""
        return np.block(
            [
                [self.between(ref, ref), self.between(ref, src)],
                [self.between(src, ref), self.between(src, src)],
            ]
        )
