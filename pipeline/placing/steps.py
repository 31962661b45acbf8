"""The steps of ingest: logs as timelines, images out of bags, photos read and placed, sweeps as tiles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pipeline.engine.errors import InputError, UndeterminedError
from pipeline.engine.stage import Context
from pipeline.geodesy.enu import LocalFrame
from pipeline.geometry.arrays import Ints
from pipeline.lidar.sweeps import on_clock, write_sweeps
from pipeline.placing.gather import (
    Extracted,
    as_photo,
    calibration_of,
    check_names,
    check_pose_topic,
    file_name,
    image_stream,
    stamp_of,
    wanted,
    write_images,
)
from pipeline.placing.place import Placed, place
from pipeline.placing.sensors import sensor_poses
from pipeline.placing.timeline import Timeline, timeline
from pipeline.sources.bags.payloads import read_images, read_sweeps
from pipeline.sources.calibration import read_calibration
from pipeline.sources.exposures import MarkFile
from pipeline.sources.files import MARK_SUFFIXES, beside, is_url, opened, stem
from pipeline.sources.intrinsics import SourcedCamera
from pipeline.sources.logs import BAG_SUFFIXES, LOG_SUFFIXES, read_log
from pipeline.sources.mrk import read_marks
from pipeline.sources.photos import PhotoRecord, read_photo
from pipeline.sources.records import ImageStream
from pipeline.sources.video import describe_video, read_frames, srt_beside
from pipeline.tracks.mount import Mount

_SHARD = 32
_IMAGES = 200
_UNDECODED = "the {what} is damaged here and the image cannot be decoded: copy the {what} again"


@dataclass(frozen=True, slots=True)
class Wishes:
    """What the user says that files do not.

    Args:
        camera: Calibration file of all images; None for what they or their logs say.
        mount: The camera on the vehicle.
        lidar_mount: The LiDAR on what is posed; None to find it in the bag.
        pose_topic: Topic of local poses; None for the longest.
        image_topic: Topic of images; None for the longest.
        y_up: Whether the y axis of a local frame points up.
        spacing_m: Way between two images taken out of a bag or video.
        clock_offset_s: What makes the photos' times UTC; None to find out.
        lidar_clock_offset_s: What makes the LiDAR's times the poses'.
    """

    camera: str | None
    mount: Mount
    lidar_mount: Mount | None
    pose_topic: str | None
    image_topic: str | None
    y_up: bool
    spacing_m: float
    clock_offset_s: float | None
    lidar_clock_offset_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Source:
    """A log and how its images are used.

    Args:
        line: What the log says.
        images: The stream of images that is used; None for none.
        video: The video that the stream is in; empty when it is the log itself.
    """

    line: Timeline
    images: ImageStream | None = None
    video: str = ""


def read_sources(
    context: Context,
    logs: Sequence[str],
    bags: Sequence[str],
    videos: Sequence[str],
    wishes: Wishes,
    named: frozenset[str],
) -> list[Source]:
    """Reads logs, then bags with their images, then videos with their subtitles; each file once.

    Args:
        context: For progress.
        logs: Logs whose images, if any, are not used.
        bags: Bags whose images are used.
        videos: Videos.
        wishes: What the user says.
        named: Those that the user names one by one, not as a folder or glob of many.

    Returns:
        The sources in that order; of a folder those that can be read.

    Raises:
        InputError: One cannot be read, has not the images or poses that the user names, or is called as another.
        UndeterminedError: A video has no subtitles.
    """
    check_names([*bags, *videos])
    read_anyway = {_place(name) for name in [*bags, *map(_subtitles, videos)]}
    jobs = [("log", name) for name in logs if _place(name) not in read_anyway]
    jobs += [("bag", name) for name in bags] + [("video", name) for name in videos]
    read = partial(_read_sources, wishes)
    sources: list[Source] = []
    unread: list[InputError] = []
    for (_, name), found in zip(jobs, context.map(read, jobs, shard=1, label="logs"), strict=True):
        if isinstance(found, Source):
            sources.append(found)
        elif name in named or not name.lower().endswith((*LOG_SUFFIXES, *BAG_SUFFIXES)):
            raise found
        else:
            unread.append(found)
            context.warn(f"{name} is left out: {found.message} ({found.found})")
    if unread and not sources:
        raise unread[0]
    if sources:
        check_pose_topic([source.line.log for source in sources], wishes.pose_topic)
    return sources


def _place(name: str) -> str:
    """One name for one file, however the user names it."""
    return name if is_url(name) else str(Path(name).resolve())


def _read_sources(wishes: Wishes, jobs: Sequence[tuple[str, str]]) -> Source | InputError:
    """One source; what cannot be read comes back as the error, for whoever knows how it was named."""
    ((kind, name),) = jobs
    try:
        if kind == "video":
            return Source(timeline(read_log(_subtitles(name))), describe_video(name)[0], name)
        log = read_log(name)
        stream = image_stream(log, wishes.image_topic) if kind == "bag" else None
    except InputError as error:
        return error
    return Source(timeline(log, wishes.pose_topic, stream.frame if stream else None), stream)


def _subtitles(video: str) -> str:
    beside_it = srt_beside(video)
    if beside_it is None:
        raise UndeterminedError(
            "E-VIDEO-10", "nothing says where the video's frames were taken", where=video,
            found="no .SRT beside it", expected="the drone's subtitles, of the same name",
            hint="copy the .SRT from the card too (in DJI's app: video captions on)",
        )  # fmt: skip
    return beside_it


def extract(context: Context, sources: Sequence[Source], wishes: Wishes) -> list[Extracted]:
    """Takes the images that are used out of bags and videos, into the run folder's `images`.

    Args:
        context: For the output folder and progress.
        sources: What was read.
        wishes: What the user says.

    Returns:
        The images, in order of source and time.

    Raises:
        UndeterminedError: Nothing says where any image of a source was taken.
    """
    folder = context.output("images")
    lines = [source.line for source in sources]
    jobs = []
    for number, source in enumerate(sources):
        if source.images is not None:
            chosen = wanted(
                number, lines, source.images, wishes.mount, wishes.spacing_m,
                clock_offset_s=wishes.clock_offset_s, y_up=wishes.y_up,
            )  # fmt: skip
            # Pieces of a stream are read side by side; each is some hundred images, so that seeking to it pays.
            jobs += [(number, source, chosen[begin : begin + _IMAGES]) for begin in range(0, len(chosen), _IMAGES)]
    take = partial(_take, folder, wishes)
    return [image for part in context.map(take, jobs, shard=1, label="bags") for image in part]


def _take(folder: Path, wishes: Wishes, jobs: Sequence[tuple[int, Source, Ints]]) -> list[Extracted]:
    out = []
    for number, source, chosen in jobs:
        stream, log = source.images, source.line.log
        if stream is None:
            continue
        times_ns = stream.time_ns[chosen]
        location = source.video or log.location
        images = (
            read_frames(location, times_ns) if source.video else read_images(location, stream.stream, times_ns.tolist())
        )
        camera = None if wishes.camera else calibration_of(log, stream.frame)
        written = {time_ns: path for path, time_ns in write_images(folder, location, chosen, times_ns, images)}
        for index, time_ns in zip(chosen.tolist(), times_ns.tolist(), strict=True):
            path = written.get(time_ns, folder / file_name(location, index, ".png"))
            problem = "" if time_ns in written else _UNDECODED.format(what="video" if source.video else "bag")
            out.append(Extracted(path, number, time_ns, camera, stream.note, problem))
    return sorted(out, key=lambda image: image.log_ns)


def read_photos(
    context: Context, photos: Sequence[str], images: Sequence[Extracted], sources: Sequence[Source], wishes: Wishes
) -> list[PhotoRecord]:
    """Reads photos and extracted images.

    Args:
        context: For progress.
        photos: Locations of photos.
        images: Images out of bags and videos.
        sources: What was read of logs.
        wishes: What the user says.

    Returns:
        Records, photos first.
    """
    stated = read_calibration(wishes.camera) if wishes.camera else None
    logged = [calibration_of(source.line.log, "") for source in sources if not source.images]
    of_photos = stated or next((camera for camera in logged if camera is not None), None)
    jobs = [(name, of_photos, "") for name in photos]
    jobs += [(str(image.path), stated or image.camera, image.problem) for image in images]
    records = [record for part in context.map(_read, jobs, shard=_SHARD, label="photos") for record in part]
    taken = zip(records[len(photos) :], images, strict=True)
    return [*records[: len(photos)], *(as_photo(record, image, sources[image.line].line) for record, image in taken)]


def _read(jobs: Sequence[tuple[str, SourcedCamera | None, str]]) -> list[PhotoRecord]:
    return [
        PhotoRecord(location, stem(location), image_problem=problem) if problem else read_photo(location, camera)
        for location, camera, problem in jobs
    ]


def placed(
    records: Sequence[PhotoRecord], images: Sequence[Extracted], sources: Sequence[Source], wishes: Wishes
) -> Placed:
    """Photos and images where the logs say the camera was."""
    return place(
        records,
        [source.line for source in sources],
        dict(stamp_of(image) for image in images),
        wishes.mount,
        clock_offset_s=wishes.clock_offset_s,
        y_up=wishes.y_up,
    )


def exposure_marks(photos: Sequence[str]) -> tuple[list[MarkFile], list[str]]:
    """The exposure marks beside photos, and those that are empty.

    A damaged file stops the run: poses would silently be metres worse.

    Args:
        photos: Locations of photos.

    Returns:
        The files that hold marks, and a sentence for each that holds none.
    """
    files, empty = [], []
    for location in beside(photos, MARK_SUFFIXES):
        with opened(location) as stream:
            data = stream.read()
        if data.strip(b"\x00 \t\r\n"):
            files.append(MarkFile(location, tuple(read_marks(data, location))))
        else:
            # Drones without a base station write the file and leave it empty.
            empty.append(f"{location} is empty")
    return files, empty


def write_sweeps_of(context: Context, sources: Sequence[Source], origin: LocalFrame | None, wishes: Wishes) -> int:
    """LiDAR sweeps of bags as tiles in the run's frame, in `sweeps`.

    Args:
        context: For the output folder.
        sources: What was read.
        origin: The run's ENU frame; None in a local frame.
        wishes: What the user says.

    Returns:
        Points written.
    """
    written = 0
    for number, source in enumerate(sources):
        log = source.line.log
        if source.images is None or not log.sweeps or not source.line.places:
            continue
        stream = max(log.sweeps, key=lambda sweeps: sweeps.points)
        try:
            poses = sensor_poses(source.line, stream, wishes.lidar_mount, origin, y_up=wishes.y_up)
        except UndeterminedError as error:
            # Points do not need the sweeps; `score` will say that there is nothing to score against.
            context.warn(f"the sweeps of {stream.stream} are left out: {error.message} ({error.hint})")
            continue
        folder = context.output("sweeps") / f"bag-{number:02d}"
        sweeps = read_sweeps(log.location, stream.stream, log.time_base.epoch)
        written += write_sweeps(sweeps, on_clock(poses, wishes.lidar_clock_offset_s), folder)
    return written
