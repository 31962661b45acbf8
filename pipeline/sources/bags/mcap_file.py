"""The container MCAP, read from front to back with the help of its index where it has one."""

from __future__ import annotations

import io
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Header, Metadata, Schema, Statistics

from pipeline.sources.bags.container import (
    MAX_RECORD_BYTES,
    Bag,
    DamagedError,
    Message,
    Raw,
    Topic,
    Wanted,
    decompressed,
    log_time_ns,
    unreadable,
)

MAGIC = b"\x89MCAP0\r\n"
_FRAME = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_FOOTER_BYTES = _FRAME.size + 20
_DISTRO = re.compile(r"^\s*ros_distro:\s*['\"]?([\w-]+)", re.MULTILINE)


@dataclass(slots=True)
class _Summary:
    """The index at the end of a file."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: dict[int, ChunkIndex] = field(default_factory=dict)
    statistics: Statistics | None = None


class McapFile(Bag):
    """An MCAP file.

    Args:
        stream: The file.
        where: Its name, for messages.

    Raises:
        InputError: Not an MCAP file.

    Source: mcap.dev/spec.
    """

    def __init__(self, stream: BinaryIO, where: str) -> None:
        super().__init__("MCAP")
        self._stream = stream
        self._size = stream.seek(0, os.SEEK_END)
        stream.seek(0)
        if (found := stream.read(len(MAGIC))) != MAGIC:
            raise unreadable(where, f"begins with {found!r}", "an MCAP file")
        self._schemas: dict[int, Schema] = {}
        self._topics: dict[int, Topic] = {}
        self._wanted: dict[int, bool] = {}
        self._per_channel: Counter[int] = Counter()
        self._strangers = 0
        self._compressions: set[str] = set()
        self._summary = self._read_summary()
        self._schemas.update(self._summary.schemas)
        for channel in self._summary.channels.values():
            self._channel(channel)

    def messages(self, wanted: Wanted) -> Iterator[Message]:
        """As `Bag.messages`."""
        for opcode, begin, length in self._frames():
            if length > MAX_RECORD_BYTES and opcode in {Opcode.CHUNK, Opcode.MESSAGE}:
                self.losses.append(f"a record of {length} bytes at byte {begin} was left out")
            elif opcode == Opcode.CHUNK:
                if self._worth_reading(begin - _FRAME.size, wanted):
                    yield from self._chunk(self._content(begin, length), wanted)
            elif opcode in {Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL}:
                yield from self._record(opcode, self._content(begin, length), wanted)
            elif opcode in {Opcode.HEADER, Opcode.METADATA} and length < 1 << 20:
                self._describe(opcode, self._content(begin, length))
        if self._strangers:
            self.losses.append(f"{self._strangers} messages of channels that the file does not describe")
        self.facts["compression"] = sorted(self._compressions)
        self._count()

    def _count(self) -> None:
        """Counts as the index has them: chunks without wanted messages are not opened."""
        statistics = self._summary.statistics
        if statistics is None:
            return
        self.counted.update(dict.fromkeys(self.counted, 0))
        for name in self.counted:
            self.counted[name] = sum(
                statistics.channel_message_counts.get(number, 0)
                for number, topic in self._topics.items()
                if topic.name == name
            )
        if statistics.message_count:
            self.spans(log_time_ns(statistics.message_start_time), log_time_ns(statistics.message_end_time))

    def _read_summary(self) -> _Summary:
        """The index, empty where there is none or it is damaged."""
        try:
            return _summary(memoryview(self._summary_content()))
        except (DamagedError, McapError, struct.error, UnicodeDecodeError) as error:
            self.losses.append(f"no index ({_told(error)}): the file was read message by message")
            return _Summary()

    def _summary_content(self) -> bytes:
        end = self._size - len(MAGIC)
        self._stream.seek(max(end - _FOOTER_BYTES, 0))
        tail = self._stream.read(_FOOTER_BYTES + len(MAGIC))
        if not tail.endswith(MAGIC) or _FRAME.unpack_from(tail) != (Opcode.FOOTER, 20):
            raise DamagedError("the file has no end: the recording was cut off")
        footer = Footer.read(_reader(tail[_FRAME.size :]))
        if footer.summary_start == 0:
            raise DamagedError("the file was written without one")
        if not 0 < end - footer.summary_start <= MAX_RECORD_BYTES:
            raise DamagedError("it is not where the file says")
        self._stream.seek(footer.summary_start)
        content = self._stream.read(end - footer.summary_start)
        if footer.summary_crc not in {0, zlib.crc32(content[:-4])}:
            raise DamagedError("its checksum is wrong")
        return content

    def _frames(self) -> Iterator[tuple[int, int, int]]:
        """Opcode, first byte and length of each record's content, up to the end of the data."""
        at = len(MAGIC)
        starts = sorted(self._summary.chunks)
        while at + _FRAME.size <= self._size:
            self._stream.seek(at)
            opcode, length = _FRAME.unpack(self._stream.read(_FRAME.size))
            begin = at + _FRAME.size
            if opcode in {Opcode.DATA_END, Opcode.FOOTER}:
                return
            if opcode and begin + length <= self._size:
                yield opcode, begin, length
                at = begin + length
                continue
            next_chunk = next((start for start in starts if start > at), None)
            lost = (self._size if next_chunk is None else next_chunk) - at
            self.losses.append(f"{lost} bytes from byte {at} on could not be read: a record of {length} bytes")
            if next_chunk is None:
                if opcode == Opcode.CHUNK:
                    yield opcode, begin, min(length, self._size - begin)
                return
            at = next_chunk
        if not self.losses:
            self.losses.append("the file ends early")

    def _content(self, begin: int, length: int) -> memoryview:
        self._stream.seek(begin)
        return memoryview(self._stream.read(length))

    def _worth_reading(self, at: int, wanted: Wanted) -> bool:
        """Whether a chunk holds wanted messages, or nobody knows; counts then come from the index."""
        index = self._summary.chunks.get(at)
        if index is None or self._summary.statistics is None or not index.message_index_offsets:
            return True
        self._compressions.add(index.compression or "none")
        return any(
            number not in self._topics or self._is_wanted(number, wanted) for number in index.message_index_offsets
        )

    def _is_wanted(self, number: int, wanted: Wanted) -> bool:
        if number not in self._wanted:
            self._wanted[number] = wanted(self._topics[number])
        return self._wanted[number]

    def _chunk(self, content: memoryview, wanted: Wanted) -> Iterator[Message]:
        try:
            data = memoryview(self._unpacked(content))
        except (DamagedError, struct.error) as error:
            self.losses.append(f"a damaged chunk, its messages are lost: {_told(error)}")
            return
        at = 0
        while at + _FRAME.size <= len(data):
            opcode, length = _FRAME.unpack_from(data, at)
            begin = at + _FRAME.size
            at = begin + length
            if at > len(data):
                self.losses.append("the rest of a chunk is lost: a message longer than the chunk")
                return
            yield from self._record(opcode, data[begin:at], wanted)

    def _unpacked(self, content: memoryview) -> Raw:
        """A chunk's records, its checksum proven."""
        _, _, size, checksum, name_length = _CHUNK.unpack_from(content)
        begin = _CHUNK.size + name_length
        compression = bytes(content[_CHUNK.size : begin]).decode("ascii", "replace")
        self._compressions.add(compression or "none")
        (length,) = struct.unpack_from("<Q", content, begin)
        packed = content[begin + 8 : begin + 8 + length]
        whole = len(packed) == length
        data = decompressed(packed, compression, size, whole=whole)
        if checksum and whole and zlib.crc32(data) != checksum:
            raise DamagedError("its checksum is wrong")
        return data

    def _record(self, opcode: int, content: memoryview, wanted: Wanted) -> Iterator[Message]:
        if opcode == Opcode.MESSAGE:
            if len(content) < _MESSAGE.size:
                self._strangers += 1
                return
            number, _, log_time, _ = _MESSAGE.unpack_from(content)
            topic = self._topics.get(number)
            if topic is None:
                self._strangers += 1
                return
            log_ns = log_time_ns(log_time)
            self.saw(topic, log_ns)
            if self._is_wanted(number, wanted):
                yield topic, log_ns, content[_MESSAGE.size :]
        elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
            self._define(opcode, content)

    def _define(self, opcode: int, content: memoryview) -> None:
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(_reader(content))
                self._schemas.setdefault(schema.id, schema)
            else:
                self._channel(Channel.read(_reader(content)))
        except (McapError, struct.error, UnicodeDecodeError) as error:
            self.losses.append(f"the description of a channel is damaged: {_told(error)}")

    def _channel(self, channel: Channel) -> None:
        if channel.id in self._topics:
            return
        schema = self._schemas.get(channel.schema_id)
        if schema is None:
            topic = Topic(channel.topic, "", channel.message_encoding, "", b"")
        else:
            topic = Topic(channel.topic, schema.name, channel.message_encoding, schema.encoding, schema.data)
        self._topics[channel.id] = topic
        self.known(topic)

    def _describe(self, opcode: int, content: memoryview) -> None:
        """Who wrote the file."""
        try:
            if opcode == Opcode.HEADER:
                header = Header.read(_reader(content))
                self.facts.update({"library": header.library, "profile": header.profile})
            else:
                metadata = Metadata.read(_reader(content)).metadata
                found = _DISTRO.search(metadata.get("serialized_metadata", ""))
                distro = metadata.get("ROS_DISTRO") or (found[1] if found else "")
                if distro:
                    self.facts["ros_distro"] = distro
        except (McapError, struct.error, UnicodeDecodeError) as error:
            self.losses.append(f"the description of the file is damaged: {_told(error)}")


def _summary(content: memoryview) -> _Summary:
    out = _Summary()
    at = 0
    while at + _FRAME.size <= len(content):
        opcode, length = _FRAME.unpack_from(content, at)
        begin = at + _FRAME.size
        at = begin + length
        reader = _reader(content[begin:at])
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(reader)
            out.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(reader)
            out.channels[channel.id] = channel
        elif opcode == Opcode.CHUNK_INDEX:
            index = ChunkIndex.read(reader)
            out.chunks[index.chunk_start_offset] = index
        elif opcode == Opcode.STATISTICS:
            out.statistics = Statistics.read(reader)
    return out


def _reader(content: Raw) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))


def _told(error: Exception) -> str:
    return str(error) or "it ends early"
