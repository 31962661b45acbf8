"""Photo times and trigger events brought together by their intervals, not by their order.

A camera's clock may be off by anything, run fast, and tell whole seconds only; photos get lost, triggers misfire,
bursts come several to a second. What stays is the rhythm: for the right offset nearly every photo has an event of its
own, for a wrong one only some have. Offsets are found by votes of all differences, each is refined, and the best wins
only if no other explains the photos nearly as well: a rhythm without a mark (a trigger every two seconds, and nothing
else) fits at every beat, and then the data do not say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.clocks.chances import likeliest, shares, unit, windows
from pipeline.clocks.offsets import (
    FEWEST_MATCHES,
    JITTER_S,
    Line,
    Problem,
    kept_odds_of,
    likeliest_lines,
    windows_at,
)
from pipeline.geometry.arrays import Floats, Ints

# By how much the best has to lead, log-odds.
_MARGIN = 6.5
# A photo's event is told only if all others together are less likely than this.
_DOUBT = 0.003


@dataclass(frozen=True, slots=True)
class Alignment:
    """Photos and events of one offset.

    Args:
        offset_s: Event clock minus photo clock, at the first photo.
        drift: Seconds the offset grows per second.
        event: (n,) index of each photo's event, -1 without one.
        residual_s: (n,) event minus the photo's time by offset and drift, NaN without one.
        sigma_s: One sigma of a photo's time by offset and drift alone, beside the tick.
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
        variants: Others as good that give a few photos other events.
    """

    best: Alignment | None
    rival: Alignment | None
    variants: tuple[Alignment, ...] = ()


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
    first_s = float(photo_s[0]) + resolution_s / 2.0
    # `photo_s` begins at 0 within the problem.
    known = None if prior is None else (prior[0] + first_s, prior[1])
    problem = Problem(
        np.asarray(photo_s, np.float64) - photo_s[0],
        np.asarray(event_s, np.float64),
        resolution_s,
        known,
        unit(resolution_s, JITTER_S),
    )
    found = [a for a in (_alignment(problem, line) for line in likeliest_lines(problem)) if a.matched >= FEWEST_MATCHES]
    if not found:
        return Alignments(None, None)
    best, *others = (replace(a, offset_s=a.offset_s - first_s) for a in found)
    near = [a for a in others if best.score - a.score < _MARGIN]
    rivals = [a for a in near if _differs(best, a)]
    return Alignments(best, rivals[0] if rivals else None, tuple(a for a in near if not _differs(best, a)))


def doubts(
    photo_s: Floats, event_s: Floats, resolution_s: float, found: Alignments, offset_sigma_s: float
) -> list[Ints]:
    """Events other than the assigned one that may be a photo's.

    Args:
        photo_s: (n,) as given to `align`.
        event_s: (m,) as given to `align`.
        resolution_s: Tick of the camera's clock.
        found: The alignments.
        offset_sigma_s: One sigma of the best one's offset.

    Returns:
        Per photo, indices of such events; empty where the assigned one is beyond doubt.
    """
    best = found.best
    if best is None:
        return [np.empty(0, np.int64)] * len(photo_s)
    predicted_s = _predicted(photo_s, best, resolution_s)
    sigma_s = float(np.hypot(best.sigma_s, offset_sigma_s))
    kept_odds = kept_odds_of(best.matched, len(event_s))
    near = windows(predicted_s, event_s, resolution_s, sigma_s, unit(resolution_s, sigma_s), kept_odds)
    out = []
    for photo, (low, share) in enumerate(zip(near.low.tolist(), shares(near), strict=True)):
        others = np.arange(low, low + len(share))
        other = others != best.event[photo]
        told = _likely(others[other], share[other])
        out.append(np.union1d(told, [a.event[photo] for a in found.variants if a.event[photo] >= 0]).astype(np.int64))
    return [others[others != best.event[photo]] for photo, others in enumerate(out)]


def _likely(events: Ints, share: Floats) -> Ints:
    """The fewest events that leave less than the doubt."""
    order = np.argsort(-share)
    left = np.append(share.sum(), share.sum() - np.cumsum(share[order]))
    return events[order[: int(np.argmax(left < _DOUBT))]]


def _predicted(photo_s: Floats, alignment: Alignment, resolution_s: float) -> Floats:
    since_s = np.asarray(photo_s, np.float64) - photo_s[0]
    out: Floats = photo_s + alignment.drift * since_s + alignment.offset_s + resolution_s / 2.0
    return out


def _alignment(problem: Problem, line: Line) -> Alignment:
    event = likeliest(windows_at(problem, line))
    at = np.flatnonzero(event >= 0)
    residual_s = np.full(len(event), np.nan)
    residual_s[at] = problem.event_s[event[at]] - line.predicted_s(problem.photo_s)[at]
    offset_s = line.offset_s - line.drift * line.about_s
    return Alignment(offset_s, line.drift, event, residual_s, line.sigma_s, line.score)


def _differs(one: Alignment, other: Alignment) -> bool:
    """Whether two alignments give most photos different events: else `doubts` tells which."""
    both = (one.event >= 0) & (other.event >= 0)
    return bool(2 * np.count_nonzero(one.event[both] != other.event[both]) >= np.count_nonzero(both))
