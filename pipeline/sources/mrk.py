"""RTK exposure marks (.MRK): one line per photo with GPS time, position after lever arm, and sigmas."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import datetime

from pipeline.clocks.gps import utc_from_gps
from pipeline.engine.errors import InputError

_MAX_BYTES = 64 << 20
_NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_LABELLED = re.compile(rf"({_NUMBER})\s*,\s*([A-Za-z]+)\b")
_SIGMAS = re.compile(rf"({_NUMBER})\s*,\s*({_NUMBER})\s*,\s*({_NUMBER})(?![\d.])(?!\s*,\s*[A-Za-z])")
_HEAD = re.compile(rf"^\s*(\d+)\s+({_NUMBER})\s+\[\s*(\d+)\s*\]")


@dataclass(frozen=True, slots=True)
class Mark:
    """One exposure.

    Args:
        index: Number of the photo in its folder, as the file says.
        time: Exposure, UTC.
        latitude_deg: Camera centre, deg, lever arm applied.
        longitude_deg: Camera centre, deg, lever arm applied.
        height_m: Ellipsoidal height of the camera centre, m.
        sigma_north_m: One sigma, m.
        sigma_east_m: One sigma, m.
        sigma_up_m: One sigma, m.
        quality: Fix: 0 none, 16 single, 34 float, 50 fixed.
    """

    index: int
    time: datetime
    latitude_deg: float
    longitude_deg: float
    height_m: float
    sigma_north_m: float
    sigma_east_m: float
    sigma_up_m: float
    quality: int


def read_marks(data: bytes, where: str = "") -> list[Mark]:
    """Reads a .MRK file. Values are found by their labels: documents differ in the order of latitude and longitude.

    Args:
        data: The file's bytes.
        where: The file's name, for messages.

    Returns:
        The exposures in the file's order.

    Raises:
        InputError: A line is not an exposure, or the file has none.

    Source: DJI Zenmuse P1 user manual, "Timestamp .MRK file".
    """
    if len(data) > _MAX_BYTES:
        raise _wrong(where, f"{len(data)} bytes", f"at most {_MAX_BYTES} bytes")
    lines = data.decode("utf-8-sig", "replace").splitlines()
    marks = [_mark(line, f"{where}:{n}") for n, line in enumerate(lines, 1) if line.strip(" \t\x00")]
    if not marks:
        raise _wrong(where, "an empty file", "one line per exposure")
    return marks


def _mark(line: str, where: str) -> Mark:
    head = _HEAD.match(line)
    rest = line[head.end() :] if head else line
    labelled = {label.lower(): float(value) for value, label in _LABELLED.findall(rest)}
    sigmas = _SIGMAS.search(rest)
    if head is None or sigmas is None or not {"lat", "lon", "ellh"} <= labelled.keys():
        raise _wrong(where, line.strip()[:120], "index, seconds, [week], N, E, V, Lat, Lon, Ellh, three sigmas, Q")
    try:
        time = utc_from_gps(int(head[3]), float(head[2]))
        north, east, up = (float(value) for value in sigmas.groups())
        mark = Mark(
            int(head[1]), time, labelled["lat"], labelled["lon"], labelled["ellh"], north, east, up,
            int(labelled.get("q", 0.0)),
        )  # fmt: skip
    except (ValueError, OverflowError) as error:
        raise _wrong(where, str(error), "a GPS time and finite numbers") from error
    numbers = (mark.latitude_deg, mark.longitude_deg, mark.height_m, north, east, up)
    if (
        not all(math.isfinite(value) for value in numbers)
        or abs(mark.latitude_deg) > 90
        or abs(mark.longitude_deg) > 180
    ):
        raise _wrong(where, line.strip()[:120], "finite coordinates in degrees")
    return mark


def _wrong(where: str, found: str, expected: str) -> InputError:
    return InputError(
        "E-MRK-01", "the RTK mark file cannot be read", where=where, found=found, expected=expected,
        hint="copy it again from the card, or move it out of the photo folder",
    )  # fmt: skip
