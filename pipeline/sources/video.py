"""Videos: when each frame is shown, and single frames as lossless images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Bools, Ints
from pipeline.sources.files import beside, local_copy, stem
from pipeline.sources.png import png
from pipeline.sources.records import NS_PER_S, ImageStream, Nanoseconds

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

VIDEO_SUFFIXES = (".mp4", ".mov")


@dataclass(frozen=True, slots=True)
class _Index:
    """Frames in the order in which they are shown.

    Args:
        pts: (n,) presentation times in units of the stream's time base.
        key: (n,) whether decoding can begin there.
        unit: The time base, s.
    """

    pts: Ints
    key: Bools
    unit: Fraction

    @property
    def time_ns(self) -> Nanoseconds:
        """(n,) after the first frame that is shown."""
        since = (self.pts - self.pts[0]) * self.unit.numerator
        # Whole numbers: ticks of 1/90000 s have no exact decimals, and a frame is found again by its time.
        seconds, rest = np.divmod(since, self.unit.denominator)
        half = self.unit.denominator // 2
        out: Nanoseconds = seconds * NS_PER_S + (rest * NS_PER_S + half) // self.unit.denominator
        return out


def describe_video(location: str) -> tuple[ImageStream, dict[str, Any]]:
    """What a video is, without decoding more than its first frame.

    Args:
        location: Path or URL.

    Returns:
        The stream, its times counted from the first frame shown, as subtitles count them; and facts: "duration_s",
        "frame_rate_hz" (mean), "frames", "width", "height", "codec", "creation_time" (as the file says; DJI writes
        local time there and calls it UTC), "rotation_deg" (what a player would turn it by, counter-clockwise; not
        applied here).

    Raises:
        InputError: It is not there, or no video.
        ResourceError: It may not be read.
    """
    with _video(location) as (container, stream):
        index = _index(location, container, stream)
        time_ns = index.time_ns
        mean_ns = (time_ns[-1] - time_ns[0]) / max(len(time_ns) - 1, 1)
        context = stream.codec_context
        facts = {
            "duration_s": float(time_ns[-1] + mean_ns) / NS_PER_S,
            "frame_rate_hz": float(NS_PER_S / mean_ns) if mean_ns else 0.0,
            "frames": len(time_ns),
            "width": context.width,
            "height": context.height,
            "codec": context.name,
            "creation_time": container.metadata.get("creation_time", stream.metadata.get("creation_time", "")),
            "rotation_deg": _rotation_deg(container, stream, index),
        }
        name = Path(location).name
        return ImageStream(name, time_ns, "", context.name, context.width, context.height), facts


def frame_times(location: str) -> Nanoseconds:
    """When each frame is shown, without decoding.

    Args:
        location: Path or URL.

    Returns:
        (n,) ns after the first frame that is shown, rising.

    Raises:
        InputError: It is not there, or no video.
        ResourceError: It may not be read.
    """
    with _video(location) as (container, stream):
        return _index(location, container, stream).time_ns


def read_frames(location: str, times_ns: Sequence[int] | Nanoseconds) -> Iterator[tuple[int, bytes, str]]:
    """The frames that are shown nearest to some instants, each decoded exactly.

    Args:
        location: Path or URL.
        times_ns: ns after the first frame; rising order spares seeking.

    Yields:
        For each instant, in the order given: the frame's own time, the image (PNG, 8 bit RGB; the file's rotation not
        applied) and its suffix. A frame that cannot be decoded is left out.

    Raises:
        InputError: It is not there, or no video.
        ResourceError: It may not be read.
    """
    with _video(location) as (container, stream):
        index = _index(location, container, stream)
        time_ns = index.time_ns
        decoder = _Decoder(container, stream, index)
        image: tuple[int, bytes] | None = None
        for wanted in times_ns:
            at = _nearest(time_ns, int(wanted))
            if image is None or image[0] != at:
                frame = decoder.frame(at)
                image = None if frame is None else (at, png(frame.to_ndarray(format="bgr24")))
            if image is not None:
                yield int(time_ns[at]), image[1], ".png"


def srt_beside(location: str) -> str | None:
    """The subtitle file of the same name beside a video, in whatever case it is written; None where there is none."""
    wanted = stem(location).lower()
    return next((found for found in beside([location], (".srt",)) if stem(found).lower() == wanted), None)


class _Decoder:
    """Decodes forward as long as that reaches the wanted frame, and seeks to the keyframe before it otherwise."""

    def __init__(self, container: InputContainer, stream: VideoStream, index: _Index) -> None:
        self._container, self._stream, self._index = container, stream, index
        self._frames: Iterator[VideoFrame] = iter(())
        self._at = -1

    def frame(self, at: int) -> VideoFrame | None:
        """Frame number `at` in the order shown; None where it cannot be decoded."""
        import av  # noqa: PLC0415 - heavy

        keys = np.flatnonzero(self._index.key[: at + 1])
        key = int(keys[-1]) if len(keys) else 0
        target = int(self._index.pts[at])
        try:
            if not key <= self._at < at:
                self._container.seek(int(self._index.pts[key]), stream=self._stream, backward=True)
                self._frames = self._container.decode(self._stream)
            self._at = -1
            for frame in self._frames:
                if frame.pts is not None and frame.pts >= target:
                    if frame.pts > target or frame.is_corrupt:
                        return None
                    self._at = at
                    return frame
        except av.FFmpegError:
            # Damage between the keyframe and here; other frames may still be whole.
            return None
        return None


def _nearest(time_ns: Nanoseconds, wanted: int) -> int:
    after = int(np.searchsorted(time_ns, wanted))
    if after == 0 or after == len(time_ns):
        return min(after, len(time_ns) - 1)
    return after - 1 if wanted - time_ns[after - 1] <= time_ns[after] - wanted else after


def _rotation_deg(container: InputContainer, stream: VideoStream, index: _Index) -> int:
    frame = _Decoder(container, stream, index).frame(0)
    return 0 if frame is None else int(frame.rotation)


def _index(location: str, container: InputContainer, stream: VideoStream) -> _Index:
    """Reads the packets' times. Packets that an edit list hides are decoded but never shown."""
    import av  # noqa: PLC0415 - heavy

    pts, key = [], []
    try:
        for packet in container.demux(stream):
            if packet.pts is not None and packet.size and not packet.is_discard:
                pts.append(packet.pts)
                key.append(packet.is_keyframe)
    except av.FFmpegError:
        # What was read before the damage can still be shown.
        pass
    shown, first = np.unique(np.array(pts, np.int64), return_index=True)
    if not len(shown) or stream.time_base is None:
        raise _no_video(location, "no video frame")
    return _Index(shown, np.array(key, np.bool_)[first], stream.time_base)


@contextmanager
def _video(location: str) -> Iterator[tuple[InputContainer, VideoStream]]:
    import av  # noqa: PLC0415 - heavy

    with local_copy(location) as path:
        try:
            container = av.open(str(path), metadata_errors="replace")
        except av.FFmpegError as error:
            raise _no_video(location, error.strerror or type(error).__name__) from error
        with container:
            if not container.streams.video:
                raise _no_video(location, "no video stream")
            stream = container.streams.video[0]
            # The library's types do not say that a codec may be unknown.
            if getattr(stream, "codec_context", None) is None:
                raise _no_video(location, "a codec that is not known here")
            stream.thread_type = "AUTO"
            yield container, stream


def _no_video(location: str, found: str) -> InputError:
    return InputError(
        "E-VIDEO-01", "the video cannot be read", where=location, found=found,
        expected="an MP4 or MOV with H.264 or H.265",
        hint="copy it again from the card; a recording cut off by a power loss is repaired by putting the card back "
        "into the drone",
    )  # fmt: skip
