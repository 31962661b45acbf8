"""The metrics of a set of depths against reference depths, as sums that add up over shards."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Bools, Floats

DELTA_BASE = 1.25
_NAMES = ("abs_rel", "sq_rel", "rmse", "rmse_log", "mae", "delta1", "delta2", "delta3")


@dataclass(frozen=True, slots=True)
class DepthSums:
    """Sums over pixels from which the metrics follow; sums of parts add up to the sum of the whole.

    Args:
        n: Pixels.
        sums: (8,) of |d-g|/g, (d-g)^2/g (m), (d-g)^2 (m2), (ln d - ln g)^2, |d-g| (m), and the three delta counts.
    """

    n: int
    sums: Floats

    @staticmethod
    def of(depth_m: Floats, reference_m: Floats) -> DepthSums:
        """The sums of one set of pixels.

        Args:
            depth_m: (n,) estimated depths, finite and > 0, m.
            reference_m: (n,) reference depths, finite and > 0, m.

        Source: Eigen, Puhrsch, Fergus, "Depth map prediction from a single image using a multi-scale deep network"
        (2014), section 4.1; Aggarwal et al., "EpiTransfer", section IV.
        """
        error = depth_m - reference_m
        ratio = np.maximum(depth_m / reference_m, reference_m / depth_m)
        columns = (
            np.abs(error) / reference_m,
            error**2 / reference_m,
            error**2,
            np.log(depth_m / reference_m) ** 2,
            np.abs(error),
            *((ratio < DELTA_BASE**k).astype(np.float64) for k in (1, 2, 3)),
        )
        return DepthSums(len(depth_m), np.array([math.fsum(column) for column in columns]))

    @staticmethod
    def total(parts: Iterable[DepthSums]) -> DepthSums:
        """The sums of several sets together, whatever their order."""
        listed = list(parts)
        columns = zip(*(part.sums for part in listed), strict=True)
        sums = [math.fsum(column) for column in columns] if listed else [0.0] * len(_NAMES)
        return DepthSums(sum(part.n for part in listed), np.array(sums))

    def metrics(self) -> dict[str, float | int | None]:
        """AbsRel, SqRel (m), RMSE (m), RMSE_log (natural), MAE (m) and delta 1 to 3; None where there is no pixel."""
        values: list[float | None] = [None] * len(_NAMES)
        if self.n:
            mean = self.sums / self.n
            mean[2:4] = np.sqrt(mean[2:4])
            values = [float(x) for x in mean]
        return {"n": self.n, **dict(zip(_NAMES, values, strict=True))}


@dataclass(frozen=True, slots=True)
class MethodSums:
    """One method's sums on a set of pixels.

    Args:
        n_scored: Pixels with a reference.
        kept: Over those the method keeps.
        common: Over those every method keeps.
    """

    n_scored: int
    kept: DepthSums
    common: DepthSums

    @staticmethod
    def of(depth_m: Floats, reference_m: Floats, kept: Bools, common: Bools) -> MethodSums:
        """The sums of one method.

        Args:
            depth_m: (n,) estimated depths, m; finite and > 0 where kept.
            reference_m: (n,) reference depths, m; all finite.
            kept: (n,) which the method keeps.
            common: (n,) which every method keeps.
        """
        return MethodSums(
            len(reference_m),
            DepthSums.of(depth_m[kept], reference_m[kept]),
            DepthSums.of(depth_m[common], reference_m[common]),
        )

    @staticmethod
    def total(parts: Iterable[MethodSums]) -> MethodSums:
        """The sums of several sets together."""
        listed = list(parts)
        return MethodSums(
            sum(part.n_scored for part in listed),
            DepthSums.total(part.kept for part in listed),
            DepthSums.total(part.common for part in listed),
        )

    def metrics(self) -> dict[str, object]:
        """`all` (the pixels the method keeps), `common` (those every method keeps) and `kept_share` of those scored."""
        share = self.kept.n / self.n_scored if self.n_scored else None
        return {"all": self.kept.metrics(), "common": self.common.metrics(), "kept_share": share}


def usable(depth_m: Floats, kept: Bools) -> Bools:
    """Which depths count as kept: those the method publishes, and that are depths at all.

    Args:
        depth_m: (n,) m, NaN for none.
        kept: (n,) as the method says.
    """
    out: Bools = kept & np.isfinite(depth_m) & (np.nan_to_num(depth_m) > 0.0)
    return out
