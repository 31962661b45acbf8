"""All sums of one frame's scored pixels, from which every figure follows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.lidar.reference import Reference
from pipeline.scoring.calibration import CalibrationSums, MapSums
from pipeline.scoring.depth_rows import AlignedDepths
from pipeline.scoring.metrics import MethodSums


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
class FrameSums:
    """One frame's sums.

    Args:
        methods: One entry per method of the job.
        calibration: Of the published method, against its sigma, the reference's spread and what the pose does to it.
        calibration_alone: The same without what the frame's pose does to the reference.
        map: Of the published method.
    """

    methods: tuple[MethodSums, ...]
    calibration: CalibrationSums
    calibration_alone: CalibrationSums
    map: MapSums

    @staticmethod
    def of(scored: Scored) -> FrameSums:
        """The sums of one frame."""
        lines, reference = scored.lines, scored.reference.depth_m
        common = np.asarray(lines.kept.all(axis=1))
        methods = tuple(
            MethodSums.of(lines.depth_m[:, m], reference, lines.kept[:, m], common) for m in range(len(lines.methods))
        )
        kept = lines.kept[:, 0]
        depth, sigma, reference = lines.depth_m[kept, 0], lines.sigma_m[kept, 0], reference[kept]
        spread = scored.reference.spread_m[kept]
        return FrameSums(
            methods,
            CalibrationSums.of(depth, sigma, reference, np.hypot(spread, scored.pose_sigma_m[kept])),
            CalibrationSums.of(depth, sigma, reference, spread),
            MapSums.of(depth, reference, scored.rays_in_enu[kept]),
        )
