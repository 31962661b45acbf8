"""The container of ROS 1 bags (format 2.0), read from front to back: a bag that was cut off has no index."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from typing import BinaryIO

from pipeline.sources.bags.container import (
    MAX_RECORD_BYTES,
    Bag,
    DamagedError,
    Message,
    Raw,
    Topic,
    Wanted,
    decompressed,
    unreadable,
)
from pipeline.sources.records import NS_PER_S

MAGIC = b"#ROSBAG V"
_VERSION = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG_HEADER, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7
_MAX_HEADER_BYTES = 1 << 20
_U32 = struct.Struct("<I")
_TIME = struct.Struct("<II")

_Fields = dict[bytes, bytes]


class Rosbag1(Bag):
    """A ROS 1 bag.

    Args:
        stream: The file.
        where: Its name, for messages.

    Raises:
        InputError: Not such a bag, of another version, encrypted, or without one whole record.

    Source: wiki.ros.org/Bags/Format/2.0.
    """

    def __init__(self, stream: BinaryIO, where: str) -> None:
        super().__init__("ROS 1 bag")
        self._stream = stream
        self._topics: dict[int, Topic] = {}
        self._chunks: list[int] = []
        self._wanted: dict[int, bool] = {}
        self._strangers = 0
        self._compressions: set[str] = set()
        self._size = stream.seek(0, os.SEEK_END)
        stream.seek(0)
        found = stream.read(len(_VERSION))
        if found != _VERSION:
            raise unreadable(where, f"begins with {found!r}", "#ROSBAG V2.0", "rosbag migrate, for older versions")
        header = self._first_header(where)
        self._index_at = int.from_bytes(header.get(b"index_pos", b""), "little")
        self._indexed = len(_VERSION) < self._index_at <= self._size
        if self._indexed:
            self._read_index()
        else:
            self.losses.append(
                "no index at the end (the recording was cut off): the messages were read one by one, and what came "
                "after the cut is lost; rosbag reindex mends such bags"
            )

    def messages(self, wanted: Wanted) -> Iterator[Message]:
        """As `Bag.messages`."""
        for fields, data, whole in self._records(len(_VERSION)):
            op = _op(fields)
            if op == _CHUNK:
                yield from self._chunk(fields, data, wanted, whole=whole)
            else:
                yield from self._record(op, fields, data, wanted)
        if self._strangers:
            self.losses.append(f"{self._strangers} messages of connections that the bag does not describe")
        self.facts["compression"] = sorted(self._compressions)

    def _first_header(self, where: str) -> _Fields:
        """The bag header, which is padded so that it can be rewritten when the bag is closed."""
        for fields, _, _ in self._records(len(_VERSION)):
            if fields.get(b"encryptor"):
                raise unreadable(where, "an encrypted bag", "a plain bag", "rosbag decrypt")
            if _op(fields) == _BAG_HEADER:
                self.losses.clear()
                return fields
            break
        raise unreadable(where, "no bag header", "a ROS 1 bag", "rosbag reindex, or copy the file again")

    def _read_index(self) -> None:
        """Connections, whose first description may be damaged, and where chunks begin."""
        for fields, data, _ in self._records(self._index_at):
            if _op(fields) == _CONNECTION:
                self._connection(fields, data)
            elif _op(fields) == _CHUNK_INFO:
                self._chunks.append(int.from_bytes(fields.get(b"chunk_pos", b""), "little"))
        self._chunks.sort()
        # What is wrong here is told when the whole is read.
        self.losses.clear()

    def _records(self, at: int) -> Iterator[tuple[_Fields, Raw, bool]]:
        """Records of the file, their data only of the kinds that are read, and whether those are whole."""
        while at < self._size:
            after = next((place for place in self._chunks if at < place < self._size), self._size)
            try:
                fields, begin, length = self._header(at)
                op = _op(fields)
                whole = begin + length <= self._size
                if not whole and after < self._size:
                    raise DamagedError(f"a record of {length} bytes")  # noqa: TRY301 - one way to tell it
            except DamagedError as error:
                self.losses.append(f"{after - at} bytes from byte {at} on could not be read: {error}")
                at = after
                continue
            at = begin + length
            data = b""
            if op in {_CHUNK, _MESSAGE, _CONNECTION} and length <= MAX_RECORD_BYTES:
                data = self._stream.read(length)
            elif op in {_CHUNK, _MESSAGE, _CONNECTION}:
                self.losses.append(f"a record of {length} bytes at byte {begin} was left out")
                continue
            if not whole:
                self.losses.append(f"the file ends within a record of {length} bytes, of which {len(data)} are there")
            yield fields, data, whole

    def _header(self, at: int) -> tuple[_Fields, int, int]:
        """Header fields of a record, where its data begin, and their length."""
        self._stream.seek(at)
        length = _u32(self._stream.read(4))
        if length > _MAX_HEADER_BYTES:
            raise DamagedError(f"a record header of {length} bytes")
        header = self._stream.read(length)
        fields = _fields(header)
        return fields, at + 8 + length, _u32(self._stream.read(4))

    def _chunk(self, fields: _Fields, data: Raw, wanted: Wanted, *, whole: bool) -> Iterator[Message]:
        compression = fields.get(b"compression", b"none").decode("ascii", "replace")
        self._compressions.add(compression)
        try:
            size = _u32(fields.get(b"size", b""))
            content = memoryview(decompressed(data, compression, size, whole=whole))
            for inner, message in _inside(content):
                yield from self._record(_op(inner), inner, message, wanted)
        except DamagedError as error:
            self.losses.append(f"a damaged chunk, its messages after the damage are lost: {error}")

    def _record(self, op: int, fields: _Fields, data: Raw, wanted: Wanted) -> Iterator[Message]:
        if op == _CONNECTION:
            self._connection(fields, data)
        elif op == _MESSAGE:
            number = int.from_bytes(fields.get(b"conn", b""), "little")
            topic, stamp = self._topics.get(number), fields.get(b"time", b"")
            if topic is None or len(stamp) != 8:
                self._strangers += 1
                return
            seconds, nanoseconds = _TIME.unpack(stamp)
            log_ns = seconds * NS_PER_S + nanoseconds
            self.saw(topic, log_ns)
            if number not in self._wanted:
                self._wanted[number] = wanted(topic)
            if self._wanted[number]:
                yield topic, log_ns, data

    def _connection(self, fields: _Fields, data: Raw) -> None:
        number = int.from_bytes(fields.get(b"conn", b""), "little")
        if number in self._topics:
            return
        try:
            inner = _fields(bytes(data))
        except DamagedError as error:
            self.losses.append(f"the description of connection {number} is damaged: {error}")
            return
        name = _normal(fields.get(b"topic", b"").decode("utf-8", "replace"))
        kind = inner.get(b"type", b"").decode("utf-8", "replace")
        topic = Topic(name, kind, "ros1", "ros1msg", inner.get(b"message_definition", b""))
        self._topics[number] = topic
        self.known(topic)


def _inside(content: memoryview) -> Iterator[tuple[_Fields, memoryview]]:
    """Records of a chunk.

    Raises:
        DamagedError: One is longer than the chunk, or no record.
    """
    at = 0
    while at < len(content):
        length = _u32(content[at : at + 4])
        begin = at + 8 + length
        fields = _fields(bytes(content[at + 4 : begin - 4]))
        size = _u32(content[begin - 4 : begin])
        at = begin + size
        if at > len(content):
            raise DamagedError("a message longer than its chunk")
        yield fields, content[begin:at]


def _fields(header: bytes) -> _Fields:
    """Fields of a record header: each a length, a name, "=" and a value."""
    out: _Fields = {}
    at = 0
    while at < len(header):
        begin = at + 4
        at = begin + _u32(header[at:begin])
        name, equals, value = header[begin:at].partition(b"=")
        if not equals or at > len(header):
            raise DamagedError("a header field without a name")
        out[name] = value
    return out


def _op(fields: _Fields) -> int:
    value = fields.get(b"op", b"")
    if len(value) != 1:
        raise DamagedError("a record of no kind")
    return value[0]


def _u32(data: Raw) -> int:
    if len(data) != 4:
        raise DamagedError("the file ends within a record")
    value: int = _U32.unpack(data)[0]
    return value


def _normal(topic: str) -> str:
    """A topic without doubled slashes."""
    return ("/" if topic.startswith("/") else "") + "/".join(part for part in topic.split("/") if part)
