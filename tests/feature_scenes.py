"""Features of two images whose correspondences are known, under poses as a drone logs them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.arrays import Bytes, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Pose, PoseSigmas, RelativePose, relative_pose
from pipeline.geometry.rotations import enu_from_cam, rotation_from_vector
from pipeline.matching.features import Features
from pipeline.matching.matcher import View
from pipeline.matching.reach import Band

DEG = np.pi / 180.0
PLAIN = Camera("pinhole", 4000, 3000, 2800.0, 2810.0, 2010.0, 1490.0)
STRONG = Camera("brown", 4000, 3000, 3600.0, 3600.0, 1999.5, 1499.5, (-0.3, 0.0, 0.001, -0.0005, 0.0))
SMALL = Camera("fisheye", 1600, 1200, 900.0, 905.0, 802.0, 597.0, (0.02, -0.003, 0.0, 0.0))
OWN = PoseSigmas(np.array([0.05, 0.05, 0.08]), np.array([0.25, 0.08, 0.08]) * DEG)
NONE = PoseSigmas(np.zeros(3), np.zeros(3))
BAND = Band(4.0, 0.5, 5.0)

# Name: (yaw, pitch, roll) and centre of ref and of src.
FLIGHTS = {
    "forward, 20 deg down, epipole in the image": ((0, -20, 0), (0, 5, 31), (1, -21, 0.5), (0, 0, 31)),
    "level forward, epipole in the middle": ((0, 0, 0), (0, 5, 31), (0, 0, 0), (0, 0, 31)),
    "backward": ((0, -20, 0), (0, 0, 31), (0, -20, 0), (0, 5, 31)),
    "sideways": ((0, -20, 0), (5, 0, 31), (2, -20, 0), (0, 0, 31)),
    "nadir, turned": ((40, -89, 0), (3, 4, 60), (43, -88, 0), (0, 0, 60)),
    "long forward": ((0, -20, 0), (0, 18, 31), (0, -20, 0), (0, 0, 31)),
}


def pose(angles_deg: object, centre: object) -> Pose:
    """Without error, with the sigmas that a log has."""
    return Pose(
        enu_from_cam(*np.radians(np.asarray(angles_deg, np.float64))), np.asarray(centre, np.float64), OWN, NONE
    )


def disturbed(rng: np.random.Generator, angles_deg: object, centre: object) -> Pose:
    """With an error of these sigmas."""
    true = pose(angles_deg, centre)
    turn = rotation_from_vector(true.error_axes @ rng.normal(0.0, OWN.gimbal_rad))
    return replace(true, rotation=turn @ true.rotation, centre=true.centre + rng.normal(0.0, OWN.position_m))


def features(pixels: Floats, descriptors: Bytes) -> Features:
    """Features of equal strength, found in the image as given."""
    one = np.ones(len(pixels), np.float32)
    return Features(pixels, descriptors, one, one)


def blank(camera: Camera) -> Bytes:
    """An image of the camera's size that nothing is seen in and that takes no memory."""
    return np.broadcast_to(np.zeros(1, np.uint8), (camera.height, camera.width))


@dataclass(frozen=True)
class Scene:
    """Features of two images; ref feature i is src feature partner[i], -1 for clutter."""

    ref: View
    src: View
    partner: Ints
    logged: RelativePose

    @property
    def true_px(self) -> tuple[Floats, Floats]:
        """Pixels of the features that have a partner, and their partners'."""
        true = self.partner >= 0
        return self.ref.features.pixels[true], self.src.features.pixels[self.partner[true]]


def scene(
    rng: np.random.Generator, name: str, ref_camera: Camera = PLAIN, src_camera: Camera | None = None, *, n: int = 800
) -> Scene:
    """Points at 12..100 m, half a pixel of noise, as much clutter as points, and poses as a drone logs them."""
    src_camera = src_camera or ref_camera
    ref_angles, ref_centre, src_angles, src_centre = FLIGHTS[name]
    ref, src = pose(ref_angles, ref_centre), pose(src_angles, src_centre)
    pixels = rng.uniform(0.0, (ref_camera.width - 1, ref_camera.height - 1), (3 * n, 2))
    rays = ref_camera.rays(pixels)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points = rays * rng.uniform(12.0, 100.0, (len(rays), 1))
    src_pixels = src_camera.project((points @ ref.rotation.T + ref.centre - src.centre) @ src.rotation)
    seen = np.flatnonzero(src_camera.holds(src_pixels))[:n]
    k = len(seen)
    base = rng.integers(0, 120, (k, 128))
    ref_features, src_features = (
        features(
            np.concatenate([px[seen] + rng.normal(0.0, 0.5, (k, 2)), rng.uniform(0.0, (c.width, c.height), (n, 2))]),
            np.concatenate(
                [np.clip(base + rng.normal(0, 8, base.shape), 0, 255), rng.integers(0, 120, (n, 128))]
            ).astype(np.uint8),
        )
        for px, c in ((pixels, ref_camera), (src_pixels, src_camera))
    )
    shuffled = rng.permutation(k + n)
    partner = np.full(k + n, -1)
    partner[:k] = np.argsort(shuffled)[:k]
    logged = relative_pose(disturbed(rng, ref_angles, ref_centre), disturbed(rng, src_angles, src_centre))
    return Scene(
        View(ref_camera, blank(ref_camera), ref_features),
        View(src_camera, blank(src_camera), src_features.take(shuffled)),
        partner,
        logged,
    )
