"""How honest the predicted sigmas are, and what the depth errors mean on the map; sums that add up over shards."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats


@dataclass(frozen=True, slots=True)
class CalibrationSums:
    """Counts of errors within one and two predicted sigmas.

    Args:
        n: Pixels with a predicted sigma.
        within_1: Those whose error is at most one sigma.
        within_2: Those whose error is at most two.
    """

    n: int
    within_1: int
    within_2: int

    @staticmethod
    def of(depth_m: Floats, sigma_m: Floats, reference_m: Floats, spread_m: Floats) -> CalibrationSums:
        """Counts over one set of pixels.

        The error has two parts: the depth's, which sigma predicts, and the reference's own, of which the spread of the
        returns about their surface is the measure. They are added in quadrature.

        Args:
            depth_m: (n,) estimated depths, m.
            sigma_m: (n,) their predicted sigma, m; NaN for none.
            reference_m: (n,) reference depths, m.
            spread_m: (n,) spread of the reference, m.
        """
        has = np.isfinite(sigma_m)
        error = np.abs(depth_m[has] - reference_m[has])
        sigma = np.hypot(sigma_m[has], spread_m[has])
        return CalibrationSums(int(has.sum()), int((error <= sigma).sum()), int((error <= 2.0 * sigma).sum()))

    @staticmethod
    def total(parts: Iterable[CalibrationSums]) -> CalibrationSums:
        """The counts of several sets together."""
        listed = list(parts)
        return CalibrationSums(
            sum(p.n for p in listed), sum(p.within_1 for p in listed), sum(p.within_2 for p in listed)
        )

    def metrics(self) -> dict[str, float | int | None]:
        """The shares; a Gaussian error has 0.683 and 0.954."""
        share = [count / self.n if self.n else None for count in (self.within_1, self.within_2)]
        return {"n": self.n, "within_1_sigma": share[0], "within_2_sigma": share[1]}


@dataclass(frozen=True, slots=True)
class MapSums:
    """Squared displacements of points on the map.

    Args:
        n: Points.
        vertical: Sum of squared differences in up, m2.
        horizontal: Sum of squared horizontal distances, m2.
    """

    n: int
    vertical: float
    horizontal: float

    @staticmethod
    def of(depth_m: Floats, reference_m: Floats, rays_in_enu: Floats) -> MapSums:
        """Displacement of each estimated point from the reference point on the same ray of the same pose.

        What the pose does across the ray is not in it: it moves both points alike.

        Args:
            depth_m: (n,) estimated depths, m.
            reference_m: (n,) reference depths, m.
            rays_in_enu: (n, 3) the pixels' rays, scaled to depth 1, ENU.
        """
        displacement = (depth_m - reference_m)[:, None] * rays_in_enu
        return MapSums(
            len(depth_m), math.fsum(displacement[:, 2] ** 2), math.fsum(np.sum(displacement[:, :2] ** 2, axis=1))
        )

    @staticmethod
    def total(parts: Iterable[MapSums]) -> MapSums:
        """The sums of several sets together."""
        listed = list(parts)
        return MapSums(
            sum(p.n for p in listed), math.fsum(p.vertical for p in listed), math.fsum(p.horizontal for p in listed)
        )

    def metrics(self) -> dict[str, float | int | None]:
        """Root mean squares, m."""
        rms = [math.sqrt(total / self.n) if self.n else None for total in (self.vertical, self.horizontal)]
        return {"n": self.n, "rmse_z_m": rms[0], "rmse_h_m": rms[1]}
