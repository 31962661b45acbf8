"""The messages of a ULog that are whole, so that damage costs what it hit and nothing behind it.

The library reads on through damage only as far as the logger left sync marks, may go back and forth over a damaged
definition for ever, and keeps all topics or counts none. So the file is walked here, message by message: every topic
is counted, and the wanted ones go on to the library as a small file without a fault.
"""

from __future__ import annotations

import mmap
import re
import struct
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from pipeline.engine.errors import InputError
from pipeline.sources.px4.topics import labelled

MAGIC = b"ULog\x01\x12\x35"
_HEADER_BYTES = 16
_HEAD = struct.Struct("<HB")
_SYNC = b"\x08\x00S\x2f\x73\x13\x20\x25\x0c\xbb\x12"
_SIZES = {
    "int8_t": 1, "uint8_t": 1, "bool": 1, "char": 1, "int16_t": 2, "uint16_t": 2, "int32_t": 4, "uint32_t": 4,
    "float": 4, "int64_t": 8, "uint64_t": 8, "double": 8,
}  # fmt: skip
# A message's size is 16 bits.
_MOST_BYTES = 0xFFFF
_DEEPEST = 8
_FORMAT = re.compile(rb"([\w/-]+):((?:[\w/-]+(?:\[\d{1,5}\])? \w+;)*[\w/-]+(?:\[\d{1,5}\])? \w+;?)")
_FIELD = re.compile(r"([\w/-]+)(?:\[(\d+)\])? (\w+)")
_TOPIC = re.compile(rb"[\w/-]+")
_KEY = re.compile(rb"(char\[\d+\]|u?int32_t) (\w+)")
# Kinds by which the thread is found again: their messages can be told from chance.
_SURE_KINDS = re.compile(rb"[DSFA]")
# The others, and how many of them must follow one another: a twentieth of all bytes are such a kind.
_UNSURE_KINDS = frozenset(b"BIMPQRLCO")
_IN_A_ROW = 3
_RELEASE_BYTES = 64 << 20
_IN_MEMORY_BYTES = 64 << 20


@dataclass(slots=True)
class Sifted:
    """What a walk over a file found.

    Args:
        counts: Records per topic ("sensor_gps", "sensor_gps[1]"), those left out included.
        dropout_ms: Durations of the gaps that the logger itself noted.
        losses: What was lost, one sentence each.
    """

    counts: dict[str, int] = field(default_factory=dict)
    dropout_ms: list[int] = field(default_factory=list)
    losses: list[str] = field(default_factory=list)


@dataclass(slots=True)
class _Subscription:
    """A topic under the number that its records bear in this file, and the bytes of a record without padding."""

    label: str
    wanted: bool
    length: int
    records: int = 0


def sift(path: Path, location: str, topics: frozenset[str], keys: frozenset[str]) -> tuple[Sifted, IO[bytes]]:
    """Walks a ULog.

    Args:
        path: The file.
        location: Its name, for messages.
        topics: Topics to pass on.
        keys: Information and parameters to pass on.

    Returns:
        What was found, and a ULog of the wanted messages for the library, which closes it.

    Raises:
        InputError: No ULog, one of a later layout, or not one record is left.

    Source: PX4 user guide, "ULog File Format" (version 1).
    """
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
        if len(head) < _HEADER_BYTES or not head.startswith(MAGIC):
            raise _wrong(location, f"begins with {head!r}", "a ULog: the bytes 'ULog' 01 12 35, version and time")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            walk = _Walk(data, location, topics, keys)
            walk.run()
    if not walk.found.counts:
        walk.out.close()
        raise _wrong(location, "no records" + "".join(f"; {loss}" for loss in walk.found.losses[:1]), "logged topics")
    walk.out.seek(0)
    return walk.found, walk.out


class _Walk:
    """One walk over a file."""

    def __init__(self, data: mmap.mmap, location: str, topics: frozenset[str], keys: frozenset[str]) -> None:
        self.data, self.location, self.topics, self.keys = data, location, topics, keys
        self.end = len(data)
        self.found = Sifted()
        self.out: IO[bytes] = tempfile.SpooledTemporaryFile(max_size=_IN_MEMORY_BYTES)  # noqa: SIM115 - handed on
        self.out.write(MAGIC + b"\x01" + data[8:_HEADER_BYTES])
        self.formats: dict[str, list[tuple[str, int, str]]] = {}
        self.subscriptions: list[_Subscription] = []
        # A record's first five bytes (size, kind, number) say all that can be checked.
        self.known: dict[bytes, tuple[_Subscription, int]] = {}
        self.appended: list[int] = []
        self.damage: Counter[str] = Counter()

    def run(self) -> None:
        """From the first message to the last."""
        data, known, write = self.data, self.known, self.out.write
        at, release = _HEADER_BYTES, _RELEASE_BYTES
        self._flags(at)
        while at < self.end:
            hit = known.get(data[at : at + 5])
            after = at + hit[1] if hit else self._other(at)
            if self.appended and after > self.appended[0] > at:
                # A crash cut this message short, and what it dumped was appended here.
                at = self.appended.pop(0)
                continue
            if after > self.end or after < 0:
                at = self._lost(at)
                continue
            if hit:
                hit[0].records += 1
                if hit[0].wanted:
                    # The library takes no record with the padding at its end.
                    write(_HEAD.pack(hit[0].length - 3, ord("D")) + data[at + 3 : at + hit[0].length])
            at = after
            if at > release:
                _release(data, at)
                release = at + _RELEASE_BYTES
        self._sum_up()

    def _other(self, at: int) -> int:
        """The end of a message that is no record of a known topic; -1 when it cannot be one."""
        head = self.data[at : at + 3]
        if len(head) < 3:
            return -1
        size, kind = int.from_bytes(head[:2], "little"), head[2]
        after = at + 3 + size
        if size == 0 or after > self.end:
            return -1
        if kind == ord("F"):
            return after if self._format(self.data[at:after]) else -1
        if kind == ord("A"):
            return after if self._subscribe(self.data[at:after]) else -1
        # The others have nothing to be checked by, but that a message follows. Of kinds unknown here none is used.
        if kind == ord("D") or not self._message_at(after):
            return -1
        if kind == ord("O") and size == 2:
            self.found.dropout_ms.append(int.from_bytes(self.data[at + 3 : after], "little"))
        if kind in b"IP" and not self.subscriptions:
            self._keep_value(self.data[at:after])
        return after

    def _message_at(self, at: int) -> bool:
        """Whether a message, or the file's end, is here: a sure one, or several that look like some in a row."""
        for _ in range(_IN_A_ROW):
            if at == self.end or self._sure(at):
                return True
            head = self.data[at : at + 3]
            after = at + 3 + int.from_bytes(head[:2], "little")
            if len(head) < 3 or head[2] not in _UNSURE_KINDS or head[:2] == b"\0\0" or after > self.end:
                return False
            at = after
        return True

    def _lost(self, at: int) -> int:
        """Goes on behind damage, to the next message that cannot be there by chance."""
        place = at + 3
        while match := _SURE_KINDS.search(self.data, place):
            place = match.end()
            begin = match.start() - 2
            if self._sure(begin):
                self.damage.update(places=1, bytes=begin - at)
                return begin
        self.damage["tail"] = self.end - at
        return self.end

    def _sure(self, at: int) -> bool:
        head = self.data[at : at + 11]
        if head[:5] in self.known or head == _SYNC:
            return True
        size = int.from_bytes(head[:2], "little")
        content = self.data[at + 3 : at + 3 + size] if head[2:3] in {b"F", b"A"} else b""
        if head[2:3] == b"F":
            return len(content) == size and _FORMAT.fullmatch(content) is not None
        return len(content) == size and content[3:].decode("latin-1") in self.formats

    def _flags(self, at: int) -> None:
        """The flag message, which comes first where there is one."""
        content = self.data[at : at + 43]
        if content[2:3] != b"B" or len(content) < 43:
            return
        incompatible = content[11:19]
        if incompatible[0] & ~1 or any(incompatible[1:]):
            raise _wrong(self.location, f"incompatible flags {incompatible.hex()}", "flags of ULog version 1")
        if incompatible[0]:
            offsets = struct.unpack("<3Q", content[19:43])
            self.appended = sorted(offset for offset in offsets if _HEADER_BYTES < offset < self.end)

    def _format(self, message: bytes) -> bool:
        match = _FORMAT.fullmatch(message, 3)
        if match is None:
            return False
        name = match[1].decode()
        if name not in self.formats and not self.subscriptions:
            fields = _FIELD.findall(match[2].decode())
            self.formats[name] = [(kind, int(count or 0), text) for kind, count, text in fields]
            self.out.write(message)
        return True

    def _subscribe(self, message: bytes) -> bool:
        """Takes note of a topic's number: every record of it begins alike from now on."""
        if len(message) < 7 or _TOPIC.fullmatch(message, 6) is None:
            return False
        topic, instance, number = message[6:].decode(), message[3], message[4:6]
        label = labelled(topic, instance)
        try:
            fields = _leaves(self.formats, topic)
        except ValueError as error:
            self.found.losses.append(f"all {label} records are lost: {error}")
            return True
        wanted = topic in self.topics
        if wanted and ("timestamp", "uint64_t") not in fields:
            self.found.losses.append(f"all {label} records were left out: they have no time")
            wanted = False
        most = sum(_SIZES[kind] for _, kind in fields)
        # Padding at the end need not be logged.
        while fields and fields[-1][0].startswith("_padding"):
            fields.pop()
        least = sum(_SIZES[kind] for _, kind in fields)
        subscription = _Subscription(label, wanted, least + 5)
        self.subscriptions.append(subscription)
        for size in range(least + 2, most + 3):
            self.known[_HEAD.pack(size, ord("D")) + number] = (subscription, size + 3)
        if wanted:
            self.out.write(message)
        return True

    def _keep_value(self, message: bytes) -> None:
        match = _KEY.fullmatch(message, 4, 4 + message[3])
        if match is None or match[2].decode() not in self.keys:
            return
        if match[1].startswith(b"char") or len(message) - match.end() == 4:
            self.out.write(message)

    def _sum_up(self) -> None:
        found = self.found
        for subscription in self.subscriptions:
            if subscription.records:
                found.counts[subscription.label] = found.counts.get(subscription.label, 0) + subscription.records
        if self.damage["places"]:
            found.losses.append(f"{self.damage['bytes']} bytes in {self.damage['places']} damaged places were skipped")
        if self.damage["tail"]:
            found.losses.append(f"the last message is cut short: {self.damage['tail']} bytes")
        if found.dropout_ms:
            lost_s = sum(found.dropout_ms) / 1e3
            found.losses.append(f"the logger itself lost data {len(found.dropout_ms)} times, {lost_s:.3f} s in all")


def _leaves(formats: dict[str, list[tuple[str, int, str]]], topic: str, depth: int = 0) -> list[tuple[str, str]]:
    """The fields of a topic, those of nested types in their place: names and basic types.

    Raises:
        ValueError: A type is not defined, or more than a message can hold.
    """
    if depth > _DEEPEST or not formats.get(topic):
        raise ValueError(f"the definition of {topic} is missing or damaged")
    out: list[tuple[str, str]] = []
    for kind, count, name in formats[topic]:
        for index in range(max(count, 1)):
            label = f"{name}[{index}]" if count else name
            if kind in _SIZES:
                out.append((label, kind))
            else:
                out += [(f"{label}.{inner}", basic) for inner, basic in _leaves(formats, kind, depth + 1)]
            if len(out) > _MOST_BYTES:
                raise ValueError(f"the definition of {topic} is damaged")
    if len({label for label, _ in out}) < len(out) or sum(_SIZES[kind] for _, kind in out) > _MOST_BYTES - 2:
        raise ValueError(f"the definition of {topic} is damaged")
    return out


def _release(data: mmap.mmap, at: int) -> None:
    """Lets go of pages that were read: a mapped log would count as memory until the end."""
    if hasattr(mmap, "MADV_DONTNEED"):
        data.madvise(mmap.MADV_DONTNEED, 0, at - at % mmap.PAGESIZE)


def _wrong(location: str, found: str, expected: str) -> InputError:
    return InputError(
        "E-ULOG-01", "the ULog cannot be read", where=location, found=found, expected=expected,
        hint="copy it from the vehicle again, or let ulog_info look at it",
    )  # fmt: skip
