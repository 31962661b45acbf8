"""Photos, and images from bags and videos, put where a log says the camera was."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from pipeline.clocks.fit import Nanoseconds
from pipeline.engine.errors import UndeterminedError
from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import gimbal_angles
from pipeline.placing.clock import match_clock
from pipeline.placing.missing import unclaimed
from pipeline.placing.named import by_name
from pipeline.placing.photo_clock import ClockMatch, PhotoTimes, image_times, photo_times, span_text
from pipeline.placing.pose import CameraPoses, camera_poses
from pipeline.placing.timeline import Timeline
from pipeline.sources.accuracy import TimingSigmas
from pipeline.sources.dji import Attitude, Fix, Position
from pipeline.sources.photos import PhotoRecord
from pipeline.tracks.mount import Mount

# Header stamps and presentation times are those of the poses' own clock.
_STAMP_SIGMA_S = 0.001
_UNPLACED = "not placed by the log"


@dataclass(frozen=True, slots=True)
class Stamp:
    """The instant of an image that came out of a log.

    Args:
        line: Which log it came out of, an index of the timelines.
        log_ns: Its instant on that log's clock.
    """

    line: int
    log_ns: int


@dataclass(frozen=True, slots=True)
class Placed:
    """Photos with their poses, and how their clocks were found.

    Args:
        records: The photos in the order given, those that a log places with its pose.
        clocks: Rows of `clocks` for the cameras' clocks.
        notes: What to tell the user.
        missing: Exposures without a photo, for the manifest.
        idle: Logs that placed no image.
    """

    records: tuple[PhotoRecord, ...]
    clocks: tuple[Mapping[str, Any], ...] = ()
    notes: tuple[str, ...] = ()
    missing: Mapping[str, Sequence[str]] = field(default_factory=dict)
    idle: tuple[str, ...] = ()


def place(
    records: Sequence[PhotoRecord],
    lines: Sequence[Timeline],
    stamps: Mapping[str, Stamp],
    mount: Mount,
    *,
    clock_offset_s: float | None,
    y_up: bool,
) -> Placed:
    """Gives photos the poses of the logs.

    Args:
        records: The photos.
        lines: The logs.
        stamps: Instants of images that came out of a log, by location.
        mount: The camera on the vehicle, as stated.
        clock_offset_s: What the user says makes the photos' times UTC, s; None to find out.
        y_up: Whether the y axis of a local frame points up.

    Returns:
        The photos, placed; one that no log places keeps its own pose, or its reason.

    Raises:
        UndeterminedError: The logs place no photo of a camera, or name none.
    """
    work = _Work(lines, stamps, mount, clock_offset_s, y_up, {record.location: record for record in records})
    for number, line in enumerate(lines):
        if line.places:
            work.by_name(line)
            work.by_stamp(number, line)
    for (clock, _), group in work.clocks_left().items():
        work.by_clock(clock, group)
    work.unnamed()
    return Placed(
        tuple(work.by_location[record.location] for record in records),
        tuple(work.clocks),
        tuple(dict.fromkeys(work.notes)),
        work.missing,
        tuple(line.log.location for line in lines if line.log.location not in work.used),
    )


@dataclass(slots=True)
class _Work:
    """Photos on their way to their poses."""

    lines: Sequence[Timeline]
    stamps: Mapping[str, Stamp]
    mount: Mount
    clock_offset_s: float | None
    y_up: bool
    by_location: dict[str, PhotoRecord]
    clocks: list[Mapping[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    missing: dict[str, list[str]] = field(default_factory=dict)
    used: set[str] = field(default_factory=set)

    def by_name(self, line: Timeline) -> None:
        """Poses that belong to named images."""
        found = by_name(list(self.by_location.values()), line, self.mount, y_up=self.y_up)
        self.by_location.update({record.location: record for record in found})
        self.used.update([line.log.location] if found else [])

    def by_stamp(self, number: int, line: Timeline) -> None:
        """Images that came out of this log: their instants are on its clock."""
        inside = [
            self.by_location[name]
            for name, stamp in self.stamps.items()
            if stamp.line == number and name in self.by_location
        ]
        if inside:
            at_ns = np.array([self.stamps[record.location].log_ns for record in inside], np.int64)
            self._apply(inside, line, at_ns, np.full(len(inside), _STAMP_SIGMA_S), "log stamp")

    def clocks_left(self) -> dict[tuple[str, int], list[PhotoRecord]]:
        """Images that are not settled yet, by clock: a camera's, or the log's that they came out of (its index)."""
        out: dict[tuple[str, int], list[PhotoRecord]] = {}
        for record in self.by_location.values():
            stamp = self.stamps.get(record.location)
            settled = record.time_source.startswith("log ") or (
                stamp is not None and self.lines[stamp.line].places and not record.pose_problem
            )
            if settled or record.image_problem:
                continue
            if stamp is not None:
                name = PurePosixPath(self.lines[stamp.line].log.location).name
                out.setdefault((f"images of {name}", stamp.line), []).append(record)
            elif record.time is not None:
                out.setdefault((" ".join(f"photos {record.make} {record.model}".split()), -1), []).append(record)
        return out

    def by_clock(self, clock: str, group: Sequence[PhotoRecord]) -> None:
        """Images of one clock, log by log, until each has its place.

        Raises:
            UndeterminedError: No log places any photo of a camera: whoever names a log wants it used.
        """
        waiting, refused = list(group), []
        for line in self.lines:
            asking = [record for record in waiting if not self._came_from(record, line)]
            if not line.places or line.names_images or not asking:
                continue
            photos = self._times(asking)
            match = match_clock(photos, line, self._stated_s(photos))
            if not isinstance(match, ClockMatch):
                refused.append(f"{line.log.location}: {match}")
                continue
            self.clocks.append(_clock_row(clock, line, match))
            if match.events is not None and not photos.of_log:
                told = unclaimed(photos, match)
                self.missing.setdefault("photos", []).extend(told.photos)
                self.missing.setdefault("triggers", []).extend(told.triggers)
            self._placed_by(line, photos, match)
            waiting = [record for record in waiting if self.by_location[record.location] is record]
        stamped = group[0].location in self.stamps
        if refused and len(waiting) == len(group) and not stamped:
            raise _unmatched(clock, group, self.lines, refused)
        # Frames of one video that no other log fits are rows with their reason: other videos may be well.
        reason = "; ".join(refused) if stamped and refused else "no log covers its time" if self.clocks else ""
        for record in waiting:
            self._unplaced(record, reason)

    def unnamed(self) -> None:
        """Photos left over that a log of named images does not name."""
        named = [line.log.location for line in self.lines if line.names_images]
        for record in list(self.by_location.values()):
            if named and not record.time_source.startswith("log ") and not record.pose_problem.startswith(_UNPLACED):
                self._unplaced(record, f"{named[0]} does not name it, or not it alone")

    def _times(self, records: Sequence[PhotoRecord]) -> PhotoTimes:
        """Times of images of one clock."""
        first = self.stamps.get(records[0].location)
        if first is None:
            return photo_times(records)
        return image_times(records, self.lines[first.line], [self.stamps[r.location].log_ns for r in records])

    def _stated_s(self, photos: PhotoTimes) -> float | None:
        """The user's offset, which is for clocks that show a time of day: that of a video counts from its start."""
        return None if photos.of_log and not photos.trusted else self.clock_offset_s

    def _came_from(self, record: PhotoRecord, line: Timeline) -> bool:
        stamp = self.stamps.get(record.location)
        return stamp is not None and self.lines[stamp.line] is line

    def _placed_by(self, line: Timeline, photos: PhotoTimes, match: ClockMatch) -> None:
        """Places the photos that this log covers; one within it that has no pose says why."""
        source = np.where(match.event >= 0, "log event", "log clock")
        self._apply(photos.records, line, match.log_ns, match.sigma_s, source, match.reason)

    def _apply(
        self,
        records: Sequence[PhotoRecord],
        line: Timeline,
        log_ns: Nanoseconds,
        sigma_s: Floats,
        source: Any,
        reasons: Sequence[str] = (),
    ) -> None:
        poses = camera_poses(line, log_ns, self.mount, y_up=self.y_up)
        self.notes += poses.notes
        sources = np.broadcast_to(np.asarray(source), len(records)).tolist()
        for k, record in enumerate(records):
            reason = (reasons[k] if reasons else "") or poses.reason[k]
            unaimed = not np.all(np.isfinite(poses.rotation[k]))
            if unaimed and np.all(np.isfinite(poses.centre_m[k])) and not (reasons and reasons[k]):
                # A log of positions alone: the photo's own attitude serves, where it has one.
                placed = _with_position(record, poses, k, float(sigma_s[k]))
                if record.attitude is None:
                    self.by_location[record.location] = replace(placed, pose_problem=reason)
                    continue
                self.by_location[record.location] = _with_time(placed, line, int(log_ns[k]), sources[k])
                self.used.add(line.log.location)
            elif not reason:
                placed = _with_attitude(_with_position(record, poses, k, float(sigma_s[k])), poses, k)
                self.by_location[record.location] = _with_time(placed, line, int(log_ns[k]), sources[k])
                self.used.add(line.log.location)
            elif not poses.outside[k]:
                self._unplaced(record, reason)

    def _unplaced(self, record: PhotoRecord, reason: str) -> None:
        """A photo that no log places: its own pose stands, or its reason."""
        if record.pose_problem and reason:
            self.by_location[record.location] = replace(record, pose_problem=f"{_UNPLACED}: {reason}")


def _with_time(record: PhotoRecord, line: Timeline, log_ns: int, source: str) -> PhotoRecord:
    """The exposure's UTC as the log says it; a log that knows no UTC leaves the photo's own time."""
    time = line.utc(log_ns)
    if time is None:
        return replace(record, time_source=f"{source}, {record.time_source} as time" if record.time else source)
    return replace(record, time=time, time_source=source)


def _with_attitude(record: PhotoRecord, poses: CameraPoses, k: int) -> PhotoRecord:
    yaw, pitch, roll = np.degrees(gimbal_angles(poses.rotation[k])).tolist()
    return replace(record, attitude=Attitude(yaw, pitch, roll, poses.source))


def _with_position(record: PhotoRecord, poses: CameraPoses, k: int, sigma_s: float) -> PhotoRecord:
    """A photo with a log's position, and what an error of its instant does to the pose."""
    timing = TimingSigmas(
        _triple(np.hypot(np.abs(poses.velocity_m_s[k]) * sigma_s, poses.bend_m[k])),
        _triple(np.degrees(np.hypot(poses.turning_rad_s[k] * sigma_s, poses.bend_rad[k]))),
    )
    record = replace(record, timing=timing, pose_problem="")
    if poses.frame is None:
        return replace(record, local_m=_triple(poses.centre_m[k]), position=None)
    latitude, longitude, _ = poses.frame.geodetic_from_enu(poses.centre_m[k])
    return replace(
        record,
        position=Position(float(latitude), float(longitude), poses.source),
        absolute_m=_known(poses.amsl_m[k]),
        relative_m=_known(poses.above_home_m[k]),
        ellipsoidal_m=_known(poses.ellipsoidal_m[k]),
        fix=Fix(
            sigma_horizontal_m=_known(poses.sigma_horizontal_m[k]), sigma_vertical_m=_known(poses.sigma_vertical_m[k])
        ),
    )


def _triple(values: Floats) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _clock_row(clock: str, line: Timeline, match: ClockMatch) -> dict[str, Any]:
    against = "UTC" if line.clock is not None else "the log's boot"
    return {
        "clock_id": clock,
        "source": clock.partition(" ")[0],
        "method": f"{match.method}; offset to {against}",
        "offset_s": match.offset_s,
        "sigma_s": match.offset_sigma_s,
        "drift_ppm": 1e6 * match.drift,
        "residual_s": match.residual_s,
        "anchors": match.anchors,
        "problem": match.note,
    }


def _unmatched(
    clock: str, group: Sequence[PhotoRecord], lines: Sequence[Timeline], refused: Sequence[str]
) -> UndeterminedError:
    """Both time spans, and why no method brought them together."""
    photos = photo_times(group)
    zone = photos.records[0].time_source if photos.trusted else "EXIF, no time zone"
    found = [f"{len(group)} {clock}, {span_text(*photos.time_ns[[0, -1]].tolist())} ({zone})"]
    for line in lines:
        stream = line.positions or line.local
        if stream is not None and len(stream.time_ns):
            first_ns, last_ns = line.utc_ns(stream.time_ns[[0, -1]]).tolist()
            span = f"{span_text(first_ns, last_ns)} ({line.log.time_base.source or 'UTC'})"
            if line.clock is None:
                span = f"{(last_ns - first_ns) / 1e9:.1f} s on a clock that nothing ties to UTC"
            found.append("; ".join([f"{line.log.location}, {span}", *line.log.losses]))
    return UndeterminedError(
        "E-CLOCK-02",
        "the photos' clock cannot be brought to the log's",
        found="; ".join(found),
        expected="camera events in the log, positions in the photos, or a stated offset",
        hint="; ".join(refused),
    )
