"""World points from depths, with how the errors of both cameras and of the pixels move them.

A point lies at p = s v from the ref centre and q = p - B from the src centre (v the ref ray in ENU at z = 1, B the
baseline). The depth moves with the src ray's displacement D at the point, ds = a . D, a the depth's normal. With
world turns d and shifts e of the two cameras, D = e_src - e_ref + p x d_ref - q x d_src, and so, with M = v a^T,

    dX = (I - M) e_ref + M e_src - (I - M) [p]x d_ref - M [q]x d_src + pixels
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import PlacedPair
from pipeline.geometry.rotations import skew


@dataclass(frozen=True, slots=True)
class WorldPoints:
    """Points in ENU.

    Args:
        p_in_enu_m: (n, 3).
        jacobian: (n, 3, 12) by the errors of the two frames: turn and shift (rad, m, ENU) of ref, then of src.
        independent: (n, 3, 3) m^2, covariance of the error that no other pair has.
    """

    p_in_enu_m: Floats
    jacobian: Floats
    independent: Floats


def world_points(
    ref_px: Floats, depth_m: Floats, normal: Floats, pixel_sigma_m: Floats, ref_camera: Camera, placed: PlacedPair
) -> WorldPoints:
    """Points of one pair.

    Args:
        ref_px: (n, 2) pixels of ref as given.
        depth_m: (n,).
        normal: (n, 3) of the depth, on the ref camera's axes.
        pixel_sigma_m: (n,) the depth's sigma by the matched positions alone; they move a point along its ref ray.
        ref_camera: Camera of ref.
        placed: Both cameras as the depths were found with.
    """
    ref, src = placed.ref, placed.src
    v = ref_camera.rays(ref_px) @ ref.rotation.T
    p = depth_m[:, None] * v
    q = p - (src.centre - ref.centre)
    by_src = v[:, :, None] * (normal @ ref.rotation.T)[:, None, :]
    by_ref = np.eye(3) - by_src
    by_cameras = np.concatenate([-by_ref @ skew(p), by_ref, -by_src @ skew(q), by_src], axis=2)
    along = v * pixel_sigma_m[:, None]
    independent = along[:, :, None] * along[:, None, :] + by_cameras @ placed.noise @ np.swapaxes(by_cameras, 1, 2)
    return WorldPoints(ref.centre + p, by_cameras @ placed.gain, independent)
