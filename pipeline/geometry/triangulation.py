"""Direct linear triangulation: the baseline that epipolar transfer is compared with."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.poses import RelativePose


def dlt_depth(ref_xy: Floats, src_xy: Floats, pose: RelativePose) -> Floats:
    """Depth in ref of the homogeneous least-squares point of each match.

    Args:
        ref_xy: (2, n) ideal image-plane coordinates in ref.
        src_xy: (2, n) ideal image-plane coordinates in src.
        pose: src_from_ref.

    Returns:
        (n,) m; negative or not finite where the rays do not meet in front of ref.

    Source: Hartley and Zisserman, Multiple View Geometry, 12.2.
    """
    ref = np.eye(3, 4)
    src = np.concatenate([pose.rotation, pose.translation[:, None]], axis=1)
    with np.errstate(invalid="ignore"):
        rows = [
            xy[axis][:, None] * matrix[2] - matrix[axis]
            for xy, matrix in ((ref_xy, ref), (src_xy, src))
            for axis in (0, 1)
        ]
    system = np.stack(rows, axis=1)
    usable = np.all(np.isfinite(system), axis=(1, 2))
    depth = np.full(ref_xy.shape[1], np.nan)
    point = np.linalg.svd(system[usable])[2][:, 3, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth[usable] = point[:, 2] / point[:, 3]
    return depth
