"""Absolute and relative poses with their covariances.

A frame's error has a part of its own and a part common to the flight (a GNSS bias, a misaligned gimbal or compass).
The common part moves all points together but hardly changes the relative pose of two frames; it is kept apart
throughout.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import gimbal_error_axes, rotation_from_vector, skew


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


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a camera stands, without what is known of its error.

    Args:
        rotation: (3, 3) enu_from_cam, camera RDF.
        centre: (3,) m, ENU.
    """

    rotation: Floats
    centre: Floats

    def moved(self, error: Floats) -> Placement:
        """The camera after a small turn about ENU's axes (rotation vector, rad) and a shift (m), together (6,)."""
        return Placement(rotation_from_vector(error[:3]) @ self.rotation, self.centre + error[3:])


@dataclass(frozen=True, slots=True)
class PlacedPair:
    """Both cameras of a pair as its points are placed with, and what their errors are made of.

    The errors of the two cameras (turn of ref, shift of ref, turn and shift of src, ENU, rad and m) are `gain` times
    the errors of the two frames, whose covariances `PoseErrors` holds, plus an error of the pair alone.

    Args:
        ref: The frame that gets the depth.
        src: The other.
        gain: (12, 12); the unit matrix unless the pair was refined by itself.
        noise: (12, 12) covariance of the pair's own error; zero unless the pair was refined by itself.
    """

    ref: Placement
    src: Placement
    gain: Floats
    noise: Floats

    @classmethod
    def plain(cls, ref: Placement, src: Placement) -> PlacedPair:
        """A pair whose cameras' errors are those of its frames."""
        return cls(ref, src, np.eye(12), np.zeros((12, 12)))


def relative_jacobian(ref: Placement | Pose, src: Placement | Pose) -> Floats:
    """How the src camera's pose seen from ref moves with the errors of both cameras.

    With small world rotations d and shifts e of each camera, seen from ref (rotation Q = cam_from_enu of ref) the src
    camera turns by Q (d_src - d_ref), and its centre moves by Q (e_src - e_ref + B x d_ref), B the baseline.

    Args:
        ref: The frame that gets the depth.
        src: The other.

    Returns:
        (6, 12): turn and shift seen from ref by turn and shift of ref, then of src, in ENU.
    """
    cam_from_enu = ref.rotation.T
    out = np.zeros((6, 12))
    out[:3, :3], out[:3, 6:9] = -cam_from_enu, cam_from_enu
    out[3:, :3] = cam_from_enu @ skew(src.centre - ref.centre)
    out[3:, 3:6], out[3:, 9:] = -cam_from_enu, cam_from_enu
    return out


def joint_covariance(ref: Pose, src: Pose) -> Floats:
    """(12, 12) covariance of the errors of two logged poses: turn and shift of ref, then of src, in ENU."""
    out = np.zeros((12, 12))
    out[:6, :6], out[6:, 6:] = own_covariance(ref) + common_covariance(ref, ref), own_covariance(src)
    out[6:, 6:] += common_covariance(src, src)
    out[:6, 6:] = common_covariance(ref, src)
    out[6:, :6] = out[:6, 6:].T
    return out


def own_covariance(pose: Pose) -> Floats:
    """(6, 6) of the turn and shift, in ENU, that are new in this frame."""
    spread = _spread(pose, pose.own)
    out: Floats = spread @ spread.T
    return out


def common_covariance(one: Pose, other: Pose) -> Floats:
    """(6, 6) between the turn and shift of two frames, in ENU, by what is common to the flight."""
    out: Floats = _spread(one, one.common) @ _spread(other, other.common).T
    return out


def _spread(pose: Pose, sigmas: PoseSigmas) -> Floats:
    out = np.zeros((6, 6))
    out[:3, :3], out[3:, 3:] = pose.error_axes * sigmas.gimbal_rad, np.diag(sigmas.position_m)
    return out


def relative_placement(ref: Placement | Pose, src: Placement | Pose, covariance: Floats) -> RelativePose:
    """The pose of src seen from ref, with the covariance of its error."""
    rotation = src.rotation.T @ ref.rotation
    return RelativePose(rotation, -src.rotation.T @ (src.centre - ref.centre), covariance)


def relative_pose(ref: Pose, src: Pose) -> RelativePose:
    """The relative pose of two logged frames, its covariance propagated to first order from both.

    Args:
        ref: The frame that gets the depth.
        src: The frame it is paired with.

    Returns:
        src_from_ref.
    """
    jacobian = relative_jacobian(ref, src)
    return relative_placement(ref, src, jacobian @ joint_covariance(ref, src) @ jacobian.T)
