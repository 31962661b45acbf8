"""Frames of a video whose packets came as messages, one picture each."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

from pipeline.sources.bags.images import UnknownEncodingError, payload
from pipeline.sources.png import png

_CODECS = {"h264": "h264", "h265": "hevc", "hevc": "hevc", "vp8": "vp8", "vp9": "vp9", "av1": "libdav1d"}
_WAITING = 64

Times = tuple[int, int]


class VideoDecoder:
    """Decodes packets in their order: a frame needs those before it.

    Args:
        form: Of the video, as the message says.

    Raises:
        UnknownEncodingError: No such video can be decoded.

    Source: Foxglove schema CompressedVideo.
    """

    def __init__(self, form: str) -> None:
        import av  # noqa: PLC0415 - heavy

        name = _CODECS.get(form.strip().lower())
        if name not in av.codecs_available:
            raise UnknownEncodingError(form, ", ".join(_CODECS))
        self._av = av
        self._context: Any = av.CodecContext.create(name, "r")
        # One thread: frames then come with their packets and not some packets later.
        self._context.thread_type = "NONE"
        self._times: dict[int, Times] = {}
        self._packets = 0

    def frames(self, times: Times, data: Any, wanted: Collection[int]) -> Iterator[tuple[Times, bytes]]:
        """Takes a packet.

        Args:
            times: Header stamp and log time of its picture.
            data: The packet, as the message has it.
            wanted: Times of the pictures that are wanted.

        Yields:
            Times and PNG of wanted pictures that are ready. A damaged packet gives none.
        """
        try:
            packet = self._av.Packet(bytes(payload(data)))
        except (ValueError, TypeError):
            return
        packet.pts = self._packets
        self._times[self._packets] = times
        self._times.pop(self._packets - _WAITING, None)
        self._packets += 1
        # An empty packet means the end to the decoder.
        if packet.size:
            yield from self._decoded(packet, wanted)

    def rest(self, wanted: Collection[int]) -> Iterator[tuple[Times, bytes]]:
        """Pictures that the decoder still holds when there are no more packets."""
        yield from self._decoded(None, wanted)

    def _decoded(self, packet: Any, wanted: Collection[int]) -> Iterator[tuple[Times, bytes]]:
        try:
            frames = self._context.decode(packet)
        except (self._av.error.FFmpegError, EOFError):
            return
        for frame in frames:
            times = self._times.pop(frame.pts, None) if frame.pts is not None else None
            if times is not None and any(time_ns in wanted for time_ns in times):
                yield times, png(frame.to_ndarray(format="bgr24"))
