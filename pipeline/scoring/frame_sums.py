"""All sums of one frame's scored pixels, from which every figure follows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.lidar.reference import Reference
from pipeline.scoring.binned import PARALLAX_EDGES_DEG, BinnedSums, range_edges_m
from pipeline.scoring.bootstrap import intervals
from pipeline.scoring.calibration import CalibrationSums, MapSums
from pipeline.scoring.depth_rows import AlignedDepths
from pipeline.scoring.metrics import GroupedSums, MethodSums

# Cells of an image, across and down: what neighbouring pixels have in common they have within such a cell.
GRID = (8, 6)


@dataclass(frozen=True, slots=True)
class Scored:
    """The pixels of a frame that have a reference.

    Args:
        lines: Depths by every method, the published one first.
        reference: At the same pixels; all valid.
        pose_sigma_m: (n,) one sigma of what the frame's pose does to the reference, m.
        rays_in_enu: (n, 3) the pixels' rays, scaled to depth 1.
        image_size: Width and height, px.
    """

    lines: AlignedDepths
    reference: Reference
    pose_sigma_m: Floats
    rays_in_enu: Floats
    image_size: tuple[int, int]


@dataclass(frozen=True, slots=True)
class GridSums:
    """One method's sums of one frame by cells of the image.

    Args:
        n_cells: Cells with a scored pixel.
        n_covered: Those of them in which the method keeps one.
        kept: 95 % intervals (8, 2) of its metrics in this frame, cells drawn anew; None where too few have a pixel.
        common: The same on the pixels that every method keeps.
    """

    n_cells: int
    n_covered: int
    kept: Floats | None
    common: Floats | None

    @staticmethod
    def of(cell: Ints, depth_m: Floats, reference_m: Floats, kept: Bools, common: Bools) -> GridSums:
        """The sums of one method.

        Args:
            cell: (n,) cell of each pixel.
            depth_m: (n,) as of `MethodSums.of`.
            reference_m: (n,) as of `MethodSums.of`.
            kept: (n,) which the method keeps.
            common: (n,) which every method keeps.
        """
        count = GRID[0] * GRID[1]
        by_cell = (GroupedSums.of(depth_m[of], reference_m[of], cell[of], count) for of in (kept, common))
        return GridSums(len(np.unique(cell)), len(np.unique(cell[kept])), *map(intervals, by_cell))


@dataclass(frozen=True, slots=True)
class FrameSums:
    """One frame's sums.

    Args:
        methods: One entry per method of the job.
        by_range: The same by Euclidean distance of the reference point from the camera, m.
        by_parallax: The same by the angle between the two rays of the match, deg.
        grid: The same by cells of the image.
        calibration: Of the published method, against its sigma, the reference's spread and what the pose does to it.
        calibration_alone: The same without what the frame's pose does to the reference.
        map: Of the published method.
    """

    methods: tuple[MethodSums, ...]
    by_range: tuple[BinnedSums, ...]
    by_parallax: tuple[BinnedSums, ...]
    grid: tuple[GridSums, ...]
    calibration: CalibrationSums
    calibration_alone: CalibrationSums
    map: MapSums

    @staticmethod
    def of(scored: Scored, max_range_m: float) -> FrameSums:
        """The sums of one frame.

        Args:
            scored: Its pixels.
            max_range_m: Largest distance from the camera that is scored, m.
        """
        lines, reference = scored.lines, scored.reference.depth_m
        common = np.asarray(lines.kept.all(axis=1))
        columns = [(lines.depth_m[:, m], reference, lines.kept[:, m], common) for m in range(len(lines.methods))]
        # All are within the range; rounding must not put one beyond the last bin.
        distance = np.minimum(reference * np.linalg.norm(scored.rays_in_enu, axis=1), max_range_m)
        ranges, cell = range_edges_m(max_range_m), _cells(lines.pixels, scored.image_size)
        kept = lines.kept[:, 0]
        depth, sigma, reference = lines.depth_m[kept, 0], lines.sigma_m[kept, 0], reference[kept]
        spread = scored.reference.spread_m[kept]
        return FrameSums(
            tuple(MethodSums.of(*column) for column in columns),
            tuple(BinnedSums.of(distance, ranges, *column) for column in columns),
            tuple(BinnedSums.of(lines.parallax_deg, PARALLAX_EDGES_DEG, *column) for column in columns),
            tuple(GridSums.of(cell, *column) for column in columns),
            CalibrationSums.of(depth, sigma, reference, np.hypot(spread, scored.pose_sigma_m[kept])),
            CalibrationSums.of(depth, sigma, reference, spread),
            MapSums.of(depth, reference, scored.rays_in_enu[kept]),
        )


def _cells(pixels: Floats, image_size: tuple[int, int]) -> Ints:
    """(n,) the cell of each pixel, row by row."""
    # The image's edge is half a pixel outside the centre of its first one.
    place = np.floor((pixels + 0.5) * GRID / image_size).astype(np.int64)
    column, row = np.clip(place, 0, np.array(GRID) - 1).T
    out: Ints = row * GRID[0] + column
    return out
