"""Two photos of a flat textured ground, and where one's pixels are seen in the other."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from feature_scenes import pose

from pipeline.geometry.arrays import Bytes, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Pose

PLANE_CAMERA = Camera("pinhole", 800, 600, 700.0, 702.0, 401.0, 298.0)
_TEXEL_M = 0.02


@dataclass(frozen=True)
class PlanePhotos:
    """Photos from 30 m above.

    Args:
        images: (h, w) of ref and src.
        cameras: Of ref and src.
        poses: Of ref and src, without error.
        src_from_ref: (3, 3) homography between their pixels.
    """

    images: tuple[Bytes, Bytes]
    cameras: tuple[Camera, Camera]
    poses: tuple[Pose, Pose]
    src_from_ref: Floats

    def errors(self, ref_px: Floats, src_px: Floats) -> Floats:
        """(n, 2) px: how far src pixels lie from where ref's are seen."""
        there = np.column_stack([ref_px, np.ones(len(ref_px))]) @ self.src_from_ref.T
        out: Floats = src_px - there[:, :2] / there[:, 2:]
        return out


def plane_photos(
    rng: np.random.Generator, cameras: tuple[Camera, Camera] = (PLANE_CAMERA, PLANE_CAMERA)
) -> PlanePhotos:
    """Each texel 2 cm, with noise of two grey values; pinhole cameras."""
    ground = sum(
        cv2.GaussianBlur(rng.normal(0.0, 60.0 * sigma, (3000, 3000)).astype(np.float32), (0, 0), sigma)
        for sigma in (1.5, 4.0, 12.0)
    )
    ground_from_texel = np.array([[_TEXEL_M, 0.0, -30.0], [0.0, -_TEXEL_M, 30.0], [0.0, 0.0, 1.0]])
    poses = pose((10, -80, 0), (2.0, 3.0, 30.0)), pose((14, -78, 3), (-1.5, 0.0, 31.0))
    images, to_image = [], []
    for camera, of in zip(cameras, poses, strict=True):
        plane = np.column_stack([of.rotation.T[:, :2], -of.rotation.T @ of.centre])
        image_from_ground = camera.matrix @ plane
        size = (camera.width, camera.height)
        shown = cv2.warpPerspective(ground, image_from_ground @ ground_from_texel, size, flags=cv2.INTER_CUBIC)
        images.append((128.0 + shown + rng.normal(0.0, 2.0, shown.shape)).round().clip(0, 255).astype(np.uint8))
        to_image.append(image_from_ground)
    return PlanePhotos((images[0], images[1]), cameras, poses, to_image[1] @ np.linalg.inv(to_image[0]))
