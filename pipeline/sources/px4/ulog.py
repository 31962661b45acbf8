"""PX4 ULog (.ulg): positions, attitudes, camera events and GPS time of an autopilot's log."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints
from pipeline.sources.files import local_copy
from pipeline.sources.px4.sieve import MAGIC, sift
from pipeline.sources.records import (
    Attitudes,
    Events,
    FlightLog,
    Nanoseconds,
    Positions,
    TimeBase,
    in_order,
    nothing,
    segments,
)

_FUSED = "vehicle_global_position"
_RECEIVERS = ("sensor_gps", "vehicle_gps_position")
_VEHICLE, _GIMBAL = "vehicle_attitude", "gimbal_device_attitude_status"
_CAPTURE, _TRIGGER = "camera_capture", "camera_trigger"
_HOME, _AIR = "home_position", "vehicle_air_data"
_TOPICS = frozenset({_FUSED, *_RECEIVERS, _VEHICLE, _GIMBAL, _CAPTURE, _TRIGGER, _HOME, _AIR})
_FACTS = {"sys_name": "system", "ver_hw": "hardware"}
_RELEASE, _CAPTURE_FEEDBACK = "ver_sw_release", "CAM_CAP_FBACK"
# What the library raises on messages it cannot make sense of.
_REFUSALS = (struct.error, ValueError, KeyError, IndexError, TypeError, OverflowError, RecursionError, MemoryError)
# Microseconds later than this on any clock are damage: the year 2096.
_LAST_US = 4_000_000_000_000_000
# UTC before 2010 or after 2100 is no time of a flight.
_FIRST_UTC_US, _LAST_UTC_US = 1_262_304_000_000_000, 4_102_444_800_000_000
_FIX_3D = 3
# GIMBAL_DEVICE_FLAGS of MAVLink.
_YAW_LOCK, _IN_VEHICLE_FRAME, _IN_EARTH_FRAME = 16, 32, 64
# The hot shoe's interrupt is stamped at once; from a commanded trigger to the exposure is the camera's own matter.
_FEEDBACK_SIGMA_S, _TRIGGER_SIGMA_S = 0.001, 0.05


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
    topics = [_Topic(_label(data.name, data.multi_id), data.name, data.data) for data in log.data_list]
    losses = list(found.losses)
    receivers = [stream for topic in _named(topics, *_RECEIVERS) if (stream := _positions(topic, losses))]
    fused = [stream for topic in _named(topics, _FUSED) if (stream := _positions(topic, losses))]
    heights = _Heights(topics, receivers)
    echoed = log.initial_parameters.get(_CAPTURE_FEEDBACK) == 0
    return FlightLog(
        location=location,
        kind="PX4 ULog",
        counts=found.counts,
        time_base=_time_base(_named(topics, *_RECEIVERS)),
        positions=tuple(heights.filled(stream) for stream in (*fused, *receivers)),
        attitudes=tuple(_attitudes(topics, losses)),
        events=tuple(_events(topics, echoed, losses)),
        losses=tuple(losses),
        facts=_facts(log, len(found.dropout_ms)),
    )


@dataclass(frozen=True, slots=True)
class _Topic:
    """One instance of a topic.

    Args:
        label: Name, with the instance where it is not the first.
        name: Without.
        columns: Fields by name; elements of arrays as "q[0]".
    """

    label: str
    name: str
    columns: Mapping[str, AnyArray]

    def raw(self, *names: str) -> AnyArray | None:
        """The first of these fields that the firmware logged."""
        return next((self.columns[name] for name in names if name in self.columns), None)

    def scaled(self, name: str, whole: str, unit: float) -> Floats:
        """A field, or the older one in whole units; NaN when neither is there."""
        values = self.raw(name, whole)
        if values is None:
            return nothing(len(self.columns["timestamp"]))
        scale = unit if np.issubdtype(values.dtype, np.integer) else 1.0
        # Damage makes signalling NaNs.
        with np.errstate(invalid="ignore"):
            return np.asarray(values, np.float64) * scale

    def number(self, name: str) -> Floats:
        """A field; NaN when it is not there."""
        return self.scaled(name, name, 1.0)

    def quaternions(self) -> Floats:
        """(n, 4)."""
        return np.stack([self.number(f"q[{index}]") for index in range(4)], axis=-1)

    def time_us(self, *, sampled: bool = False) -> Ints:
        """Times, 0 where they are none; of the measurement where the firmware logged it and it is asked for."""
        stamps = self.columns["timestamp"]
        samples = self.raw("timestamp_sample")
        if sampled and samples is not None and samples.dtype == stamps.dtype:
            stamps = np.where((samples > 0) & (samples <= stamps), samples, stamps)
        return np.where(stamps < _LAST_US, stamps, 0).astype(np.int64)

    def kept(self, time_us: Ints, good: Bools, losses: list[str]) -> Ints:
        """Indices of samples that are good and in order of time; the others are told of."""
        index = np.flatnonzero(good & (time_us > 0))
        index = index[in_order(time_us[index])]
        lost = len(good) - len(index)
        if lost:
            losses.append(f"{self.label}: {lost} records with impossible values or times were left out.")
        return index


def _label(name: str, instance: int) -> str:
    return f"{name}[{instance}]" if instance else name


def _named(topics: Iterable[_Topic], *names: str) -> list[_Topic]:
    return [topic for name in names for topic in topics if topic.name == name]


def _positions(topic: _Topic, losses: list[str]) -> Positions | None:
    """The positions of the filter or of a receiver; None when none is good."""
    fused = topic.name == _FUSED
    latitude = topic.scaled("latitude_deg", "lat", 1e-7)
    longitude = topic.scaled("longitude_deg", "lon", 1e-7)
    if np.all(np.isnan(latitude)) or np.all(np.isnan(longitude)):
        losses.append(f"{topic.label}: it has no latitude and longitude.")
        return None
    fixed = _flag(topic, "lat_lon_valid") if fused else topic.number("fix_type") >= _FIX_3D
    # Without a fix nothing is lost that anybody had: only the others are told of.
    possible = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 180.0) & ((latitude != 0.0) | (longitude != 0.0))
    time_us = topic.time_us(sampled=True)
    index = topic.kept(time_us, possible | ~fixed, losses)
    index = index[(possible & fixed)[index]]
    if not len(index):
        return None
    amsl = topic.scaled("altitude_msl_m", "alt", 1e-3)
    ellipsoidal = topic.scaled("altitude_ellipsoid_m", "alt_ellipsoid", 1e-3)
    heights_good = _flag(topic, "alt_valid")
    breaks = np.cumsum(~fixed) + _changes(topic, "lat_lon_reset_counter", "alt_reset_counter")
    time_ns = time_us[index] * 1000
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


def _flag(topic: _Topic, name: str) -> Bools:
    """A flag, which older firmware does not log: then all is good."""
    values = topic.raw(name)
    return np.ones(len(topic.columns["timestamp"]), np.bool_) if values is None else np.asarray(values != 0)


def _changes(topic: _Topic, *counters: str) -> Ints:
    """How often any of these counters had changed, (n,)."""
    out = np.zeros(len(topic.columns["timestamp"]), np.int64)
    for name in counters:
        values = topic.raw(name)
        if values is not None:
            out[1:] += np.cumsum(values[1:] != values[:-1])
    return out


def _finite(values: Floats) -> Floats:
    """Heights, NaN where they are not of this earth."""
    return np.where(np.abs(values) < 1e5, values, np.nan)


def _sigma(values: Floats) -> Floats:
    """Sigmas, NaN where they say nothing."""
    return np.where((values > 0.0) & np.isfinite(values), values, np.nan)


class _Heights:
    """Heights that a position's own topic does not hold, from the topics that do."""

    def __init__(self, topics: Sequence[_Topic], receivers: Sequence[Positions]) -> None:
        self.home = _step(_named(topics, _HOME), "alt", "valid_alt")
        self.air = _step(_named(topics, _AIR), "baro_alt_meter", "")
        # By the receiver's own geoid, whichever that is: adding it again undoes what the receiver subtracted.
        self.separation: tuple[Nanoseconds, Floats] | None = None
        for stream in receivers:
            known = np.isfinite(stream.ellipsoidal_m - stream.amsl_m)
            if self.separation is None and np.any(known):
                self.separation = stream.time_ns[known], (stream.ellipsoidal_m - stream.amsl_m)[known]

    def filled(self, stream: Positions) -> Positions:
        """A stream with the heights it lacks."""
        time_ns = stream.time_ns
        ellipsoidal, above_home, barometric = stream.ellipsoidal_m, stream.above_home_m, stream.barometric_m
        if self.separation is not None:
            # The geoid is level over a flight, so its ends may be held.
            apart = np.interp(time_ns, *self.separation)
            ellipsoidal = np.where(np.isnan(ellipsoidal), stream.amsl_m + apart, ellipsoidal)
        if self.home is not None:
            latest = np.searchsorted(self.home[0], time_ns, side="right") - 1
            above_home = stream.amsl_m - self.home[1][np.maximum(latest, 0)]
        if self.air is not None:
            barometric = np.interp(time_ns, *self.air, left=np.nan, right=np.nan)
        return Positions(
            stream.stream, time_ns, stream.latitude_deg, stream.longitude_deg, ellipsoidal, stream.amsl_m, above_home,
            barometric, stream.sigma_horizontal_m, stream.sigma_vertical_m, stream.segment, stream.fused,
        )  # fmt: skip


def _step(topics: Sequence[_Topic], name: str, valid: str) -> tuple[Nanoseconds, Floats] | None:
    """Times and values of a height; None when there is none."""
    if not topics:
        return None
    topic = topics[0]
    values = _finite(topic.number(name))
    # A height that cannot be used costs nothing but itself, and the positions say what they lack.
    index = topic.kept(topic.time_us(sampled=True), np.isfinite(values) & _flag(topic, valid), [])
    return (topic.time_us(sampled=True)[index] * 1000, values[index]) if len(index) else None


def _attitudes(topics: Sequence[_Topic], losses: list[str]) -> Iterable[Attitudes]:
    for topic in _named(topics, _VEHICLE):
        breaks = _changes(topic, "quat_reset_counter")
        every = np.ones(len(breaks), np.bool_)
        yield from _turned(topic, "vehicle", "ned", every, breaks, losses)
    for topic in _named(topics, _GIMBAL):
        flags = topic.raw("device_flags")
        # Without an explicit frame the yaw lock tells it (MAVLink, GIMBAL_DEVICE_ATTITUDE_STATUS).
        whole = np.zeros(len(topic.columns["timestamp"]), np.int64) if flags is None else flags.astype(np.int64)
        explicit = (whole & (_IN_VEHICLE_FRAME | _IN_EARTH_FRAME)) != 0
        earth = np.where(explicit, (whole & _IN_EARTH_FRAME) != 0, (whole & _YAW_LOCK) != 0)
        breaks = np.concatenate([[0], np.cumsum(earth[1:] != earth[:-1])])
        yield from _turned(topic, "gimbal", "ned", earth, breaks, losses)
        yield from _turned(topic, "gimbal", "heading", ~earth, breaks, losses)


def _turned(
    topic: _Topic,
    of: Literal["vehicle", "gimbal"],
    frame: Literal["ned", "heading"],
    here: Bools,
    breaks: Ints,
    losses: list[str],
) -> Iterable[Attitudes]:
    """A stream of those attitudes that are against one frame, where there are any."""
    q = topic.quaternions()
    norm = np.linalg.norm(q, axis=-1)
    time_us = topic.time_us(sampled=True)
    index = topic.kept(time_us[here], (np.abs(norm - 1.0) < 0.05)[here], losses)
    index = np.flatnonzero(here)[index]
    if len(index):
        time_ns = time_us[index] * 1000
        unit = q[index] / norm[index, None]
        yield Attitudes(topic.label, time_ns, unit, of, frame, segments(time_ns, breaks[index]))


def _events(topics: Sequence[_Topic], echoed: bool, losses: list[str]) -> Iterable[Events]:
    """Camera events.

    Args:
        topics: All.
        echoed: Whether the autopilot was set to publish a capture with every commanded trigger, the camera's own word
            not asked for (CAM_CAP_FBACK = 0).
        losses: Told what was left out.
    """
    for topic in _named(topics, _CAPTURE):
        taken = np.ones(len(topic.columns["timestamp"]), np.bool_)
        results = topic.raw("result")
        if results is not None:
            taken = np.asarray(results == 1)
            if failed := int(np.sum(~taken)):
                losses.append(f"{topic.label}: {failed} captures that the camera did not confirm were left out.")
        yield from _exposed(topic, topic.label, taken, not echoed, losses)
    for topic in _named(topics, _TRIGGER):
        reported = topic.raw("feedback")
        confirmed = np.zeros(len(topic.columns["timestamp"]), np.bool_) if reported is None else reported != 0
        yield from _exposed(topic, f"{topic.label} (feedback)", confirmed, True, losses)
        yield from _exposed(topic, topic.label, ~confirmed, False, losses)


def _exposed(topic: _Topic, label: str, here: Bools, feedback: bool, losses: list[str]) -> Iterable[Events]:
    time_us = topic.time_us()
    index = np.flatnonzero(here)[topic.kept(time_us[here], here[here], losses)]
    if len(index):
        numbers = topic.raw("seq")
        number = np.full(len(index), -1, np.int64) if numbers is None else numbers[index].astype(np.int64)
        sigma_s = _FEEDBACK_SIGMA_S if feedback else _TRIGGER_SIGMA_S
        yield Events(label, time_us[index] * 1000, number, feedback, sigma_s)


def _time_base(receivers: Sequence[_Topic]) -> TimeBase:
    """UTC by the receiver that gave it most often."""
    best = TimeBase("boot", problem="No receiver gave UTC: the log's clock counts from the autopilot's start.")
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
        log_ns, utc_ns = time_us[index] * 1000, utc[index].astype(np.int64) * 1000
        spread_s = float(np.ptp(utc_ns - log_ns)) / 1e9
        problem = f"{topic.label}: UTC against the log's clock jumps by {spread_s:.1f} s." if spread_s > 1.0 else ""
        # Both stamps are of the arrival at the autopilot: real logs scatter by tens of milliseconds.
        best = TimeBase("boot", log_ns, utc_ns, True, f"{topic.label}.time_utc_usec", problem)
    return best


def _facts(log: Any, dropouts: int) -> dict[str, Any]:
    facts = {fact: log.msg_info_dict[key] for key, fact in _FACTS.items() if key in log.msg_info_dict}
    if isinstance(log.msg_info_dict.get(_RELEASE), int):
        facts["firmware"] = log.get_version_info_str() or "development version"
    return {**facts, "dropouts": dropouts}
