"""A camera's clock against a log's: by trigger events, by places, by what the user or the files say, in that order.

Order alone never decides which photo is which exposure: one lost frame would shift all that follow. What one of them
decides must not contradict the others: neither a stated offset nor the places of the photos.
"""

from __future__ import annotations

import numpy as np

from pipeline.clocks.fit import ClockFit, Nanoseconds
from pipeline.clocks.offsets import FEWEST_MATCHES
from pipeline.clocks.places import offset_by_place
from pipeline.geometry.arrays import Floats, Ints
from pipeline.placing.by_events import by_events
from pipeline.placing.photo_clock import ClockMatch, PhotoTimes, Refusal
from pipeline.placing.pose import LONGEST_POSITION_GAP_S, level_track
from pipeline.placing.timeline import Timeline
from pipeline.sources.records import Positions
from pipeline.tracks.series import between, bracket

# Photo clocks that say UTC themselves are this near it, and users state offsets to a good half second.
_TRUSTED_SIGMA_S = 2.0
_STATED_SIGMA_S = 0.4
# A stated offset that the log contradicts by more was meant otherwise; whole seconds are usual.
_STATED_SLACK_S = 1.5
# Position tags lag by seconds; what is further off than that is another place.
_ELSEWHERE_M = 500.0
_HEADER_SIGMA_S = 0.001
_BY_SATELLITE = frozenset({"utc_at_exposure", "gps"})
_QUARTER_S = 900


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
    # What else says the offset is asked only where the intervals alone leave it open.
    prior = _prior(photos, line, stated_s)
    for events in line.events:
        found = by_events(photos, line, events, None)
        if isinstance(found, Refusal) and prior is not None:
            found = by_events(photos, line, events, prior)
        if isinstance(found, ClockMatch):
            return _unless_contradicted(photos, line, found, stated_s)
        refusals += found.reasons
    if stated_s is None:
        by_place = _by_places(photos, line)
        if isinstance(by_place, ClockMatch):
            return by_place
        refusals += by_place.reasons
    by_clock = _as_said(photos, line, stated_s)
    if isinstance(by_clock, ClockMatch):
        return _unless_contradicted(photos, line, by_clock, stated_s)
    return Refusal((*refusals, *by_clock.reasons))


def _unless_contradicted(
    photos: PhotoTimes, line: Timeline, match: ClockMatch, stated_s: float | None
) -> ClockMatch | Refusal:
    """A match, unless the user or the photos' own positions say otherwise: somebody is wrong, and who is not known."""
    slack_s = _STATED_SLACK_S + photos.tick_s
    if stated_s is not None and line.clock is not None and abs(match.offset_s - stated_s) > slack_s:
        told = (
            f"ingest.clock_offset_s says {stated_s:+g} s, the {match.method} say {match.offset_s:+.2f} s: leave it out "
            f"(or --set ingest.clock_offset_s={match.offset_s:.1f}) if they are right"
        )
        return Refusal((told,))
    apart_m = _apart_m(photos, line, match)
    if apart_m > _ELSEWHERE_M:
        apart = f"{apart_m / 1000.0:.0f} km" if apart_m > 10_000.0 else f"{apart_m:.0f} m"
        return Refusal((f"the photos' own positions are {apart} from where the log was then: another flight's log?",))
    return match


def _apart_m(photos: PhotoTimes, line: Timeline, match: ClockMatch) -> float:
    """Median level distance of photos from where the log puts their instants; 0 where either has no positions."""
    if line.positions is None:
        return 0.0
    tagged, track_m, photo_m = _places(photos, line.positions)
    where = bracket(line.positions.time_ns, line.positions.segment, match.log_ns[tagged], LONGEST_POSITION_GAP_S)
    apart_m = np.linalg.norm(between(track_m, where)[:, :2] - photo_m[:, :2], axis=1)
    known = apart_m[np.isfinite(apart_m)]
    return float(np.median(known)) if len(known) else 0.0


def _places(photos: PhotoTimes, positions: Positions) -> tuple[Ints, Floats, Floats]:
    """Which photos have positions, the track (n, 3) and those positions (k, 3), in one frame, m."""
    tagged = np.array([k for k, record in enumerate(photos.records) if record.position is not None], np.int64)
    places = [photos.records[k].position for k in tagged]
    frame, track_m = level_track(positions)
    latitude, longitude = (
        np.array([getattr(place, name) for place in places], np.float64) for name in ("latitude_deg", "longitude_deg")
    )
    return tagged, track_m, frame.enu_from_geodetic(latitude, longitude, np.full(len(tagged), frame.height_m))


def _prior(photos: PhotoTimes, line: Timeline, stated_s: float | None) -> tuple[float, float] | None:
    """What else says the offset to UTC, s; nothing where the log knows no UTC."""
    if line.clock is None:
        return None
    if stated_s is not None:
        return stated_s, float(np.hypot(_STATED_SIGMA_S, line.clock.sigma_s))
    return (0.0, float(np.hypot(_TRUSTED_SIGMA_S, line.clock.sigma_s))) if photos.trusted else None


def _by_places(photos: PhotoTimes, line: Timeline) -> ClockMatch | Refusal:
    """By where the photos say they were."""
    if line.positions is None:
        return Refusal(())
    tagged, track_m, photo_m = _places(photos, line.positions)
    if len(tagged) < FEWEST_MATCHES:
        return Refusal(("the photos hold no positions to find the time by",))
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
    unchecked = "the log's camera events do not confirm this offset" if line.events else "nothing checks this offset"
    note = "" if header else unchecked
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
        line.log_ns(shared_ns), np.full(n, sigma_s), np.full(n, -1, np.int64), ("",) * n,
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
