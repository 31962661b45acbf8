"""A camera's clock by the intervals between a log's exposures or triggers."""

from __future__ import annotations

import numpy as np

from pipeline.clocks.intervals import Alignment, Alignments, align, doubts
from pipeline.clocks.offsets import COARSE_TICK_S, FEWEST_MATCHES
from pipeline.geometry.arrays import Floats
from pipeline.placing.photo_clock import ClockMatch, PhotoTimes, Refusal
from pipeline.placing.timeline import Timeline
from pipeline.sources.records import Events

_LEAST_SHARE = 0.5
# A clock that is off by more than any time zone was never set. Then chance has more offsets to find a few photos at,
# and the log of another flight is likelier than a clock years off: the fit has to be of many photos.
_ANY_ZONE_S = 15.0 * 3600.0
_FAR_MATCHES = 8


def by_events(
    photos: PhotoTimes, line: Timeline, events: Events, prior: tuple[float, float] | None
) -> ClockMatch | Refusal:
    """Brings photos and events together by their intervals.

    Args:
        photos: The photos.
        line: The log.
        events: Its exposures or triggers.
        prior: Offset to UTC and its sigma, s, where something else says it: decides between offsets that the intervals
            leave open.

    Returns:
        The instants, or why there are none.
    """
    if min(len(photos.records), len(events.time_ns)) < FEWEST_MATCHES:
        return Refusal(
            (f"{len(events.time_ns)} events of {events.stream} and {len(photos.records)} photos are too few",)
        )
    shared_ns = line.utc_ns(events.time_ns)
    base_photo, base_event = int(photos.time_ns[0]), int(shared_ns[0])
    photo_s, event_s = (photos.time_ns - base_photo) / 1e9, (shared_ns - base_event) / 1e9
    between_s = (base_event - base_photo) / 1e9
    found = align(photo_s, event_s, photos.tick_s, None if prior is None else (prior[0] - between_s, prior[1]))
    best = found.best
    if best is None:
        return Refusal((f"no offset brings three photos to events of {events.stream}",))
    if found.rival is not None:
        return Refusal((_undecided(events, line, (best, found.rival), between_s, len(photos.records)),))
    predicted_s = photo_s * (1.0 + best.drift) + best.offset_s + photos.tick_s / 2.0
    inside = np.count_nonzero((predicted_s > event_s[0] - 1.0) & (predicted_s < event_s[-1] + 1.0))
    if best.matched < max(FEWEST_MATCHES, _LEAST_SHARE * inside):
        return Refusal((f"at best {best.matched} of {len(photos.records)} photos have an event of {events.stream}",))
    far = line.clock is not None and abs(best.offset_s + between_s) > _ANY_ZONE_S
    if far and best.matched < max(_FAR_MATCHES, _LEAST_SHARE * len(photos.records)):
        days = abs(best.offset_s + between_s) / 86_400.0
        return Refusal(
            (f"the photos' clock and the log's are {days:.0f} days apart at best: is it the log of this flight?",)
        )
    return _matched(photos, line, events, found, best, photo_s, event_s, between_s)


def _matched(
    photos: PhotoTimes,
    line: Timeline,
    events: Events,
    found: Alignments,
    best: Alignment,
    photo_s: Floats,
    event_s: Floats,
    between_s: float,
) -> ClockMatch:
    """Photos with an event take its instant; the others the clock's."""
    base_ns = int(line.utc_ns(events.time_ns)[0])
    has = best.event >= 0
    predicted_s = photo_s * (1.0 + best.drift) + best.offset_s + photos.tick_s / 2.0
    shared_ns = base_ns + np.rint(predicted_s * 1e9).astype(np.int64)
    log_ns = np.where(has, events.time_ns[np.maximum(best.event, 0)], line.log_ns(shared_ns))
    offset_sigma_s = _offset_sigma_s(best, photos.tick_s)
    within_tick_s = photos.tick_s / np.sqrt(12.0) if photos.tick_s >= COARSE_TICK_S else best.sigma_s
    fit_sigma_s = float(np.hypot(offset_sigma_s, within_tick_s))
    sigma_s = np.where(has, events.sigma_s, fit_sigma_s)
    reasons = [""] * len(has)
    others_of = doubts(photo_s, event_s, photos.tick_s, found, offset_sigma_s)
    for photo in np.flatnonzero(has).tolist():
        others = others_of[photo]
        apart = np.abs(event_s[others] - event_s[best.event[photo]])
        if len(others) and float(apart.max()) > 3.0 * events.sigma_s + 0.01:
            reasons[photo] = (
                f"{1 + len(others)} triggers fit its time, {float(apart.max()):.2f} s apart: the camera's clock tells "
                f"{photos.tick_s:g} s only"
            )
    return ClockMatch(
        log_ns, sigma_s, best.event, tuple(reasons),
        f"intervals of {best.matched} of {len(event_s)} {'exposures' if events.feedback else 'triggers'} "
        f"({events.stream})",
        best.offset_s + between_s, best.drift, offset_sigma_s, best.rms_s, best.matched,
        events, "" if events.feedback else f"triggers, not exposures: the shutter's lag is unknown ({events.stream})",
    )  # fmt: skip


def _offset_sigma_s(best: Alignment, tick_s: float) -> float:
    """How well the events tell the offset; within a tick, what the spread of the residuals leaves open.

    Exposures on the beat of a clock all show the same fraction of its tick: no number of them tells which.
    """
    known = best.residual_s[np.isfinite(best.residual_s)]
    averaged_s = best.sigma_s / np.sqrt(len(known))
    return float(np.hypot(averaged_s, max(tick_s - np.ptp(known), 0.0) / np.sqrt(12.0)))


def _undecided(
    events: Events, line: Timeline, found: tuple[Alignment, Alignment], between_s: float, photos: int
) -> str:
    """Both offsets, and how to say which; an offset to UTC says nothing of a clock that counts from boot."""
    offsets_s = [alignment.offset_s + between_s for alignment in found]
    told = " and ".join(
        f"{offset_s:+.2f} s ({alignment.matched} of {photos} photos)"
        for offset_s, alignment in zip(offsets_s, found, strict=True)
    )
    cure = ""
    if line.clock is not None and max(map(abs, offsets_s)) < _ANY_ZONE_S:
        cure = "; if you know which, --set ingest.clock_offset_s=" + " or ".join(f"{o:.1f}" for o in offsets_s)
    return f"the intervals of {events.stream} do not decide between {told}{cure}"
