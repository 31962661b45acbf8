"""Errors put into the pose of a pair's src camera: along the flight's axes, and about those of its gimbal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.poses import Placement, Pose
from pipeline.geometry.rotations import rotation_from_vector

ALONG, ACROSS, UP = "translation_along", "translation_across", "translation_up"
# In the order of the gimbal's error axes.
GIMBAL = ("yaw", "pitch", "roll")
UNITS: Mapping[str, str] = {ALONG: "m", ACROSS: "m", UP: "m", "yaw": "deg", "pitch": "deg", "roll": "deg"}
# A baseline this near the vertical has nothing level across it that is its own.
_UPRIGHT = 1e-6


@dataclass(frozen=True, slots=True)
class Injection:
    """One error.

    Args:
        kind: One of UNITS.
        value: m or deg, by the kind's unit.
    """

    kind: str
    value: float


NOTHING = Injection(ALONG, 0.0)


def injections(values: Mapping[str, Sequence[float]]) -> tuple[Injection, ...]:
    """Every error once, NOTHING first: no error of one kind is no error of another.

    Args:
        values: m or deg, by kind.
    """
    return NOTHING, *(Injection(kind, value) for kind, some in values.items() for value in some if value)


def with_error(ref: Pose | Placement, src: Pose, injection: Injection) -> Pose:
    """The src camera off by an error; its sigmas stay those of the log.

    Args:
        ref: The frame that gets the depth.
        src: The other.
        injection: The error.
    """
    if injection.kind in GIMBAL:
        vector = src.error_axes[:, GIMBAL.index(injection.kind)] * np.radians(injection.value)
        return replace(src, rotation=rotation_from_vector(vector) @ src.rotation)
    return replace(src, centre=src.centre + injection.value * translation_axis(ref, src, injection.kind))


def translation_axis(ref: Pose | Placement, src: Pose | Placement, kind: str) -> Floats:
    """(3,) the unit vector of a translation, ENU.

    Args:
        ref: The frame that gets the depth.
        src: The other.
        kind: ALONG the baseline, away from ref, which changes its length alone; level ACROSS it, to the right of ALONG;
            or UP.
    """
    if kind == UP:
        return np.array([0.0, 0.0, 1.0])
    baseline = src.centre - ref.centre
    if kind == ALONG:
        return _unit(baseline, ref.rotation[:, 0])
    return _unit(np.array([baseline[1], -baseline[0], 0.0]), np.array([1.0, 0.0, 0.0]))


def _unit(vector: Floats, otherwise: Floats) -> Floats:
    length = float(np.linalg.norm(vector))
    return vector / length if length > _UPRIGHT else otherwise
