"""Everything a flight left behind, read: photos, logs, bags, videos, and the images taken out of the latter two."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.clocks.fit import Nanoseconds
from pipeline.engine.errors import InputError, UndeterminedError
from pipeline.flight import RUN_IMAGES
from pipeline.geometry.arrays import Ints
from pipeline.placing.clock import no_overlap_hint
from pipeline.placing.photo_clock import span_text
from pipeline.placing.place import Stamp
from pipeline.placing.pose import camera_poses
from pipeline.placing.timeline import Timeline
from pipeline.sources.files import is_url, stem
from pipeline.sources.intrinsics import SourcedCamera
from pipeline.sources.photos import PhotoRecord
from pipeline.sources.records import FlightLog, ImageStream
from pipeline.tracks.mount import Mount
from pipeline.tracks.spacing import spaced


@dataclass(frozen=True, slots=True)
class Extracted:
    """An image taken out of a bag or video.

    Args:
        path: Where it was written.
        line: The log it came out of, an index of the timelines.
        log_ns: Its instant on that log's clock.
        camera: Its calibration as the log has it; None when it has none.
        note: What to distrust of its time.
        problem: Why there is no such image although there should be; empty when it was written.
    """

    path: Path
    line: int
    log_ns: int
    camera: SourcedCamera | None
    note: str
    problem: str = ""


def image_stream(log: FlightLog, topic: str | None) -> ImageStream:
    """The images of a bag: those of the named topic, else the longest stream.

    Raises:
        InputError: There are no images, or none of that topic.
    """
    if not log.images:
        raise InputError(
            "E-BAG-24", "the bag has no images", where=log.location,
            found=", ".join(sorted(log.counts)[:20]) or "no topics", expected="a topic of images",
            hint="a bag that has the poses of other images belongs in ingest.logs (--logs)",
        )  # fmt: skip
    if topic is not None:
        named = [stream for stream in log.images if stream.stream == topic]
        if not named:
            raise InputError(
                "E-BAG-20", "the bag has no images of this topic", where=log.location, found=topic,
                expected=", ".join(stream.stream for stream in log.images), hint="set ingest.image_topic",
            )  # fmt: skip
        return named[0]
    return min(log.images, key=lambda s: (-len(s.time_ns), s.stream))


def check_names(locations: Sequence[str]) -> None:
    """Refuses two bags or videos of one name: their images would be called the same.

    Raises:
        InputError: There are such.
    """
    seen: dict[str, str] = {}
    for location in locations:
        name = file_name(location, 0, "").lower()
        if name in seen:
            raise InputError(
                "E-VIDEO-11", "two videos or bags have one name", where=f"{seen[name]} and {location}",
                expected="one of each name: their images are named after them",
                hint="ingest one folder at a time, or rename one (a video together with its .SRT)",
            )  # fmt: skip
        seen[name] = location


def check_pose_topic(logs: Sequence[FlightLog], topic: str | None) -> None:
    """Refuses a topic of poses that no log has: other poses in its stead would be nobody's wish.

    Raises:
        InputError: There is no such topic.
    """
    known = sorted({poses.stream for log in logs for poses in log.poses})
    if topic is not None and topic not in known:
        raise InputError(
            "E-BAG-25", "no log has poses of this topic", where=", ".join(log.location for log in logs), found=topic,
            expected=", ".join(known) or "poses in a local frame, and there are none", hint="set ingest.pose_topic",
        )  # fmt: skip


def calibration_of(log: FlightLog, frame: str) -> SourcedCamera | None:
    """The calibration a log has for a camera's frame, or its only one; None when it has none."""
    named = [camera for camera in log.cameras if frame and camera.frame == frame]
    chosen = named or (list(log.cameras) if len(log.cameras) == 1 else [])
    return SourcedCamera(chosen[0].camera, f"{log.kind} {chosen[0].stream}") if chosen else None


def wanted(
    number: int,
    lines: Sequence[Timeline],
    stream: ImageStream,
    mount: Mount,
    spacing_m: float,
    *,
    clock_offset_s: float | None,
    y_up: bool,
) -> Ints:
    """Which images of a stream to use: one every `spacing_m` of the way, by whichever log knows where it was.

    Args:
        number: The log the images are in.
        lines: All logs.
        stream: The images.
        mount: The camera on the vehicle.
        spacing_m: Way between two images, m.
        clock_offset_s: What the user says makes the images' times UTC, s, for logs other than their own; None for none.
        y_up: Whether the y axis of a local frame points up.

    Returns:
        Indices of the stream.

    Raises:
        UndeterminedError: No log says where any of the images was taken.
    """
    own = lines[number]
    others = [line for line in lines if line is not own and line.clock is not None and own.clock is not None]
    stated_ns = round((clock_offset_s or 0.0) * 1e9)
    for line in [own, *others]:
        if line.places:
            at_ns = stream.time_ns if line is own else line.log_ns(own.utc_ns(stream.time_ns + stated_ns))
            chosen = spaced(camera_poses(line, at_ns, mount, y_up=y_up).centre_m, spacing_m)
            if len(chosen):
                return chosen
    raise _nowhere(own, [line for line in others if line.places], stream)


def _nowhere(own: Timeline, others: Sequence[Timeline], stream: ImageStream) -> UndeterminedError:
    """When the images were taken and when the logs know positions, and the offset that would help."""
    found = [f"{len(stream.time_ns)} images of {stream.stream}, and no positions at their times"]
    hints = ["name the poses' topic (ingest.pose_topic) or their log (ingest.logs)"]
    images_ns = own.utc_ns(stream.time_ns)
    for line in others:
        poses = line.positions or line.local
        if poses is not None and len(poses.time_ns) and len(images_ns):
            first_ns, last_ns = line.utc_ns(poses.time_ns[[0, -1]]).tolist()
            found.append(
                f"images {span_text(*images_ns[[0, -1]].tolist())}, {line.log.location} {span_text(first_ns, last_ns)}"
            )
            if not np.any((images_ns >= first_ns) & (images_ns <= last_ns)):
                hints.append(no_overlap_hint(images_ns, first_ns, last_ns, "images"))
    return UndeterminedError(
        "E-BAG-21",
        "nothing says where the images were taken",
        where=own.log.location,
        found="; ".join(found),
        expected="poses in the same file (topics of poses or GNSS fixes; an .SRT beside a video), or a log with UTC",
        hint="; ".join(hints),
    )


def as_photo(record: PhotoRecord, image: Extracted, line: Timeline) -> PhotoRecord:
    """The record of an image that was taken out of a log: named by its place in the run, timed by the log."""
    time = line.utc(image.log_ns)
    notes = (*record.notes, image.note) if image.note else record.notes
    return replace(
        record,
        location=f"{RUN_IMAGES}{image.path.name}",
        time=time,
        time_source="header stamp" if time is not None else "",
        notes=notes,
    )


def stamp_of(image: Extracted) -> tuple[str, Stamp]:
    """An extracted image's name in the run, and its instant."""
    return f"{RUN_IMAGES}{image.path.name}", Stamp(image.line, image.log_ns)


def file_name(location: str, index: int, suffix: str) -> str:
    """The name of an image taken out of a bag or video: the source's, and its number in the stream."""
    name = Path(location).name if not is_url(location) and Path(location).is_dir() else stem(location)
    return f"{name}_{index:06d}{suffix}"


def write_images(
    folder: Path, location: str, indices: Ints, times_ns: Nanoseconds, images: Iterator[tuple[int, bytes, str]]
) -> Iterator[tuple[Path, int]]:
    """Writes images as they come out of their source.

    Args:
        folder: Where.
        location: The source.
        indices: (k,) numbers of the images in their stream.
        times_ns: (k,) their instants.
        images: Instant, file bytes and suffix of each.

    Yields:
        Path and instant of each image written.
    """
    number_of = {int(time): int(index) for time, index in zip(times_ns, indices, strict=True)}
    for time_ns, data, suffix in images:
        path = folder / file_name(location, number_of[time_ns], suffix)
        path.write_bytes(data)
        yield path, time_ns
