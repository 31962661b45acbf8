"""Exposures in MAVLink: what the camera or the autopilot reported of each, on the autopilot's clock.

Source: https://mavlink.io/en/messages/common.html and https://mavlink.io/en/messages/ardupilotmega.html.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Bools, Ints
from pipeline.sources.mavlink.clock import HOUR_NS, UNIX_FROM_US, BootClock, log_from_utc
from pipeline.sources.mavlink.frames import LATEST_STAMP_US, Rows
from pipeline.sources.records import NS_PER_MS, NS_PER_US, Events, Nanoseconds, TimeBase
from pipeline.sources.streams import FEEDBACK_SIGMA_S, TRIGGER_SIGMA_S

# CAMERA_FEEDBACK_FLAGS: a frame of a video is no photo, and an open loop only asked for one.
_VIDEO, _OPEN_LOOP = 1, 4
# Dates of a clock that is tied to the autopilot's by arrivals alone are off by the link's delay.
_ARRIVAL_SIGMA_S = 0.2


@dataclass(frozen=True, slots=True)
class Placed:
    """Event streams, and what could not be placed in time.

    Args:
        events: The streams.
        losses: One sentence each.
    """

    events: tuple[Events, ...]
    losses: tuple[str, ...]


def camera_feedback(rows: Rows, label: str, clock: BootClock, base: TimeBase) -> Placed:
    """Exposures by CAMERA_FEEDBACK: only its time and number are of the exposure.

    Args:
        rows: Of one camera.
        label: Name of the stream.
        clock: The autopilot's boot.
        base: Its time base.

    Returns:
        Streams of exposures that the camera reported, and of those only asked for.
    """
    photos = rows[rows["flags"] != _VIDEO]
    time_ns, known = _times(photos, clock, base)
    numbers, asked = photos["img_idx"].astype(np.int64), photos["flags"] == _OPEN_LOOP
    least_s = _least_sigma_s(photos, base)
    sigma_s, asked_sigma_s = max(FEEDBACK_SIGMA_S, least_s), max(TRIGGER_SIGMA_S, least_s)
    found = (
        _events(label, time_ns, numbers, known & ~asked, feedback=True, sigma_s=sigma_s),
        _events(f"{label} (open loop)", time_ns, numbers, known & asked, feedback=False, sigma_s=asked_sigma_s),
    )
    return Placed(tuple(events for events in found if events is not None), _unplaced(label, known))


def camera_trigger(rows: Rows, label: str, clock: BootClock, base: TimeBase) -> Placed:
    """Triggers by CAMERA_TRIGGER, arguments and result as of `camera_feedback`."""
    time_ns, known = _times(rows, clock, base)
    numbers = rows["seq"].astype(np.int64)
    sigma_s = max(TRIGGER_SIGMA_S, _least_sigma_s(rows, base))
    events = _events(label, time_ns, numbers, known, feedback=False, sigma_s=sigma_s)
    return Placed(() if events is None else (events,), _unplaced(label, known))


def image_captured(rows: Rows, label: str, clock: BootClock, shift_ns: int = 0) -> Placed:
    """Exposures by CAMERA_IMAGE_CAPTURED, which a camera sends again when it is asked to.

    Args:
        rows: Of one camera.
        label: Name of the stream.
        clock: The autopilot's boot.
        shift_ns: The autopilot's clock minus the sender's.

    Returns:
        The stream.
    """
    taken = rows[rows["capture_result"] == 1]
    time_ns = taken["time_boot_ms"].astype(np.int64) * NS_PER_MS + shift_ns
    known = np.abs(time_ns - clock.of_arrival(taken)) <= HOUR_NS
    # A clock that was only fitted by arrivals is no better than those.
    sigma_s = TRIGGER_SIGMA_S if shift_ns else FEEDBACK_SIGMA_S
    numbers = taken["image_index"].astype(np.int64)
    images = [bytes(url).split(b"\0", 1)[0].decode("utf-8", "replace") for url in taken["file_url"]]
    events = _events(label, time_ns, numbers, known, feedback=True, sigma_s=sigma_s, images=images)
    failed = len(rows) - len(taken)
    losses = [f"{failed} {label} messages tell of a capture that failed"] if failed else []
    return Placed(() if events is None else (events,), (*losses, *_unplaced(label, known)))


def _times(rows: Rows, clock: BootClock, base: TimeBase) -> tuple[Nanoseconds, Bools]:
    """Times on the log's clock of messages that count from 1970 or from boot, told by magnitude."""
    usec = rows["time_usec"]
    dated = (usec >= UNIX_FROM_US) & (usec < LATEST_STAMP_US)
    time_ns = np.full(len(rows), -1, np.int64)
    time_ns[dated] = log_from_utc(base, usec[dated].astype(np.int64) * NS_PER_US)
    since_boot = (usec > 0) & (usec < UNIX_FROM_US)
    time_ns[since_boot] = usec[since_boot].astype(np.int64) * NS_PER_US
    known: Bools = (time_ns >= 0) & (np.abs(time_ns - clock.of_arrival(rows)) <= HOUR_NS)
    return time_ns, known


def _least_sigma_s(rows: Rows, base: TimeBase) -> float:
    """What the tie between UTC and the autopilot's clock adds to events that are dated, s."""
    dated = bool(np.any(rows["time_usec"] >= UNIX_FROM_US))
    return _ARRIVAL_SIGMA_S if dated and base.source != "SYSTEM_TIME" else 0.0


def _events(
    label: str,
    time_ns: Nanoseconds,
    numbers: Ints,
    known: Bools,
    *,
    feedback: bool,
    sigma_s: float,
    images: list[str] | None = None,
) -> Events | None:
    index = np.flatnonzero(known)
    if not len(index):
        return None
    # Heard over two links, or sent again: the same exposure comes once.
    order = index[np.lexsort((numbers[index], time_ns[index]))]
    changed = (np.diff(time_ns[order]) != 0) | (np.diff(numbers[order]) != 0)
    order = order[np.concatenate([[True], changed])]
    names = tuple(images[i] for i in order.tolist()) if images is not None else ()
    return Events(label, time_ns[order], numbers[order], feedback, sigma_s, names)


def _unplaced(label: str, known: Bools) -> tuple[str, ...]:
    lost = len(known) - int(np.count_nonzero(known))
    if not lost:
        return ()
    return (f"{lost} of {len(known)} {label} messages have a time that cannot be tied to the autopilot's clock",)
