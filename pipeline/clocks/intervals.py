"""Photo times and trigger events brought together by their intervals, not by their order.

A camera's clock may be off by anything, run fast, and tell whole seconds only; photos get lost, triggers misfire,
bursts come several to a second. What stays is the rhythm: for the right offset nearly every photo has an event of its
own, for a wrong one only some have. Offsets are found by votes of all differences, each is refined with a monotone
one-to-one assignment, and the best wins only if no other explains the photos nearly as well: a rhythm without a mark (a
trigger every two seconds, and nothing else) fits at every beat, and then the data do not say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.clocks.fit import LARGEST_DRIFT
from pipeline.geometry.arrays import Floats, Ints

# The clock of a camera and the instant its firmware notes are no better than this.
_LEAST_SIGMA_S = 0.002
_JITTER_S = 0.15
# From this tick on residuals are spread evenly over the tick, and say nothing within it.
COARSE_TICK_S = 0.1
_CANDIDATES = 24
_ROUNDS = 6
# Drift is estimated where the flight is long enough to show it.
_DRIFT_SPAN_S = 300.0
_DRIFT_MATCHES = 12
# Log-odds: what a photo without an event costs (a hot shoe misses one in some hundred), and an event without a photo
# (test shots and lost files are common); and by how much the best has to lead.
_LOST_EVENT, _LOST_PHOTO = 5.0, 1.0
_MARGIN = 6.0
# Two offsets nearer than this are one.
_LEAST_APART_S = 0.02
# Within a coarse tick the offset itself is known to about this.
_COARSE_SLACK_S = 0.1
FEWEST_MATCHES = 3


@dataclass(frozen=True, slots=True)
class Alignment:
    """Photos and events of one offset.

    Args:
        offset_s: Event clock minus photo clock, at the first photo.
        drift: Seconds the offset grows per second.
        event: (n,) index of each photo's event, -1 without one.
        residual_s: (n,) event minus the photo's time by offset and drift, NaN without one.
        sigma_s: One sigma of a photo's time by offset and drift alone.
        score: Log-odds against photos and events having nothing to do with each other.
    """

    offset_s: float
    drift: float
    event: Ints
    residual_s: Floats
    sigma_s: float
    score: float

    @property
    def matched(self) -> int:
        """Photos that have an event."""
        return int(np.count_nonzero(self.event >= 0))

    @property
    def rms_s(self) -> float:
        """Root mean square of the residuals."""
        known = self.residual_s[np.isfinite(self.residual_s)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


@dataclass(frozen=True, slots=True)
class Alignments:
    """What the intervals say.

    Args:
        best: The best offset; None when photos or events are too few.
        rival: The next best, when the intervals do not decide between the two; else None.
    """

    best: Alignment | None
    rival: Alignment | None


def align(
    photo_s: Floats, event_s: Floats, resolution_s: float, prior: tuple[float, float] | None = None
) -> Alignments:
    """Finds the offset between photos and events.

    Args:
        photo_s: (n,) photo times on the camera's clock, in order; the start of the tick they were rounded down to.
        event_s: (m,) events on the log's clock, in order.
        resolution_s: Tick of the camera's clock, s: 1 for EXIF without sub-seconds.
        prior: Offset and its sigma, s, where something else says it; None when nothing does.

    Returns:
        The best alignment, and its rival where the intervals do not decide.
    """
    if len(photo_s) < FEWEST_MATCHES or len(event_s) < FEWEST_MATCHES:
        return Alignments(None, None)
    middle_s = np.asarray(photo_s, np.float64) + resolution_s / 2.0
    event_s = np.asarray(event_s, np.float64)
    problem = _Problem(middle_s - middle_s[0], event_s, resolution_s)
    found: list[Alignment] = []
    for offset_s in _votes(problem, prior, middle_s[0]):
        alignment = _refined(problem, offset_s)
        if alignment.matched >= FEWEST_MATCHES:
            found.append(_against_prior(alignment, prior, middle_s[0]))
    found.sort(key=lambda alignment: -alignment.score)
    if not found:
        return Alignments(None, None)
    # `photo_s` begins at 0 within the problem.
    best, *others = (replace(alignment, offset_s=alignment.offset_s - middle_s[0]) for alignment in found)
    apart_s = max(0.9 * resolution_s, 4.0 * min(best.sigma_s, _JITTER_S), _LEAST_APART_S)
    rivals = [a for a in others if abs(a.offset_s - best.offset_s) > apart_s and best.score - a.score < _MARGIN]
    return Alignments(best, rivals[0] if rivals else None)


@dataclass(frozen=True, slots=True)
class _Problem:
    """Photo times from the first photo on, events, and the tick."""

    photo_s: Floats
    event_s: Floats
    tick_s: float

    @property
    def span_s(self) -> float:
        return float(max(self.photo_s[-1], self.event_s[-1] - self.event_s[0], 1.0))

    @property
    def reach_s(self) -> float:
        """How far from the right event a photo may be before drift is known."""
        return self.tick_s / 2.0 + _JITTER_S + LARGEST_DRIFT / 2.0 * float(self.photo_s[-1])


def _votes(problem: _Problem, prior: tuple[float, float] | None, first_s: float) -> list[float]:
    """Offsets that many photos agree on, the most frequent first."""
    width = problem.reach_s
    low = float(problem.event_s[0] - problem.photo_s[-1])
    bins = int((problem.event_s[-1] - problem.photo_s[0] - low) / width) + 2
    votes = np.zeros(bins + 1, np.int64)
    for time_s in problem.photo_s:
        # A photo votes once per bin, however many events a burst has there.
        votes[np.unique(((problem.event_s - time_s - low) / width).astype(np.int64))] += 1
    # The right offset's votes may fall on two bins.
    pairs = votes[:-1] + votes[1:]
    out: list[float] = []
    if prior is not None:
        out.append(prior[0] + first_s)
    for index in np.argsort(-pairs, kind="stable")[: 4 * _CANDIDATES]:
        offset_s = low + (int(index) + 1.0) * width
        if pairs[index] and all(abs(offset_s - other) > 0.75 * width for other in out):
            out.append(offset_s)
        if len(out) == _CANDIDATES:
            break
    return out


def _refined(problem: _Problem, offset_s: float) -> Alignment:
    """Assignment and fit in turn, the reach narrowing to what the residuals are."""
    drift, reach_s = 0.0, 2.0 * problem.reach_s
    event = np.full(len(problem.photo_s), -1, np.int64)
    residual_s = np.full(len(event), np.nan)
    sigma_s = reach_s
    for _ in range(_ROUNDS):
        predicted_s = problem.photo_s * (1.0 + drift) + offset_s
        event = _assigned(predicted_s, problem.event_s, reach_s, problem.tick_s / 2.0)
        at = np.flatnonzero(event >= 0)
        if len(at) < FEWEST_MATCHES:
            break
        rest_s = problem.event_s[event[at]] - problem.photo_s[at]
        drift = _drift(problem.photo_s[at], rest_s)
        offset_s = _centre(rest_s - drift * problem.photo_s[at], problem.tick_s)
        residual_s = np.full(len(event), np.nan)
        residual_s[at] = rest_s - drift * problem.photo_s[at] - offset_s
        sigma_s = max(1.4826 * float(np.median(np.abs(residual_s[at]))), _LEAST_SIGMA_S)
        reach_s = min(reach_s, max(problem.tick_s / 2.0 + _JITTER_S, 6.0 * sigma_s))
    return Alignment(offset_s, drift, event, residual_s, sigma_s, _score(problem, event, residual_s, sigma_s, offset_s))


def _assigned(predicted_s: Floats, event_s: Floats, reach_s: float, free_s: float) -> Ints:
    """The monotone one-to-one assignment of photos to events with the greatest gain, -1 for none.

    Within the tick every residual is as good as another; beyond, the gain falls to 0 at the reach. Order is kept, so a
    burst within one tick goes to its events one by one.
    """
    low = np.searchsorted(event_s, predicted_s - reach_s)
    high = np.searchsorted(event_s, predicted_s + reach_s, side="right")
    # best[j]: greatest gain of the photos so far with events before j only; links lead back along the choice.
    best = np.zeros(len(event_s) + 1)
    head = np.full(len(event_s) + 1, -1, np.int64)
    links: list[tuple[int, int, int]] = []
    for photo, (first, last) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
        if first >= last:
            continue
        off = np.maximum(np.abs(event_s[first:last] - predicted_s[photo]) - free_s, 0.0) / max(reach_s - free_s, 1e-9)
        gains = best[first:last] + 1.0 - 0.9 * np.minimum(off, 1.0) ** 2
        heads = head[first:last].copy()
        for place, gain in enumerate(gains.tolist()):
            if gain > best[first + place + 1] + 1e-12:
                links.append((photo, first + place, int(heads[place])))
                upto = first + place + 1
                stop = upto + int(np.searchsorted(best[upto:], gain, side="left"))
                best[upto:stop] = gain
                head[upto:stop] = len(links) - 1
    out = np.full(len(predicted_s), -1, np.int64)
    at = int(head[-1])
    while at >= 0:
        photo, event, at = links[at]
        out[photo] = event
    return out


def _drift(photo_s: Floats, rest_s: Floats) -> float:
    if len(photo_s) < _DRIFT_MATCHES or np.ptp(photo_s) < _DRIFT_SPAN_S:
        return 0.0
    # Median of slopes between the flight's halves (Siegel's idea, one pairing): a few wrong pairs do not turn it.
    half = len(photo_s) // 2
    slopes = (rest_s[half : 2 * half] - rest_s[:half]) / np.maximum(photo_s[half : 2 * half] - photo_s[:half], 1e-3)
    return float(np.clip(np.median(slopes), -LARGEST_DRIFT, LARGEST_DRIFT))


def _centre(rest_s: Floats, tick_s: float) -> float:
    """The offset: the median, or the middle of the range where a coarse tick spreads residuals evenly."""
    if tick_s < COARSE_TICK_S:
        return float(np.median(rest_s))
    low, high = np.quantile(rest_s, (0.05, 0.95))
    return float((low + high) / 2.0)


def _score(problem: _Problem, event: Ints, residual_s: Floats, sigma_s: float, offset_s: float) -> float:
    """Log-odds of the assignment against chance, lost photos and events counted."""
    known = residual_s[np.isfinite(residual_s)]
    if not len(known):
        return 0.0
    rate = len(problem.event_s) / problem.span_s
    if problem.tick_s > 4.0 * sigma_s or problem.tick_s >= COARSE_TICK_S:
        width = max(problem.tick_s, 2.0 * _JITTER_S)
        beyond = np.maximum(np.abs(known) - problem.tick_s / 2.0, 0.0) / _JITTER_S
        gain = -np.log(rate * width) - 0.5 * beyond**2
    else:
        gain = -np.log(rate * sigma_s * np.sqrt(2.0 * np.pi)) - 0.5 * (known / sigma_s) ** 2
    inside = np.count_nonzero(
        (problem.event_s >= problem.photo_s[0] + offset_s - problem.tick_s)
        & (problem.event_s <= problem.photo_s[-1] + offset_s + problem.tick_s)
    )
    spare = max(int(inside) - len(known), 0)
    return float(np.sum(gain)) - _LOST_EVENT * (len(event) - len(known)) - _LOST_PHOTO * spare


def _against_prior(alignment: Alignment, prior: tuple[float, float] | None, first_s: float) -> Alignment:
    if prior is None:
        return alignment
    off = (alignment.offset_s - first_s - prior[0]) / prior[1]
    return replace(alignment, score=alignment.score - 0.5 * off**2)


def rivals_of(photo: int, predicted_s: float, alignment: Alignment, event_s: Floats, resolution_s: float) -> Ints:
    """Events other than the assigned one that fit a photo as well and belong to no other photo.

    Args:
        photo: Index of the photo.
        predicted_s: Its time on the log's clock, by offset and drift.
        alignment: The alignment.
        event_s: (m,) events.
        resolution_s: Tick of the camera's clock.

    Returns:
        Indices of such events.
    """
    reach_s = resolution_s / 2.0 + min(4.0 * alignment.sigma_s, _COARSE_SLACK_S)
    near = np.flatnonzero(np.abs(event_s - predicted_s) <= reach_s)
    taken = set(alignment.event.tolist())
    return np.array(
        [index for index in near.tolist() if index not in taken and index != alignment.event[photo]], np.int64
    )
