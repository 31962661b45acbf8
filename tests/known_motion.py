"""Textured images whose motion is known."""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.geometry.arrays import Bytes, Floats


def noise_image(height: int, width: int, seed: int = 0) -> Bytes:
    """Noise of wavelengths from 4 to 130 px, in three channels, over the whole range of grey."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width, 3))
    for wavelength in (4, 8, 16, 33, 65, 130):
        size = (max(2, round(width / wavelength * 2)), max(2, round(height / wavelength * 2)))
        coarse = rng.normal(size=(size[1], size[0], 3))
        total += np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)) * wavelength**0.5
    total = (total - total.mean()) / total.std()
    return np.clip(128.0 + 45.0 * total, 0, 255).astype(np.uint8)


def _about_middle(angle_deg: float, scale: float, height: int, width: int) -> Floats:
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), angle_deg, scale)
    return np.vstack([turn, [0.0, 0.0, 1.0]])


def _perspective(height: int, width: int) -> Floats:
    corners = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
    moved = corners + np.float32([[10, 6], [-14, 9], [8, -12], [-6, -8]])
    return np.asarray(cv2.getPerspectiveTransform(corners, moved), np.float64)


# Of images of 600x800: src_from_ref.
HOMOGRAPHIES = {
    "shift": np.array([[1.0, 0.0, 12.0], [0.0, 1.0, -8.0], [0.0, 0.0, 1.0]]),
    "turn and scale": _about_middle(3.0, 1.03, 600, 800),
    "perspective": _perspective(600, 800),
}


def moved_by(src_from_ref: Floats, image: Bytes) -> tuple[Bytes, Floats]:
    """The src image of a plane, and the flow (h, w, 2) that is true; NaN where it leaves the image."""
    height, width = image.shape[:2]
    src = np.asarray(cv2.warpPerspective(image, src_from_ref, (width, height), flags=cv2.INTER_CUBIC), np.uint8)
    v, u = np.mgrid[:height, :width].astype(np.float64)
    at = np.stack([u, v, np.ones_like(u)], -1) @ src_from_ref.T
    at = at[..., :2] / at[..., 2:]
    inside = np.all((at >= 8) & (at <= (width - 9, height - 9)), axis=-1)
    return src, np.where(inside[..., None], at - np.stack([u, v], -1), np.nan)


def endpoint_error(found: Floats, truth: Floats) -> Floats:
    """Distances (k,) of the flow from the true one, where this is known."""
    apart = np.linalg.norm(found - truth, axis=-1)
    return apart[np.isfinite(apart)]
