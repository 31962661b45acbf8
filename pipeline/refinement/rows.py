"""What refinement leaves: rows of `relative_poses`, and the tables `poses` and `pose_covariances`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from pipeline.flight import cameras_of, column, placement_row, relative_pose_row
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.geometry.poses import PlacedPair, Placement, relative_jacobian, relative_placement
from pipeline.geometry.rotations import gimbal_error_axes
from pipeline.refinement.matched import Matched
from schemas import POSE_COVARIANCES, POSES, REFINED_CAMERAS

NONE, PAIR, FLIGHT = "none", "pair", "flight"
_SIGMAS = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
_GIMBAL_SIGMAS = ("sigma_yaw_deg", "sigma_pitch_deg", "sigma_roll_deg")


@dataclass(frozen=True, slots=True)
class Misses:
    """How far the rays of a pair's inliers miss each other: absolute epipolar residuals, as pixels of src.

    Args:
        n: Inliers.
        rms_px: Root mean square; None of none.
        median_px: Median; None of none.
    """

    n: int
    rms_px: float | None
    median_px: float | None

    @classmethod
    def of(cls, residuals_px: Floats) -> Misses:
        """Of residuals (n,)."""
        if not residuals_px.size:
            return cls(0, None, None)
        rms, median = float(np.sqrt(np.mean(residuals_px**2))), float(np.median(residuals_px))
        return cls(residuals_px.size, rms, median)


@dataclass(frozen=True, slots=True)
class RefinedPair:
    """A pair's poses after refinement.

    Args:
        placed: Both cameras, and what their errors are made of.
        covariance: (12, 12) of the errors of both.
        mode: NONE, PAIR or FLIGHT.
        before: Under the logged pose.
        after: Under this one.
        moved_sigmas: How far it is from the logged pose; None where it is the logged one.
        problem: Why the logged pose stands, or what to distrust.
    """

    placed: PlacedPair
    covariance: Floats
    mode: str
    before: Misses
    after: Misses
    moved_sigmas: float | None = None
    problem: str = ""


def pair_row(matched: Matched, found: RefinedPair) -> dict[str, object]:
    """A row of `relative_poses`.

    Args:
        matched: The pair; its matches are not needed.
        found: Its poses.
    """
    placed = found.placed
    jacobian = relative_jacobian(placed.ref, placed.src)
    pose = relative_placement(placed.ref, placed.src, jacobian @ found.covariance @ jacobian.T)
    alone = found.mode == PAIR
    return {
        **relative_pose_row(matched.pair.pair_id, pose),
        **placement_row(placed.ref, "ref_"),
        **placement_row(placed.src, "src_"),
        "gain": placed.gain.ravel().tolist() if alone else None,
        "noise": placed.noise.ravel().tolist() if alone else None,
        "n_matches": matched.n_matches,
        "n_inliers": found.before.n,
        "rms_before_px": found.before.rms_px,
        "median_before_px": found.before.median_px,
        "rms_after_px": found.after.rms_px,
        "median_after_px": found.after.median_px,
        "moved_sigmas": found.moved_sigmas,
        "mode": found.mode,
        "problem": found.problem,
    }


@dataclass(frozen=True, slots=True)
class RefinedFrame:
    """A frame's pose after refinement.

    Args:
        placed: Where it stands.
        covariance: (6, 6) of its turn (rad) and shift (m), ENU.
        refined: Whether matches had a part in it.
        problem: What to distrust.
    """

    placed: Placement
    covariance: Floats
    refined: bool = False
    problem: str = ""


def poses_table(frames: Mapping[str, RefinedFrame]) -> pa.Table:
    """The table `poses`."""
    return POSES.from_rows(_frame_row(name, found) for name, found in frames.items())


def _frame_row(name: str, found: RefinedFrame) -> dict[str, object]:
    # A rotation vector is made of turns about the axes of yaw, pitch and roll.
    by_axes = np.linalg.pinv(gimbal_error_axes(found.placed.rotation))
    gimbal = np.degrees(np.sqrt(np.diag(by_axes @ found.covariance[:3, :3] @ by_axes.T)))
    position = np.sqrt(np.diag(found.covariance[3:, 3:]))
    return {
        "frame_id": name,
        **placement_row(found.placed),
        **{column: float(value) for column, value in zip(_SIGMAS, position, strict=True)},
        **{column: float(value) for column, value in zip(_GIMBAL_SIGMAS, gimbal, strict=True)},
        "cov": found.covariance.ravel().tolist(),
        "refined": found.refined,
        "problem": found.problem,
    }


def covariances_table(errors: PoseErrors, together: Iterable[tuple[str, str]]) -> pa.Table:
    """The table `pose_covariances`: every frame with itself, then the couples."""
    couples = [*((name, name) for name in errors.index), *together]
    return POSE_COVARIANCES.from_columns(
        {
            "frame_id": [one for one, _ in couples],
            "other_frame_id": [other for _, other in couples],
            "cov": [errors.between(*couple).ravel().tolist() for couple in couples],
        }
    )


def cameras_table(given: pa.Table, frames: pa.Table, cameras: Mapping[str, Camera]) -> pa.Table:
    """The table `refined_cameras`.

    Args:
        given: The table `cameras`.
        frames: The table `frames`.
        cameras: By frame, as refined.
    """
    ids = dict(zip(column(frames, "frame_id"), column(frames, "camera_id"), strict=True))
    refined = {ids[name]: camera for name, camera in cameras.items()}
    as_given = cameras_of(given)
    rows = []
    for row in given.to_pylist():
        # A camera none of whose frames is usable has no part in anything.
        now = refined.get(row["camera_id"], as_given[row["camera_id"]])
        if now != as_given[row["camera_id"]]:
            lens = {"model": now.model, "fx": now.fx, "fy": now.fy, "distortion": list(now.distortion)}
            row |= {**lens, "source": f"{row['source']}, refined on the images"}
        rows.append(row)
    return REFINED_CAMERAS.from_rows(rows)
