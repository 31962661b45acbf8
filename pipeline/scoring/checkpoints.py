"""Checkpoints: surveyed points that the run does not know, against the places where their rays meet.

In the terms of the ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2 (2023; version 2 of 2024)
the errors against the checkpoints and the errors of the checkpoints themselves enter by the sum of their squares,

    RMSE_H^2 = RMSE_x^2 + RMSE_y^2 + 2 s^2,  RMSE_V^2 = RMSE_z^2 + s^2,  RMSE_3D^2 = RMSE_H^2 + RMSE_V^2

with s the survey's sigma along each axis. Edition 2 judges by RMSE alone, without a 95 % figure, and wants at least 30
checkpoints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.geometry.poses import Placement
from pipeline.scoring.sighted import Offsets, Sighted, best_shift
from pipeline.scoring.sighting_errors import FrameErrors, stated_covariance
from pipeline.sources.control_places import Mark

REQUIRED = 30
# Rays that are nearer to parallel than this do not meet at a place.
_LEAST_PARALLAX_RAD = np.radians(1.0)


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """The error of a checkpoint.

    Args:
        name: The point's.
        error_m: (3,) where its rays meet less where it was surveyed, ENU.
        sigma_m: (3,) of that, by clicks, poses and survey.
        rays: How many.
    """

    name: str
    error_m: Floats
    sigma_m: Floats
    rays: int


def checkpoints(
    marks: Sequence[Mark],
    placements: Mapping[str, Placement],
    cameras: Mapping[str, Camera],
    errors: PoseErrors,
    sigma_m: float,
) -> list[Checkpoint]:
    """The errors of points that nothing in the run was fitted to.

    Args:
        marks: The points; those of which no two rays meet are passed over.
        placements: By frame_id.
        cameras: By frame_id.
        errors: Of the poses.
        sigma_m: One sigma of the surveyed coordinates along each axis.
    """
    sighted = Sighted.of(marks, placements, cameras)
    if not len(sighted.points):
        return []
    frame_errors = FrameErrors.of(errors, sighted.frame_ids)
    found = []
    for point in _meeting(sighted):
        alone = sighted.where(sighted.point == point)
        # The shift that brings a point's surveyed place onto its own sightings is its error.
        error = best_shift(alone)
        at = alone.offsets(error)
        covariance = stated_covariance(alone, at, _weight(at), frame_errors) + sigma_m**2 * np.eye(3)
        found.append(_checkpoint(alone, point, error, covariance))
    return found


def left_one_out(
    marks: Sequence[Mark],
    placements: Mapping[str, Placement],
    cameras: Mapping[str, Camera],
    errors: PoseErrors,
    sigma_m: float,
) -> list[Checkpoint]:
    """The errors of points that the translation was found from, each by the translation of the others.

    Args:
        marks: The points that the translation rests on, at least two of them.
        placements: By frame_id.
        cameras: By frame_id.
        errors: Of the poses.
        sigma_m: One sigma of the surveyed coordinates along each axis.
    """
    sighted = Sighted.of(marks, placements, cameras)
    if not len(sighted.points):
        return []
    frame_errors = FrameErrors.of(errors, sighted.frame_ids)
    found = []
    for point in _meeting(sighted):
        mine = sighted.point == point
        alone, others = sighted.where(mine), sighted.where(~mine)
        shift, error = best_shift(others), best_shift(alone)
        at = sighted.offsets(np.where(mine[:, None], error, shift))
        weight = np.zeros((3, len(mine), 2))
        weight[:, mine], weight[:, ~mine] = _weight(alone.offsets(error)), -_weight(others.offsets(shift))
        covariance = stated_covariance(sighted, at, weight, frame_errors)
        covariance += sigma_m**2 * _of_survey(sighted, np.einsum("dmk,mki->mdi", weight, at.by_shift))
        found.append(_checkpoint(alone, point, error - shift, covariance))
    return found


def _weight(at: Offsets) -> Floats:
    """(3, m, 2) the shift by the offsets."""
    inverse: Floats = np.asarray(np.linalg.pinv(at.by_shift.reshape(-1, 3)), np.float64)
    return inverse.reshape(3, -1, 2)


def _of_survey(sighted: Sighted, by_place: Floats) -> Floats:
    """(3, 3) of sums that move by (m, 3, 3) with the places, each point's for itself and with a sigma of 1."""
    by_point = np.zeros((len(sighted.names), 3, 3))
    np.add.at(by_point, sighted.point, by_place)
    out: Floats = np.einsum("pij,pkj->ik", by_point, by_point)
    return out


def _meeting(sighted: Sighted) -> list[int]:
    """Points of which two rays at least are not parallel."""
    out = []
    for point in sighted.points.tolist():
        rays = sighted.rays[sighted.point == point]
        apart = np.linalg.norm(np.cross(rays[:, None], rays[None]), axis=2)
        if np.max(apart) > np.sin(_LEAST_PARALLAX_RAD):
            out.append(point)
    return out


def _checkpoint(alone: Sighted, point: int, error: Floats, covariance: Floats) -> Checkpoint:
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return Checkpoint(alone.names[point], error, sigma, len(alone.point))


def checkpoint_metrics(
    found: Sequence[Checkpoint], sigma_m: float, plain: Sequence[Checkpoint] | None = None
) -> dict[str, Any] | None:
    """The object `checkpoints` of metrics.json; None where there are none.

    Args:
        found: The checkpoints; where the translation was solved with the same points, as `left_one_out` gives them.
        sigma_m: One sigma of the surveyed coordinates along each axis.
        plain: The same points without any translation, where `found` is with one; these stand under
            `without_translation`.
    """
    if not found:
        return None
    independent = plain is None
    metrics = _figures(found, sigma_m)
    return {
        "n": len(found),
        "required": REQUIRED,
        "shortfall": max(REQUIRED - len(found), 0),
        **metrics,
        "survey_sigma_m": sigma_m,
        "independent": independent,
        "by": "multi-ray intersection" if independent else "leave-one-out",
        "statement": _statement(metrics, len(found), independent),
        "points": [_row(one) for one in found],
        "without_translation": None
        if plain is None or not plain
        else {"n": len(plain), **_figures(plain, sigma_m), "points": [_row(one) for one in plain]},
    }


def _figures(found: Sequence[Checkpoint], sigma_m: float) -> dict[str, Any]:
    """As the head of this file has them."""
    error = np.array([one.error_m for one in found])
    x, y, z = np.mean(error**2, axis=0)
    level, height = x + y + 2.0 * sigma_m**2, z + sigma_m**2
    return {
        "rmse_h_m": float(np.sqrt(level)),
        "rmse_v_m": float(np.sqrt(height)),
        "rmse_3d_m": float(np.sqrt(level + height)),
        "mean_m": np.mean(error, axis=0).tolist(),
    }


def _row(one: Checkpoint) -> dict[str, Any]:
    return {"name": one.name, "error_m": one.error_m.tolist(), "sigma_m": one.sigma_m.tolist(), "rays": one.rays}


def _statement(metrics: Mapping[str, float], n: int, independent: bool) -> str:
    """What the figures are, and what they are not."""
    said = (
        f"RMSE_H {metrics['rmse_h_m']:.3f} m, RMSE_V {metrics['rmse_v_m']:.3f} m, RMSE_3D {metrics['rmse_3d_m']:.3f} m "
        f"against {n} checkpoint{'s' if n > 1 else ''}, the survey's own error included (ASPRS Positional Accuracy "
        "Standards, Edition 2)."
    )
    if not independent:
        said += (
            " The points also set the translation: each is judged by the translation of the others, so these are not "
            "independent checkpoints, and the figures are no statement of compliance."
        )
    elif n < REQUIRED:
        said += (
            f" Edition 2 asks for at least {REQUIRED}; {REQUIRED - n} are missing, and with {n} the figures describe "
            "these points and are no statement of compliance."
        )
    return said
