"""Instants in logs: since 1970 or since boot, and the anchors that tie one clock to the other."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np

from pipeline.sources.records import NS_PER_S, Nanoseconds, TimeBase

UNIX_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
# Clocks that were set are past September 2001; one that counts from a start never gets as far (31 years).
UTC_FROM_NS = 1_000_000_000 * NS_PER_S
# Drift of an autopilot's clock over a flight is far below. What differs more is from before the clock was set, from
# before the receiver knew the leap seconds, or damaged.
_LARGEST_CHANGE_NS = 2 * NS_PER_S


def unix_us(moment: datetime) -> int:
    """Microseconds since 1970 of a moment with its zone."""
    return (moment - UNIX_EPOCH) // timedelta(microseconds=1)


def boot_time_base(log_ns: Nanoseconds, utc_ns: Nanoseconds, source: str, *, late: bool) -> TimeBase:
    """Ties a clock since boot to UTC, by those anchors that agree with most of the others.

    Args:
        log_ns: (k,) instants since boot, k > 0.
        utc_ns: (k,) the same in UTC.
        source: The message that says so, for people.
        late: As in `TimeBase`.

    Returns:
        The time base, its anchors in the order of the log's clock; what was left out is its problem.
    """
    change_ns = utc_ns - log_ns
    # One of the values, not the mean of two: where two anchors disagree, one of them stays.
    middle_ns = np.sort(change_ns)[(len(change_ns) - 1) // 2]
    good = np.abs(change_ns - middle_ns) <= _LARGEST_CHANGE_NS
    order = np.argsort(log_ns[good], kind="stable")
    odd = len(good) - int(np.count_nonzero(good))
    problem = f"{odd} of {len(good)} {source} messages name another time and were left out" if odd else ""
    return TimeBase("boot", log_ns[good][order], utc_ns[good][order], late, source, problem)
