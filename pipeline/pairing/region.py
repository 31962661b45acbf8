"""How far an epipole lies from the region of interest.

The region is where a level function of the pixel is not negative, inside the outline of a grid over the image. Its
border is traced through the grid's cells, two triangles each, with the level taken as linear on a triangle: a line
within a cell, not its nearest corner.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints


class BorderGrid:
    """The triangles and the outline of a grid of pixels.

    Args:
        ideal_px: (rows * columns, 2) undistorted pixels, row by row; NaN where the lens model gives no ray.
        columns: Pixels per row.
    """

    def __init__(self, ideal_px: Floats, columns: int) -> None:
        index = np.arange(len(ideal_px)).reshape(-1, columns)
        corners = (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
        a, b, c, d = (corner.ravel() for corner in corners)
        self._px = ideal_px
        self._triangles: Ints = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        self._outline: Ints = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])

    def margins(self, epipole_px: Floats, inside: Bools, level: Floats, frame: Ints) -> Floats:
        """Signed distance from each epipole to the region's border.

        Args:
            epipole_px: (m, 2) ideal pixels, NaN at infinity.
            inside: (m,) whether the epipole lies in the region.
            level: (n, k) of each frame at the grid's pixels; not negative inside the region.
            frame: (m,) row of `level` that an epipole belongs to.

        Returns:
            (m,) px: positive outside the region, negative inside; infinite when the epipole is at infinity or nothing
            belongs to the region.
        """
        known = np.where(np.isfinite(self._px).all(axis=1), level, -1.0)
        start, end = (ends[frame] for ends in self._borders(known))
        distance = np.sqrt(_squared_distances(epipole_px[:, None, :], start, end)).min(axis=1)
        return np.where(np.isnan(epipole_px).any(axis=1), np.inf, np.where(inside, -distance, distance))

    def _borders(self, level: Floats) -> tuple[Floats, Floats]:
        """Ends of the border's segments, (m, s, 2) each; NaN fills the rows of frames with fewer."""
        rows = np.arange(len(level))[:, None]
        at_corner = level[:, self._triangles] >= 0.0
        crossed = np.flatnonzero((at_corner.any(axis=2) != at_corner.all(axis=2)).any(axis=0))
        # Frames of one flight have their horizon in the same few cells.
        triangles, at_corner = self._triangles[crossed], at_corner[:, crossed]
        alone = np.where(at_corner.sum(axis=2) == 1, np.argmax(at_corner, axis=2), np.argmin(at_corner, axis=2))
        at = np.arange(len(crossed))
        apex, left, right = (triangles[at, (alone + turn) % 3] for turn in range(3))
        first = self._crossing(level, rows, apex, left)
        second = self._crossing(level, rows, apex, right)
        whole = at_corner.all(axis=2) | ~at_corner.any(axis=2)
        first[whole] = np.nan
        begin, finish = self._outline, np.roll(self._outline, -1)
        rim_first = self._clipped(level, rows, begin, finish)
        rim_second = self._clipped(level, rows, finish, begin)
        return np.concatenate([first, rim_first], axis=1), np.concatenate([second, rim_second], axis=1)

    def _crossing(self, level: Floats, rows: Ints, a: Ints, b: Ints) -> Floats:
        """Where the level is 0 between two pixels of the grid, (m, s, 2)."""
        level_a, level_b = level[rows, a], level[rows, b]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = level_a / (level_a - level_b)
            return self._px[a] + share[..., None] * (self._px[b] - self._px[a])

    def _clipped(self, level: Floats, rows: Ints, end: Ints, other: Ints) -> Floats:
        """An end of the outline's segments, moved to where the region ends; NaN where no part is in the region."""
        here, there = level[:, end] >= 0.0, level[:, other] >= 0.0
        moved = np.where(here[..., None], self._px[end], self._crossing(level, rows, end[None], other[None]))
        return np.where((here | there)[..., None], moved, np.nan)


def _squared_distances(point: AnyArray, start: Floats, end: Floats) -> Floats:
    """(m, s) px^2 from points to segments; infinite for segments that are NaN."""
    along, to = end - start, point - start
    length = np.einsum("msi,msi->ms", along, along)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.clip(np.einsum("msi,msi->ms", along, to) / length, 0.0, 1.0)
    share = np.where(length > 0.0, share, 0.0)
    gap = to - share[..., None] * along
    out = np.einsum("msi,msi->ms", gap, gap)
    return np.where(np.isnan(out), np.inf, out)
