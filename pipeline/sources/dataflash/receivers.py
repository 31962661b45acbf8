"""GNSS receivers in DataFlash logs: fixes (GPS), their accuracy (GPA), and the clock that they tie to UTC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.clocks.gps import utc_ns_from_gps
from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.sources.dataflash.fields import Found
from pipeline.sources.dataflash.samples import Samples, nearest, samples
from pipeline.sources.records import NS_PER_MS, NS_PER_S, TimeBase, nothing
from pipeline.sources.streams import FIX_3D, LARGEST_SEPARATION_M, is_place
from pipeline.sources.time_bases import boot_time_base

# GPA is written with its GPS message, under the same time.
_SAME_NS = NS_PER_S // 2
# INT32_MIN stands for "unknown"; in centimetres it is this in metres.
_UNKNOWN_M = -1e6
# Accuracies are unsigned centimetres: 0 where the receiver says nothing, 65535 where they do not fit.
_LARGEST_ACCURACY_M = 655.0
# A sample is logged soon after it came.
_LONGEST_WAY_S = 1.0
_MOST_SANE = 0.9


@dataclass(frozen=True, slots=True)
class Receiver:
    """One receiver's fixes.

    Args:
        fixes: GPS messages with a 3D fix.
        outage: (n,) changes wherever messages without a fix lie between two with one.
        ellipsoidal_m: (n,) heights above the ellipsoid, NaN where not logged.
        sigma_horizontal_m: (n,) NaN where not logged.
        sigma_vertical_m: (n,) NaN where not logged.
        sample_s: (n,) when the sample came, by the receiver's driver, seconds since boot; NaN where not logged.
    """

    fixes: Samples
    outage: Ints
    ellipsoidal_m: Floats
    sigma_horizontal_m: Floats
    sigma_vertical_m: Floats
    sample_s: Floats


def receivers(found: Found) -> list[Receiver]:
    """The receivers of a log, the primary first.

    Args:
        found: What the walk found.

    Returns:
        Those that had a fix.
    """
    out = []
    for name, accuracy in (("GPS", "GPA"), ("GPS2", "GPA2")):
        accuracies = samples(found, accuracy, ())
        for stream in samples(found, name, ("Status", "Lat", "Lng")):
            fixed = stream.columns["Status"] >= FIX_3D
            placed = is_place(stream.columns["Lat"], stream.columns["Lng"])
            if not (fixed & placed).any():
                found.losses.append(f"no GPS fix in {stream.stream}")
                continue
            own = next((s for s in accuracies if s.instance == stream.instance), None)
            out.append(_receiver(stream, fixed & placed, own, found.losses))
    return out


def _receiver(stream: Samples, good: Bools, accuracy: Samples | None, losses: list[str]) -> Receiver:
    fixes = stream.pick(good)
    outage = np.cumsum(~good)[good].astype(np.int64)
    n = len(fixes.time_ns)
    if accuracy is None:
        return Receiver(fixes, outage, nothing(n), nothing(n), nothing(n), nothing(n))
    index = nearest(accuracy.time_ns, fixes.time_ns, _SAME_NS)

    def told(name: str, low: float, high: float) -> Floats:
        values = accuracy.first(name)
        return np.where(index >= 0, np.where((values > low) & (values < high), values, np.nan)[index], np.nan)

    # Older firmware logged Und, which is the height above sea level minus the one above the ellipsoid.
    above_m, undulation_m = told("AEl", _UNKNOWN_M, np.inf), told("Und", _UNKNOWN_M, np.inf)
    ellipsoidal_m = np.where(np.isfinite(above_m), above_m, fixes.first("Alt") - undulation_m)
    far = np.abs(ellipsoidal_m - fixes.first("Alt")) > LARGEST_SEPARATION_M
    if far.any():
        losses.append(
            f"{np.count_nonzero(far)} heights above the ellipsoid of {fixes.stream} are more than "
            f"{LARGEST_SEPARATION_M:.0f} m from its height above sea level and were left out"
        )
    sample_s = told("SMS", 0.0, np.inf) / 1e3
    way_s = fixes.time_ns / NS_PER_S - sample_s
    return Receiver(
        fixes,
        outage,
        np.where(far, np.nan, ellipsoidal_m),
        told("HAcc", 0.0, _LARGEST_ACCURACY_M),
        told("VAcc", 0.0, _LARGEST_ACCURACY_M),
        # Milliseconds are cut off, so a sample is never logged before its time.
        np.where((way_s >= 0.0) & (way_s <= _LONGEST_WAY_S), sample_s, np.nan),
    )


def time_base(seen: Sequence[Receiver]) -> TimeBase:
    """What ties the clock since boot to UTC: the first receiver that tells GPS time.

    GPA.SMS is when the driver took the sample in, its jitter removed, and so steadier than when GPS was written; the
    receiver's own latency is in both (the filter subtracts GPS1_DELAY_MS, or what the driver knows, from SMS).

    Args:
        seen: Receivers, the primary first.

    Returns:
        The time base; without anchors when there is no GPS time.

    Source: ArduPilot, AP_GPS.cpp (update_instance, Write_GPS), GPS_Backend.cpp (check_new_itow),
    AP_NavEKF3_Measurements.cpp (readGpsData).
    """
    for receiver in seen:
        fixes = receiver.fixes
        old = "GWk" not in fixes.columns
        week, ms = fixes.first("Week" if old else "GWk"), fixes.first("TimeMS" if old else "GMS")
        told = np.isfinite(week) & np.isfinite(ms)
        utc_ns = np.full(len(told), -1, np.int64)
        utc_ns[told] = utc_ns_from_gps(week[told].astype(np.int64), ms[told] / 1e3)
        # A receiver that repeats itself is written again later: the first time counts.
        fresh = np.concatenate([[True], np.diff(utc_ns) != 0])
        good = (utc_ns > 0) & fresh
        sampled = good & np.isfinite(receiver.sample_s)
        by_sample = np.count_nonzero(sampled) >= _MOST_SANE * np.count_nonzero(good)
        good = sampled if by_sample else good
        if not good.any():
            continue
        log_ns = fixes.time_ns[good]
        if by_sample:
            log_ns = np.rint(receiver.sample_s[good] * 1e3).astype(np.int64) * NS_PER_MS
        source = f"{fixes.stream} ({'GPA.SMS' if by_sample else 'as written'})"
        return boot_time_base(log_ns, utc_ns[good], source, late=True)
    return TimeBase("boot", problem="boot time only: no GPS time in the log")
