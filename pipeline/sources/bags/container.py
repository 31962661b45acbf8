"""What all containers of messages have in common: topics, raw messages, counts, and what was lost on the way."""

from __future__ import annotations

import bz2
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from pipeline.engine.errors import InputError
from pipeline.sources.records import NS_PER_S

# No recorder writes chunks or messages of this size; a damaged length must not ask for all memory.
MAX_RECORD_BYTES = 256 << 20
_LATEST_NS = (1 << 63) - 1

Raw = bytes | memoryview


@dataclass(frozen=True, slots=True)
class Topic:
    """One kind of messages in a bag.

    Args:
        name: Topic.
        type: Message type as the bag writes it ("sensor_msgs/msg/Imu", "foxglove.LocationFix").
        encoding: Of the messages: "ros1", "cdr", "protobuf", "json", or one that nobody here knows.
        schema_encoding: "ros1msg", "ros2msg", "ros2idl", "protobuf", "jsonschema"; empty without a schema.
        schema: The type's definition, empty when the bag has none.
    """

    name: str
    type: str
    encoding: str
    schema_encoding: str
    schema: bytes


Message = tuple[Topic, int, Raw]
Wanted = Callable[[Topic], bool]


class DamagedError(ValueError):
    """A piece of a bag that is not what its container says."""


class Bag(ABC):
    """A container of messages. Damage never raises: it ends up in `losses`, and what is whole is read.

    Args:
        kind: The format, for people.
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.losses: list[str] = []
        self.facts: dict[str, Any] = {}
        self.types: dict[str, str] = {}
        self.counted: Counter[str] = Counter()
        self._span_ns: tuple[int, int] | None = None

    @abstractmethod
    def messages(self, wanted: Wanted) -> Iterator[Message]:
        """The messages of wanted topics in the order of the file, each with its log time in ns.

        Their bytes are views that hold until the next one is asked for. Counts and losses are whole afterwards.
        """

    def known(self, topic: Topic) -> None:
        """Notes a topic, with or without messages."""
        self.types.setdefault(topic.name, topic.type)
        self.counted.setdefault(topic.name, 0)

    def saw(self, topic: Topic, log_ns: int) -> None:
        """Counts a message."""
        self.counted[topic.name] += 1
        self.spans(log_ns, log_ns)

    def spans(self, first_ns: int, last_ns: int) -> None:
        """Widens the time that the bag covers."""
        low, high = self._span_ns or (first_ns, last_ns)
        self._span_ns = min(low, first_ns), max(high, last_ns)

    @property
    def duration_s(self) -> float:
        """From the first message to the last, by log time."""
        low, high = self._span_ns or (0, 0)
        return (high - low) / NS_PER_S

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Log times of the first and the last message; None without messages."""
        return self._span_ns


def decompressed(data: Raw, compression: str, size: int, *, whole: bool = True) -> Raw:
    """A chunk's content.

    Args:
        data: As it stands in the file.
        compression: "" or "none", "lz4" (frame format), "zstd", "bz2".
        size: Of the content, bytes, as the file says: nothing larger is made of it.
        whole: Whether all of the data are there; of a chunk that was cut off, the beginning comes.

    Raises:
        DamagedError: It cannot be decompressed, or the size is wrong, or the compression is not known.
    """
    if size > MAX_RECORD_BYTES:
        raise DamagedError(f"a chunk of {size} bytes")
    if compression in {"", "none"}:
        return data
    try:
        if compression == "lz4":
            import lz4.frame  # type: ignore[import-untyped]  # noqa: PLC0415 - only where it is needed

            out: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
        elif compression == "zstd":
            out = zstd(data, size) if whole else _zstd_beginning(data, size)
        elif compression == "bz2":
            out = bz2.BZ2Decompressor().decompress(data, max_length=size)
        else:
            raise DamagedError(f"compression {compression!r}, which is not known")
    except (RuntimeError, OSError, EOFError, MemoryError) as error:
        raise DamagedError(f"{compression}: {error}") from error
    if len(out) != size and whole:
        raise DamagedError(f"{len(out)} of {size} bytes after {compression}")
    return out


def zstd(data: Raw, limit: int = MAX_RECORD_BYTES) -> bytes:
    """Zstandard's content, never more than a limit.

    Raises:
        DamagedError: It is no such frame, or larger.
    """
    import zstandard  # noqa: PLC0415 - only where it is needed

    try:
        stated = zstandard.get_frame_parameters(data).content_size
        if stated not in {zstandard.CONTENTSIZE_UNKNOWN, zstandard.CONTENTSIZE_ERROR} and stated > limit:
            raise DamagedError(f"a zstd frame of {stated} bytes where {limit} are expected")
        return zstandard.ZstdDecompressor().decompress(bytes(data), max_output_size=limit)
    except zstandard.ZstdError as error:
        raise DamagedError(f"zstd: {error}") from error


def _zstd_beginning(data: Raw, limit: int) -> bytes:
    import zstandard  # noqa: PLC0415 - only where it is needed

    try:
        return zstandard.ZstdDecompressor().stream_reader(data).read(limit)
    except zstandard.ZstdError as error:
        raise DamagedError(f"zstd: {error}") from error


def log_time_ns(value: int) -> int:
    """A log time that fits the records; the far future where it is none, so that no stream breaks."""
    return min(max(value, 0), _LATEST_NS)


def unreadable(where: str, found: str, expected: str, hint: str = "copy the file again, or record anew") -> InputError:
    """A bag of which nothing can be read."""
    return InputError("E-BAG-01", "the bag cannot be read", where=where, found=found, expected=expected, hint=hint)
