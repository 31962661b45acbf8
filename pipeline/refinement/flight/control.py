"""Control points in a flight: surveyed landmarks whose places are eliminated, leaving quadratics in the frames.

With X a point, R and C a camera that sees it, y = R^T (X - C) is the ray in the camera and x = y / y_z its place on the
image plane. A turn t of the camera moves y by R^T ((X - C) x t), a shift e by -R^T e. X itself is unknown about where
it was surveyed: what its pixels cannot agree on with the survey moves the point rather than the flight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement
from pipeline.geometry.rotations import skew
from pipeline.refinement.flight.elimination import Quadratic
from pipeline.refinement.flight.lens import Lenses

# A mark is clicked, by hand or by a detector, to about a pixel of the photo.
SIGMA_PX = 1.0
_STEPS = 4
_NEAREST_M = 0.1


@dataclass(frozen=True, slots=True)
class Control:
    """A surveyed point and the frames that see it.

    Args:
        name: Its name.
        surveyed_m: (3,) ENU, m.
        sigma_m: One sigma of the survey along each axis, m.
        frames: (m,) numbers of different frames.
        pixels: (m, 2) where they see it, px as given.
    """

    name: str
    surveyed_m: Floats
    sigma_m: float
    frames: Ints
    pixels: Floats


@dataclass(frozen=True, slots=True)
class Sights:
    """The pixels of a control point as rays of the present lenses.

    Args:
        xy: (m, 2) on the image plane.
        root: (m, 2, 2) W with W^T W the inverse covariance of xy.
        by_lens: (m, 2, c) of xy by the unknown parameters of the lenses.
    """

    xy: Floats
    root: Floats
    by_lens: Floats


@dataclass(frozen=True, slots=True)
class ControlFit:
    """How far the projection of a surveyed place is from its pixels.

    Args:
        name: The point's.
        before_px: (m,) with the logged poses; infinite where it is out of the camera's sight.
        after_px: (m,) with the refined ones.
    """

    name: str
    before_px: Floats
    after_px: Floats


def sights(control: Control, lenses: Lenses, change: Floats) -> Sights:
    """The rays of a control point's pixels.

    Args:
        control: The point.
        lenses: Of the flight.
        change: (3 c,) of the lenses.
    """
    which = lenses.of_frame[control.frames]
    given = lenses.through(which, control.pixels, np.zeros_like(change))
    rays = np.column_stack([given, np.ones(len(given))])
    root = np.stack([lenses.cameras[k].pixel_jacobian(ray) for k, ray in zip(which, rays, strict=True)]) / SIGMA_PX
    now = lenses.through(which, control.pixels, change) if np.any(change) else given
    return Sights(now, root, lenses.by_unknowns(which, control.pixels, change))


def most_likely(control: Control, seen: Sights, at: Sequence[Placement], start_m: Floats, scale: float) -> Floats:
    """(3,) the point that suits the survey and the pixels best with the poses fixed, ENU m.

    Args:
        control: The point.
        seen: Its pixels.
        at: Placements of its frames.
        start_m: (3,) to start from.
        scale: Of the robust weights, in sigmas.
    """
    point = start_m
    for _ in range(_STEPS):
        found, _, by_point, weight = _linearised(seen, at, point, scale)
        information, gradient = _of_point(control, point, found, by_point, weight)
        point = point - np.linalg.solve(information, gradient)
    return point


def eliminated(control: Control, seen: Sights, at: Sequence[Placement], point_m: Floats, scale: float) -> Quadratic:
    """The quadratic in the errors of the point's frames, and of the lenses, when it takes the place that suits it best.

    Args:
        control: The point.
        seen: Its pixels.
        at: Placements of its frames.
        point_m: (3,) as `most_likely` finds it.
        scale: Of the robust weights, in sigmas.
    """
    found, by_pose, by_point, weight = _linearised(seen, at, point_m, scale)
    m = len(at)
    jacobian = np.zeros((m, 2, m, 6))
    jacobian[np.arange(m), :, np.arange(m)] = by_pose
    jacobian = np.concatenate([jacobian.reshape(m, 2, 6 * m), -seen.root @ seen.by_lens], axis=2)
    rows = (jacobian * weight[:, None, None]).reshape(2 * m, -1)
    of_point, gradient = _of_point(control, point_m, found, by_point, weight)
    cross = rows.T @ by_point.reshape(-1, 3)
    # What is told twice of the point, by survey and by pixels, is told of the frames.
    gain = np.linalg.solve(of_point, cross.T).T
    information = rows.T @ jacobian.reshape(2 * m, -1) - gain @ cross.T
    return Quadratic(information, rows.T @ found.ravel() - gain @ gradient, np.zeros((0, len(information))))


def offsets_px(control: Control, at: Sequence[Placement], cameras: Sequence[Camera]) -> Floats:
    """(m,) from the projections of the surveyed place to its pixels; infinite where a camera does not see it.

    Args:
        control: The point.
        at: Placements of its frames.
        cameras: Of its frames.
    """
    projected = [
        camera.project((control.surveyed_m - placed.centre) @ placed.rotation)
        for placed, camera in zip(at, cameras, strict=True)
    ]
    away = np.linalg.norm(np.stack(projected) - control.pixels, axis=1)
    # Beside the camera a pixel is as far as one likes.
    most = np.array([camera.width + camera.height for camera in cameras], np.float64)
    return np.where(away < most, away, np.inf)


def _linearised(
    seen: Sights, at: Sequence[Placement], point: Floats, scale: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Whitened residuals (m, 2), by poses (m, 2, 6) and by the point (m, 2, 3); and their robust weights (m,)."""
    rotation = np.stack([placed.rotation for placed in at])
    into_cam = np.swapaxes(rotation, 1, 2)
    away = point - np.stack([placed.centre for placed in at])
    y = np.einsum("mij,mj->mi", into_cam, away)
    # Of a point behind a camera its pixel says nothing; mirrored, it might seem to fit.
    front = y[:, 2] > _NEAREST_M
    z = np.where(front, y[:, 2], 1.0)
    x = y[:, :2] / z[:, None]
    found = np.einsum("mij,mj->mi", seen.root, x - seen.xy)
    weight = front / (1.0 + np.sum(found**2, axis=1) / scale**2)
    change = np.concatenate([into_cam @ skew(away), -into_cam, into_cam], axis=2)
    by_all = seen.root @ ((change[:, :2] - x[:, :, None] * change[:, 2:]) / z[:, None, None])
    return found, by_all[:, :, :6], by_all[:, :, 6:], weight


def _of_point(
    control: Control, point: Floats, found: Floats, by_point: Floats, weight: Floats
) -> tuple[Floats, Floats]:
    """Information (3, 3) and gradient (3,) of the point itself, by survey and pixels."""
    surveyed = 1.0 / control.sigma_m**2
    information = surveyed * np.eye(3) + np.einsum("m,mki,mkj->ij", weight, by_point, by_point)
    gradient = surveyed * (point - control.surveyed_m) + np.einsum("m,mki,mk->i", weight, by_point, found)
    return information, gradient
