"""Offsets and drifts between photos and events that are worth weighing: found by votes, refined, told by beats."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.clocks.chances import Windows, likeliest, log_odds, unit, windows
from pipeline.clocks.fit import LARGEST_DRIFT
from pipeline.geometry.arrays import Floats, Ints

# The clock of a camera and the instant its firmware notes are no better than this, and no worse.
_LEAST_SIGMA_S = 0.002
JITTER_S = 0.15
# From this tick on residuals are spread evenly over the tick, and say nothing within it; only what lies beyond tells
# the jitter.
COARSE_TICK_S = 0.1
_COARSE_JITTER_S = 0.02
# Offsets looked at by votes, by the nearest events, and with all assignments.
_VOTED, _QUICK, _SLOW, _FULL, _CLIMBED = 1500, 400, 120, 20, 8
# Of a regular rhythm, the beats on either side looked at in one go, and offsets in all.
_BEATS = (-16, -8, -4, -3, -2, -1, 1, 2, 3, 4, 8, 16)
_MOST_BEATS = 300
_MOST_BINS = 4_000_000
_QUICK_ROUNDS = 3
# Drift is estimated where the flight is long enough to show it.
_DRIFT_SPAN_S = 300.0
_DRIFT_MATCHES = 12
# What is so far behind the best, log-odds, that no refinement brings it near.
_HOPELESS = 30.0
# Two offsets nearer than this are one.
_LEAST_APART_S = 0.02
FEWEST_MATCHES = 3


@dataclass(frozen=True, slots=True)
class Problem:
    """Photo times from the first photo on, events, the tick, what is known of the offset, and of lost photos."""

    photo_s: Floats
    event_s: Floats
    tick_s: float
    prior: tuple[float, float] | None
    unit_s: float
    kept_odds: float = 1.0

    @property
    def reach_s(self) -> float:
        """How far from the right event a photo may be before drift is known."""
        flown_s = min(float(np.ptp(self.photo_s)), float(np.ptp(self.event_s)))
        return self.tick_s / 2.0 + JITTER_S + LARGEST_DRIFT / 2.0 * flown_s


@dataclass(frozen=True, slots=True)
class Line:
    """An offset and drift on the way: event = photo + offset + drift (photo - about)."""

    offset_s: float
    drift: float
    about_s: float
    sigma_s: float
    score: float = 0.0

    def predicted_s(self, photo_s: Floats) -> Floats:
        """Photo times on the event clock, (n,)."""
        out: Floats = photo_s + self.offset_s + self.drift * (photo_s - self.about_s)
        return out


def likeliest_lines(problem: Problem) -> list[Line]:
    """The likeliest offsets.

    Args:
        problem: Photos and events.

    Returns:
        Lines with their scores, the best first.
    """
    lines = _promising(problem)
    if not lines:
        return []
    problem = _scaled(problem, lines)
    coarse = problem.tick_s >= COARSE_TICK_S
    if coarse:
        # With soft edges first: the way to the right offset is then uphill from further away.
        lines = _leading(problem, [replace(line, sigma_s=JITTER_S) for line in lines], np.inf)[:_CLIMBED]
        lines = [_climbed(problem, line, problem.tick_s / 10.0) for line in lines]
    lines = _leading(problem, [_assigned(problem, line) for line in lines])
    if coarse:
        lines = [_climbed(problem, line, problem.tick_s / 40.0) for line in lines]
    lines += _beats(problem, max(lines, key=lambda line: line.score))
    return sorted(lines, key=lambda line: -line.score)


def _beats(problem: Problem, line: Line) -> list[Line]:
    """In a regular rhythm, the best offset by as many beats earlier and later as explain the photos nearly as well.

    Votes of a rhythm are alike for hundreds of offsets, and the best of them need not be among those looked at.
    """
    event = likeliest(windows_at(problem, line))
    beat_s = float(np.median(np.diff(problem.event_s[event[event >= 0]])))
    out: list[Line] = []
    if not beat_s > _LEAST_APART_S:
        return out
    while len(out) < _MOST_BEATS:
        steps = [replace(line, offset_s=line.offset_s + k * beat_s) for k in _BEATS]
        steps = [replace(step, score=_weighed(problem, step)) for step in steps]
        out += [step for step in steps if step.score > line.score - _HOPELESS]
        best = max(steps, key=lambda step: step.score)
        if best.score <= line.score:
            break
        line = best
    return out


def _leading(problem: Problem, lines: list[Line], behind: float = _HOPELESS) -> list[Line]:
    """The lines that are not hopelessly behind the best, the best first."""
    lines = [replace(line, score=_weighed(problem, line)) for line in lines]
    lines.sort(key=lambda line: -line.score)
    return [line for line in lines if line.score > lines[0].score - behind]


def _scaled(problem: Problem, lines: list[Line]) -> Problem:
    """The same problem in the units of the offset that fits best."""
    fits = [_assigned(problem, line) for line in lines[:3]]
    best = max(fits, key=lambda line: line.score)
    matched = int(np.count_nonzero(likeliest(windows_at(problem, best)) >= 0))
    sigma_s = min(line.sigma_s for line in fits)
    return replace(problem, unit_s=unit(problem.tick_s, sigma_s), kept_odds=kept_odds_of(matched, len(problem.event_s)))


def _promising(problem: Problem) -> list[Line]:
    """The offsets worth weighing with all assignments."""
    if float(np.median(np.diff(problem.event_s))) > 2.0 * problem.reach_s:
        lines = [_quick(problem, offset_s) for offset_s in _votes(problem)[:_QUICK]]
    else:
        # Every offset has an event near every photo: only one event for each tells offsets apart.
        lines = [
            Line(offset_s, 0.0, float(np.median(problem.photo_s)), JITTER_S) for offset_s in _votes(problem)[:_SLOW]
        ]
        lines = [replace(line, score=_weighed(problem, line)) for line in lines]
    lines.sort(key=lambda line: -line.score)
    out: list[Line] = []
    for line in lines:
        at_s = line.offset_s - line.drift * line.about_s
        if all(abs(at_s - (o.offset_s - o.drift * o.about_s)) > _LEAST_APART_S for o in out):
            out.append(line)
        if len(out) == _FULL:
            break
    return out


def _votes(problem: Problem) -> list[float]:
    """Offsets that many photos agree on, the most frequent first."""
    low_s, high_s = float(problem.event_s[0] - problem.photo_s[-1]), float(problem.event_s[-1])
    width_s = max(problem.reach_s / 2.0, (high_s - low_s) / _MOST_BINS)
    votes = np.zeros(int((high_s - low_s) / width_s) + 5, np.int64)
    for time_s in problem.photo_s:
        # A photo votes once per bin, however many events a burst has there.
        bins = ((problem.event_s - time_s - low_s) / width_s).astype(np.int64) + 2
        votes[bins[np.diff(bins, prepend=-1) > 0]] += 1
    # The right offset's votes may fall on four bins.
    around = votes[:-3] + votes[1:-2] + votes[2:-1] + votes[3:]
    out = [] if problem.prior is None else [problem.prior[0]]
    order = np.argsort(-around, kind="stable")[:_VOTED]
    taken = np.zeros(len(around), np.bool_)
    for index in order.tolist():
        if around[index] and not taken[index]:
            # Neighbours see the same votes.
            taken[max(index - 1, 0) : index + 2] = True
            out.append(low_s + index * width_s)
        if len(out) == _QUICK:
            break
    return out


def _quick(problem: Problem, offset_s: float) -> Line:
    """Offset and drift by the nearest events, and how well it does."""
    reach_s = 1.5 * problem.reach_s
    line = Line(offset_s, 0.0, 0.0, reach_s)
    for _ in range(_QUICK_ROUNDS):
        event = _nearest(line.predicted_s(problem.photo_s), problem.event_s)
        off_s = problem.event_s[event] - line.predicted_s(problem.photo_s)
        at = np.flatnonzero(np.abs(off_s) <= reach_s)
        if len(at) < FEWEST_MATCHES:
            return line
        line = _fitted(problem, at, event[at])
        reach_s = min(reach_s, max(problem.tick_s / 2.0 + JITTER_S, 6.0 * line.sigma_s))
    predicted_s = line.predicted_s(problem.photo_s)
    event = _nearest(predicted_s, problem.event_s)
    beyond_s = np.maximum(np.abs(problem.event_s[event] - predicted_s) - problem.tick_s / 2.0, 0.0)
    fits = beyond_s < 2.0 * JITTER_S
    score = float(np.sum(1.0 - 0.5 * np.minimum(beyond_s / JITTER_S, 2.0)[fits]))
    doubled = int(np.count_nonzero(fits)) - len(np.unique(event[fits]))
    return replace(line, score=score - doubled)


def _assigned(problem: Problem, line: Line) -> Line:
    """Offset and drift by the assignment of the greatest odds, where that is better."""
    event = likeliest(windows_at(problem, line))
    at = np.flatnonzero(event >= 0)
    lines = [line]
    if len(at) >= FEWEST_MATCHES:
        fitted = _fitted(problem, at, event[at])
        lines = [fitted, replace(line, sigma_s=fitted.sigma_s)]
    scored = [replace(line, score=_weighed(problem, line)) for line in lines]
    return max(scored, key=lambda line: line.score)


def _climbed(problem: Problem, line: Line, least_s: float) -> Line:
    """The offset and drift within a coarse tick that all assignments together favour."""
    step_s, flown_s = problem.tick_s / 4.0, float(np.ptp(problem.photo_s))
    while step_s > least_s:
        sides = [replace(line, offset_s=line.offset_s + side * step_s) for side in (-1.0, 1.0)]
        if flown_s > _DRIFT_SPAN_S:
            drifts = [line.drift + side * step_s / flown_s for side in (-1.0, 1.0)]
            sides += [replace(line, drift=drift) for drift in drifts if abs(drift) <= LARGEST_DRIFT]
        sides = [replace(side, score=_weighed(problem, side)) for side in sides]
        better = max(sides, key=lambda side: side.score)
        if better.score > line.score:
            line = better
        else:
            step_s /= 2.0
    return line


def kept_odds_of(matched: int, events: int) -> float:
    """Odds that an event has its photo on the card, by how many have."""
    return max((matched + 1.0) / (events - matched + 1.0), 1.0)


def windows_at(problem: Problem, line: Line) -> Windows:
    """Odds of photos and events at an offset and drift."""
    return windows(
        line.predicted_s(problem.photo_s),
        problem.event_s,
        problem.tick_s,
        line.sigma_s,
        problem.unit_s,
        problem.kept_odds,
    )


def _weighed(problem: Problem, line: Line) -> float:
    score = log_odds(windows_at(problem, line))
    if problem.prior is None:
        return score
    return score - 0.5 * ((line.offset_s - line.drift * line.about_s - problem.prior[0]) / problem.prior[1]) ** 2


def _fitted(problem: Problem, at: Ints, event: Ints) -> Line:
    """Offset, drift and jitter of photos and their events."""
    photo_s = problem.photo_s[at]
    rest_s = problem.event_s[event] - photo_s
    about_s = float(np.median(photo_s))
    drift = _drift(photo_s, rest_s)
    rest_s = rest_s - drift * (photo_s - about_s)
    offset_s = _centre(rest_s, problem.tick_s)
    off_s = np.abs(rest_s - offset_s)
    if problem.tick_s < COARSE_TICK_S:
        sigma_s = float(np.clip(1.4826 * np.median(off_s), _LEAST_SIGMA_S, JITTER_S))
    else:
        sigma_s = float(np.clip(np.quantile(off_s, 0.95) - problem.tick_s / 2.0, _COARSE_JITTER_S, JITTER_S))
    return Line(offset_s, drift, about_s, sigma_s)


def _drift(photo_s: Floats, rest_s: Floats) -> float:
    if len(photo_s) < _DRIFT_MATCHES or np.ptp(photo_s) < _DRIFT_SPAN_S:
        return 0.0
    # Median of slopes between the flight's halves (Siegel's idea, one pairing): a few wrong pairs do not turn it.
    half = len(photo_s) // 2
    slopes = (rest_s[half : 2 * half] - rest_s[:half]) / np.maximum(photo_s[half : 2 * half] - photo_s[:half], 1e-3)
    slope = float(np.median(slopes))
    # What no quartz does comes of wrong pairs.
    return slope if abs(slope) <= LARGEST_DRIFT else 0.0


def _centre(rest_s: Floats, tick_s: float) -> float:
    """The offset: the median, or the middle of the range where a coarse tick spreads residuals evenly."""
    if tick_s < COARSE_TICK_S:
        return float(np.median(rest_s))
    low, high = np.quantile(rest_s, (0.05, 0.95))
    return float((low + high) / 2.0)


def _nearest(at_s: Floats, event_s: Floats) -> Ints:
    right = np.clip(np.searchsorted(event_s, at_s), 1, len(event_s) - 1)
    out: Ints = np.where(at_s - event_s[right - 1] <= event_s[right] - at_s, right - 1, right)
    return out
