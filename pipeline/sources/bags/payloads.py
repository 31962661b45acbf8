"""Images and LiDAR sweeps of a bag, read when they are wanted and one at a time."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any, Literal

from pipeline.engine.errors import InputError
from pipeline.sources.bags.bag import MISFITS, open_bag
from pipeline.sources.bags.columns import of_epoch
from pipeline.sources.bags.container import Bag, Raw, Topic
from pipeline.sources.bags.decoders import Decoder, UndecodableError, decoder
from pipeline.sources.bags.images import UnknownEncodingError, image_file
from pipeline.sources.bags.messages import kind_of, stamp_ns
from pipeline.sources.bags.points import points_of_message
from pipeline.sources.bags.video_packets import VideoDecoder
from pipeline.sources.records import Sweep

_VIDEO = "foxglove/CompressedVideo"
_IMAGES = (
    "sensor_msgs/Image", "sensor_msgs/CompressedImage", "foxglove/RawImage", "foxglove/CompressedImage", _VIDEO,
)  # fmt: skip
_SWEEPS = ("sensor_msgs/PointCloud2", "foxglove/PointCloud")

_Wanted = set[int]


def read_images(location: str, stream: str, times_ns: Collection[int]) -> Iterator[tuple[int, bytes, str]]:
    """Images of a stream as image files, in the order of the bag.

    JPEG and PNG are passed through untouched; raw images and video frames become PNG. A damaged image is left out, so
    that its time does not come.

    Args:
        location: As `bags.open_bag`.
        stream: Topic, as in `ImageStream`.
        times_ns: Which images, by the times of `ImageStream`.

    Yields:
        Time, file content, and suffix (".jpg" or ".png").

    Raises:
        InputError: The bag cannot be read, has no such images, or they are encoded in a way that is not known.
        ResourceError: The bag may not be read.
    """
    wanted = {int(time_ns) for time_ns in times_ns}
    if not wanted:
        return
    video: VideoDecoder | None = None
    try:
        for topic, log_ns, message in _messages(location, stream, _IMAGES):
            if kind_of(topic.type) == _VIDEO:
                video = video or VideoDecoder(str(message.format))
                for times, picture in video.frames((stamp_ns(message), log_ns), message.data, wanted):
                    yield _taken(wanted, times), picture, ".png"
            elif (found := _time(message, log_ns, wanted)) is not None and (file := _file(message)) is not None:
                wanted.discard(found)
                yield found, *file
            if not wanted:
                return
        for times, picture in video.rest(wanted) if video else ():
            yield _taken(wanted, times), picture, ".png"
    except UnknownEncodingError as error:
        raise InputError(
            "E-BAG-02", "images are encoded in a way that is not known", where=f"{location} {stream}",
            found=str(error), expected=error.expected, hint="record colour images, or extract the photos yourself",
        ) from error  # fmt: skip


def read_sweeps(location: str, stream: str, epoch: Literal["utc", "boot"] | None = None) -> Iterator[Sweep]:
    """LiDAR sweeps of a stream, in the order of the bag. A damaged one is left out.

    Args:
        location: As `bags.open_bag`.
        stream: Topic, as in `SweepStream`.
        epoch: Of the bag's `TimeBase`; stamps of another clock then give way to log times, as in `SweepStream`.

    Yields:
        The sweeps.

    Raises:
        InputError: The bag cannot be read, or has no such sweeps, or their points have no x, y, z.
        ResourceError: The bag may not be read.
    """
    for _, log_ns, message in _messages(location, stream, _SWEEPS):
        names = [str(field.name) for field in message.fields]
        if not {"x", "y", "z"} <= set(names):
            raise InputError(
                "E-BAG-04", "LiDAR points without coordinates", where=f"{location} {stream}",
                found=", ".join(names) or "no fields", expected="fields x, y, z",
                hint="name another topic, or leave the sweeps out",
            )  # fmt: skip
        try:
            stamp = stamp_ns(message)
            stamped = stamp > 0 and (epoch is None or bool(of_epoch(stamp, epoch)))
            points, delay_s = points_of_message(message, stamp)
        except MISFITS:
            continue
        yield Sweep(stamp if stamped else log_ns, points, delay_s)


def _messages(location: str, stream: str, kinds: Collection[str]) -> Iterator[tuple[Topic, int, Any]]:
    """Decoded messages of one topic; those that cannot be decoded are left out."""
    with open_bag(location) as bag:
        decoders: dict[Topic, Decoder] = {}

        def wanted(topic: Topic) -> bool:
            if topic.name != stream or kind_of(topic.type) not in kinds:
                return False
            try:
                decoders[topic] = decoder(topic)
            except UndecodableError:
                return False
            return True

        for topic, log_ns, data in bag.messages(wanted):
            message = _decoded(decoders[topic], data)
            if message is not None:
                yield topic, log_ns, message
        if not decoders:
            raise _missing(bag, location, stream, kinds)


def _decoded(decode: Decoder, data: Raw) -> Any:
    try:
        return decode(data)
    except UndecodableError:
        return None


def _missing(bag: Bag, location: str, stream: str, kinds: Collection[str]) -> InputError:
    topics = sorted(name for name, kind in bag.types.items() if kind_of(kind) in kinds)
    return InputError(
        "E-BAG-03", "the bag has no such images or sweeps", where=location, found=f"no readable topic {stream}",
        expected=", ".join(topics) or "a topic of one of the types " + ", ".join(kinds),
        hint="name a topic that `epitransfer inspect` lists, or record it anew",
    )  # fmt: skip


def _time(message: Any, log_ns: int, wanted: _Wanted) -> int | None:
    """The time by which a message is wanted: header stamp or log time, whichever the stream goes by."""
    try:
        stamp = stamp_ns(message)
    except MISFITS:
        return None
    return next((time_ns for time_ns in (stamp, log_ns) if time_ns in wanted), None)


def _taken(wanted: _Wanted, times: tuple[int, int]) -> int:
    found = next(time_ns for time_ns in times if time_ns in wanted)
    wanted.discard(found)
    return found


def _file(message: Any) -> tuple[bytes, str] | None:
    try:
        return image_file(message)
    except UnknownEncodingError:
        raise
    except MISFITS:
        return None
