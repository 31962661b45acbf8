"""How honest the predicted sigmas are, and what the depth errors mean on the map; sums that add up over shards."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from statistics import NormalDist

import numpy as np

from pipeline.geometry.arrays import Floats, Ints

NOMINAL = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
# How many sigmas are the bound of each count: of one and two sigma, and of each nominal share of a Gaussian.
_BOUNDS = (1.0, 2.0, *(NormalDist().inv_cdf(0.5 + 0.5 * p) for p in NOMINAL))
# Bins of the predicted relative sigma: ten in a decade, at preferred numbers (ISO 3, series R10).
_PREFERRED = (1.0, 1.25, 1.6, 2.0, 2.5, 3.15, 4.0, 5.0, 6.3, 8.0)
SIGMA_EDGES = (0.0, *(x / decade for decade in (1000.0, 100.0, 10.0) for x in _PREFERRED), 1.0, math.inf)
# Errors in sigmas are counted in bins of an eighth of an octave, from which their median follows.
_PER_OCTAVE = 8
_OCTAVES = 8
_HISTOGRAM = 2 * _OCTAVES * _PER_OCTAVE
_MEDIAN_OF_GAUSSIAN = NormalDist().inv_cdf(0.75)


@dataclass(frozen=True, slots=True)
class CalibrationSums:
    """Counts and sums of errors in units of their predicted sigma.

    Args:
        n: Pixels with a predicted sigma.
        within: (12,) those whose error is at most one and two sigmas, and at most the bound of each nominal share.
        squares: Sum of squared errors in sigmas.
        histogram: (128,) counts of errors in sigmas, 2^-8 to 2^8; what is beyond is in the first or last bin.
        by_sigma: (32, 3) pixels and sums of the squared relative sigma and error, by bins of the relative sigma.
    """

    n: int
    within: Ints
    squares: float
    histogram: Ints
    by_sigma: Floats

    @staticmethod
    def of(depth_m: Floats, sigma_m: Floats, reference_m: Floats, spread_m: Floats) -> CalibrationSums:
        """Counts and sums over one set of pixels.

        The error has two parts: the depth's, which sigma predicts, and the reference's own, of which the spread of the
        returns about their surface is the measure. They are added in quadrature.

        Args:
            depth_m: (n,) estimated depths, m.
            sigma_m: (n,) their predicted sigma, m; NaN for none.
            reference_m: (n,) reference depths, m.
            spread_m: (n,) spread of the reference, m.
        """
        total = np.hypot(sigma_m, spread_m)
        has = np.isfinite(total) & (total > 0.0)
        depth, sigma = depth_m[has], total[has]
        error = np.abs(depth - reference_m[has])
        # Of the estimated depth, as the sigma is: it is what is known where there is no reference.
        predicted, observed = sigma / depth, error / depth
        place = np.searchsorted(SIGMA_EDGES, predicted, side="right") - 1
        columns = (None, predicted**2, observed**2)
        return CalibrationSums(
            len(depth),
            np.array([np.count_nonzero(error <= bound * sigma) for bound in _BOUNDS], np.int64),
            math.fsum((error / sigma) ** 2),
            _counted(error / sigma),
            np.stack([np.bincount(place, column, len(SIGMA_EDGES) - 1) for column in columns], axis=1),
        )

    @staticmethod
    def total(parts: Iterable[CalibrationSums]) -> CalibrationSums:
        """The counts and sums of several sets together; at least one set."""
        listed = list(parts)
        stacked = np.stack([p.by_sigma for p in listed], axis=-1)
        return CalibrationSums(
            sum(p.n for p in listed),
            np.sum([p.within for p in listed], axis=0),
            math.fsum(p.squares for p in listed),
            np.sum([p.histogram for p in listed], axis=0),
            np.array([[math.fsum(cell) for cell in row] for row in stacked]),
        )

    def metrics(self) -> dict[str, object]:
        """How the errors compare with their sigmas; None where there is no pixel.

        Returns:
            `n`; `within_1_sigma` and `within_2_sigma`, which a Gaussian has as 0.683 and 0.954; `curve` of the observed
            to the nominal share; `mean_square` of the errors in sigmas, and `robust_mean_square`, their squared median
            over that of a Gaussian, both 1 where sigmas are honest; `by_sigma`, rms predicted and observed error in
            shares of the estimated depth, for the bins that have a pixel.
        """
        shares = [int(count) / self.n if self.n else None for count in self.within]
        median = self._median()
        return {
            "n": self.n,
            "within_1_sigma": shares[0],
            "within_2_sigma": shares[1],
            "curve": [{"nominal": p, "observed": share} for p, share in zip(NOMINAL, shares[2:], strict=True)],
            "mean_square": self.squares / self.n if self.n else None,
            "robust_mean_square": None if median is None else (median / _MEDIAN_OF_GAUSSIAN) ** 2,
            "by_sigma": self._bins(),
        }

    def _bins(self) -> list[dict[str, float | int | None]]:
        spans = pairwise(SIGMA_EDGES)
        return [
            {
                "from": low,
                "to": high if math.isfinite(high) else None,
                "n": int(n),
                "predicted": math.sqrt(predicted / n),
                "observed": math.sqrt(observed / n),
            }
            for (low, high), (n, predicted, observed) in zip(spans, self.by_sigma.tolist(), strict=True)
            if n
        ]

    def _median(self) -> float | None:
        """Median of the errors in sigmas, between the edges of its bin as the logarithm goes."""
        if not self.n:
            return None
        reached = np.cumsum(self.histogram)
        half = self.n / 2.0
        k = int(np.searchsorted(reached, half))
        inside = (half - float(reached[k] - self.histogram[k])) / float(self.histogram[k])
        return float(2.0 ** ((k + inside) / _PER_OCTAVE - _OCTAVES))


def _counted(normalised: Floats) -> Ints:
    with np.errstate(divide="ignore"):
        place = np.floor(_PER_OCTAVE * (np.log2(normalised) + _OCTAVES))
    rows = np.clip(place, 0, _HISTOGRAM - 1).astype(np.int64)
    return np.bincount(rows, minlength=_HISTOGRAM).astype(np.int64)


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
        sums = (self.vertical, self.horizontal, self.vertical + self.horizontal)
        rms = [math.sqrt(total / self.n) if self.n else None for total in sums]
        return {"n": self.n, "rmse_z_m": rms[0], "rmse_h_m": rms[1], "rmse_3d_m": rms[2]}
