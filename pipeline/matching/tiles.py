"""Large images in pieces, so that memory does not grow with them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Bools, Bytes, Floats


@dataclass(frozen=True, slots=True)
class Tile:
    """A piece of an image.

    Args:
        left: First column of the piece.
        top: First row.
        right: Past its last column.
        bottom: Past its last row.
        core: Left, top, right and bottom of the part that is this piece's own; its margin belongs to others.
    """

    left: int
    top: int
    right: int
    bottom: int
    core: tuple[int, int, int, int]

    def cut(self, image: Bytes) -> Bytes:
        """The piece of an image (height, width[, 3])."""
        return image[self.top : self.bottom, self.left : self.right]

    def owns(self, pixels: Floats) -> Bools:
        """Whether pixels (n, 2) of the whole image lie in the piece's own part."""
        left, top, right, bottom = self.core
        columns, rows = pixels[:, 0], pixels[:, 1]
        own: Bools = (columns >= left - 0.5) & (columns < right - 0.5) & (rows >= top - 0.5) & (rows < bottom - 0.5)
        return own


def tiles(width: int, height: int, longest: int, margin: int) -> list[Tile]:
    """Cuts an image into pieces of about equal size.

    Args:
        width: Of the image, px.
        height: Of the image, px.
        longest: Longest side of a piece's own part.
        margin: By how much a piece reaches into its neighbours.

    Returns:
        The pieces, row by row; the image as it is when it is small enough.
    """
    columns, rows = math.ceil(width / longest), math.ceil(height / longest)
    xs, ys = (np.linspace(0, size, count + 1).round().astype(int) for size, count in ((width, columns), (height, rows)))
    return [
        Tile(
            max(0, left - margin),
            max(0, top - margin),
            min(width, right + margin),
            min(height, bottom + margin),
            (left, top, right, bottom),
        )
        for top, bottom in zip(ys[:-1].tolist(), ys[1:].tolist(), strict=True)
        for left, right in zip(xs[:-1].tolist(), xs[1:].tolist(), strict=True)
    ]
