"""Absolute and relative poses with their covariances.

A frame's error has a part of its own and a part common to the flight (a GNSS bias, a misaligned gimbal or compass).
The common part moves all points together but hardly changes the relative pose of two frames; it is kept apart
throughout.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import gimbal_error_axes, skew


@dataclass(frozen=True, slots=True)
class PoseSigmas:
    """Standard deviations of a pose's error.

    Args:
        position_m: (3,) along east, north, up.
        gimbal_rad: (3,) of yaw, pitch and roll.
    """

    position_m: Floats
    gimbal_rad: Floats


@dataclass(frozen=True, slots=True)
class Pose:
    """A camera's pose in ENU.

    Args:
        rotation: (3, 3) enu_from_cam, camera RDF.
        centre: (3,) m, ENU.
        own: Sigmas of the error that is new in this frame.
        common: Sigmas of the error shared by all frames of the flight.
    """

    rotation: Floats
    centre: Floats
    own: PoseSigmas
    common: PoseSigmas

    @property
    def error_axes(self) -> Floats:
        """(3, 3): columns are the ENU axes about which yaw, pitch and roll errors turn the camera."""
        return gimbal_error_axes(self.rotation)


@dataclass(frozen=True, slots=True)
class RelativePose:
    """The pose of src seen from ref.

    Args:
        rotation: (3, 3) src_from_ref.
        translation: (3,) m, src_from_ref: x_src = rotation @ x_ref + translation.
        covariance: (6, 6) of the src camera's pose error seen from ref, on the ref camera's axes:
            rotation vector (rad), then centre (m).
    """

    rotation: Floats
    translation: Floats
    covariance: Floats

    @property
    def centre(self) -> Floats:
        """(3,) m: the src camera's centre in the ref camera frame."""
        out: Floats = -self.rotation.T @ self.translation
        return out


def relative_pose(ref: Pose, src: Pose) -> RelativePose:
    """The relative pose of two frames, its covariance propagated to first order from both.

    With small world rotations d and shifts e of each camera, seen from ref (rotation Q = cam_from_enu of ref) the src
    camera turns by Q (d_src - d_ref), and its centre moves by Q (e_src - e_ref + B x d_ref), B the baseline.

    Args:
        ref: The frame that gets the depth.
        src: The frame it is paired with.

    Returns:
        src_from_ref.
    """
    cam_from_enu = ref.rotation.T
    baseline = src.centre - ref.centre
    rotation = src.rotation.T @ ref.rotation
    lever = cam_from_enu @ skew(baseline) @ ref.error_axes
    turn_ref, turn_src = cam_from_enu @ ref.error_axes, cam_from_enu @ src.error_axes
    zero = np.zeros((3, 3))
    parts = (
        (np.vstack([turn_src - turn_ref, lever]), ref.common.gimbal_rad),
        (np.vstack([-turn_ref, lever]), ref.own.gimbal_rad),
        (np.vstack([turn_src, zero]), src.own.gimbal_rad),
        (np.vstack([zero, cam_from_enu]), np.hypot(ref.own.position_m, src.own.position_m)),
    )
    covariance = np.zeros((6, 6))
    for jacobian, sigmas in parts:
        scaled = jacobian * sigmas
        covariance += scaled @ scaled.T
    return RelativePose(rotation, -src.rotation.T @ baseline, covariance)
