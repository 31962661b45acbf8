"""Points as well-known binary, a whole column at once."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from pipeline.geometry.arrays import Floats

POINT_Z = 1001
"""The ISO type code of a point with z (OGC 06-103r4, 8.2.3)."""

# Byte order 1 is little endian.
_RECORD = np.dtype([("order", "u1"), ("type", "<u4"), ("xyz", "<f8", 3)])
POINT_Z_BYTES = _RECORD.itemsize


def point_z(points: Floats) -> bytes:
    """The WKB of points, one after the other.

    Args:
        points: (n, 3) x, y, z.

    Returns:
        n times 29 bytes.
    """
    records = np.empty(len(points), _RECORD)
    records["order"], records["type"], records["xyz"] = 1, POINT_Z, points
    return records.tobytes()


def point_z_column(points: Floats) -> pa.BinaryArray:
    """The WKB of points as an Arrow column.

    Args:
        points: (n, 3) x, y, z.

    Returns:
        n values of 29 bytes.
    """
    ends = np.arange(len(points) + 1, dtype=np.int32) * POINT_Z_BYTES
    return pa.Array.from_buffers(pa.binary(), len(points), [None, pa.py_buffer(ends), pa.py_buffer(point_z(points))])
