"""The public header block of a LAS file, held against the file's size before anything trusts its counts."""

from __future__ import annotations

import struct
from pathlib import Path

from pipeline.engine.errors import InputError

# LAS 1.4 R15, table 3: header size, offset to the points, VLRs, format, record length, legacy number of points.
_COMMON = struct.Struct("<HIIBHI")
_COMMON_AT = 94
# Number of EVLRs and of points, from LAS 1.4 on.
_EXTENDED = struct.Struct("<IQ")
_EXTENDED_AT = 243
_SHORTEST, _EXTENDED_FROM = 227, 375
_VLR_HEADER, _EVLR_HEADER = 54, 60
# Bit 7 of the format marks compressed points, whose size the header does not tell.
_COMPRESSED = 0x80


def check_public_header(path: Path) -> None:
    """Refuses a file that cannot hold what its header says it holds: a reader would loop or allocate without end.

    Args:
        path: LAS or LAZ file.

    Raises:
        InputError: Unreadable, no LAS file, damaged or cut short.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_EXTENDED_FROM)
        size = path.stat().st_size
    except OSError as error:
        raise _damaged(path, error.strerror or str(error)) from error
    if len(head) < _SHORTEST or head[:4] != b"LASF":
        raise _damaged(path, f"{size:,} bytes that begin with {head[:4]!r}, not LASF")
    header_size, points_at, vlrs, kind, record, count = _COMMON.unpack_from(head, _COMMON_AT)
    evlrs = 0
    if head[25] >= 4 and len(head) >= _EXTENDED_FROM:
        evlrs, points = _EXTENDED.unpack_from(head, _EXTENDED_AT)
        count = points or count
    if header_size + vlrs * _VLR_HEADER > points_at or evlrs * _EVLR_HEADER > size:
        raise _damaged(path, f"{vlrs:,} records before byte {points_at:,} and {evlrs:,} after the points")
    points_end = points_at + (0 if kind & _COMPRESSED else count * record)
    if points_end > size:
        raise _damaged(path, f"{size:,} bytes where the header speaks of {points_end:,}")


def _damaged(path: Path, found: str) -> InputError:
    return InputError(
        "E-LIDAR-02", "the LiDAR tile cannot be read", where=str(path), found=found,
        expected="a LAS, LAZ or COPC file, whole", hint="copy the file again, or take it out of score.lidar",
    )  # fmt: skip
