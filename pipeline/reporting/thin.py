"""An even choice of what is too much to draw."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import AnyArray


def evenly(rows: AnyArray, most: int) -> AnyArray:
    """At most `most` of some rows, evenly spaced, the first and the last among them."""
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.int64)]
