"""The simulated flight in ROS's axes: body forward-left-up, world east-north-up, camera right-down-forward."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import ENU_FROM_NED, enu_from_cam, ned_from_frd, quaternion_from_rotation
from pipeline.simulation.recording import LEVER_ARM_M, SIGMA_HORIZONTAL_M, SIGMA_VERTICAL_M, Recording

BODY_FRAME, CAMERA_FRAME = "base_link", "camera_optical_frame"
_FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, slots=True)
class RosFrames:
    """Attitudes of a recording, one row for each of its attitude instants.

    Args:
        body_wxyz: (m, 4) enu_from_flu of the body.
        camera_wxyz: (m, 4) flu_from_cam: the camera on its gimbal, in the body.
        lever_m: (3,) of the camera in the body, whose origin is the antenna.
    """

    body_wxyz: Floats
    camera_wxyz: Floats
    lever_m: Floats


def ros_frames(recording: Recording) -> RosFrames:
    """Attitudes in ROS's axes.

    Args:
        recording: What the recorder sees.

    Returns:
        Body and camera.

    Source: ROS REP 103 and 145.
    """
    enu_from_flu = ENU_FROM_NED @ ned_from_frd(*recording.vehicle_rad.T) @ _FLU_FROM_FRD.T
    camera = np.swapaxes(enu_from_flu, -1, -2) @ enu_from_cam(*recording.gimbal_rad.T)
    lever: Floats = _FLU_FROM_FRD @ np.array(LEVER_ARM_M)
    return RosFrames(quaternion_from_rotation(enu_from_flu), quaternion_from_rotation(camera), lever)


def position_covariance_m2() -> Floats:
    """(9,) covariance of the positions in ENU, row by row."""
    return np.diag([SIGMA_HORIZONTAL_M**2, SIGMA_HORIZONTAL_M**2, SIGMA_VERTICAL_M**2]).ravel()
