"""Covariances between the pose errors of frames that may see the same points.

A frame's error is a turn (rotation vector, rad) and a shift (m) in ENU. Frames share a part of it: a GNSS bias, a
misaligned gimbal, or, once they are refined together, whatever the images could not tell. Points made from several
frames are as uncertain as those covariances say; adding variances as if they were independent would promise too much.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.poses import Pose, common_covariance, own_covariance

UNKNOWN = -1


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """The 6 x 6 covariances between frames.

    Args:
        index: Number of each frame by its name.
        block_of: (f, f) row of `blocks` for two frames' numbers; UNKNOWN where the covariance is not kept.
        blocks: (m, 6, 6): turn and shift of the first frame by those of the second.
    """

    index: Mapping[str, int]
    block_of: Ints
    blocks: Floats

    @classmethod
    def of(cls, frames: Sequence[str], known: Iterable[tuple[str, str, Floats]]) -> PoseErrors:
        """From blocks by frame names; each stands for its transpose too.

        Args:
            frames: Names.
            known: First frame, second frame, (6, 6); a frame with itself among them.
        """
        index = {name: i for i, name in enumerate(frames)}
        block_of = np.full((len(frames), len(frames)), UNKNOWN, np.int64)
        blocks: list[Floats] = []
        for one, other, block in known:
            i, j = index[one], index[other]
            block_of[i, j] = len(blocks)
            blocks.append(block)
            if i != j:
                block_of[j, i] = len(blocks)
                blocks.append(block.T)
        return cls(index, block_of, np.array(blocks).reshape(-1, 6, 6))

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

    def between(self, one: str, other: str) -> Floats:
        """(6, 6) covariance between two frames.

        Raises:
            KeyError: A frame is unknown, or the covariance is not kept.
        """
        row = int(self.block_of[self.index[one], self.index[other]])
        if row == UNKNOWN:
            raise KeyError(f"no covariance is kept between {one} and {other}")
        block: Floats = self.blocks[row]
        return block

    def joint(self, ref: str, src: str) -> Floats:
        """(12, 12) of two frames: turn and shift of ref, then of src."""
        return np.block(
            [
                [self.between(ref, ref), self.between(ref, src)],
                [self.between(src, ref), self.between(src, src)],
            ]
        )
