"""A clock tied to another by instants known on both: offset and drift, with what they leave unexplained."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.geometry.arrays import Bools, Floats

Nanoseconds = npt.NDArray[np.int64]

# Quartz is within 100 parts per million; a slope beyond this is no drift but wrong anchors.
LARGEST_DRIFT = 2e-4
# A drift is told from noise only over a while.
_DRIFT_SPAN_S = 120.0
_DRIFT_ANCHORS = 10
# Anchors further from the median than this many times the usual deviation are glitches (a receiver before its first
# fix, a bit flipped).
_OUTLIER_MADS = 6.0
_LEAST_TOLERANCE_S = 0.02
# Late anchors: the earliest arrivals are nearly on time, and what "nearly" is nobody logged.
_EARLIEST_SHARE = 0.95
_LATE_SIGMA_S = 0.1
_ANCHOR_SIGMA_S = 0.001


@dataclass(frozen=True, slots=True)
class ClockFit:
    """How instants of one clock become instants of another.

    Args:
        offset_ns: Other clock minus this one, at `at_ns`.
        drift: Seconds the offset grows per second.
        at_ns: Instant of this clock that the offset belongs to.
        sigma_s: One sigma of the offset.
        residual_s: Root mean square of the anchors about the fit; None without anchors.
        anchors: Instants used.
        left_out: Anchors that were glitches.
    """

    offset_ns: int
    drift: float = 0.0
    at_ns: int = 0
    sigma_s: float = 0.0
    residual_s: float | None = None
    anchors: int = 0
    left_out: int = 0

    def apply(self, time_ns: Nanoseconds) -> Nanoseconds:
        """Instants of this clock on the other one.

        Args:
            time_ns: (n,) ns.

        Returns:
            (n,) ns.
        """
        time_ns = np.asarray(time_ns, np.int64)
        slow = np.rint(self.drift * (time_ns - self.at_ns).astype(np.float64)).astype(np.int64)
        out: Nanoseconds = time_ns + np.int64(self.offset_ns) + slow
        return out


def fit_clock(own_ns: Nanoseconds, other_ns: Nanoseconds, *, late: bool = False) -> ClockFit | None:
    """Ties a clock to another by anchors.

    Args:
        own_ns: (k,) instants on the clock.
        other_ns: (k,) the same instants on the other clock.
        late: Whether `own_ns` are arrivals, later than the instants by a varying delay.

    Returns:
        The fit; None without anchors.
    """
    if not len(own_ns):
        return None
    own_ns, other_ns = np.asarray(own_ns, np.int64), np.asarray(other_ns, np.int64)
    difference_ns = other_ns - own_ns
    middle = int(np.median(difference_ns))
    at_ns = int(own_ns[len(own_ns) // 2])
    rest_s = (difference_ns - middle).astype(np.float64) / 1e9
    time_s = (own_ns - at_ns).astype(np.float64) / 1e9
    good = _near(rest_s, time_s)
    slope = _slope(time_s[good], rest_s[good])
    flat = rest_s - slope * time_s
    level = float(np.quantile(flat[good], _EARLIEST_SHARE)) if late else float(np.median(flat[good]))
    residual_s = float(np.sqrt(np.mean((flat[good] - level) ** 2)))
    count = int(np.count_nonzero(good))
    own_sigma_s = max(residual_s / np.sqrt(count), _ANCHOR_SIGMA_S)
    return ClockFit(
        middle + round(level * 1e9),
        slope,
        at_ns,
        float(np.hypot(own_sigma_s, _LATE_SIGMA_S)) if late else float(own_sigma_s),
        residual_s,
        count,
        len(own_ns) - count,
    )


def _near(rest_s: Floats, time_s: Floats) -> Bools:
    """Anchors that are no glitches, drift allowed for."""
    slack = LARGEST_DRIFT * float(np.ptp(time_s)) if len(time_s) else 0.0
    centre = float(np.median(rest_s))
    mad = 1.4826 * float(np.median(np.abs(rest_s - centre)))
    good: Bools = np.abs(rest_s - centre) <= max(_OUTLIER_MADS * mad, _LEAST_TOLERANCE_S) + slack
    return good


def _slope(time_s: Floats, rest_s: Floats) -> float:
    """Least-squares slope where the anchors' span can tell it, else 0."""
    if len(time_s) < _DRIFT_ANCHORS or np.ptp(time_s) < _DRIFT_SPAN_S:
        return 0.0
    centred = time_s - time_s.mean()
    slope = float(centred @ (rest_s - rest_s.mean()) / (centred @ centred))
    sigma = float(np.std(rest_s - slope * centred)) / float(np.sqrt(centred @ centred))
    # A slope within its own error is no drift, and one that no quartz has is none either.
    return slope if 3.0 * sigma < abs(slope) <= LARGEST_DRIFT else 0.0
