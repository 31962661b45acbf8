"""Which RTK exposure mark belongs to which photo: by number, and only where time and place agree."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median

from pipeline.sources import dji
from pipeline.sources.files import parent
from pipeline.sources.mrk import Mark
from pipeline.sources.photos import PhotoRecord

# DJI_0012, DJI_20220525101750_0012_V, MAX_0012: the running number, with an optional letter for the sensor.
_RUNNING_NUMBER = re.compile(r"_(\d{3,5})(?:_[A-Z]{1,2})?$")
_SAME_TIME_S = 2.0
# Time zones are whole quarters of an hour; a clock that is off by more could as well be numbers shifted by a photo.
_QUARTER_S = 900.0
# A photo's own position, rounded and without lever arm, is this near its exposure; a shifted assignment soon is not.
_SAME_PLACE_M = 25.0
_METRES_PER_DEGREE = 111_320.0


@dataclass(frozen=True, slots=True)
class MarkFile:
    """A read .MRK file."""

    location: str
    marks: tuple[Mark, ...]


@dataclass(frozen=True, slots=True)
class Exposures:
    """What the marks of a run say of its photos.

    Args:
        of_photo: Photo location to its mark.
        offset_s: Per mark file: the marks' time minus the photos' own, s; None where the photos have no time.
        residual_s: Per mark file: root mean square of the photos' times about that offset, s.
        used: Per mark file: how many photos it times.
        problems: Per mark file that was left aside: why.
    """

    of_photo: Mapping[str, Mark] = field(default_factory=dict)
    offset_s: Mapping[str, float | None] = field(default_factory=dict)
    residual_s: Mapping[str, float | None] = field(default_factory=dict)
    used: Mapping[str, int] = field(default_factory=dict)
    problems: Mapping[str, str] = field(default_factory=dict)


def running_number(frame_id: str) -> int | None:
    """The running number in a photo's name, None where it has none."""
    found = _RUNNING_NUMBER.search(frame_id)
    return int(found[1]) if found else None


def associate(records: Sequence[PhotoRecord], files: Sequence[MarkFile], clock_offset_s: float = 0.0) -> Exposures:
    """Gives photos their exposure marks.

    A mark belongs to a photo of the same folder with the same running number, if all photos of the file agree with
    their marks in time (within 2 s, up to a time zone: photo clocks run in local time) and in place. Where photos have
    no time the counts must agree. Order alone never decides: one lost frame would shift all that follow.

    Args:
        records: The photos.
        files: The mark files.
        clock_offset_s: What the user adds to the photos' times, s.

    Returns:
        The marks of the photos that have one, and the reason for each file that was left aside.
    """
    of_photo: dict[str, Mark] = {}
    offsets: dict[str, float | None] = {}
    residuals: dict[str, float | None] = {}
    used: dict[str, int] = {}
    problems: dict[str, str] = {}
    for file in files:
        photos = [r for r in records if r.width and parent(r.location) == parent(file.location)]
        several = sum(parent(other.location) == parent(file.location) for other in files) > 1
        pairs, problem = _pairs(photos, file.marks, several=several)
        if not problem:
            offset, residual, problem = _agreement(pairs, clock_offset_s)
        if problem:
            problems[file.location] = problem
            continue
        of_photo.update({photo.location: mark for photo, mark in pairs})
        offsets[file.location], residuals[file.location], used[file.location] = offset, residual, len(pairs)
    return Exposures(of_photo, offsets, residuals, used, problems)


def apply(record: PhotoRecord, mark: Mark | None) -> PhotoRecord:
    """A photo's record with position, height, sigmas and time from its exposure mark."""
    if mark is None:
        return record
    position = dji.Position(mark.latitude_deg, mark.longitude_deg, "mrk position")
    fix = dji.Fix(mark.quality, mark.sigma_east_m, mark.sigma_north_m, mark.sigma_up_m)
    return replace(record, position=position, absolute_m=mark.height_m, fix=fix, time=mark.time, time_source="mrk")


def _pairs(
    photos: Sequence[PhotoRecord], marks: Sequence[Mark], *, several: bool
) -> tuple[list[tuple[PhotoRecord, Mark]], str]:
    """Photo and mark by running number, or why they do not go together."""
    by_number = {mark.index: mark for mark in marks}
    numbers = [running_number(photo.frame_id) for photo in photos]
    pairs = [(p, by_number[n]) for p, n in zip(photos, numbers, strict=True) if n is not None and n in by_number]
    repeated = [number for number, count in Counter(numbers).items() if count > 1]
    problem = ""
    if len(by_number) != len(marks):
        problem = "two exposures have the same number: split the file by flight"
    elif any(number is None for number in numbers):
        problem = "photo names hold no running number: keep the names the drone gave"
    elif repeated:
        problem = f"two photos have the running number {repeated[0]}: one folder per flight and sensor"
    elif not pairs:
        problem = "no photo has the number of an exposure"
    elif len(pairs) < len(photos) and not several:
        problem = f"{len(photos) - len(pairs)} of {len(photos)} photos have no exposure of their number"
    elif any(photo.time is None for photo, _ in pairs) and len(pairs) != len(marks):
        problem = f"{len(pairs)} photos without times and {len(marks)} exposures: the counts must agree"
    return pairs, problem


def _agreement(
    pairs: Sequence[tuple[PhotoRecord, Mark]], clock_offset_s: float
) -> tuple[float | None, float | None, str]:
    """The marks' time minus the photos', its spread, and why they cannot be the same exposures."""
    for photo, mark in pairs:
        if photo.position is not None and (apart := _apart_m(photo.position, mark)) > _SAME_PLACE_M:
            return None, None, f"{photo.frame_id} is {apart:.0f} m from exposure {mark.index}: numbers are shifted"
    timed = [(photo, mark, (mark.time - photo.time).total_seconds()) for photo, mark in pairs if photo.time is not None]
    if not timed:
        return None, None, ""
    offset = float(round(median(difference for _, _, difference in timed)))
    stated = any(
        photo.time_source in {"utc_at_exposure", "exif+offset", "exif+gps zone", "gps"} for photo, _, _ in timed
    )
    left = offset - clock_offset_s
    if not (stated or clock_offset_s):
        left -= _QUARTER_S * round(left / _QUARTER_S)
    if abs(left) > _SAME_TIME_S:
        return (
            None,
            None,
            (f"photo times and exposure times are {left:+.0f} s apart beyond a time zone: set ingest.clock_offset_s"),
        )
    for photo, mark, difference in timed:
        if abs(difference - offset) > _SAME_TIME_S:
            late = f"{difference - offset:+.1f} s"
            return None, None, f"{photo.frame_id} and exposure {mark.index} are {late} apart when the others agree"
    residual = math.sqrt(sum((difference - offset) ** 2 for _, _, difference in timed) / len(timed))
    return offset, residual, ""


def _apart_m(position: dji.Position, mark: Mark) -> float:
    north = (position.latitude_deg - mark.latitude_deg) * _METRES_PER_DEGREE
    turned = (position.longitude_deg - mark.longitude_deg + 180.0) % 360.0 - 180.0
    return math.hypot(north, turned * _METRES_PER_DEGREE * math.cos(math.radians(mark.latitude_deg)))
