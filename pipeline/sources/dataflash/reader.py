"""ArduPilot's DataFlash logs: binary (.BIN) and as text (.log)."""

from __future__ import annotations

import re
from typing import Any

from pipeline.engine.errors import InputError
from pipeline.sources.dataflash.fields import Found
from pipeline.sources.dataflash.lines import read_lines
from pipeline.sources.dataflash.receivers import receivers, time_base
from pipeline.sources.dataflash.streams import read_streams
from pipeline.sources.dataflash.walk import walk
from pipeline.sources.files import opened
from pipeline.sources.records import FlightLog

_BINARY = b"\xa3\x95\x80"
_TEXT = re.compile(rb"^(?:\xef\xbb\xbf)?FMT, *\d+,", re.MULTILINE)
# A log that was cut out of another, or has a few bytes of noise before its first message, is a log still.
_WITHIN_BYTES = 512
_FIRMWARE = re.compile(r"\b(?:Ardu)?(?:Copter|Plane|Rover|Sub|Blimp)\b.*|\bAPM:.*|.*\bV\d+\.\d+.*")


def is_format(head: bytes, name: str) -> bool:  # noqa: ARG001 - the content decides: COLMAP's files end in .bin too
    """Whether a file is a DataFlash log.

    Args:
        head: Its first bytes.
        name: Its path or URL.

    Returns:
        Whether an FMT message stands at its beginning, binary or as text.
    """
    return _is_binary(head) or _TEXT.search(head) is not None


def read(location: str) -> FlightLog:
    """Reads a DataFlash log.

    ATT's yaw is against true north: the firmware adds the declination to its compass. CAM and TRIG are read for their
    times alone; their positions and attitudes are those of when the message was written.

    Args:
        location: Path or URL.

    Returns:
        Positions, attitudes and camera events by the clock since boot, and what ties that clock to UTC.

    Raises:
        InputError: It is not there, or nothing is left of it.
        ResourceError: It may not be read.

    Source: ArduPilot, LogStructure.h of AP_Logger, AP_GPS, AP_AHRS, AP_Camera, AP_Mount, AP_Baro.
    """
    found = Found()
    with opened(location) as stream:
        binary = _is_binary(stream.read(_WITHIN_BYTES))
    # Opened anew and not wound back, which streams from the network cannot always do.
    with opened(location) as stream:
        if binary:
            walk(stream, found, location)
        else:
            read_lines(stream, found, location)
    seen = receivers(found)
    positions, attitudes, events = read_streams(found, seen)
    if not (positions or attitudes or events):
        raise InputError(
            "E-DATAFLASH-02",
            "the DataFlash log holds no position, no attitude and no camera event",
            where=location,
            found="; ".join([_counted(found), *found.losses]),
            expected="messages GPS, POS, ATT, MNT or CAM with a time since boot",
            hint="set LOG_BITMASK so that GPS, ATT and CAM are logged, or download the log again",
        )
    return FlightLog(
        location=location,
        kind="ArduPilot DataFlash" if binary else "ArduPilot DataFlash (text)",
        counts=dict(found.counts),
        time_base=time_base(seen),
        positions=positions,
        attitudes=attitudes,
        events=events,
        losses=tuple(found.losses),
        facts=_facts(found),
    )


def _is_binary(head: bytes) -> bool:
    return _BINARY in head[:_WITHIN_BYTES] and not _TEXT.match(head)


def _counted(found: Found) -> str:
    return ", ".join(f"{count} {name}" for name, count in found.counts.most_common(12)) or "no message"


def _facts(found: Found) -> dict[str, Any]:
    firmware = next((text for text in found.messages if _FIRMWARE.search(text)), "")
    return {"firmware": firmware, "parameters": len(found.parameters)}
