"""The times of a camera's photos, and what brings them onto a log's clock."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np

from pipeline.clocks.fit import Nanoseconds
from pipeline.geometry.arrays import Floats, Ints
from pipeline.placing.timeline import Timeline
from pipeline.sources.photos import PhotoRecord
from pipeline.sources.records import Events
from pipeline.sources.time_bases import UNIX_EPOCH

# Which time tags say UTC: the others are a local time whose zone nobody wrote down.
TRUSTED = frozenset({"utc_at_exposure", "gps", "exif+offset", "exif+gps zone"})
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
    times = np.array([ns_of(r.time) for r in timed if r.time is not None], np.int64)
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
    return (0 if record.time is None else ns_of(record.time)), by_number(record.frame_id)


def span_text(first_ns: int, last_ns: int) -> str:
    """Two instants of UTC, ns since 1970, as one span for people."""
    first, last = (datetime.fromtimestamp(t / 1e9, UTC) for t in (first_ns, last_ns))
    return f"{first:%Y-%m-%d %H:%M:%S} .. {last:%H:%M:%S}"


def ns_of(time: datetime) -> int:
    """Nanoseconds since 1970."""
    since = time - UNIX_EPOCH
    return (since.days * 86_400 + since.seconds) * 1_000_000_000 + since.microseconds * 1000


def _tick_s(time_ns: Nanoseconds) -> float:
    """The resolution of times: the coarsest decimal step that all of them lie on."""
    for tick_ns in (1_000_000_000, 100_000_000, 10_000_000, 1_000_000):
        if np.all(time_ns % tick_ns == 0):
            return tick_ns / 1e9
    return _FINEST_TICK_S
