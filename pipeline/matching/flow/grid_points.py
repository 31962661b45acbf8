"""Where to ask for dense matches when nobody asks for particular pixels."""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.geometry.arrays import Bytes, Floats, Singles
from pipeline.matching.images import resized, shrunk_size, to_full_pixels

_BLOCK_PX = 5
# A block of 5x5 px whose grey values bear noise of 2 levels, in both images, is placed along the direction of its
# weaker gradient g to no better than sqrt(2) * 2 / (5 g) px: half a pixel asks for 1.13 grey levels per px.
_LEAST_GRADIENT = 1.13
# OpenCV's eigenvalue of an 8-bit image with gradient g: (2 g / 255)^2 whatever the block.
_FLOOR = (2.0 * _LEAST_GRADIENT / 255.0) ** 2


def grid_points(image: Bytes, count: int, longest_px: int) -> Floats:
    """The best textured pixel of each cell of a regular grid.

    Best is where the smaller eigenvalue of the structure tensor is largest: a place that neither slides along an
    edge nor lies in a plain. Cells all of whose pixels stay below what noise allows to place to half a pixel give
    none.

    Args:
        image: (h, w) grey or (h, w, 3) red, green, blue.
        count: At most so many cells.
        longest_px: Longest side texture is looked at, as images are matched.

    Returns:
        (n, 2) px of the image as given, row by row.
    """
    height, width = image.shape[:2]
    size = shrunk_size(width, height, longest_px)
    small = resized(image, size)
    grey = small if image.ndim == 2 else np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), np.uint8)
    across = int(np.clip(np.sqrt(count * size[0] / size[1]), 1, size[0]))
    down = int(np.clip(count // across, 1, size[1]))
    columns, rows = (np.linspace(0, n, k + 1).round().astype(np.int64) for n, k in ((size[0], across), (size[1], down)))
    # Cells of one width: the narrower ones look at their last column twice.
    offsets = np.arange(int(np.diff(columns).max()))
    index = np.minimum(columns[:-1, None] + offsets, columns[1:, None] - 1)
    found = []
    for top, bottom in zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True):
        cells = _texture(grey, top, bottom)[:, index].transpose(1, 0, 2).reshape(across, -1)
        best = np.argmax(cells, axis=1)
        good = np.flatnonzero(cells[np.arange(across), best] >= _FLOOR)
        row, offset = np.divmod(best[good], len(offsets))
        found.append(np.stack([index[good, offset], top + row], axis=1))
    return to_full_pixels(np.concatenate(found).astype(np.float64), size, (width, height))


def _texture(grey: Bytes, top: int, bottom: int) -> Singles:
    """The smaller eigenvalue at some rows, as it would be of the whole image."""
    reach = _BLOCK_PX // 2 + 1
    first, last = max(0, top - reach), min(len(grey), bottom + reach)
    rows = np.ascontiguousarray(grey[first:last])
    return np.asarray(cv2.cornerMinEigenVal(rows, _BLOCK_PX), np.float32)[top - first : bottom - first]
