"""Boxes about runs of returns, so that a camera looks only at those it may see."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.cameras import Camera

_RETURNS = 1024
# Places along each side of an image at which its outermost rays are looked for, and what lies between two of them.
_ALONG_SIDE, _WIDER = 33, 1.05


@dataclass(frozen=True, slots=True)
class Blocks:
    """Bounding boxes of consecutive returns, of use where these are ordered by place.

    Args:
        lower_m: (b, 3) lower corners, ENU m.
        upper_m: (b, 3) upper corners.
        count: Returns in all.
    """

    lower_m: Floats
    upper_m: Floats
    count: int

    @classmethod
    def of(cls, points_in_enu_m: Floats) -> Self:
        """The boxes of returns (n, 3), ENU m."""
        starts = np.arange(0, len(points_in_enu_m), _RETURNS)
        if not len(starts):
            return cls(np.zeros((0, 3)), np.zeros((0, 3)), 0)
        lower, upper = (np.asarray(f.reduceat(points_in_enu_m, starts, axis=0)) for f in (np.minimum, np.maximum))
        return cls(lower, upper, len(points_in_enu_m))

    def moved(self, translation_m: Floats) -> Self:
        """The boxes of the same returns shifted by (3,) ENU m."""
        return replace(self, lower_m=self.lower_m + translation_m, upper_m=self.upper_m + translation_m)

    def runs(self, meets: Bools) -> list[slice]:
        """Rows of the returns in some blocks.

        Args:
            meets: (b,) which blocks.

        Returns:
            Slices in ascending order, neighbouring blocks joined.
        """
        edges = np.flatnonzero(np.diff(np.concatenate([[False], meets, [False]]).astype(np.int8)))
        return [
            slice(int(first) * _RETURNS, min(int(last) * _RETURNS, self.count)) for first, last in edges.reshape(-1, 2)
        ]

    def before(self, centre_in_enu_m: Floats, axis: Floats, slope: float, max_range_m: float) -> Bools:
        """Which blocks a camera may see something of: those in its range that meet the cone about its axis.

        Args:
            centre_in_enu_m: (3,) camera centre, ENU m.
            axis: (3,) unit vector along the optical axis, ENU.
            slope: Tangent of the cone's half angle.
            max_range_m: Largest distance from the camera, m.

        Returns:
            (b,).
        """
        beside = np.maximum(np.maximum(self.lower_m - centre_in_enu_m, centre_in_enu_m - self.upper_m), 0.0)
        near: Bools = np.einsum("ij,ij->i", beside, beside) <= max_range_m**2
        # A ball about the box meets the cone when its middle is no further outside than its radius.
        radius = 0.5 * np.linalg.norm(self.upper_m - self.lower_m, axis=1)
        offset = 0.5 * (self.lower_m + self.upper_m) - centre_in_enu_m
        along = offset @ axis
        across = np.sqrt(np.maximum(np.einsum("ij,ij->i", offset, offset) - along**2, 0.0))
        outside = (across - slope * along) / np.hypot(1.0, slope)
        meets: Bools = near & (along > -radius)
        if np.isfinite(slope):
            meets &= outside <= radius
        return meets


def widest_slope(camera: Camera) -> float:
    """Tangent of the largest angle between the axis and a ray in the image; infinite where that is not known."""
    u, v = (np.linspace(-0.5, size - 0.5, _ALONG_SIDE) for size in (camera.width, camera.height))
    sides = [np.column_stack([u, np.full_like(u, end)]) for end in (v[0], v[-1])]
    sides += [np.column_stack([np.full_like(v, end), v]) for end in (u[0], u[-1])]
    slopes = np.linalg.norm(camera.rays(np.concatenate(sides))[:, :2], axis=1)
    # Beyond the fold of a distortion there is no ray, and how far those before it reach is left open.
    return float(_WIDER * slopes.max()) if np.all(np.isfinite(slopes)) else float("inf")
