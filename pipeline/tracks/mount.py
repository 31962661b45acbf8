"""From the vehicle's attitude, or its gimbal's, to the camera's: fixed mounts, gimbal frames and the lever arm.

Everything here is FRD: a camera's or gimbal's x axis is the optical axis, y its right, z its down.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import ned_from_frd

# A gimbal that points further from the stated mount than this contradicts it: flexing and levelling stay below.
CONTRADICTION_DEG = 5.0


@dataclass(frozen=True, slots=True)
class Mount:
    """How the camera sits on the vehicle.

    Args:
        angles_rad: Yaw, pitch, roll of the optical axis in the body's axes (yaw 0 forward, pitch -90 deg down); None
            when a gimbal stream tells, or nothing.
        lever_arm_m: (3,) from the antenna (the logged position) to the camera, on the body's forward, right and down.
    """

    angles_rad: tuple[float, float, float] | None = None
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def body_from_camera(self) -> Floats | None:
        """(3, 3), both FRD; None when the angles are not stated."""
        return None if self.angles_rad is None else ned_from_frd(*self.angles_rad)


def ned_from_gimbal(
    gimbal: Floats, frame: Literal["ned", "heading", "body"], ned_from_body: Floats | None
) -> Floats | None:
    """The gimbal's attitude in NED, whatever its stream is measured against.

    Args:
        gimbal: (k, 3, 3) rotations `frame`_from_gimbal.
        frame: "ned", "heading" (level, turned by the vehicle's heading) or "body".
        ned_from_body: (k, 3, 3) of the vehicle at the same instants; None when it is not logged.

    Returns:
        (k, 3, 3), or None when the vehicle's attitude is needed and not there.

    Source: MAVLink common messages, GIMBAL_DEVICE_ATTITUDE_STATUS (flags for yaw in vehicle or earth frame).
    """
    if frame == "ned":
        return gimbal
    if ned_from_body is None:
        return None
    base = ned_from_body if frame == "body" else heading_only(ned_from_body)
    out: Floats = base @ gimbal
    return out


def heading_only(ned_from_body: Floats) -> Floats:
    """The level frame with x along a body's heading, (k, 3, 3).

    Pointing straight up or down, the heading is that of the body's belly or back, as in Euler angles with roll 0.
    """
    level = np.hypot(ned_from_body[..., 0, 0], ned_from_body[..., 1, 0])
    yaw = np.where(
        level > 1e-9,
        np.arctan2(ned_from_body[..., 1, 0], ned_from_body[..., 0, 0]),
        np.arctan2(-ned_from_body[..., 0, 1], ned_from_body[..., 1, 1]),
    )
    return ned_from_frd(yaw, 0.0, 0.0)


def contradiction_deg(ned_from_camera: Floats, other: Floats) -> float:
    """Median angle between two accounts of where the camera points, (k, 3, 3) each, deg; NaN without any."""
    trace = np.trace(np.swapaxes(ned_from_camera, -1, -2) @ other, axis1=-2, axis2=-1)
    angle = np.degrees(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))
    known = angle[np.isfinite(angle)]
    return float(np.median(known)) if len(known) else float("nan")
