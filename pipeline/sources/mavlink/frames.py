"""MAVLink frames in a telemetry log: found one after another, checked, counted, and the wanted fields kept as columns.

A telemetry log is eight bytes of arrival time (big-endian microseconds since 1970), then a frame, over and over.

Source: https://mavlink.io/en/guide/serialization.html (frames of MAVLink 1 and 2, checksum, cut-off zeros).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

# Rows of one message: "at" (the record's place in the file, which is its order), "stamp" (arrival, us since 1970, -1
# where that is no time), then the message's fields by their names.
Rows = npt.NDArray[np.void]
# Who sent a message: system, component.
Sender = tuple[int, int]

STAMP_BYTES = 8
# 2100-01-01.
LATEST_STAMP_US = 4_102_444_800_000_000
_V1, _V2 = 0xFE, 0xFD
_SIGNED, _SIGNATURE_BYTES, _CHECKSUM_BYTES = 0x01, 13, 2
_CHUNK_BYTES = 1 << 20
# Stamp, header, payload, checksum, signature, and the stamp and magic byte that follow.
_LONGEST = 8 + 10 + 255 + 2 + 13 + 9
_SHORTEST = 8 + 6 + 2
# Where a record may begin after damage: a stamp before 2100 and a magic byte. Bytes of a payload look like that so
# seldom that the checksum has little left to refuse.
_BEGIN = re.compile(rb"\x00[\x00-\x0e].{6}[\xfd\xfe]", re.DOTALL)
_NAMED = 4


@dataclass(frozen=True, slots=True)
class Telemetry:
    """What a telemetry log holds.

    Args:
        counts: Messages by name, all senders together.
        versions: Of the frames seen: 1, 2 or both.
        rows: Wanted fields by message name and sender, in the order of the file.
        losses: What could not be read, one sentence each.
    """

    counts: dict[str, int]
    versions: list[int]
    rows: dict[tuple[str, Sender], Rows]
    losses: list[str]


def read_frames(stream: BinaryIO, wanted: Mapping[str, tuple[str, ...]]) -> Telemetry:
    """Reads a telemetry log from front to back, once; memory grows with the wanted fields alone.

    Args:
        stream: The log, at its beginning.
        wanted: Fields to keep, by message name.

    Returns:
        What it holds; nothing at all where no frame checks.
    """
    walk = _Walk(stream, wanted)
    walk.run()
    return walk.found()


@dataclass(slots=True)
class _Window:
    """The part of the file that is in memory."""

    stream: BinaryIO
    data: bytes = b""
    base: int = 0
    at: int = 0
    ended: bool = False

    def fill(self) -> bool:
        """Holds the longest record from `at` on, or all that is left; whether that may be a record."""
        while not self.ended and len(self.data) - self.at < _LONGEST:
            fresh = self.stream.read(_CHUNK_BYTES)
            self.base, self.data, self.at = self.base + self.at, self.data[self.at :] + fresh, 0
            self.ended = not fresh
        return len(self.data) - self.at >= _SHORTEST

    def find(self) -> bool:
        """Moves on to where the next record may begin; False at the file's end."""
        while self.fill():
            found = _BEGIN.search(self.data, self.at)
            if found:
                self.at = found.start()
                return self.fill()
            # A stamp may lie across the end of what was read so far.
            self.at = len(self.data) if self.ended else max(self.at, len(self.data) - STAMP_BYTES)
        self.at = len(self.data)
        return False


class _Frame(NamedTuple):
    """A frame whose header makes sense; `end` is where the next record begins."""

    version: int
    ident: int
    sender: Sender
    begin: int
    payload: int
    sum_at: int
    end: int


def _frame(data: bytes, at: int) -> _Frame | None:
    """The frame of a record, as far as its header goes."""
    begin = at + STAMP_BYTES
    magic, length = data[begin], data[begin + 1]
    if magic == _V1:
        payload = begin + 6
        sum_at = payload + length
        end = sum_at + _CHECKSUM_BYTES
        frame = _Frame(1, data[begin + 5], (data[begin + 3], data[begin + 4]), begin, payload, sum_at, end)
    elif magic == _V2 and begin + 10 <= len(data) and not data[begin + 2] & ~_SIGNED:
        payload = begin + 10
        sum_at = payload + length
        end = sum_at + _CHECKSUM_BYTES + (_SIGNATURE_BYTES if data[begin + 2] else 0)
        ident = data[begin + 7] | data[begin + 8] << 8 | data[begin + 9] << 16
        frame = _Frame(2, ident, (data[begin + 5], data[begin + 6]), begin, payload, sum_at, end)
    else:
        return None
    return frame if end <= len(data) else None


class _Walk:
    """One pass over a file."""

    def __init__(self, stream: BinaryIO, wanted: Mapping[str, tuple[str, ...]]) -> None:
        from pymavlink.dialects.v20 import ardupilotmega  # noqa: PLC0415 - heavy

        self._window = _Window(stream)
        self._checksum = ardupilotmega.x25crc
        self._kinds: Mapping[int, Any] = ardupilotmega.mavlink_map
        self._seeds = {ident: bytes([kind.crc_extra]) for ident, kind in self._kinds.items()}
        kept = {ident: kind for ident, kind in self._kinds.items() if kind.msgname in wanted}
        self._columns = {ident: _columns(kind, wanted[kind.msgname]) for ident, kind in kept.items()}
        self._sizes = {ident: kind.unpacker.size for ident, kind in kept.items()}
        self._fresh: dict[tuple[int, Sender], bytearray] = {}
        self._settled: dict[tuple[int, Sender], bytearray] = {}
        self._counts: Counter[int] = Counter()
        self._versions: set[int] = set()
        self._damage = _Damage()

    def run(self) -> None:
        """Walks all records; after a damaged place it goes on with the next record that checks."""
        window = self._window
        while window.fill():
            frame = _frame(window.data, window.at)
            if frame is not None and self._checks(frame):
                self._keep(frame)
                window.at = frame.end
            else:
                self._skip(frame)
        rest = len(window.data) - window.at
        if rest:
            self._damage.cut_short(window.base + window.at, rest)

    def found(self) -> Telemetry:
        """What the walk gathered."""
        for key in self._fresh:
            self._settle(key)
        names = {ident: self._name(ident) for ident in (*self._counts, *self._damage.wrong_sums)}
        rows = {
            (names[ident], sender): np.frombuffer(settled, self._columns[ident])
            for (ident, sender), settled in self._settled.items()
        }
        counts = {names[ident]: count for ident, count in self._counts.most_common()}
        return Telemetry(counts, sorted(self._versions), rows, self._damage.sentences(names))

    def _name(self, ident: int) -> str:
        kind = self._kinds.get(ident)
        return str(kind.msgname) if kind else f"UNKNOWN_{ident}"

    def _checks(self, frame: _Frame) -> bool:
        data = self._window.data
        seed = self._seeds.get(frame.ident)
        if seed is None:
            # The checksum of a message that the dialect does not know cannot be told; the record behind it can.
            at_end = self._window.ended and frame.end == len(data)
            return at_end or _BEGIN.match(data, frame.end) is not None
        found = data[frame.sum_at] | data[frame.sum_at + 1] << 8
        return bool(self._checksum(data[frame.begin + 1 : frame.sum_at] + seed).crc == found)

    def _keep(self, frame: _Frame) -> None:
        self._counts[frame.ident] += 1
        self._versions.add(frame.version)
        size = self._sizes.get(frame.ident)
        if size is None:
            return
        data, key = self._window.data, (frame.ident, frame.sender)
        rows = self._fresh.setdefault(key, bytearray())
        place = self._window.base + self._window.at
        rows += place.to_bytes(8, "little") + data[frame.begin - STAMP_BYTES : frame.begin]
        # MAVLink 2 cuts zeros off a payload's end; a later dialect may have added fields.
        rows += data[frame.payload : min(frame.sum_at, frame.payload + size)].ljust(size, b"\0")
        if len(rows) >= _CHUNK_BYTES:
            self._settle(key)

    def _settle(self, key: tuple[int, Sender]) -> None:
        """Puts the wanted columns of the raw rows gathered so far behind those of before."""
        ident, columns = key[0], self._columns[key[0]]
        raw = np.frombuffer(bytes(self._fresh[key]), _row_type(self._kinds[ident]))
        self._fresh[key].clear()
        rows = np.empty(len(raw), columns)
        for name in columns.names or ():
            rows[name] = raw[name]
        rows["stamp"][(rows["stamp"] < 0) | (rows["stamp"] > LATEST_STAMP_US)] = -1
        # A buffer that grows, and not a list of arrays: to join those would take their memory twice.
        self._settled.setdefault(key, bytearray()).extend(rows.tobytes())

    def _skip(self, frame: _Frame | None) -> None:
        """Goes on to the next record that checks, and notes what lay between."""
        window = self._window
        lost_at = window.base + window.at
        end = window.base + frame.end if frame is not None else -1
        window.at += 1
        while window.find():
            following = _frame(window.data, window.at)
            if following is not None and self._checks(following):
                break
            window.at += 1
        found_at = window.base + window.at
        if frame is not None and found_at == end and frame.ident in self._kinds:
            self._damage.wrong_sums[frame.ident] += 1
        elif window.at == len(window.data):
            self._damage.cut_short(lost_at, found_at - lost_at)
        else:
            self._damage.lose(lost_at, found_at - lost_at)


def _row_type(kind: Any) -> np.dtype[np.void]:
    """The layout of a message on the wire, after its place and its stamp."""
    codes = bytes(kind.native_format).decode().lstrip("<")
    fields: list[tuple[Any, ...]] = [("at", "<i8"), ("stamp", ">i8")]
    for name, code, length in zip(kind.ordered_fieldnames, codes, kind.array_lengths, strict=True):
        if code == "c":
            fields.append((name, f"S{max(length, 1)}"))
        else:
            fields.append((name, f"<{code}", (length,)) if length else (name, f"<{code}"))
    return np.dtype(fields)


def _columns(kind: Any, names: tuple[str, ...]) -> np.dtype[np.void]:
    """The layout of the columns that are kept, in this machine's byte order."""
    row = _row_type(kind)
    return np.dtype([(name, row[name].newbyteorder("=")) for name in ("at", "stamp", *names)])


@dataclass(slots=True)
class _Damage:
    """What did not check."""

    lost: int = 0
    places: int = 0
    first_at: int = 0
    tail: int = 0
    wrong_sums: Counter[int] = field(default_factory=Counter)

    def lose(self, at: int, length: int) -> None:
        """Bytes between two records that check."""
        if not self.places:
            self.first_at = at
        self.lost += length
        self.places += 1

    def cut_short(self, at: int, length: int) -> None:
        """Bytes at the file's end that are less than a record."""
        if length >= _LONGEST:
            self.lose(at, length)
        else:
            self.tail = length

    def sentences(self, names: Mapping[int, str]) -> list[str]:
        """What was lost, for people."""
        told = []
        if self.wrong_sums:
            most = ", ".join(f"{names[ident]} {count}" for ident, count in self.wrong_sums.most_common(_NAMED))
            told.append(
                f"{self.wrong_sums.total()} messages with a wrong checksum were skipped ({most}): damaged, or of "
                "another dialect"
            )
        if self.places:
            told.append(f"{self.lost} bytes in {self.places} damaged places were skipped, the first at {self.first_at}")
        if self.tail:
            told.append(f"the last message is cut short: {self.tail} bytes")
        return told
