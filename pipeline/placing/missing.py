"""Exposures that no photo belongs to: lost photos, named where their neighbours' numbers tell, and misfires."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from pipeline.placing.photo_clock import ClockMatch, PhotoTimes

_NUMBER = re.compile(r"(\d{3,})(?=\D*$)")


@dataclass(frozen=True, slots=True)
class Unclaimed:
    """What the log has and the card has not.

    Args:
        photos: Names of photos that are missing, by the gap in their neighbours' numbers.
        triggers: Exposures that left no photo, for people.
    """

    photos: tuple[str, ...]
    triggers: tuple[str, ...]


def unclaimed(photos: PhotoTimes, match: ClockMatch) -> Unclaimed:
    """Exposures without a photo.

    Between two photos whose running numbers leave a gap as wide as the exposures between them, those are the missing
    photos; where the gap is narrower nobody can tell which of the exposures left none.

    Args:
        photos: The photos.
        match: Their exposures.

    Returns:
        Missing photos and spare triggers.
    """
    if match.events is None:
        return Unclaimed((), ())
    claimed = {int(event): k for k, event in enumerate(match.event.tolist()) if event >= 0}
    lost: list[str] = []
    spare: list[str] = []
    run: list[int] = []
    before: int | None = None
    for event in [*range(len(match.events.time_ns)), len(match.events.time_ns)]:
        if event not in claimed and event < len(match.events.time_ns):
            run.append(event)
            continue
        after = claimed.get(event)
        names = _between(photos, before, after)
        at_rhythm = _most_regular(match, run, len(names))
        lost += [f"{name} (exposure {_told(match, e)})" for name, e in zip(names, at_rhythm, strict=False)]
        spare += [_told(match, e) for e in run if e not in at_rhythm]
        run, before = [], after
    return Unclaimed(tuple(lost), tuple(spare))


def _between(photos: PhotoTimes, before: int | None, after: int | None) -> list[str]:
    """Names whose numbers lie between those of two photos; none where the names hold no running number."""
    if before is None or after is None:
        return []
    first, last = (photos.records[k].frame_id for k in (before, after))
    a, b = _NUMBER.search(first), _NUMBER.search(last)
    if a is None or b is None or first[: a.start()] != last[: b.start()]:
        return []
    width = len(a[1])
    return [f"{first[: a.start()]}{n:0{width}d}{first[a.end() :]}" for n in range(int(a[1]) + 1, int(b[1]))]


def _most_regular(match: ClockMatch, run: list[int], wanted: int) -> list[int]:
    """Of several spare exposures the ones that keep the rhythm, as many as photos are missing."""
    if not wanted or match.events is None:
        return []
    if len(run) <= wanted:
        return list(run)
    time_ns = match.events.time_ns
    ideal = np.linspace(time_ns[run[0] - 1], time_ns[run[-1] + 1], wanted + 2)[1:-1]
    free = list(run)
    chosen = []
    for instant in ideal:
        nearest = min(free, key=lambda event: abs(int(time_ns[event]) - instant))
        free.remove(nearest)
        chosen.append(nearest)
    return sorted(chosen)


def _told(match: ClockMatch, event: int) -> str:
    if match.events is None:
        return ""
    number = int(match.events.number[event])
    seconds = (int(match.events.time_ns[event]) - int(match.events.time_ns[0])) / 1e9
    return f"{'#' + str(number) if number >= 0 else event + 1} at {seconds:.2f} s after the first"
