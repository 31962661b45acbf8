"""The takes of a flight: stretches between gaps and turns, and the pairs whose both frames lie in one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.flight import PairRow
from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.poses import Placement

# In median steps: a longer one, in time or way, is a gap; a shorter way is hovering, which has no course.
_GAP, _HOVER = 5.0, 0.25
# Wide enough for the wander of a receiver between two close photos, narrow enough for the corner of any survey.
_TURN_RAD = np.radians(60.0)


@dataclass(frozen=True, slots=True)
class Take:
    """A stretch of the flight.

    Args:
        name: "take 1", counted over the takes that have pairs.
        frames: Its frames in the flight's order.
        pairs: The pairs whose both frames lie in it.
        heading_deg: From its first frame to its last, clockwise from north; None where these stand above one another.
    """

    name: str
    frames: tuple[str, ...]
    pairs: tuple[PairRow, ...]
    heading_deg: float | None

    def sampled(self, most: int) -> Take:
        """The take with no more than some of its pairs, evenly chosen."""
        return replace(self, pairs=tuple(self.pairs[row] for row in spread(len(self.pairs), most)))


def spread(count: int, most: int) -> Ints:
    """Rows of at most `most` of `count` things, evenly chosen, the first and the last among them."""
    return np.unique(np.linspace(0.0, count - 1.0, min(count, most)).round().astype(np.int64))


def takes_of(
    placements: Mapping[str, Placement], time_s: Mapping[str, float], pairs: Sequence[PairRow]
) -> tuple[Take, ...]:
    """The takes that have pairs; where no pair lies within a stretch, the whole flight is one.

    Args:
        placements: At least one frame, in the flight's order where their times do not say it.
        time_s: Exposures, s; NaN where not known.
        pairs: The pairs that may be used.
    """
    time = np.array([time_s[name] for name in placements])
    order = np.argsort(time, kind="stable") if np.isfinite(time).all() else np.arange(len(time))
    names = [list(placements)[row] for row in order]
    starts = stretches(np.stack([placements[name].centre for name in names]), time[order])
    parts = [names[start:end] for start, end in zip(starts, [*starts[1:], len(names)], strict=True)]
    found = [part for part in parts if _within(part, pairs)] or [names]
    return tuple(
        Take(f"take {number}", tuple(part), _within(part, pairs), _heading_deg(placements, part))
        for number, part in enumerate(found, start=1)
    )


def stretches(centre_m: Floats, time_s: Floats) -> Ints:
    """Where stretches without gaps and turns begin.

    Args:
        centre_m: (n, 3) m, ENU, in order.
        time_s: (n,) s; NaN where not known.

    Returns:
        (k,) rows, the first of them 0. The frame at a corner ends a stretch; the next one begins another, whose course
        is that of its own first step.
    """
    step = np.diff(centre_m, axis=0)
    way, wait = np.linalg.norm(step, axis=1), np.diff(time_s)
    gap = _longest(way) | _longest(wait)
    moving = way > _HOVER * np.median(way) if way.size else np.zeros(0, np.bool_)
    starts, course = [0], np.zeros(3)
    for row in range(len(step)):
        turned = moving[row] and np.any(course) and _angle(course, step[row]) > _TURN_RAD
        if gap[row] or turned:
            starts.append(row + 1)
            course = np.zeros(3)
        elif moving[row]:
            course = course + step[row]
    return np.array(starts, np.int64)


def _longest(steps: Floats) -> Bools:
    """Which steps are far longer than the usual one; one that is no number is not."""
    known = steps[np.isfinite(steps)]
    out: Bools = steps > (_GAP * np.median(known) if known.size else np.inf)
    return out


def _angle(one: Floats, other: Floats) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))


def _within(part: Sequence[str], pairs: Sequence[PairRow]) -> tuple[PairRow, ...]:
    frames = set(part)
    return tuple(pair for pair in pairs if pair.ref in frames and pair.src in frames)


def _heading_deg(placements: Mapping[str, Placement], part: Sequence[str]) -> float | None:
    east, north, _ = placements[part[-1]].centre - placements[part[0]].centre
    return float(np.degrees(np.arctan2(east, north)) % 360.0) if np.hypot(east, north) > 0.0 else None
