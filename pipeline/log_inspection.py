"""What a log, bag, subtitle file, trajectory or video holds, as plain values for `inspect`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from pipeline.clocks.fit import Nanoseconds
from pipeline.geometry.arrays import Floats
from pipeline.placing.timeline import Timeline, clock_problem, timeline
from pipeline.sources.logs import read_log
from pipeline.sources.records import Attitudes, Events, LocalPoses, Positions
from pipeline.sources.video import describe_video, srt_beside

_HEIGHTS = (
    ("ellipsoidal", "ellipsoidal_m"),
    ("amsl", "amsl_m"),
    ("above home", "above_home_m"),
    ("barometric", "barometric_m"),
)


def describe_log(location: str) -> dict[str, Any]:
    """Describes a log.

    Args:
        location: Path or URL of a log, bag, subtitle file or trajectory, or a folder that is one.

    Returns:
        A mapping with the unit in each key.

    Raises:
        InputError: It cannot be read, or nothing is left of it.
        ResourceError: It may not be read.
    """
    log = read_log(location)
    line = timeline(log)
    return {
        "kind": log.kind,
        "source": location,
        "records": sum(log.counts.values()),
        "counts": dict(log.counts),
        "time": _span(line),
        "duration_s": _duration_s(line),
        "clock": _clock(line),
        "clock_problem": clock_problem(log, line.clock),
        "positions": [_positions(stream) for stream in log.positions],
        "attitudes": [_attitudes(stream) for stream in log.attitudes],
        "camera_events": [_events(stream) for stream in log.events],
        "local_poses": [_local(stream) for stream in log.poses],
        "transforms": [f"{t.parent} > {t.child}" for t in log.transforms],
        "images": [
            {"stream": s.stream, "images": len(s.time_ns), "width_px": s.width, "height_px": s.height,
             "encoding": s.encoding, **({"note": s.note} if s.note else {})}
            for s in log.images
        ],
        "cameras": [
            {"stream": c.stream, "width_px": c.camera.width, "height_px": c.camera.height,
             "focal_px": round(c.camera.focal_px, 2), "lens": c.camera.model}
            for c in log.cameras
        ],
        "lidar": [
            {"stream": s.stream, "sweeps": len(s.time_ns), "points": s.points, "fields": list(s.fields)}
            for s in log.sweeps
        ],
        "facts": {name: value for name, value in log.facts.items() if name != "topics"},
        "losses": list(log.losses),
    }  # fmt: skip


def describe_clip(location: str) -> dict[str, Any]:
    """Describes a video.

    Args:
        location: Path or URL.

    Returns:
        A mapping with the unit in each key.

    Raises:
        InputError: It is no video.
        ResourceError: It may not be read.
    """
    stream, facts = describe_video(location)
    subtitles = srt_beside(location)
    return {
        "kind": "video",
        "source": location,
        "images": len(stream.time_ns),
        "facts": facts,
        "subtitles": subtitles or "",
        "problem": "" if subtitles else "no .SRT beside it: nothing says where its frames were taken",
    }


def _streams(line: Timeline) -> Iterable[Positions | Attitudes | Events | LocalPoses]:
    log = line.log
    return (*log.positions, *log.attitudes, *log.events, *log.poses)


def _ends(line: Timeline) -> Nanoseconds:
    """First and last instant of everything, on the log's clock; empty when nothing has times."""
    timed = [s.time_ns for s in (*_streams(line), *line.log.images, *line.log.sweeps) if len(s.time_ns)]
    if not timed:
        return np.empty(0, np.int64)
    return np.array([min(int(t[0]) for t in timed), max(int(t[-1]) for t in timed)], np.int64)


def _span(line: Timeline) -> list[str]:
    ends = _ends(line)
    if line.clock is None or not len(ends):
        return []
    return [datetime.fromtimestamp(value / 1e9, UTC).isoformat() for value in line.utc_ns(ends).tolist()]


def _duration_s(line: Timeline) -> float | str:
    ends = _ends(line)
    return round(float(ends[1] - ends[0]) / 1e9, 3) if len(ends) else ""


def _clock(line: Timeline) -> str:
    base = line.log.time_base
    if line.clock is None:
        return "since boot, not tied to UTC"
    if base.epoch == "utc":
        return base.source or "UTC as stamped"
    told = f"{base.source}: {line.clock.anchors} anchors, sigma {line.clock.sigma_s:.3f} s"
    return told + (f", drift {1e6 * line.clock.drift:.1f} ppm" if line.clock.drift else "")


def _positions(stream: Positions) -> dict[str, Any]:
    out: dict[str, Any] = {
        "stream": stream.stream,
        "samples": len(stream.time_ns),
        "rate_hz": _rate(stream.time_ns),
        "latitude_deg": _range(stream.latitude_deg),
        "longitude_deg": _range(stream.longitude_deg),
    }
    for name, column in _HEIGHTS:
        if span := _range(getattr(stream, column)):
            out[f"height {name} (m)"] = span
    if span := _range(stream.sigma_horizontal_m):
        out["sigma_horizontal_m"] = span
    return out


def _attitudes(stream: Attitudes) -> dict[str, Any]:
    against = {"ned": "true north and the horizon", "heading": "the vehicle's heading", "body": "the body"}
    return {
        "stream": stream.stream,
        "of": stream.of,
        "against": against[stream.frame],
        "samples": len(stream.time_ns),
        "rate_hz": _rate(stream.time_ns),
    }


def _events(stream: Events) -> dict[str, Any]:
    return {
        "stream": stream.stream,
        "kind": "exposures" if stream.feedback else "triggers",
        "events": len(stream.time_ns),
        "sigma_s": stream.sigma_s,
    }


def _local(stream: LocalPoses) -> dict[str, Any]:
    return {
        "stream": stream.stream,
        "of": stream.of,
        "frame": stream.parent,
        "poses": len(stream.time_ns),
        "images": sum(bool(name) for name in stream.image),
        "rate_hz": _rate(stream.time_ns),
    }


def _rate(time_ns: Nanoseconds) -> float:
    span_s = float(time_ns[-1] - time_ns[0]) / 1e9 if len(time_ns) > 1 else 0.0
    return round((len(time_ns) - 1) / span_s, 2) if span_s > 0.0 else 0.0


def _range(values: Floats | Sequence[float]) -> list[float]:
    known = np.asarray(values, np.float64)
    known = known[np.isfinite(known)]
    return [float(known.min()), float(known.max())] if len(known) else []
