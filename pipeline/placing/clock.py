"""A camera's clock against a log's: by trigger events, by places, by what the user or the files say, in that order.

Order alone never decides which photo is which exposure: one lost frame would shift all that follow.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np

from pipeline.clocks.fit import ClockFit, Nanoseconds
from pipeline.clocks.intervals import Alignment, Alignments, align, doubts
from pipeline.clocks.offsets import COARSE_TICK_S, FEWEST_MATCHES
from pipeline.clocks.places import offset_by_place
from pipeline.geometry.arrays import Floats, Ints
from pipeline.placing.pose import level_track
from pipeline.placing.timeline import Timeline
from pipeline.sources.photos import PhotoRecord
from pipeline.sources.records import Events

# Photo clocks that say UTC themselves are this near it, and users state offsets to a good half second.
_TRUSTED_SIGMA_S = 2.0
_STATED_SIGMA_S = 0.4
# Which time tags say UTC: the others are a local time whose zone nobody wrote down.
TRUSTED = frozenset({"utc_at_exposure", "gps", "exif+offset", "exif+gps zone"})
_BY_SATELLITE = frozenset({"utc_at_exposure", "gps"})
_LEAST_SHARE = 0.5
_HEADER_SIGMA_S = 0.001
_QUARTER_S = 900
_FINEST_TICK_S = 1e-6
_DIGITS = re.compile(r"(\d+)")


@dataclass(frozen=True, slots=True)
class PhotoTimes:
    """The photos of one camera, in order of time.

    Args:
        records: The photos.
        time_ns: (n,) on the camera's clock, read as UTC.
        tick_s: Resolution of that clock.
        trusted: Whether the clock says UTC itself.
        of_log: Whether they came out of a log or video, and have its clock.
    """

    records: tuple[PhotoRecord, ...]
    time_ns: Nanoseconds
    tick_s: float
    trusted: bool
    of_log: bool = False


@dataclass(frozen=True, slots=True)
class ClockMatch:
    """Exposures of photos on a log's clock.

    Args:
        log_ns: (n,) instants on the log's own clock.
        sigma_s: (n,) one sigma of them.
        event: (n,) index of the photo's event, -1 without one.
        reason: Per photo, why it has no instant; empty where it has one.
        method: How, for people.
        offset_s: Log's time (UTC, or boot where it says no UTC) minus the camera's.
        drift: Seconds the offset grows per second.
        offset_sigma_s: One sigma of the offset.
        residual_s: Root mean square of the anchors; None where the method has none.
        anchors: Events or photos used.
        events: The events used; None when none were.
        note: What to distrust.
    """

    log_ns: Nanoseconds
    sigma_s: Floats
    event: Ints
    reason: tuple[str, ...]
    method: str
    offset_s: float
    drift: float
    offset_sigma_s: float
    residual_s: float | None
    anchors: int
    events: Events | None = None
    note: str = ""


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a log's clock and the camera's could not be brought together, with the remedy."""

    reasons: tuple[str, ...] = field(default_factory=tuple)

    def __str__(self) -> str:
        return "; ".join(self.reasons)


def photo_times(records: Sequence[PhotoRecord]) -> PhotoTimes:
    """The photos of one camera by time, then name: cameras number what they take in one second in order."""
    timed = sorted((r for r in records if r.time is not None), key=_by_time)
    times = np.array([_ns(r.time) for r in timed if r.time is not None], np.int64)
    return PhotoTimes(tuple(timed), times, _tick_s(times), all(r.time_source in TRUSTED for r in timed))


def image_times(records: Sequence[PhotoRecord], line: Timeline, log_ns: Sequence[int]) -> PhotoTimes:
    """Images that came out of a log or video, on its clock.

    Args:
        records: The images.
        line: What they came out of.
        log_ns: Their instants on its own clock.

    Returns:
        The images by time: UTC where something ties that clock to it, else since the log or video began.
    """
    order = sorted(range(len(records)), key=lambda k: (log_ns[k], by_number(records[k].frame_id)))
    time_ns = line.utc_ns(np.array([log_ns[k] for k in order], np.int64))
    # Such instants are exact: that they lie on whole seconds or frames says nothing of the clock's resolution.
    return PhotoTimes(tuple(records[k] for k in order), time_ns, _FINEST_TICK_S, line.clock is not None, of_log=True)


def by_number(name: str) -> list[tuple[int, str]]:
    """A name as a key that puts IMG_9 before IMG_10."""
    return [(int(part or -1), "") if k % 2 else (0, part) for k, part in enumerate(_DIGITS.split(name))]


def _by_time(record: PhotoRecord) -> tuple[int, list[tuple[int, str]]]:
    return (0 if record.time is None else _ns(record.time)), by_number(record.frame_id)


def match_clock(photos: PhotoTimes, line: Timeline, stated_s: float | None) -> ClockMatch | Refusal:
    """Brings a camera's clock and a log's together.

    Args:
        photos: The photos.
        line: The log.
        stated_s: What the user says is to be added to the camera's times to make them UTC; None when nothing.

    Returns:
        The instants, or why there are none.
    """
    refusals: list[str] = []
    for events in line.events:
        found = _by_events(photos, line, events, stated_s)
        if isinstance(found, ClockMatch):
            return found
        refusals += found.reasons
    if stated_s is None:
        by_place = _by_places(photos, line)
        if isinstance(by_place, ClockMatch):
            return by_place
        refusals += by_place.reasons
    by_clock = _as_said(photos, line, stated_s)
    return by_clock if isinstance(by_clock, ClockMatch) else Refusal((*refusals, *by_clock.reasons))


def _by_events(photos: PhotoTimes, line: Timeline, events: Events, stated_s: float | None) -> ClockMatch | Refusal:
    """By the intervals between triggers."""
    if min(len(photos.records), len(events.time_ns)) < FEWEST_MATCHES:
        return Refusal(
            (f"{len(events.time_ns)} events of {events.stream} and {len(photos.records)} photos are too few",)
        )
    shared_ns = line.utc_ns(events.time_ns)
    base_photo, base_event = int(photos.time_ns[0]), int(shared_ns[0])
    photo_s, event_s = (photos.time_ns - base_photo) / 1e9, (shared_ns - base_event) / 1e9
    between_s = (base_event - base_photo) / 1e9
    prior = _prior(photos, line, stated_s)
    found = align(photo_s, event_s, photos.tick_s, None if prior is None else (prior[0] - between_s, prior[1]))
    best = found.best
    if best is None:
        return Refusal((f"no offset brings three photos to events of {events.stream}",))
    if found.rival is not None:
        told = _undecided(events, best, found.rival, between_s, len(photos.records))
        # An offset to UTC says nothing of a clock that counts from the start of the machine.
        cure = f" (say which: --set ingest.clock_offset_s={best.offset_s + between_s:.1f})" if line.clock else ""
        return Refusal((f"{told}{cure}",))
    predicted_s = photo_s * (1.0 + best.drift) + best.offset_s + photos.tick_s / 2.0
    inside = np.count_nonzero((predicted_s > event_s[0] - 1.0) & (predicted_s < event_s[-1] + 1.0))
    if best.matched < max(FEWEST_MATCHES, _LEAST_SHARE * inside):
        return Refusal((f"at best {best.matched} of {len(photos.records)} photos have an event of {events.stream}",))
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
    log_ns = np.where(has, events.time_ns[np.maximum(best.event, 0)], _log_ns(line, shared_ns))
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
    """How well the events tell the offset; within a coarse tick, what the spread of the residuals leaves open.

    Exposures on the beat of a coarse clock all show the same fraction of it: no number of them tells which.
    """
    known = best.residual_s[np.isfinite(best.residual_s)]
    averaged_s = best.sigma_s / np.sqrt(len(known))
    if tick_s < COARSE_TICK_S:
        return float(averaged_s)
    return float(max(tick_s - np.ptp(known), averaged_s) / np.sqrt(12.0))


def _prior(photos: PhotoTimes, line: Timeline, stated_s: float | None) -> tuple[float, float] | None:
    """What else says the offset to UTC, s; nothing where the log knows no UTC."""
    if line.clock is None:
        return None
    if stated_s is not None:
        return stated_s, float(np.hypot(_STATED_SIGMA_S, line.clock.sigma_s))
    return (0.0, float(np.hypot(_TRUSTED_SIGMA_S, line.clock.sigma_s))) if photos.trusted else None


def _undecided(events: Events, best: Alignment, rival: Alignment, between_s: float, photos: int) -> str:
    return (
        f"the intervals of {events.stream} do not decide: an offset of {best.offset_s + between_s:+.2f} s fits "
        f"{best.matched} of {photos} photos, {rival.offset_s + between_s:+.2f} s fits {rival.matched}"
    )


def _by_places(photos: PhotoTimes, line: Timeline) -> ClockMatch | Refusal:
    """By where the photos say they were."""
    tagged = [k for k, record in enumerate(photos.records) if record.position is not None]
    if line.positions is None or len(tagged) < FEWEST_MATCHES:
        return Refusal(("the photos hold no positions to find the time by",) if line.positions is not None else ())
    frame, track_m = level_track(line.positions)
    places = [photos.records[k].position for k in tagged]
    latitude, longitude = (np.array([getattr(p, name) for p in places]) for name in ("latitude_deg", "longitude_deg"))
    photo_m = frame.enu_from_geodetic(latitude, longitude, np.full(len(tagged), frame.height_m))
    shared_ns = line.utc_ns(line.positions.time_ns)
    base_photo, base_log = int(photos.time_ns[0]), int(shared_ns[0])
    photo_s = (photos.time_ns - base_photo) / 1e9 + photos.tick_s / 2.0
    fit = offset_by_place(photo_s[tagged], photo_m[:, :2], (shared_ns - base_log) / 1e9, track_m[:, :2])
    if fit is None:
        return Refusal(("the log's track is too short to find the photos on",))
    if fit.problem:
        return Refusal((fit.problem,))
    at_ns = base_log + np.rint((photo_s + fit.offset_s) * 1e9).astype(np.int64)
    what = "images" if photos.of_log else "photos"
    sigma_s = float(np.hypot(fit.sigma_s, photos.tick_s / np.sqrt(12.0)))
    return _by_offset(
        photos, line, at_ns, sigma_s, f"positions of {fit.anchors} {what} on {line.positions.stream}",
        fit.offset_s + (base_log - base_photo) / 1e9, fit.anchors,
        f"no camera events: positions tell the clock to {fit.sigma_s:.2f} s",
    )  # fmt: skip


def _as_said(photos: PhotoTimes, line: Timeline, stated_s: float | None) -> ClockMatch | Refusal:
    """By the user's word, or the file's."""
    stream = line.positions if line.positions is not None else line.local
    if line.clock is None:
        return Refusal(("the log knows no UTC",))
    if stream is None or not len(photos.time_ns):
        return Refusal(())
    if stated_s is None and not photos.trusted:
        return Refusal((_zoneless(photos, line.utc_ns(stream.time_ns)),))
    header = photos.of_log and stated_s is None
    offset_s = stated_s or 0.0
    at_ns = photos.time_ns + round((offset_s + (0.0 if header else photos.tick_s / 2.0)) * 1e9)
    shared_ns = line.utc_ns(stream.time_ns)
    if not np.any((at_ns >= shared_ns[0]) & (at_ns <= shared_ns[-1])):
        what = "images" if photos.of_log else "photos"
        return Refusal((no_overlap_hint(photos.time_ns, int(shared_ns[0]), int(shared_ns[-1]), what),))
    sigma_s = _said_sigma_s(photos, line.clock, stated_s, header=header)
    method = "stated by the user" if stated_s is not None else f"said by the files ({photos.records[0].time_source})"
    note = "" if header else "nothing checks this offset: no camera events, no positions"
    return _by_offset(photos, line, at_ns, sigma_s, method, offset_s, 0, note)


def _zoneless(photos: PhotoTimes, shared_ns: Nanoseconds) -> str:
    """What is missing of times without a zone, and the zone that would bring them into the log."""
    if photos.of_log:
        return "their own log knows no UTC"
    hint = no_overlap_hint(photos.time_ns, int(shared_ns[0]), int(shared_ns[-1]), "photos")
    return f"the photos do not say their time zone; {hint}"


def _said_sigma_s(photos: PhotoTimes, clock: ClockFit, stated_s: float | None, *, header: bool) -> float:
    """How far the exposures may be off where nothing checks the offset: both clocks' errors, and the tick."""
    if header:
        own_s = _HEADER_SIGMA_S
    elif stated_s is not None or all(record.time_source in _BY_SATELLITE for record in photos.records):
        own_s = _STATED_SIGMA_S
    else:
        # A zone beside the time does not make the clock right: somebody set it by hand or by telephone.
        own_s = _TRUSTED_SIGMA_S
    return float(np.sqrt(own_s**2 + clock.sigma_s**2 + (0.0 if header else photos.tick_s**2 / 12.0)))


def _by_offset(
    photos: PhotoTimes,
    line: Timeline,
    shared_ns: Nanoseconds,
    sigma_s: float,
    method: str,
    offset_s: float,
    anchors: int,
    note: str,
) -> ClockMatch:
    n = len(photos.records)
    return ClockMatch(
        _log_ns(line, shared_ns), np.full(n, sigma_s), np.full(n, -1, np.int64), ("",) * n,
        method, offset_s, 0.0, sigma_s, None, anchors, None, note,
    )  # fmt: skip


def no_overlap_hint(time_ns: Nanoseconds, first_ns: int, last_ns: int, what: str) -> str:
    """Which whole quarter of an hour would put most photos inside the log, as a sentence.

    Args:
        time_ns: (n,) of the photos, read as UTC.
        first_ns: Begin of the log, UTC.
        last_ns: Its end.
        what: "photos" or "images", for people.
    """
    quarters = np.arange(-14 * 4, 14 * 4 + 1) * _QUARTER_S
    inside = []
    for quarter_s in quarters.tolist():
        at_ns = time_ns + quarter_s * 1_000_000_000
        inside.append(int(np.count_nonzero((at_ns >= first_ns) & (at_ns <= last_ns))))
    best = int(np.argmax(inside))
    if not inside[best]:
        days = abs(int(np.median(time_ns)) - (first_ns + last_ns) // 2) / 86_400e9
        apart = f"{days:.0f} days" if days > 2.0 else f"{24.0 * days:.0f} h"
        return f"times of {what} and log are {apart} apart, whatever the time zone: is it the log of this flight?"
    return (
        f"an offset of {int(quarters[best])} s would put {inside[best]} of {len(time_ns)} {what} inside the "
        f"log: --set ingest.clock_offset_s={int(quarters[best])}"
    )


def _log_ns(line: Timeline, shared_ns: Nanoseconds) -> Nanoseconds:
    """From the time photos and log share back to the log's own clock."""
    if line.clock is None:
        return shared_ns
    guess = shared_ns - line.clock.offset_ns
    # The drift is parts per million: one step is exact to a nanosecond.
    return guess - (line.clock.apply(guess) - shared_ns)


def _ns(time: datetime) -> int:
    since = time - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * 1_000_000_000 + since.microseconds * 1000


def _tick_s(time_ns: Nanoseconds) -> float:
    """The resolution of times: the coarsest decimal step that all of them lie on."""
    for tick_ns in (1_000_000_000, 100_000_000, 10_000_000, 1_000_000):
        if np.all(time_ns % tick_ns == 0):
            return tick_ns / 1e9
    return _FINEST_TICK_S
