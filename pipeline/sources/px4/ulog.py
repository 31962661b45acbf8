"""PX4 ULog (.ulg): positions, attitudes, camera events and GPS time of an autopilot's log."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import Any, Literal

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.sources.files import local_copy
from pipeline.sources.mavlink.gimbal_flags import yaw_frames
from pipeline.sources.px4.sieve import MAGIC, sift
from pipeline.sources.px4.topics import Topic, labelled, named
from pipeline.sources.records import NS_PER_US, Attitudes, Events, FlightLog, Nanoseconds, Positions, TimeBase, nothing
from pipeline.sources.streams import (
    FEEDBACK_SIGMA_S,
    FIX_3D,
    MM_PER_M,
    PER_DEG,
    TRIGGER_SIGMA_S,
    borrowed,
    interpolated,
    is_place,
    is_rotation,
    segments,
    separation_m,
    unit,
)
from pipeline.sources.time_bases import boot_time_base

_FUSED = "vehicle_global_position"
_RECEIVERS = ("sensor_gps", "vehicle_gps_position")
_VEHICLE, _GIMBAL = "vehicle_attitude", "gimbal_device_attitude_status"
_CAPTURE, _TRIGGER = "camera_capture", "camera_trigger"
_HOME, _AIR = "home_position", "vehicle_air_data"
_TOPICS = frozenset({_FUSED, *_RECEIVERS, _VEHICLE, _GIMBAL, _CAPTURE, _TRIGGER, _HOME, _AIR})
_FACTS = {"sys_name": "autopilot", "ver_hw": "hardware"}
_RELEASE, _CAPTURE_FEEDBACK = "ver_sw_release", "CAM_CAP_FBACK"
# What the library raises on messages it cannot make sense of.
_REFUSALS = (struct.error, ValueError, KeyError, IndexError, TypeError, OverflowError, RecursionError, MemoryError)
# UTC before 2010 or after 2100 is no time of a flight.
_FIRST_UTC_US, _LAST_UTC_US = 1_262_304_000_000_000, 4_102_444_800_000_000


def is_format(head: bytes, name: str) -> bool:  # noqa: ARG001 - the readers' common signature
    """Whether a file is a ULog: by its magic number."""
    return head.startswith(MAGIC)


def read(location: str) -> FlightLog:
    """Reads a PX4 ULog.

    Args:
        location: Path or URL.

    Returns:
        Positions, attitudes, camera events and GPS time. Fields are found by name; the names and units of all
        firmware versions are known.

    Raises:
        InputError: It is not there, no ULog, or nothing in it is whole.
        ResourceError: It may not be read.

    Source: PX4 user guide, "ULog File Format" and the uORB message reference (VehicleGlobalPosition, SensorGps,
    VehicleAttitude, GimbalDeviceAttitudeStatus, CameraCapture, CameraTrigger).
    """
    from pyulog import ULog  # noqa: PLC0415 - heavy
    from pyulog.core import ULogException  # noqa: PLC0415 - heavy

    with local_copy(location) as path:
        found, sifted = sift(path, location, _TOPICS, frozenset({*_FACTS, _RELEASE, _CAPTURE_FEEDBACK}))
    try:
        log = ULog(sifted, disable_str_exceptions=True)
    except (ULogException, *_REFUSALS) as error:
        raise InputError(
            "E-ULOG-02", "the ULog cannot be decoded", where=location, found=f"{type(error).__name__}: {error}",
            expected="messages as their definitions say", hint="copy it from the vehicle again",
        ) from error  # fmt: skip
    topics = [Topic(labelled(data.name, data.multi_id), data.name, data.data) for data in log.data_list]
    losses = list(found.losses)
    receivers = [stream for topic in named(topics, *_RECEIVERS) if (stream := _positions(topic, losses))]
    fused = [stream for topic in named(topics, _FUSED) if (stream := _positions(topic, losses))]
    heights = _Heights(topics, receivers)
    echoed = log.initial_parameters.get(_CAPTURE_FEEDBACK) == 0
    return FlightLog(
        location=location,
        kind="PX4 ULog",
        counts=found.counts,
        time_base=_time_base(named(topics, *_RECEIVERS)),
        positions=tuple(heights.filled(stream) for stream in (*fused, *receivers)),
        attitudes=tuple(_attitudes(topics, losses)),
        events=tuple(_events(topics, echoed, losses)),
        losses=tuple(losses),
        facts=_facts(log, len(found.dropout_ms)),
    )


def _positions(topic: Topic, losses: list[str]) -> Positions | None:
    """The positions of the filter or of a receiver; None when none is good."""
    fused = topic.name == _FUSED
    latitude = topic.scaled("latitude_deg", "lat", PER_DEG)
    longitude = topic.scaled("longitude_deg", "lon", PER_DEG)
    if np.all(np.isnan(latitude)) or np.all(np.isnan(longitude)):
        losses.append(f"{topic.label} has no latitude and longitude: its {len(topic)} records were left out")
        return None
    fixed = topic.flag("lat_lon_valid") if fused else topic.number("fix_type") >= FIX_3D
    # Without a fix nothing is lost that anybody had: only the others are told of.
    possible = is_place(latitude, longitude)
    time_us = topic.time_us(sampled=True)
    index = topic.kept(time_us, possible | ~fixed, losses)
    index = index[(possible & fixed)[index]]
    if not len(index):
        return None
    amsl = topic.scaled("altitude_msl_m", "alt", MM_PER_M)
    ellipsoidal = topic.scaled("altitude_ellipsoid_m", "alt_ellipsoid", MM_PER_M)
    heights_good = topic.flag("alt_valid")
    breaks = np.cumsum(~fixed) + topic.changes("lat_lon_reset_counter", "alt_reset_counter")
    time_ns = time_us[index] * NS_PER_US
    return Positions(
        stream=topic.label,
        time_ns=time_ns,
        latitude_deg=latitude[index],
        longitude_deg=longitude[index],
        ellipsoidal_m=_finite(np.where(heights_good, ellipsoidal, np.nan)[index]),
        amsl_m=_finite(np.where(heights_good, amsl, np.nan)[index]),
        above_home_m=nothing(len(index)),
        barometric_m=nothing(len(index)),
        sigma_horizontal_m=_sigma(topic.number("eph")[index]),
        sigma_vertical_m=_sigma(topic.number("epv")[index]),
        segment=segments(time_ns, breaks[index]),
        fused=fused,
    )


def _finite(values: Floats) -> Floats:
    """Heights, NaN where they are not of this earth."""
    return np.where(np.abs(values) < 1e5, values, np.nan)


def _sigma(values: Floats) -> Floats:
    """Sigmas, NaN where they say nothing."""
    return np.where((values > 0.0) & np.isfinite(values), values, np.nan)


class _Heights:
    """Heights that a position's own topic does not hold, from the topics that do."""

    def __init__(self, topics: Sequence[Topic], receivers: Sequence[Positions]) -> None:
        self.home = _step(named(topics, _HOME), "alt", "valid_alt")
        self.air = _step(named(topics, _AIR), "baro_alt_meter", "")
        self.receivers = receivers

    def filled(self, stream: Positions) -> Positions:
        """A stream with the heights it lacks."""
        time_ns = stream.time_ns
        ellipsoidal, above_home, barometric = stream.ellipsoidal_m, stream.above_home_m, stream.barometric_m
        if np.isnan(ellipsoidal).any():
            by_receiver = stream.amsl_m + borrowed(self.receivers, separation_m, time_ns)
            ellipsoidal = np.where(np.isnan(ellipsoidal), by_receiver, ellipsoidal)
        if self.home is not None:
            latest = np.searchsorted(self.home[0], time_ns, side="right") - 1
            above_home = stream.amsl_m - self.home[1][np.maximum(latest, 0)]
        if self.air is not None:
            barometric = interpolated(*self.air, time_ns, ends_hold=False)
        return Positions(
            stream.stream, time_ns, stream.latitude_deg, stream.longitude_deg, ellipsoidal, stream.amsl_m, above_home,
            barometric, stream.sigma_horizontal_m, stream.sigma_vertical_m, stream.segment, stream.fused,
        )  # fmt: skip


def _step(topics: Sequence[Topic], name: str, valid: str) -> tuple[Nanoseconds, Floats] | None:
    """Times and values of a height; None when there is none."""
    if not topics:
        return None
    topic = topics[0]
    values = _finite(topic.number(name))
    # A height that cannot be used costs nothing but itself, and the positions say what they lack.
    index = topic.kept(topic.time_us(sampled=True), np.isfinite(values) & topic.flag(valid), [])
    return (topic.time_us(sampled=True)[index] * NS_PER_US, values[index]) if len(index) else None


def _attitudes(topics: Sequence[Topic], losses: list[str]) -> Iterable[Attitudes]:
    for topic in named(topics, _VEHICLE):
        breaks = topic.changes("quat_reset_counter")
        every = np.ones(len(breaks), np.bool_)
        yield from _turned(topic, "vehicle", "ned", every, breaks, losses)
    for topic in named(topics, _GIMBAL):
        flags = topic.raw("device_flags")
        ned, heading = yaw_frames(np.zeros(len(topic), np.int64) if flags is None else flags)
        if odd := int(np.count_nonzero(~ned & ~heading)):
            losses.append(f"{odd} {topic.label} records name two frames at once and were left out")
        breaks = np.cumsum(np.diff(ned, prepend=ned[:1]), dtype=np.int64)
        yield from _turned(topic, "gimbal", "ned", ned, breaks, losses)
        yield from _turned(topic, "gimbal", "heading", heading, breaks, losses)


def _turned(
    topic: Topic,
    of: Literal["vehicle", "gimbal"],
    frame: Literal["ned", "heading"],
    here: Bools,
    breaks: Ints,
    losses: list[str],
) -> Iterable[Attitudes]:
    """A stream of those attitudes that are against one frame, where there are any."""
    q = topic.quaternions()
    time_us = topic.time_us(sampled=True)
    index = topic.kept(time_us[here], is_rotation(q)[here], losses)
    index = np.flatnonzero(here)[index]
    if len(index):
        time_ns = time_us[index] * NS_PER_US
        yield Attitudes(topic.label, time_ns, unit(q[index]), of, frame, segments(time_ns, breaks[index]))


def _events(topics: Sequence[Topic], echoed: bool, losses: list[str]) -> Iterable[Events]:
    """Camera events.

    Args:
        topics: All.
        echoed: Whether the autopilot was set to publish a capture with every commanded trigger, the camera's own word
            not asked for (CAM_CAP_FBACK = 0).
        losses: Told what was left out.
    """
    for topic in named(topics, _CAPTURE):
        taken = np.ones(len(topic), np.bool_)
        results = topic.raw("result")
        if results is not None:
            taken = np.asarray(results == 1)
            if failed := int(np.sum(~taken)):
                losses.append(f"{failed} {topic.label} records tell of a capture that failed")
        yield from _exposed(topic, topic.label, taken, not echoed, losses)
    for topic in named(topics, _TRIGGER):
        reported = topic.raw("feedback")
        confirmed = np.zeros(len(topic), np.bool_) if reported is None else reported != 0
        yield from _exposed(topic, f"{topic.label} (feedback)", confirmed, True, losses)
        yield from _exposed(topic, topic.label, ~confirmed, False, losses)


def _exposed(topic: Topic, label: str, here: Bools, feedback: bool, losses: list[str]) -> Iterable[Events]:
    time_us = topic.time_us()
    index = np.flatnonzero(here)[topic.kept(time_us[here], here[here], losses)]
    if len(index):
        numbers = topic.raw("seq")
        number = np.full(len(index), -1, np.int64) if numbers is None else numbers[index].astype(np.int64)
        sigma_s = FEEDBACK_SIGMA_S if feedback else TRIGGER_SIGMA_S
        yield Events(label, time_us[index] * NS_PER_US, number, feedback, sigma_s)


def _time_base(receivers: Sequence[Topic]) -> TimeBase:
    """UTC by the receiver that gave it most often."""
    best = TimeBase("boot", problem="boot time only: no receiver gave UTC")
    for topic in receivers:
        utc = topic.raw("time_utc_usec")
        if utc is None or not np.issubdtype(utc.dtype, np.integer):
            continue
        # The UTC of a message may have come with another one; the field says how far apart they arrived.
        apart = np.nan_to_num(topic.number("timestamp_time_relative"))
        time_us = topic.time_us() + np.rint(np.clip(apart, -1e7, 1e7)).astype(np.int64)
        index = topic.kept(time_us, (utc > _FIRST_UTC_US) & (utc < _LAST_UTC_US), [])
        if len(index) <= len(best.anchor_log_ns):
            continue
        log_ns, utc_ns = time_us[index] * NS_PER_US, utc[index].astype(np.int64) * NS_PER_US
        # Both stamps are of the arrival at the autopilot: real logs scatter by tens of milliseconds.
        best = boot_time_base(log_ns, utc_ns, f"{topic.label}.time_utc_usec", late=True)
    return best


def _facts(log: Any, dropouts: int) -> dict[str, Any]:
    facts = {fact: log.msg_info_dict[key] for key, fact in _FACTS.items() if key in log.msg_info_dict}
    if isinstance(log.msg_info_dict.get(_RELEASE), int):
        facts["firmware"] = log.get_version_info_str() or "development version"
    return {**facts, "dropouts": dropouts}
