"""What is wrong with a match: a duplicate, off the logged pose by more than its error, or off the consensus."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.poses import RelativePose

_SEED_CONFIDENCE = 0.9999
_ITERATIONS = 10_000


@dataclass(frozen=True, slots=True)
class Residuals:
    """Epipolar residuals of matches under a pose.

    Args:
        angle_rad: (n,) signed angle of the src ray from the match's epipolar plane.
        sigma_rad: (n,) its predicted sigma from pose and pixel covariance, at the match's own range.
    """

    angle_rad: Floats
    sigma_rad: Floats


def without_duplicates(
    ref_px: Floats, src_px: Floats, score: Floats, cell_px: tuple[float, float] = (1.0, 1.0)
) -> Bools:
    """Keeps the best-scored of matches that share a pixel in either image (features with two orientations).

    Args:
        ref_px: (n, 2).
        src_px: (n, 2).
        score: (n,).
        cell_px: What counts as one pixel of ref and of src.

    Returns:
        (n,) True for the matches to keep.
    """
    order = np.argsort(-score, kind="stable")
    for pixels, cell in zip((ref_px, src_px), cell_px, strict=True):
        # A match that has lost its ref pixel is no rival for the src pixel any more.
        _, first = np.unique(np.round(pixels[order] / cell).astype(np.int64), axis=0, return_index=True)
        order = order[np.sort(first)]
    keep = np.zeros(len(score), np.bool_)
    keep[order] = True
    return keep


def epipolar_residuals(ref_rays: Floats, src_rays: Floats, pose: RelativePose, noise: Floats) -> Residuals:
    """The angle between each src ray and the plane of its ref ray and the baseline.

    Args:
        ref_rays: (n, 3) in the ref camera frame.
        src_rays: (n, 3) on the ref camera's axes.
        pose: src_from_ref with its covariance.
        noise: (3, n) covariance xx, xy, yy of the matched positions, all of it on src's image plane (z = 1).
    """
    centre = pose.centre
    plane = np.cross(centre, ref_rays)
    plane /= np.linalg.norm(plane, axis=1, keepdims=True)
    unit = src_rays / np.linalg.norm(src_rays, axis=1, keepdims=True)
    angle = np.arcsin(np.clip(np.sum(plane * unit, axis=1), -1.0, 1.0))
    range_m = _ranges(ref_rays, unit, centre)
    jacobian = np.concatenate([np.cross(unit, plane), plane / range_m[:, None]], axis=1)
    variance = np.einsum("ni,ij,nj->n", jacobian, pose.covariance, jacobian) + _across(unit, plane, pose, noise)
    return Residuals(angle, np.sqrt(variance))


def _across(unit: Floats, plane: Floats, pose: RelativePose, noise: Floats) -> Floats:
    """Variance (rad^2) of unit src rays across their epipolar planes by the noise of their pixels."""
    ray, normal = unit @ pose.rotation.T, plane @ pose.rotation.T
    # The ray (x, y, 1) / length turns by (I - r r^T) / length per unit of x and y.
    across = ray[:, 2, None] * (normal[:, :2] - np.sum(normal * ray, axis=1, keepdims=True) * ray[:, :2])
    xx, xy, yy = noise
    out: Floats = across[:, 0] * (across[:, 0] * xx + 2.0 * across[:, 1] * xy) + across[:, 1] ** 2 * yy
    return out


def _ranges(ref_rays: Floats, src_unit: Floats, centre: Floats) -> Floats:
    """Distance from src to the point nearest to both rays, within a tenth and a thousand baselines."""
    ref_unit = ref_rays / np.linalg.norm(ref_rays, axis=1, keepdims=True)
    cosine = np.sum(ref_unit * src_unit, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (cosine * (ref_unit @ centre) - src_unit @ centre) / (1.0 - cosine**2)
    length = float(np.linalg.norm(centre))
    return np.clip(np.where(found > 0.0, found, np.inf), 0.1 * length, 1000.0 * length)


def consensus(ref_xy: Floats, src_xy: Floats, threshold: float) -> Bools:
    """Matches that agree with one essential matrix (MAGSAC++).

    The essential matrix, not the fundamental: flat ground would leave the latter undetermined.

    Args:
        ref_xy: (n, 2) ideal image-plane coordinates.
        src_xy: (n, 2) ideal image-plane coordinates.
        threshold: Largest residual, on the image plane.

    Returns:
        (n,).
    """
    if len(ref_xy) < 5:
        return np.zeros(len(ref_xy), np.bool_)
    _, mask = cv2.findEssentialMat(
        np.ascontiguousarray(ref_xy),
        np.ascontiguousarray(src_xy),
        np.eye(3),
        cv2.USAC_MAGSAC,
        _SEED_CONFIDENCE,
        threshold,
        _ITERATIONS,
    )
    # OpenCV gives no mask at all where it finds no model, which its stubs do not know.
    found = np.zeros(0, np.bool_) if mask is None else np.asarray(mask, np.bool_).reshape(-1)
    return found if found.size == len(ref_xy) else np.zeros(len(ref_xy), np.bool_)
