"""Where the pose allows a match: equal angles about the baseline within the band, and a parallax of points in front.

All points on one epipolar plane are seen at the same angle about the baseline, from ref and from src alike. So both
images' pixels are put on two angles: `about`, the turn about the baseline, and `along`, the angle from the direction
towards src. A match needs equal `about` within the band that the pose covariance allows, and `along` larger in src
than in ref (a point in front of both cameras), by no more than the parallax of the nearest point that is looked for.
Lens distortion is already in the rays, so the band is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import RelativePose

# Pixels whose band is wider than this lie at the epipole, where there is no depth to be had.
_WIDEST_BAND = 0.5


@dataclass(frozen=True, slots=True)
class Band:
    """How far from its epipolar plane, and how near, a match may lie.

    Args:
        sigmas: Width of the band in standard deviations of the pose and pixel error.
        sigma_px: One sigma of a feature's position.
        nearest_m: Range of the nearest point looked for.
    """

    sigmas: float
    sigma_px: float
    nearest_m: float

    def nearest_for(self, pose: RelativePose) -> float:
        """The nearest range for a pair: nearer than the baseline a point turns by 60 deg, which no feature bears."""
        return max(self.nearest_m, float(np.linalg.norm(pose.centre)))


@dataclass(frozen=True, slots=True)
class EpipolarAngles:
    """Where an image's rays lie about the baseline.

    Args:
        about: (n,) rad, turn about the baseline from ref to src; NaN for a ray too near to the baseline.
        along: (n,) rad, angle from that direction.
        tolerance: (n,) rad of `about`: half the band's width.
        slack: (n,) rad of `along`: the same error along the epipolar plane.
    """

    about: Floats
    along: Floats
    tolerance: Floats
    slack: Floats


def rays_in_ref(pixels: Floats, camera: Camera, rotation_ref_from_camera: Floats) -> Floats:
    """Unit rays of pixels on the ref camera's axes; NaN where the lens model gives none.

    Returns:
        (n, 3).
    """
    rays = camera.rays(pixels) @ rotation_ref_from_camera.T
    out: Floats = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return out


def epipolar_angles(rays: Floats, pose: RelativePose, band: Band, pixel_rad: float) -> EpipolarAngles:
    """Puts rays on their angles about the baseline, with the band's width for each.

    The error of `about` at a ray is that of the epipolar plane's turn: m . (a + e / range) with m the plane's normal,
    a the relative turn and e the shift of src, plus the pixels of both images; it grows as 1 / sin(along) towards the
    epipole.

    Args:
        rays: (n, 3) unit rays on the ref axes.
        pose: src_from_ref with its covariance.
        band: Of the search.
        pixel_rad: Angle of a pixel.
    """
    # Without a baseline there is no band, and no angle is a number.
    with np.errstate(invalid="ignore"):
        axis = pose.centre / np.linalg.norm(pose.centre)
    # Any fixed direction across the baseline serves as zero.
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    about = np.arctan2(rays @ second, rays @ first)
    across = np.hypot(rays @ first, rays @ second)
    along = np.arctan2(across, rays @ axis)
    safe = np.maximum(across, 1e-6)
    normal = np.cross(axis, rays) / safe[:, None]
    in_plane = np.cross(normal, rays)
    pixel = 2.0 * (band.sigma_px * pixel_rad) ** 2
    width, slack = (
        band.sigmas * np.sqrt(_largest_turn_variance(direction, rays, pose, band.nearest_for(pose)) + pixel)
        for direction in (normal, in_plane)
    )
    return EpipolarAngles(np.where(width / safe < _WIDEST_BAND, about, np.nan), along, width / safe, slack)


def _largest_turn_variance(direction: Floats, rays: Floats, pose: RelativePose, nearest_m: float) -> Floats:
    """Largest variance (rad^2) of the src ray's displacement along unit directions across it, from a range to infinity.

    It is a convex quadratic of the inverse range, so the largest is at one of the ends.
    """
    turn = np.cross(rays, direction)
    ends = (np.concatenate([turn, direction * inverse], axis=1) for inverse in (0.0, 1.0 / nearest_m))
    far, near = (np.einsum("ni,ij,nj->n", jacobian, pose.covariance, jacobian) for jacobian in ends)
    out: Floats = np.maximum(far, near)
    return out


@dataclass(frozen=True, slots=True)
class Reach:
    """Which pixels of src each pixel of ref may match.

    Args:
        ref: Angles of the ref pixels.
        src: Angles of the src pixels.
        max_parallax_rad: Largest angle by which a ray turns from ref to src.
    """

    ref: EpipolarAngles
    src: EpipolarAngles
    max_parallax_rad: float

    @classmethod
    def between(
        cls, ref_rays: Floats, src_rays: Floats, pose: RelativePose, band: Band, pixel_rad: tuple[float, float]
    ) -> Reach:
        """The reach of rays under a pose.

        Args:
            ref_rays: (n, 3) unit rays on the ref axes.
            src_rays: (m, 3) unit rays of src on the ref axes.
            pose: src_from_ref with its covariance.
            band: Of the search.
            pixel_rad: Angle of a pixel of ref and of src.
        """
        return cls(
            epipolar_angles(ref_rays, pose, band, pixel_rad[0]),
            epipolar_angles(src_rays, pose, band, pixel_rad[1]),
            largest_parallax(pose, band.nearest_for(pose)),
        )

    def near(self, rows: Ints) -> Ints:
        """The src pixels whose band may meet that of some ref pixels, which are sorted by `about`."""
        first, last = self.ref.about[rows[0]], self.ref.about[rows[-1]]
        apart = _turn(self.src.about - 0.5 * (first + last)) - 0.5 * (last - first)
        return np.flatnonzero(apart <= np.maximum(self.src.tolerance, self.ref.tolerance[rows].max()))

    def allows(self, rows: Ints, columns: Ints) -> Bools:
        """Whether ref pixels may match src pixels; index arrays that broadcast against each other.

        A pixel at the epipole, whose angles are no numbers, matches none.
        """
        ref, src = self.ref, self.src
        turn = _turn(ref.about[rows] - src.about[columns])
        # The wider band is that of the image whose ray is nearer to the baseline: ref ahead of the epipole, src behind.
        allowed = turn <= np.maximum(ref.tolerance[rows], src.tolerance[columns])
        rise = src.along[columns] - ref.along[rows]
        slack = np.maximum(ref.slack[rows], src.slack[columns])
        out: Bools = allowed & (rise >= -slack) & (rise <= self.max_parallax_rad + slack)
        return out


def _turn(angle: Floats) -> Floats:
    """The size of an angle, across +-pi too."""
    size = np.abs(angle)
    return np.minimum(size, 2.0 * np.pi - size)


def largest_parallax(pose: RelativePose, nearest_m: float) -> float:
    """The largest turn (rad) of a ray between the two centres for points no nearer than a range."""
    length = float(np.linalg.norm(pose.centre))
    return float(2.0 * np.arcsin(min(1.0, 0.5 * length / nearest_m)))
