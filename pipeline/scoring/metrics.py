"""The metrics of a set of depths against reference depths, as sums that add up over shards."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints

DELTA_BASE = 1.25
NAMES = ("abs_rel", "sq_rel", "rmse", "rmse_log", "mae", "delta1", "delta2", "delta3")
# Those that are the root of a mean.
_ROOTS = slice(2, 4)


def terms(depth_m: Floats, reference_m: Floats) -> Floats:
    """What each pixel adds to the sums.

    Args:
        depth_m: (n,) estimated depths, finite and > 0, m.
        reference_m: (n,) reference depths, finite and > 0, m.

    Returns:
        (8, n): |d-g|/g, (d-g)^2/g (m), (d-g)^2 (m2), (ln d - ln g)^2, |d-g| (m), and max(d/g, g/d) < 1.25^k for k of
        1, 2 and 3.

    Source: Eigen, Puhrsch, Fergus, "Depth map prediction from a single image using a multi-scale deep network"
    (2014), section 4.1; Aggarwal et al., "EpiTransfer", section IV.
    """
    error = depth_m - reference_m
    ratio = np.maximum(depth_m / reference_m, reference_m / depth_m)
    return np.stack(
        [
            np.abs(error) / reference_m,
            error**2 / reference_m,
            error**2,
            np.log(depth_m / reference_m) ** 2,
            np.abs(error),
            *((ratio < DELTA_BASE**k).astype(np.float64) for k in (1, 2, 3)),
        ]
    )


def values(n: AnyArray, sums: Floats) -> Floats:
    """The metrics that sums are those of.

    Args:
        n: (...) pixels.
        sums: (..., 8) their sums.

    Returns:
        (..., 8) in the order of `NAMES`; NaN where there is no pixel.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        out: Floats = sums / np.asarray(n)[..., None]
    out[..., _ROOTS] = np.sqrt(out[..., _ROOTS])
    return out


def named(n: int, found: Floats) -> dict[str, float | int | None]:
    """Metrics (8,) by name, with the pixels they are of; None where there is no pixel."""
    return {"n": n, **{name: float(x) if n else None for name, x in zip(NAMES, found, strict=True)}}


@dataclass(frozen=True, slots=True)
class DepthSums:
    """Sums over pixels from which the metrics follow; sums of parts add up to the sum of the whole.

    Args:
        n: Pixels.
        sums: (8,) of their `terms`.
    """

    n: int
    sums: Floats

    @staticmethod
    def of(depth_m: Floats, reference_m: Floats) -> DepthSums:
        """The sums of one set of pixels; arguments as of `terms`."""
        return DepthSums(len(depth_m), np.array([math.fsum(column) for column in terms(depth_m, reference_m)]))

    @staticmethod
    def total(parts: Iterable[DepthSums]) -> DepthSums:
        """The sums of several sets together, whatever their order."""
        listed = list(parts)
        columns = zip(*(part.sums for part in listed), strict=True)
        sums = [math.fsum(column) for column in columns] if listed else [0.0] * len(NAMES)
        return DepthSums(sum(part.n for part in listed), np.array(sums))

    def metrics(self) -> dict[str, float | int | None]:
        """AbsRel, SqRel (m), RMSE (m), RMSE_log (natural), MAE (m) and delta 1 to 3; None where there is no pixel."""
        return named(self.n, values(np.asarray(self.n), self.sums))


@dataclass(frozen=True, slots=True)
class GroupedSums:
    """Sums over several sets of pixels.

    Args:
        n: (k,) pixels of each.
        sums: (k, 8) their sums.
    """

    n: Ints
    sums: Floats

    @staticmethod
    def of(depth_m: Floats, reference_m: Floats, group: Ints, count: int) -> GroupedSums:
        """The sums of each group.

        Args:
            depth_m: (n,) as of `terms`.
            reference_m: (n,) as of `terms`.
            group: (n,) which group a pixel is of, 0 .. count - 1; negative for none.
            count: Groups.
        """
        member = group >= 0
        rows = group[member]
        columns = terms(depth_m[member], reference_m[member])
        sums = np.stack([np.bincount(rows, column, count) for column in columns], axis=1).astype(np.float64)
        return GroupedSums(np.bincount(rows, minlength=count).astype(np.int64), sums)

    @staticmethod
    def stacked(parts: Iterable[DepthSums]) -> GroupedSums:
        """Sets as groups, one each."""
        listed = list(parts)
        sums = np.array([part.sums for part in listed]).reshape(-1, len(NAMES))
        return GroupedSums(np.array([part.n for part in listed], np.int64), sums)

    @staticmethod
    def total(parts: Iterable[GroupedSums]) -> GroupedSums:
        """The sums of several parts with the same groups; at least one part."""
        listed = list(parts)
        stacked = np.stack([part.sums for part in listed], axis=-1)
        sums = np.array([[math.fsum(cell) for cell in row] for row in stacked])
        return GroupedSums(np.sum([part.n for part in listed], axis=0, dtype=np.int64), sums)

    def metrics(self) -> list[dict[str, float | int | None]]:
        """Of each group, as of `DepthSums.metrics`."""
        return [named(int(n), found) for n, found in zip(self.n, values(self.n, self.sums), strict=True)]


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
