"""DJI subtitle files (.SRT): where the drone was while it filmed, on the video's own clock."""

from __future__ import annotations

import re
from datetime import timedelta
from typing import Any, Literal

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Floats, Ints
from pipeline.sources.dji_logs.srt_cues import Cues, read_cues
from pipeline.sources.dji_logs.streams import attitudes, positions
from pipeline.sources.files import opened
from pipeline.sources.records import NS_PER_MS, NS_PER_US, Attitudes, FlightLog, Nanoseconds, Positions, TimeBase
from pipeline.sources.streams import in_order
from pipeline.sources.time_bases import UNIX_EPOCH

_ARROW = re.compile(rb"\d\d:\d\d:\d\d[,.]\d{1,3}\s*-->")
# Whole seconds of the date line run up to one second before or behind the cues; a joined clip is off by more.
_JUMP_NS = 2.5e9
_HEIGHT_NOTES = {
    "abs_alt": "abs_alt is taken as above mean sea level; DJI does not say which datum it is, and it has been found "
    "tens of metres off",
    # A known Air 2 file says 27 m over a hill in Barcelona whose ground is well above that.
    "altitude": "altitude is taken as above take-off, which the known files agree with; DJI does not say so",
    "h": "H is above the home point",
    "barometer": "BAROMETER and Hb are barometric, from zero at the start",
}


def is_format(head: bytes, name: str) -> bool:
    """Whether it is a subtitle file: by its name, or by the cue lines it begins with."""
    return name.lower().endswith(".srt") or _ARROW.search(head) is not None


def read(location: str) -> FlightLog:
    """Reads a subtitle file of any DJI firmware.

    Args:
        location: Path or URL.

    Returns:
        Positions on the video's clock (ns since its first frame), vehicle and gimbal attitude where the firmware
        writes them, camera settings in the facts. Repeats between the receiver's measurements are left out.

    Raises:
        InputError: It is not there, has no cues, or no cue holds flight data.
        ResourceError: It may not be read.

    Source: see `pipeline.sources.dji_logs.srt_dialects`.
    """
    with opened(location) as stream:
        cues = read_cues(stream)
    losses: list[str] = []
    facts: dict[str, Any] = {}
    time_ns, rows = _clock(cues, losses)
    if not len(rows):
        raise InputError(
            "E-SRT-01", "the subtitle file has no cues", where=location, found=f"{cues.count} cues with a time",
            expected="cues like 00:00:01,000 --> 00:00:02,000", hint="copy it again from the card, or leave it out",
        )  # fmt: skip
    if not cues.tells:
        raise InputError(
            "E-SRT-02", "the subtitles hold no flight data", where=location,
            found=f"{cues.count} cues with neither position nor camera settings",
            expected="DJI subtitles: [latitude: ..] or GPS(..)",
            hint="switch on video subtitles (captions) in DJI's app, or leave the file out",
        )  # fmt: skip
    segment = _segments(time_ns, cues.column("frame")[rows], cues.column("local_us")[rows])
    facts["camera"] = dict(sorted(cues.settings.items()))
    if len(segment) and segment[-1]:
        facts["pieces"] = int(segment[-1]) + 1
    tracks = _positions(cues, time_ns, rows, segment, losses, facts)
    return FlightLog(
        location=location, kind="DJI subtitles",
        counts={"cues": cues.count, "positions": sum(len(p.time_ns) for p in tracks)},
        time_base=_time_base(cues, time_ns, rows, facts),
        positions=tracks,
        attitudes=tuple(_attitudes(cues, time_ns, rows, segment)),
        losses=tuple(losses), facts=facts,
    )  # fmt: skip


def _clock(cues: Cues, losses: list[str]) -> tuple[Nanoseconds, Ints]:
    """(n,) times in the video, in order, and (n,) the cues they are of."""
    start_ms = cues.column("start_ms")
    untimed = int(np.count_nonzero(np.isnan(start_ms)))
    local_ms = cues.column("local_us") / 1000.0
    dated = np.flatnonzero(np.isfinite(local_ms))
    if untimed == cues.count and len(dated):
        losses.append("the cues have no times in the video; they are taken from the date lines")
        start_ms = local_ms - local_ms[dated[0]]
    elif untimed:
        losses.append(f"{untimed} of {cues.count} cues have no readable time")
    rows = np.flatnonzero(np.isfinite(start_ms))
    time_ns = np.rint(start_ms[rows] * NS_PER_MS).astype(np.int64)
    ordered = in_order(time_ns)
    if not ordered.all():
        losses.append(f"{np.count_nonzero(~ordered)} of {len(ordered)} cues run backwards in time and were left out")
    return time_ns[ordered], rows[ordered]


def _segments(time_ns: Nanoseconds, frame: Floats, local_us: Floats) -> Ints:
    """(n,) a new one where clips were joined: frame numbers begin again, or the time of day jumps."""
    breaks = np.zeros(len(time_ns), np.bool_)
    breaks[1:] = (np.diff(frame) < 0.0) | (np.abs(np.diff(local_us * 1e3 - time_ns)) > _JUMP_NS)
    return np.cumsum(breaks).astype(np.int64)


def _positions(
    cues: Cues, time_ns: Nanoseconds, rows: Ints, segment: Ints, losses: list[str], facts: dict[str, Any]
) -> tuple[Positions, ...]:
    latitude, longitude, order = _coordinates(cues)
    heights = {
        "amsl_m": cues.column("abs_alt")[rows],
        "above_home_m": cues.column("rel_alt", "h", "altitude")[rows],
        "barometric_m": cues.column("barometer")[rows],
    }
    made = positions(
        "SRT", time_ns, latitude[rows], longitude[rows], heights, segment, losses, item="cues", fused=False, held=True
    )
    if made is None:
        losses.append("no cue holds a position")
        return ()
    facts["coordinate_order"] = order
    facts["repeats"] = made[1]
    notes = [text for name, text in _HEIGHT_NOTES.items() if name in cues.columns]
    if notes:
        facts["height_note"] = "; ".join(notes)
    return (made[0],)


def _coordinates(cues: Cues) -> tuple[Floats, Floats, str]:
    """(count,) latitude and longitude, deg, and what tells one from the other."""
    latitude, longitude = cues.column("latitude"), cues.column("longitude")
    unnamed = np.isnan(latitude) | np.isnan(longitude)
    if "first" not in cues.columns or not unnamed.any():
        return latitude, longitude, "named fields"
    first, second = cues.column("first"), cues.column("second")
    home = cues.column("home_first"), cues.column("home_second")
    longitude_first, why = _longitude_first(first, second, home, cues.column("metres"))
    ordered = (second, first) if longitude_first else (first, second)
    return np.where(unnamed, ordered[0], latitude), np.where(unnamed, ordered[1], longitude), why


def _longitude_first(first: Floats, second: Floats, home: tuple[Floats, Floats], metres: Floats) -> tuple[bool, str]:
    """Whether GPS(a, b, ..) has longitude first, and why; by evidence before by dialect."""
    beyond = np.count_nonzero(np.abs(first) > 90.0) - np.count_nonzero(np.abs(second) > 90.0)
    if beyond:
        return bool(beyond > 0), "values beyond 90 deg can only be longitudes"
    beyond = np.count_nonzero(np.abs(home[0]) > 90.0) - np.count_nonzero(np.abs(home[1]) > 90.0)
    both = np.isfinite(first) & np.isfinite(second) & np.isfinite(home[0]) & np.isfinite(home[1])
    if beyond and both.any():
        direct = np.median(np.abs(first - home[0])[both] + np.abs(second - home[1])[both])
        crossed = np.median(np.abs(first - home[1])[both] + np.abs(second - home[0])[both])
        return bool((beyond > 0) == (direct <= crossed)), "the home point, whose longitude is beyond 90 deg"
    if np.nansum(metres) > 0.5 * np.count_nonzero(np.isfinite(metres)):
        return False, "the third value is in metres: the form with latitude first (Matrice 300)"
    return True, (
        "assumed: this form has longitude first in all known files, but no value here is beyond 90 deg to prove it"
    )


def _attitudes(cues: Cues, time_ns: Nanoseconds, rows: Ints, segment: Ints) -> list[Attitudes]:
    """Vehicle and gimbal, in local north-east-down.

    The order pitch, roll, yaw and the signs of F.PRY are borne out by the Phantom 4 RTK file at hand: it flies
    sideways to the left at 13 m/s and the second value is -20 deg, left side down.
    """
    kinds: tuple[tuple[Literal["vehicle", "gimbal"], str], ...] = (("vehicle", "F.PRY"), ("gimbal", "gimbal"))
    out = []
    for of, stream in kinds:
        angles = np.stack([cues.column(f"{of}_{axis}")[rows] for axis in ("yaw", "pitch", "roll")], axis=1)
        if f"{of}_roll" not in cues.columns:
            angles[:, 2] = 0.0
        made = attitudes(stream, of, time_ns, angles, segment, held=True)
        if made is not None:
            out.append(made)
    return out


def _time_base(cues: Cues, time_ns: Nanoseconds, rows: Ints, facts: dict[str, Any]) -> TimeBase:
    """The video's clock; tied to UTC only where date lines say that they are UTC."""
    source = "cue times: time in the video"
    local_us, utc = cues.column("local_us")[rows], cues.column("utc")[rows]
    dated = np.flatnonzero(np.isfinite(local_us))
    if not len(dated):
        return TimeBase("boot", source=source, problem="no date in the file")
    if not np.any(utc == 1.0):
        facts["local_start"] = _iso(local_us[dated[0]])
        return TimeBase("boot", source=source, problem=f"local time without zone: {facts['local_start']}")
    stated = np.flatnonzero(utc == 1.0)
    new = stated[np.diff(local_us[stated], prepend=np.nan) != 0.0]
    whole = bool(np.all(local_us[new] % 1e6 == 0.0))
    # A whole second shows first in the cue after it began.
    anchors = new[1:] if whole and len(new) > 1 else new
    return TimeBase(
        "boot", time_ns[anchors], np.rint(local_us[anchors]).astype(np.int64) * NS_PER_US,
        late=whole, source="date lines that say UTC",
    )  # fmt: skip


def _iso(local_us: float) -> str:
    moment = UNIX_EPOCH + timedelta(microseconds=round(local_us))
    return moment.replace(tzinfo=None).isoformat(timespec="milliseconds")
