"""Arrays of numbers in a figure as base64, a third of what digits take."""

from __future__ import annotations

import base64

import numpy as np

from pipeline.geometry.arrays import AnyArray

_TYPES = {
    np.dtype(np.float32): "f4",
    np.dtype(np.float64): "f8",
    np.dtype(np.uint8): "u1",
    np.dtype(np.int32): "i4",
}


def typed(values: AnyArray) -> dict[str, str]:
    """An array as plotly reads it from JSON; NaN stays NaN, which plotly takes for a gap.

    Args:
        values: (n,) or (rows, columns) of float32, float64, uint8 or int32.

    Returns:
        `dtype`, `bdata` and, of two dimensions, `shape`.

    Raises:
        KeyError: An array of another type, which plotly does not know or which wants narrowing first.

    Source: plotly.js, "typed array specification" (dtype, bdata, shape).
    """
    name = _TYPES[values.dtype]
    little = values.astype(values.dtype.newbyteorder("<"))
    found = {"dtype": name, "bdata": base64.b64encode(little.tobytes()).decode("ascii")}
    return found if values.ndim == 1 else found | {"shape": ", ".join(map(str, values.shape))}


def singles(values: AnyArray) -> dict[str, str]:
    """As `typed`, in single precision."""
    return typed(np.asarray(values, np.float32))
