"""DJI flight records (DJIFlightRecord_*.txt): recognised, and refused with what to do instead."""

from __future__ import annotations

import re

from pipeline.engine.errors import InputError
from pipeline.sources.files import opened
from pipeline.sources.records import FlightLog

_NAME = re.compile(r"DJIFlightRecord_[^/\\]*\.txt$", re.IGNORECASE)
_TEXT_BYTES = frozenset({*range(0x20, 0x7F), 0x09, 0x0A, 0x0D})
_VERSION_AT = 10
_ENCRYPTED_SINCE = 13


def is_format(head: bytes, name: str) -> bool:
    """Whether it is a flight record: a .txt file that is not text. DJI's own name for it settles a doubt."""
    if not name.lower().endswith(".txt") or not head or head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return False
    share = sum(byte not in _TEXT_BYTES for byte in head) / len(head)
    return (not _is_utf8(head) and share > 0.3) or (_NAME.search(name) is not None and b"\0" in head)


def _is_utf8(head: bytes) -> bool:
    """Whether it is text in UTF-8, cut off within a character perhaps."""
    try:
        head.decode("utf-8")
    except UnicodeDecodeError as error:
        return error.end == len(head) and len(head) - error.start < 4 and b"\0" not in head
    return b"\0" not in head


def read(location: str) -> FlightLog:
    """Refuses a flight record.

    Args:
        location: Path or URL.

    Returns:
        Never.

    Raises:
        InputError: Always; says how to convert it.
        ResourceError: It may not be read.

    Source: dji-log-parser (docs.rs/dji-log-parser), "Encryption in Version 13 and Later"; the version is byte 10.
    """
    with opened(location) as stream:
        head = stream.read(_VERSION_AT + 1)
    version = head[_VERSION_AT] if len(head) > _VERSION_AT else 0
    found = "a DJI flight record"
    if 0 < version < 100:
        found += f", log version {version}" + (": encrypted by DJI" if version >= _ENCRYPTED_SINCE else "")
    raise InputError(
        "E-DJI-04", "DJI flight records cannot be read: since log version 13 DJI encrypts them", where=location,
        found=found, expected="a CSV made from it",
        hint="upload it to airdata.com or phantomhelp.com/logviewer and download the CSV, or run dji-log-parser with "
        "an API key of your own (dji-log --csv flight.csv --api-key KEY RECORD.txt); then name the CSV instead",
    )  # fmt: skip
