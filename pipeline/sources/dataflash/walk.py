"""The walk over a binary DataFlash log: from message to message by their lengths, block by block, in bounded memory.

A message is two header bytes, a type, and as many bytes as the type's FMT message says. Nothing else marks where one
begins, and there is no checksum, so after damage the walk goes on at the next header that another one follows.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import AnyArray, Bools, Bytes, Ints
from pipeline.sources.dataflash.fields import TEXTS, WANTED, Found

_HEAD1, _HEAD2 = 0xA3, 0x95
_FMT, _FMT_BYTES = 0x80, 89
_BLOCK_BYTES = 4 << 20
# No message is longer than 255 bytes; to judge one, the messages that begin inside it are looked at, and what follows.
_MARGIN_BYTES = 1024
_INNER_HEADS = 128
# Headers taken at once: few while formats are being defined, for each one changes what follows it.
_FEWEST, _MOST = 64, 1 << 16
# A sound log defines a few hundred formats.
_MOST_DEFINITIONS = 20_000
# Shorter than this, what follows the last message is the rest of a flash page (DFReader says 528 bytes).
_PAGE_BYTES = 528


@dataclass(frozen=True, slots=True)
class _Definition:
    """What an FMT message says of a type.

    Args:
        name: The message's name.
        stated: Bytes of a message by the FMT's length.
        fitting: Bytes of a message by the FMT's fields, 0 when a field is of no known kind.
        layout: The wanted fields within a message, without its header; None when there are none.
        divisors: Of each wanted number, what to divide it by.
    """

    name: str
    stated: int
    fitting: int
    layout: np.dtype[np.void] | None
    divisors: dict[str, float]


def walk(stream: BinaryIO, found: Found, where: str) -> None:
    """Reads the wanted messages of a binary log.

    Args:
        stream: The log, read from its beginning to its end, block by block.
        found: Where messages, counts and losses are put.
        where: The log's name, for messages.

    Raises:
        InputError: The file is not a log that was damaged, but noise.

    Source: ArduPilot, libraries/AP_Logger/LogStructure.h; pymavlink, DFReader.py (formats and their multipliers).
    """
    walker = _Walker(found, where)
    rest = b""
    while True:
        fresh = stream.read(_BLOCK_BYTES)
        data = rest + fresh
        rest = data[walker.block(np.frombuffer(data, np.uint8), last=not fresh) :]
        if not fresh:
            break
    walker.finish(rest)


class _Walker:
    """State of a walk: the formats so far, and where the last message ended."""

    def __init__(self, found: Found, where: str) -> None:
        self._found = found
        self._where = where
        self._lengths = np.zeros(256, np.int64)
        self._lengths[_FMT] = _FMT_BYTES
        self._definitions = {_FMT: _Definition("FMT", _FMT_BYTES, _FMT_BYTES, None, {})}
        self._raw: dict[int, bytes] = {}
        self._disputed: dict[int, list[int]] = {}
        self._strange: dict[str, str] = {}
        self._seen: Counter[int] = Counter()
        self._defined = 0
        self._heads = _FEWEST
        self._skipped = self._total = 0

    def block(self, data: Bytes, *, last: bool) -> int:
        """Reads the messages of a block.

        Args:
            data: (n,) bytes, beginning where the walk stands.
            last: Whether the file ends with them.

        Returns:
            How many bytes are done; the block after this one begins with the others.
        """
        heads = _heads(data)
        limit = len(data) if last else max(len(data) - _MARGIN_BYTES, 0)
        # A message that begins past the limit is left to the next block, which sees what follows it.
        usable = int(np.searchsorted(heads, limit))
        at, first = 0, 0
        while first < usable:
            stop = min(first + self._heads, usable)
            at, first = self._stretch(data, heads, first, stop, at, last)
        # Bytes before the limit that no message claims are lost; the file's last ones are judged at its end.
        done = at if last else max(at, limit)
        self._skipped += done - at
        self._total += done
        return done

    def finish(self, rest: bytes) -> None:
        """Says what was lost; `rest` is what follows the last message."""
        self._total += len(rest)
        padding = not rest.strip(b"\0") or not rest.strip(b"\xff")
        head = rest[0] == _HEAD1 and rest[1:2] in (b"", bytes([_HEAD2])) if rest else False
        if head and len(rest) < _PAGE_BYTES:
            self._found.losses.append("the log ends in the middle of a message")
        elif not padding:
            self._skipped += len(rest)
        if self._skipped:
            self._found.losses.append(f"{self._skipped} of {self._total} bytes are damaged and were skipped")
        self._found.losses += self._strange.values()
        if not self._seen and not self._defined:
            raise InputError(
                "E-DATAFLASH-01",
                "the DataFlash log holds no message",
                where=self._where,
                found=f"{self._total} bytes without a whole FMT message",
                expected="an FMT message before the first of each kind",
                hint="download the log again from the vehicle",
            )

    def _stretch(self, data: Bytes, heads: Ints, first: int, stop: int, at: int, last: bool) -> tuple[int, int]:
        """Reads the messages that begin at heads[first:stop]; returns where they end and the next head's index."""
        near = heads[first : stop + _INNER_HEADS]
        kinds = data[near + 2]
        self._settle(data, near, kinds)
        lengths = self._lengths[kinds]
        chosen, count = _chosen(data, near, lengths, stop - first, at, last)
        chosen, changed = self._cut_at_definition(data, near, kinds, chosen)
        begins, types = near[chosen], kinds[chosen]
        self._keep(data, begins, types)
        sizes = lengths[chosen]
        end = int(begins[-1] + sizes[-1]) if len(begins) else at
        # Every byte between two messages, or before the first, is a byte that was skipped.
        self._skipped += end - at - int(sizes.sum())
        if changed:
            self._heads = _FEWEST
            self._define(data[begins[-1] + 3 : end].tobytes())
            return end, first + int(np.searchsorted(near, end))
        self._heads = min(self._heads * 4, _MOST)
        return end, first + count

    def _cut_at_definition(self, data: Bytes, near: Ints, kinds: Bytes, chosen: Ints) -> tuple[Ints, bool]:
        """The messages up to the first FMT that says something new, itself included; whether there is one."""
        for place in np.flatnonzero(kinds[chosen] == _FMT).tolist():
            begin = int(near[chosen[place]])
            raw = data[begin + 3 : begin + _FMT_BYTES].tobytes()
            if raw != self._raw.get(raw[0]):
                return chosen[: place + 1], True
        return chosen, False

    def _define(self, raw: bytes) -> None:
        kind = raw[0]
        self._raw[kind] = raw
        self._defined += 1
        if self._defined > _MOST_DEFINITIONS:
            raise InputError(
                "E-DATAFLASH-03",
                "the DataFlash log defines its formats anew without end",
                where=self._where,
                found=f"more than {_MOST_DEFINITIONS} definitions",
                expected="a few hundred",
                hint="download the log again from the vehicle",
            )
        if kind == _FMT:
            # The length of FMT itself is what the walk stands on.
            return
        definition = _definition(raw)
        self._definitions[kind] = definition
        possible = definition.fitting if definition.fitting <= 255 else 0
        self._lengths[kind] = definition.stated if definition.stated >= 3 else possible
        self._disputed.pop(kind, None)
        if possible not in (0, definition.stated):
            self._disputed[kind] = [0, 0]

    def _settle(self, data: Bytes, near: Ints, kinds: Bytes) -> None:
        """Where an FMT's length and its fields disagree, the bytes decide: which of the two leads to a header?"""
        for kind, votes in self._disputed.items():
            begins = near[kinds == kind]
            definition = self._definitions[kind]
            votes[0] += int(np.count_nonzero(_is_head(data, begins + definition.stated)))
            votes[1] += int(np.count_nonzero(_is_head(data, begins + definition.fitting)))
            fits = votes[1] > votes[0] or definition.stated < 3
            self._lengths[kind] = definition.fitting if fits else definition.stated

    def _keep(self, data: Bytes, begins: Ints, types: Bytes) -> None:
        """Counts messages, and keeps the wanted ones."""
        for kind, count in enumerate(np.bincount(types, minlength=256).tolist()):
            if not count:
                continue
            definition = self._definitions[kind]
            self._seen[kind] += count
            self._found.counts[definition.name] += count
            if definition.name in WANTED or definition.name in TEXTS or kind in self._disputed:
                self._decode(data, begins[types == kind], kind, definition)

    def _decode(self, data: Bytes, begins: Ints, kind: int, definition: _Definition) -> None:
        length = int(self._lengths[kind])
        if length != definition.stated or length != definition.fitting:
            whether = "" if length == definition.fitting else "; their fields were not read"
            self._strange[definition.name] = (
                f"the format of {definition.name} states {definition.stated} bytes and fields of "
                f"{definition.fitting or 'unknown size'}; its messages are {length} bytes long{whether}"
            )
        if length != definition.fitting or definition.layout is None:
            return
        bodies = np.lib.stride_tricks.sliding_window_view(data, length - 3)[begins + 3]
        records = bodies.view(definition.layout)[:, 0]
        if definition.name in TEXTS:
            self._keep_texts(records, definition)
            return
        columns = {name: (_own(records[name]), divisor) for name, divisor in definition.divisors.items()}
        if columns:
            self._found.add(definition.name, columns)

    def _keep_texts(self, records: AnyArray, definition: _Definition) -> None:
        names = definition.layout.names if definition.layout is not None and definition.layout.names else ()
        if definition.name == "MSG" and "Message" in names:
            for text in records["Message"].tolist():
                self._found.say(_text(text))
        elif {"Name", "Value"} <= set(names):
            for name, value in zip(records["Name"].tolist(), records["Value"].tolist(), strict=True):
                if isinstance(name, bytes) and isinstance(value, float | int):
                    self._found.set(_text(name), float(value))


def _heads(data: Bytes) -> Ints:
    """Where two header bytes and a type stand, in order."""
    found = np.flatnonzero(data[:-2] == _HEAD1) if len(data) > 2 else np.empty(0, np.int64)
    out: Ints = found[data[found + 1] == _HEAD2]
    return out


def _is_head(data: Bytes, places: Ints) -> Bools:
    inside = places < len(data) - 1
    at = np.where(inside, places, 0)
    out: Bools = inside & (data[at] == _HEAD1) & (data[np.minimum(at + 1, len(data) - 1)] == _HEAD2)
    return out


def _chosen(data: Bytes, near: Ints, lengths: Ints, count: int, at: int, last: bool) -> tuple[Ints, int]:
    """Which headers begin messages.

    Args:
        data: (n,) the block.
        near: (m,) headers, some more than those to be judged.
        lengths: (m,) of the messages that they would begin, 0 where the type is unknown.
        count: How many of the headers are to be judged.
        at: Where the message before them ended.
        last: Whether the file ends with the block.

    Returns:
        (k,) indices of messages' headers, and the index of the first header past the last message.
    """
    ends = near + lengths
    known = (lengths > 0) & (ends <= len(data))
    followed = known & (_is_head(data, ends) | (last & (ends == len(data))))
    linked = np.zeros(len(near), np.bool_)
    linked[:-1] = known[:-1] & (near[1:] == ends[:-1])
    taken = np.zeros(count, np.bool_)
    # A message that the next header follows directly needs no thought; the others are gone through one by one.
    odd = np.flatnonzero(~linked[:count])
    past = np.searchsorted(near, ends[odd])
    sound = np.append(np.flatnonzero(followed), len(near))
    inner = sound[np.searchsorted(sound, odd + 1)]
    here, end = 0, at
    for stop, after, within in zip(odd.tolist(), past.tolist(), inner.tolist(), strict=True):
        if stop < here:
            continue
        if stop > here:
            taken[here:stop] = True
            end = int(ends[stop - 1])
        here = stop + 1
        # A header inside the message that is followed by another says that this one was cut short, or is none. One
        # that nothing follows is believed only where the message before it ended.
        if followed[stop] or (known[stop] and near[stop] == end and within >= after):
            taken[stop], here, end = True, after, int(ends[stop])
        elif known[stop] and within < after:
            here = within
    taken[here:] = True
    return np.flatnonzero(taken), max(here, count)


def _definition(raw: bytes) -> _Definition:
    """What an FMT message says, its bytes without the header."""
    from pymavlink.DFReader import FORMAT_TO_STRUCT, DFFormat  # noqa: PLC0415 - heavy

    kind, stated, name, kinds, columns = struct.unpack("<BB4s16s64s", raw)
    texts = [part.split(b"\0")[0].decode("latin-1") for part in (name, kinds, columns)]
    if not all(letter in FORMAT_TO_STRUCT for letter in texts[1]):
        return _Definition(texts[0], stated, 0, None, {})
    fmt = DFFormat(kind, texts[0], stated, texts[1], texts[2])
    wanted = (*WANTED.get(texts[0], ()), *TEXTS.get(texts[0], ()))
    names: list[str] = []
    formats: list[str] = []
    offsets: list[int] = []
    divisors: dict[str, float] = {}
    offset = 0
    for column, letter, scale in zip(fmt.columns, fmt.format, fmt.msg_mults, strict=False):
        code = str(FORMAT_TO_STRUCT[letter][0])
        number = not code.endswith("s")
        if column in wanted and column not in names and (number or texts[0] in TEXTS):
            names.append(column)
            formats.append(f"<{code}" if number else f"S{code[:-1]}")
            offsets.append(offset)
            divisors[column] = 1.0 if scale is None else float(round(1.0 / scale))
        offset += struct.calcsize(f"<{code}")
    fitting = 3 + struct.calcsize(str(fmt.msg_struct))
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": fitting - 3})
    return _Definition(texts[0], stated, fitting, layout if names else None, divisors)


def _own(column: AnyArray) -> AnyArray:
    """A column by itself: a view would keep the whole messages."""
    return np.ascontiguousarray(column).copy()


def _text(raw: bytes) -> str:
    return raw.split(b"\0")[0].decode("utf-8", "replace").strip()
