"""Logs of one flight drawn anew about its true poses, and how far refined poses are from the truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
from flight_truth import FlightTruth, TruePose

from pipeline.engine.tables import read_table
from pipeline.flight import PairRow, column
from pipeline.geometry.arrays import Floats
from pipeline.geometry.poses import Pose, RelativePose
from pipeline.geometry.rotations import rotation_from_vector, vector_from_rotation


def redrawn_poses(
    truth: Mapping[str, TruePose], logged: Mapping[str, Pose], rng: np.random.Generator
) -> dict[str, Pose]:
    """Poses as another log of the same flight would give them, with the errors that the table's sigmas say."""
    common_m, common_rad = rng.normal(size=3), rng.normal(size=3)
    out = {}
    for name, pose in logged.items():
        own_m, own_rad = rng.normal(size=3), rng.normal(size=3)
        shift = own_m * pose.own.position_m + common_m * pose.common.position_m
        turn = own_rad * pose.own.gimbal_rad + common_rad * pose.common.gimbal_rad
        true = truth[name]
        out[name] = Pose(turned(true.rotation, turn), true.centre + shift, pose.own, pose.common)
    return out


def turned(rotation: Floats, turn_rad: Floats) -> Floats:
    """An attitude (enu_from_cam) off by yaw, pitch and roll as `frames` defines them, written without the closed form.

    Yaw is about the vertical, pitch about the camera's right axis, roll about the level forward axis.
    """
    yaw, pitch, roll = turn_rad
    level_forward = np.cross([0.0, 0.0, 1.0], rotation[:, 0])
    level_forward /= np.linalg.norm(level_forward)
    out: Floats = (
        rotation_from_vector(np.array([0.0, 0.0, -yaw]))
        @ rotation_from_vector(roll * level_forward)
        @ rotation
        @ rotation_from_vector(np.array([pitch, 0.0, 0.0]))
    )
    return out


PARTS = {"whole": 6, "turn": 3, "direction": 2, "length": 1}
"""Parts of a relative pose's error, and how many unknowns each has: what the mean of its square should be."""


def squares_of(found: RelativePose, truth: FlightTruth, pair: PairRow) -> Floats:
    """(4,) squares of a relative pose's error and of its PARTS, each in units of its own covariance."""
    ref, src = truth.poses[pair.ref], truth.poses[pair.src]
    # How much src is turned and shifted too far, seen on ref's axes; the shift then along and across the baseline.
    turn = vector_from_rotation(found.rotation.T @ (src.rotation.T @ ref.rotation))
    baseline = ref.rotation.T @ (src.centre - ref.centre)
    axes = np.eye(6)
    axes[3:, 3:] = np.linalg.qr(np.column_stack([baseline, np.eye(3)]))[0].T
    error = axes @ np.concatenate([turn, found.centre - baseline])
    covariance = axes @ found.covariance @ axes.T
    parts = [slice(0, 6), slice(0, 3), slice(4, 6), slice(3, 4)]
    return np.array([error[part] @ np.linalg.solve(covariance[part, part], error[part]) for part in parts])


def times_of(run: Path) -> dict[str, float]:
    """Exposures of a run's frames, s."""
    frames = read_table(run / "frames.parquet", "frames")
    seconds = np.asarray(frames.column("time").cast(pa.int64()).to_numpy(), np.float64) * 1e-9
    return dict(zip(column(frames, "frame_id"), seconds.tolist(), strict=True))
