"""The autopilot's clock in a telemetry log: since boot, with restarts told apart, and what ties it to UTC.

Messages carry milliseconds since the autopilot's start; the log's own stamps are the ground station's clock at their
arrival, late by the radio link. So times are those of the messages, and stamps serve only where a message has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Ints
from pipeline.sources.mavlink.frames import LATEST_STAMP_US, Rows
from pipeline.sources.records import NS_PER_MS, NS_PER_US, Nanoseconds, TimeBase
from pipeline.sources.streams import FIX_3D, in_order
from pipeline.sources.time_bases import UTC_FROM_NS, boot_time_base

# A number of microseconds this large is a date, a smaller one counts from boot.
UNIX_FROM_US = UTC_FROM_NS // NS_PER_US
HOUR_NS = 3_600_000_000_000
# A clock that falls back this far has restarted; packets overtake one another by less.
_LEAP_MS = 5_000
# A later start is told from a gap in reception by the ground station's clock, when the two disagree by so much.
_OTHER_START_MS = 60_000
# Messages on each side of a restart that must agree on it.
_SUSTAINED = 5
# Neighbours on each side that a message without a time of its own is placed by.
_NEIGHBOURS = 8
_BATCH = 1 << 16
# SYSTEM_TIME messages on each side of an instant that is brought from UTC to the log's clock.
_ANCHORS = 30
# Arrival stamps further from the median are damaged: nothing checks them.
_STAMP_NS = 10_000_000_000
_ARRIVAL_WINDOW_NS = 60_000_000_000


def restarts(at: Ints, stamp_us: Ints, boot_ms: Ints) -> Ints:
    """Where in the log the autopilot's clock began anew.

    Args:
        at: (n,) places of its messages in the log, in order.
        stamp_us: (n,) arrivals, -1 where unknown.
        boot_ms: (n,) their times since boot.

    Returns:
        (k,) places of the first message of each boot but the first.
    """
    steps_ms = np.diff(boot_ms)
    leaps = np.flatnonzero(np.abs(steps_ms) > _LEAP_MS) + 1
    leaps = leaps[(leaps >= _SUSTAINED) & (leaps <= len(at) - _SUSTAINED)]
    before = leaps[:, None] + np.arange(-_SUSTAINED, 0)
    after = leaps[:, None] + np.arange(_SUSTAINED)
    falls = boot_ms[after].max(axis=1) + _LEAP_MS < boot_ms[before].min(axis=1)
    # The ground station's clock may be set in mid-flight, but reception does not stop for that.
    late_before, late_after = (stamp_us[side] // 1000 - boot_ms[side] for side in (before, after))
    later = late_after.min(axis=1) - late_before.max(axis=1) > _OTHER_START_MS
    begins: Ints = at[leaps[falls | ((steps_ms[leaps - 1] > 0) & later)]]
    return begins


@dataclass(frozen=True, slots=True)
class BootClock:
    """One boot of the autopilot: times of its messages against their order and their arrival.

    Args:
        begin: Place in the log where the boot begins.
        end: Place behind it.
        at: (n,) places of the autopilot's messages that carry a time since boot, in order.
        boot_ns: (n,) those times.
        late_ns: (n,) arrival minus boot time; the median of all where a stamp is no time.
    """

    begin: int
    end: int
    at: Ints
    boot_ns: Nanoseconds
    late_ns: Nanoseconds

    def during(self, rows: Rows) -> Rows:
        """The messages that came during this boot, of messages in order."""
        return _between(rows, self.begin, self.end)

    def of_arrival(self, rows: Rows) -> Nanoseconds:
        """Boot time at which messages without a time of their own were sent, (m,) ns.

        Their arrival less the delay of their neighbours, and between the times of the messages before and behind:
        the stamps jitter by a second on a slow link, and the order is sure.
        """
        parts = [self._of_arrival(rows[i : i + _BATCH]) for i in range(0, len(rows), _BATCH)]
        return np.concatenate(parts) if parts else np.empty(0, np.int64)

    def _of_arrival(self, rows: Rows) -> Nanoseconds:
        last = len(self.at) - 1
        right = np.searchsorted(self.at, rows["at"])
        near = np.clip(right[:, None] + np.arange(-_NEIGHBOURS, _NEIGHBOURS), 0, last)
        delay = np.median(self.late_ns[near], axis=1).astype(np.int64)
        one, other = self.boot_ns[np.clip(right - 1, 0, last)], self.boot_ns[np.clip(right, 0, last)]
        earliest, latest = np.minimum(one, other), np.maximum(one, other)
        sent = np.where(rows["stamp"] >= 0, rows["stamp"] * NS_PER_US - delay, (earliest + latest) // 2)
        return np.clip(sent, earliest, latest)


def boot_clock(rows: Rows, span: tuple[int, int]) -> BootClock | None:
    """The clock of one boot.

    Args:
        rows: The autopilot's messages with "time_boot_ms", in order.
        span: Places in the log where the boot begins and ends.

    Returns:
        The clock; None without a message.
    """
    rows = _between(rows, *span)
    boot_ns = rows["time_boot_ms"].astype(np.int64) * NS_PER_MS
    if not len(rows):
        return None
    kept = in_order(boot_ns)
    if not kept.all():
        rows, boot_ns = rows[kept], boot_ns[kept]
    stamped = rows["stamp"] >= 0
    late_ns = rows["stamp"] * NS_PER_US - boot_ns
    late_ns[~stamped] = int(np.median(late_ns[stamped])) if stamped.any() else 0
    return BootClock(*span, rows["at"], boot_ns, late_ns)


def _between(rows: Rows, begin: int, end: int) -> Rows:
    """The rows at places from `begin` to before `end`, without a copy."""
    first, behind = np.searchsorted(rows["at"], (begin, end)).tolist()
    return rows[first:behind]


def orderly(at: Ints, time_ns: Nanoseconds) -> Ints:
    """Which samples to take, in the order of time, each instant once.

    Packets overtake one another and arrive twice over two links; a time that is seconds from those around it is of
    another boot.

    Args:
        at: (n,) places in the log, in order.
        time_ns: (n,).

    Returns:
        (m,) indices.
    """
    if not len(at):
        return np.empty(0, np.int64)
    kept = in_order(time_ns)
    expected = np.interp(at, at[kept], time_ns[kept])
    near = np.flatnonzero(np.abs(time_ns - expected) <= _LEAP_MS * NS_PER_MS)
    near = near[np.argsort(time_ns[near], kind="stable")]
    out: Ints = near[np.concatenate([[True], np.diff(time_ns[near]) > 0])]
    return out


def time_base(clock: BootClock, system_time: Rows | None, gps: Rows | None) -> TimeBase:
    """What ties the clock of a boot to UTC: the autopilot's word, else the receiver's, else the ground station's.

    Args:
        clock: The boot.
        system_time: The autopilot's SYSTEM_TIME of that boot.
        gps: Its GPS_RAW_INT of that boot.

    Returns:
        The time base.
    """
    if system_time is not None:
        dated = (system_time["time_unix_usec"] >= UNIX_FROM_US) & (system_time["time_boot_ms"] > 0)
        rows = system_time[dated & (system_time["time_unix_usec"] < LATEST_STAMP_US)]
        if len(rows):
            log_ns = rows["time_boot_ms"].astype(np.int64) * NS_PER_MS
            return boot_time_base(
                log_ns, rows["time_unix_usec"].astype(np.int64) * NS_PER_US, "SYSTEM_TIME", late=False
            )
    if gps is not None:
        rows = gps[
            (gps["time_usec"] >= UNIX_FROM_US) & (gps["time_usec"] < LATEST_STAMP_US) & (gps["fix_type"] >= FIX_3D)
        ]
        if len(rows):
            utc_ns = rows["time_usec"].astype(np.int64) * NS_PER_US
            return boot_time_base(clock.of_arrival(rows), utc_ns, "GPS_RAW_INT", late=True)
    return _by_arrival(clock)


def _by_arrival(clock: BootClock) -> TimeBase:
    """Anchors by the ground station's stamps: of each minute the message that was least late.

    Here UTC is late and not the log's clock, so `TimeBase.late` does not describe it.
    """
    stamped = np.abs(clock.late_ns - np.median(clock.late_ns)) <= _STAMP_NS
    boot_ns, late_ns = clock.boot_ns[stamped], clock.late_ns[stamped]
    if not len(late_ns) or np.median(late_ns) <= 0:
        return TimeBase("boot", problem="nothing in the log ties the autopilot's clock to UTC")
    order = np.lexsort((late_ns, boot_ns // _ARRIVAL_WINDOW_NS))
    _, first = np.unique((boot_ns // _ARRIVAL_WINDOW_NS)[order], return_index=True)
    best = order[first]
    return TimeBase(
        "boot",
        boot_ns[best],
        boot_ns[best] + late_ns[best],
        source="ground station's clock at arrival",
        problem="the autopilot never told UTC: times are the ground station's clock, wrong by its error and by the "
        "link's delay",
    )


def log_from_utc(base: TimeBase, utc_ns: Nanoseconds) -> Nanoseconds:
    """Instants of UTC on the log's clock, by the anchors around each.

    Args:
        base: The time base.
        utc_ns: (n,) as the autopilot tells UTC.

    Returns:
        (n,) ns since boot; -1 where no anchor lies within an hour.
    """
    parts = [_log_from_utc(base, utc_ns[i : i + _BATCH]) for i in range(0, len(utc_ns), _BATCH)]
    return np.concatenate(parts) if parts else np.empty(0, np.int64)


def _log_from_utc(base: TimeBase, utc_ns: Nanoseconds) -> Nanoseconds:
    anchors = base.anchor_utc_ns
    if not len(anchors):
        return np.full(len(utc_ns), -1, np.int64)
    right = np.searchsorted(anchors, utc_ns)
    near = np.clip(right[:, None] + np.arange(-_ANCHORS, _ANCHORS), 0, len(anchors) - 1)
    # Against one of them: a float does not hold nanoseconds since 1970.
    first_ns = int(anchors[0] - base.anchor_log_ns[0])
    offset_ns = (anchors - base.anchor_log_ns - first_ns)[near]
    # Arrivals are late by a varying delay: the largest offset is that of the earliest.
    offset = np.max(offset_ns, axis=1) if base.late else np.median(offset_ns, axis=1).astype(np.int64)
    apart = np.min(np.abs(anchors[near] - utc_ns[:, None]), axis=1)
    out: Nanoseconds = np.where(apart <= HOUR_NS, utc_ns - first_ns - offset, -1)
    return out
