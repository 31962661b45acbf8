"""Composing fixed transforms along the tree of coordinate frames, down and up."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from pipeline.sources.records import FixedTransform

_Motion = tuple[Floats, Floats]


def transform_between(transforms: Iterable[FixedTransform], parent: str, child: str) -> tuple[Floats, Floats] | None:
    """The transform between two frames of a tree.

    Args:
        transforms: Its edges; of several for the same two frames the last counts.
        parent: Frame.
        child: Frame.

    Returns:
        (3,) origin of the child in the parent, m, and (4,) parent_from_child, w first; None when the frames are not
        connected.
    """
    edges: dict[str, dict[str, _Motion]] = {}
    for edge in transforms:
        rotation = rotation_from_quaternion(edge.q_wxyz)
        down = rotation, np.asarray(edge.translation_m, np.float64)
        up = rotation.T, -rotation.T @ down[1]
        edges.setdefault(edge.parent, {})[edge.child] = down
        edges.setdefault(edge.child, {})[edge.parent] = up
    reached: dict[str, _Motion] = {parent: (np.eye(3), np.zeros(3))}
    waiting = deque([parent])
    while waiting and child not in reached:
        at = waiting.popleft()
        rotation, translation = reached[at]
        for frame, (step, offset) in edges.get(at, {}).items():
            if frame not in reached:
                reached[frame] = rotation @ step, translation + rotation @ offset
                waiting.append(frame)
    if child not in reached:
        return None
    rotation, translation = reached[child]
    return translation, quaternion_from_rotation(rotation)
