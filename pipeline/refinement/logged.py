"""What the log says of the poses: the prior of every refinement, and what stands where refinement is refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.flight import PairRow
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import (
    PlacedPair,
    Placement,
    Pose,
    common_covariance,
    joint_covariance,
    own_covariance,
    relative_pose,
)
from pipeline.refinement.matched import Matched
from pipeline.refinement.rows import NONE, Misses, RefinedFrame, RefinedPair

NO_INLIER = "no match agrees with the logged pose"


@dataclass(frozen=True, slots=True)
class Log:
    """The flight as logged.

    Args:
        poses: By frame.
        cameras: By frame.
        pairs: By name.
        time_s: Exposures by frame, s since 1970 UTC; NaN where not known.
    """

    poses: Mapping[str, Pose]
    cameras: Mapping[str, Camera]
    pairs: Mapping[str, PairRow]
    time_s: Mapping[str, float]


def logged_frames(log: Log) -> dict[str, RefinedFrame]:
    """Every frame as logged."""
    return {
        name: RefinedFrame(Placement(pose.rotation, pose.centre), own_covariance(pose) + common_covariance(pose, pose))
        for name, pose in log.poses.items()
    }


def as_logged(log: Log, matched: Matched, problem: str = "") -> RefinedPair:
    """A pair with the logged poses.

    Args:
        log: The flight.
        matched: The pair's matches.
        problem: Why it was not refined.
    """
    ref, src = log.poses[matched.pair.ref], log.poses[matched.pair.src]
    residual = Misses.of(matched.residuals_px(relative_pose(ref, src)))
    placed = PlacedPair.plain(Placement(ref.rotation, ref.centre), Placement(src.rotation, src.centre))
    covariance = joint_covariance(ref, src)
    return RefinedPair(placed, covariance, NONE, residual, residual, None, problem if len(matched) else NO_INLIER)
