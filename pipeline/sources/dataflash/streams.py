"""Positions, attitudes and camera events of DataFlash logs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.sources.dataflash.fields import Found
from pipeline.sources.dataflash.receivers import Receiver
from pipeline.sources.dataflash.samples import Samples, samples
from pipeline.sources.records import NS_PER_S, Attitudes, Events, Nanoseconds, Positions, nothing
from pipeline.sources.streams import (
    FEEDBACK_SIGMA_S,
    TRIGGER_SIGMA_S,
    borrowed,
    interpolated,
    is_place,
    ned_quaternions,
    segments,
    separation_m,
)

# Nothing that flies photos moves so far between two samples: the filter was reset.
_JUMP_M, _JUMP_WITHIN_NS = 50.0, NS_PER_S
# A silence of several samples is a gap, not a slow rate.
_GAP_NS, _GAP_SAMPLES = 2 * NS_PER_S, 5
_METRES_PER_DEGREE = 111_320.0
# Firmware that looked at the feedback pin 50 times a second did not log the image's number yet; later the pin raises an
# interrupt.
_TICK_NS, _TICK_TOLERANCE_NS, _FEWEST_TICKS = 20_000_000, 500_000, 5
_TICK_SIGMA_S = 0.020 / math.sqrt(12.0)
# CAM_FEEDBACK_PIN; since firmware 4.3 CAM1_FEEDBAK_PIN, CAM2_FEEDBAK_PIN.
_PINS = ("_FEEDBACK_PIN", "_FEEDBAK_PIN")


def read_streams(
    found: Found, seen: Sequence[Receiver]
) -> tuple[tuple[Positions, ...], tuple[Attitudes, ...], tuple[Events, ...]]:
    """Positions, attitudes and camera events; the backup's (AHR2) only where POS or ATT is missing.

    Args:
        found: What the walk found.
        seen: The receivers, the primary first.

    Returns:
        Positions (POS before the receivers), attitudes (the vehicle's, the gimbals'), events.
    """
    barometer = next(iter(samples(found, "BARO", ("Alt",))), None)
    shots = {name: samples(found, name, ()) for name in ("CAM", "TRIG")}
    navigation = _placed(samples(found, "POS", ("Lat", "Lng")))
    vehicle = samples(found, "ATT", ("Roll", "Pitch", "Yaw"))
    gimbals = samples(found, "MNT", ("Roll", "Pitch"))
    backup = samples(found, "AHR2", ("Roll", "Pitch", "Yaw", "Lat", "Lng")) if not (navigation and vehicle) else []
    fixes = [_fixes(receiver, barometer) for receiver in seen]
    positions = [_navigation(stream, fixes, barometer, fused=True) for stream in navigation] + fixes
    if not navigation:
        # Dead reckoning of the backup is not to be preferred to a receiver.
        positions += [_navigation(stream, fixes, barometer, fused=False) for stream in _placed(backup)]
    attitudes = [_turned(stream, "Yaw", "vehicle", "ned") for stream in vehicle or backup]
    shot_ns = [stream.time_ns for streams in shots.values() for stream in streams]
    for stream in gimbals:
        turned = _gimbal(stream, shot_ns)
        attitudes += turned
        if not turned:
            found.losses.append(f"{stream.stream} has no yaw: its {len(stream.time_ns)} messages were left out")
    return tuple(positions), tuple(attitudes), _events(found, shots)


def _placed(streams: Sequence[Samples]) -> list[Samples]:
    placed = [stream.pick(is_place(stream.columns["Lat"], stream.columns["Lng"])) for stream in streams]
    return [stream for stream in placed if len(stream.time_ns)]


def _navigation(stream: Samples, fixes: Sequence[Positions], barometer: Samples | None, *, fused: bool) -> Positions:
    """A filter's positions, on the ellipsoid by the separation that the receiver itself applies."""
    time_ns, amsl_m = stream.time_ns, stream.first("Alt")
    return Positions(
        stream=stream.stream,
        time_ns=time_ns,
        latitude_deg=stream.columns["Lat"],
        longitude_deg=stream.columns["Lng"],
        ellipsoidal_m=amsl_m + borrowed(fixes, separation_m, time_ns),
        amsl_m=amsl_m,
        above_home_m=stream.first("RelHomeAlt", "RelAlt"),
        barometric_m=_barometric(barometer, time_ns),
        sigma_horizontal_m=borrowed(fixes, lambda fix: fix.sigma_horizontal_m, time_ns),
        sigma_vertical_m=borrowed(fixes, lambda fix: fix.sigma_vertical_m, time_ns),
        segment=_segments(stream, np.zeros(len(time_ns), np.int64)),
        fused=fused,
    )


def _fixes(receiver: Receiver, barometer: Samples | None) -> Positions:
    fixes = receiver.fixes
    return Positions(
        stream=fixes.stream,
        time_ns=fixes.time_ns,
        latitude_deg=fixes.columns["Lat"],
        longitude_deg=fixes.columns["Lng"],
        ellipsoidal_m=receiver.ellipsoidal_m,
        amsl_m=fixes.first("Alt"),
        # Old firmware logged the navigation's height above home with each fix.
        above_home_m=fixes.first("RelAlt", "RAlt"),
        barometric_m=_barometric(barometer, fixes.time_ns),
        sigma_horizontal_m=receiver.sigma_horizontal_m,
        sigma_vertical_m=receiver.sigma_vertical_m,
        segment=_segments(fixes, receiver.outage),
        fused=False,
    )


def _barometric(barometer: Samples | None, time_ns: Nanoseconds) -> Floats:
    if barometer is None:
        return nothing(len(time_ns))
    return interpolated(barometer.time_ns, barometer.columns["Alt"], time_ns, ends_hold=False)


def _segments(stream: Samples, outage: Ints) -> Ints:
    """A new segment after an outage, a gap, or a jump."""
    time_ns, latitude, longitude = stream.time_ns, stream.columns["Lat"], stream.columns["Lng"]
    step_ns = np.diff(time_ns)
    north_m = np.diff(latitude) * _METRES_PER_DEGREE
    east_m = (np.diff(longitude) + 180.0) % 360.0 - 180.0
    east_m = east_m * _METRES_PER_DEGREE * np.cos(np.radians(latitude[1:]))
    broken = (np.hypot(north_m, east_m) > _JUMP_M) & (step_ns <= _JUMP_WITHIN_NS)
    if len(step_ns):
        broken |= step_ns > max(_GAP_NS, _GAP_SAMPLES * int(np.median(step_ns)))
    broken |= np.diff(outage) != 0
    return segments(time_ns, np.concatenate([[0], np.cumsum(broken)]).astype(np.int64))


def _turned(
    stream: Samples, yaw: str, of: Literal["vehicle", "gimbal"], frame: Literal["ned", "heading", "body"]
) -> Attitudes:
    q_wxyz = ned_quaternions(*(np.radians(stream.columns[name]) for name in (yaw, "Pitch", "Roll")))
    return Attitudes(stream.stream, stream.time_ns, q_wxyz, of, frame, segments(stream.time_ns))


def _gimbal(stream: Samples, shot_ns: Sequence[Nanoseconds]) -> list[Attitudes]:
    """A gimbal's attitude, by its yaw from north where there is one, else by its yaw from the vehicle's nose.

    With each photo the firmware writes one more MNT under the exposure's time, though the angles are those of when it
    is written; where there are others, those are left out.
    """
    own = ~np.isin(stream.time_ns, np.concatenate([*shot_ns, np.empty(0, np.int64)]))
    if 2 * np.count_nonzero(own) >= len(own):
        stream = stream.pick(own)
    frames: tuple[tuple[str, Literal["ned", "heading"]], ...] = (("YawE", "ned"), ("YawB", "heading"))
    for yaw, frame in frames:
        known = np.isfinite(stream.first(yaw))
        if known.any():
            return [_turned(stream.pick(known), yaw, "gimbal", frame)]
    return []


def _events(found: Found, shots: dict[str, list[Samples]]) -> tuple[Events, ...]:
    """CAM is the feedback where a feedback pin is set up (TRIG is the command then), and the command where not."""
    reported = _feedback(found, triggered=bool(shots["TRIG"]))
    out = []
    for name, streams in shots.items():
        feedback = name == "CAM" and reported
        for stream in streams:
            logged = stream.first("Img")
            number = np.where(np.isfinite(logged), logged, -1.0).astype(np.int64)
            sigma_s = _sigma_s(stream) if feedback else TRIGGER_SIGMA_S
            out.append(Events(stream.stream, stream.time_ns, number, feedback, sigma_s))
    return tuple(out)


def _feedback(found: Found, *, triggered: bool) -> bool:
    pins = [value for name, value in found.parameters.items() if name.endswith(_PINS)]
    if triggered or any(pin > 0.0 for pin in pins):
        return True
    # Parameters are written when a log begins: without any, a part of a log cannot say.
    return not found.parameters


def _sigma_s(shots: Samples) -> float:
    if "Img" in shots.columns or len(shots.time_ns) < _FEWEST_TICKS:
        return FEEDBACK_SIGMA_S
    phase_ns = (shots.time_ns - shots.time_ns[0] + _TICK_NS // 2) % _TICK_NS - _TICK_NS // 2
    ticking = bool(np.all(np.abs(phase_ns) <= _TICK_TOLERANCE_NS))
    return _TICK_SIGMA_S if ticking else FEEDBACK_SIGMA_S
