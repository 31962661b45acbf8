"""Matching guided by the pose: a feature meets only features near its epipolar plane.

All points on one epipolar plane are seen at the same angle about the baseline, from ref and from src alike. So both
images' features are put on two angles: `about`, the turn about the baseline, and `along`, the angle from the
direction towards src. A match needs equal `about` within the band that the pose covariance allows, and `along` larger
in src than in ref (a point in front of both cameras), by no more than the parallax of the nearest point that is
looked for. Sorted by `about`, a block of features has but few neighbours in reach; lens distortion is already in the
rays, so the band is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Bools, Floats, Ints, Singles
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import RelativePose

_REF_BLOCK = 128
# Features whose band is wider than this lie at the epipole, where there is no depth to be had.
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
class FoundMatches:
    """Index pairs of matched features.

    Args:
        ref: (m,) index into the ref features.
        src: (m,) index into the src features.
        score: (m,) 1 - ratio of the best to the second-best descriptor distance.
    """

    ref: Ints
    src: Ints
    score: Floats


def match_guided(
    ref_descriptors: Singles,
    src_descriptors: Singles,
    ref: EpipolarAngles,
    src: EpipolarAngles,
    *,
    max_parallax_rad: float,
    ratio: float,
) -> FoundMatches:
    """Mutual nearest neighbours inside the band that pass the ratio test there.

    Args:
        ref_descriptors: (n, d) float32 of unit length.
        src_descriptors: (m, d) float32 of unit length.
        ref: Angles of the n ref features.
        src: Angles of the m src features.
        max_parallax_rad: Largest angle by which a ray turns from ref to src.
        ratio: Largest ratio of best to second-best distance.

    Returns:
        The matches, in order of the ref feature.
    """
    ref_order = _usable_order(ref)
    best = _Best(ref_descriptors, src_descriptors)
    for start in range(0, len(ref_order), _REF_BLOCK):
        rows = ref_order[start : start + _REF_BLOCK]
        columns = _in_reach(ref, src, rows)
        if columns.size:
            allowed = _allowed(ref, src, rows, columns, max_parallax_rad)
            similarity = ref_descriptors[rows] @ src_descriptors[columns].T
            best.update(rows, columns, np.where(allowed, similarity, -1.0))
    return best.matches(ratio)


def _usable_order(angles: EpipolarAngles) -> Ints:
    usable = np.flatnonzero(np.isfinite(angles.about))
    return usable[np.argsort(angles.about[usable], kind="stable")]


def _in_reach(ref: EpipolarAngles, src: EpipolarAngles, rows: Ints) -> Ints:
    """The src features whose band may meet that of a block of ref features, which is sorted by `about`."""
    first, last = ref.about[rows[0]], ref.about[rows[-1]]
    apart = _turn(src.about - 0.5 * (first + last)) - 0.5 * (last - first)
    return np.flatnonzero(apart <= np.maximum(src.tolerance, ref.tolerance[rows].max()))


def _turn(angle: Floats) -> Floats:
    """The size of an angle, across +-pi too."""
    size = np.abs(angle)
    return np.minimum(size, 2.0 * np.pi - size)


def _allowed(ref: EpipolarAngles, src: EpipolarAngles, rows: Ints, columns: Ints, max_parallax: float) -> Bools:
    turn = _turn(ref.about[rows][:, None] - src.about[columns][None])
    # The wider band is that of the image whose ray is nearer to the baseline: ref ahead of the epipole, src behind it.
    allowed = turn <= np.maximum(ref.tolerance[rows][:, None], src.tolerance[columns][None])
    rise = src.along[columns][None] - ref.along[rows][:, None]
    slack = np.maximum(ref.slack[rows][:, None], src.slack[columns][None])
    out: Bools = allowed & (rise >= -slack) & (rise <= max_parallax + slack)
    return out


class _Best:
    """Best and second-best similarity of every ref feature, and the best ref feature of every src feature."""

    def __init__(self, ref_descriptors: Singles, src_descriptors: Singles) -> None:
        n_ref, n_src = len(ref_descriptors), len(src_descriptors)
        self.ref_descriptors, self.src_descriptors = ref_descriptors, src_descriptors
        self.first = np.full(n_ref, -1.0, np.float32)
        self.second = np.full(n_ref, -1.0, np.float32)
        self.column = np.full(n_ref, -1, np.int64)
        self.second_column = np.full(n_ref, -1, np.int64)
        self.src_first = np.full(n_src, -1.0, np.float32)
        self.src_row = np.full(n_src, -1, np.int64)

    def update(self, rows: Ints, columns: Ints, similarity: Singles) -> None:
        pick = np.argmax(similarity, axis=1)
        line = np.arange(len(rows))
        self.first[rows] = similarity[line, pick]
        self.column[rows] = columns[pick]
        back = np.argmax(similarity, axis=0)
        value = similarity[back, np.arange(len(columns))]
        better = value > self.src_first[columns]
        self.src_first[columns[better]] = value[better]
        self.src_row[columns[better]] = rows[back[better]]
        similarity[line, pick] = -1.0
        pick = np.argmax(similarity, axis=1)
        self.second[rows] = similarity[line, pick]
        self.second_column[rows] = columns[pick]

    def matches(self, ratio: float) -> FoundMatches:
        rows = np.flatnonzero(self.first > 0.0)
        columns = self.column[rows]
        mutual = self.src_row[columns] == rows
        rows, columns = rows[mutual], columns[mutual]
        alone = self.second[rows] <= 0.0
        near, far = self._distances(rows, columns), self._distances(rows, self.second_column[rows])
        far[alone] = 2.0
        score = 1.0 - near / np.maximum(far, 1e-12)
        good = score >= 1.0 - ratio
        return FoundMatches(rows[good], columns[good], score[good])

    def _distances(self, rows: Ints, columns: Ints) -> Floats:
        """Descriptor distances anew: the last digits of a matrix product depend on its blocks and threads."""
        ref, src = self.ref_descriptors[rows].astype(np.float64), self.src_descriptors[columns].astype(np.float64)
        out: Floats = np.sqrt(np.sum((ref - src) ** 2, axis=1))
        return out
