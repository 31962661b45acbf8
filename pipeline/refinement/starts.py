"""Relative poses that a plane allows: matches on flat ground fit two of them, and only the log tells which is true."""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.rotations import vector_from_rotation
from pipeline.refinement.matched import Rays
from pipeline.refinement.relative import Prior

_LEAST = 8
# Farther from the log a pose is out of the question.
_MOST_SIGMAS = 8.0


def homography(rays: Rays, threshold: float) -> tuple[Floats | None, Bools]:
    """The homography src_from_ref that most matches agree with, and which do.

    Args:
        rays: The matches.
        threshold: On the image plane.
    """
    if len(rays.ref) < _LEAST:
        return None, np.zeros(len(rays.ref), np.bool_)
    found, mask = cv2.findHomography(
        np.ascontiguousarray(rays.ref[:, :2]), np.ascontiguousarray(rays.src[:, :2]), cv2.USAC_MAGSAC, threshold
    )
    agree = np.zeros(len(rays.ref), np.bool_) if mask is None else np.asarray(mask, np.bool_).reshape(-1)
    return (None if found is None else np.asarray(found, np.float64)), agree


def homography_errors(rays: Rays, prior: Prior) -> Floats:
    """(b, 6) errors of the logged relative pose that one plane through the scene allows, near the log.

    Source: Malis and Vargas, "Deeper understanding of the homography decomposition for vision-based control" (2007),
    as OpenCV implements it.
    """
    sigma = float(np.sqrt(np.median(rays.noise[:, [0, 2]])))
    found, agree = homography(rays, max(5.0 * sigma, 1e-3))
    if found is None or agree.sum() < max(_LEAST, 0.5 * len(agree)):
        return np.empty((0, 6))
    _, rotations, translations, _ = cv2.decomposeHomographyMat(found, np.eye(3))
    length = float(np.linalg.norm(prior.centre))
    out = []
    for rotation, translation in zip(rotations, translations, strict=True):
        size = float(np.linalg.norm(translation))
        if size < 1e-9:
            continue
        centre = -rotation.T @ translation[:, 0] * (length / size)
        error = np.concatenate([vector_from_rotation(rotation.T @ prior.ref_from_src.T), centre - prior.centre])
        if error @ prior.information @ error < _MOST_SIGMAS**2:
            out.append(error)
    return np.array(out).reshape(-1, 6)
