"""World points from depths, with the covariance that pose, pixels and the flight's common error give them.

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
from pipeline.geometry.poses import Pose
from pipeline.geometry.rotations import skew


@dataclass(frozen=True, slots=True)
class WorldPoints:
    """Points in ENU.

    Args:
        p_in_enu_m: (n, 3).
        own: (n, 3, 3) m^2, covariance of the error that is the pair's own.
        common: (n, 3, 3) m^2, covariance of the error shared by the whole flight.
    """

    p_in_enu_m: Floats
    own: Floats
    common: Floats


@dataclass(frozen=True, slots=True)
class Shot:
    """One image of a pair, as far as its points are concerned.

    Args:
        camera: Its camera.
        pose: Its pose.
    """

    camera: Camera
    pose: Pose


def world_points(
    ref_px: Floats, depth_m: Floats, normal: Floats, pixel_sigma_m: Floats, ref_shot: Shot, src_shot: Shot
) -> WorldPoints:
    """Points of one pair.

    Args:
        ref_px: (n, 2) pixels of ref as given.
        depth_m: (n,).
        normal: (n, 3) of the depth, on the ref camera's axes.
        pixel_sigma_m: (n,) the depth's sigma by the matched positions alone; they move a point along its ref ray.
        ref_shot: The image that has the depth.
        src_shot: The other.
    """
    ref, src = ref_shot.pose, src_shot.pose
    v = ref_shot.camera.rays(ref_px) @ ref.rotation.T
    p = depth_m[:, None] * v
    baseline = src.centre - ref.centre
    q = p - baseline
    by_src = v[:, :, None] * (normal @ ref.rotation.T)[:, None, :]
    by_ref = np.eye(3) - by_src
    turn_ref, turn_src = -by_ref @ skew(p) @ ref.error_axes, -by_src @ skew(q) @ src.error_axes
    own = (
        _spread(by_ref * ref.own.position_m)
        + _spread(by_src * src.own.position_m)
        + _spread(turn_ref * ref.own.gimbal_rad)
        + _spread(turn_src * src.own.gimbal_rad)
        + _spread((v * pixel_sigma_m[:, None])[:, :, None])
    )
    # What all frames share: the same shift, and the same error of yaw, pitch and roll in both.
    common = np.diag(ref.common.position_m**2) + _spread((turn_ref + turn_src) * ref.common.gimbal_rad)
    return WorldPoints(ref.centre + p, own, np.broadcast_to(common, own.shape))


def _spread(jacobian: Floats) -> Floats:
    out: Floats = jacobian @ np.swapaxes(jacobian, -1, -2)
    return out
