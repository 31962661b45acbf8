"""What the flags of a gimbal device say its yaw is measured from; PX4 logs MAVLink's flags as they are.

Source: https://mavlink.io/en/messages/common.html (GIMBAL_DEVICE_FLAGS, GIMBAL_DEVICE_ATTITUDE_STATUS).
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import AnyArray, Bools

_YAW_LOCK, _YAW_IN_VEHICLE_FRAME, _YAW_IN_EARTH_FRAME = 16, 32, 64


def yaw_frames(flags: AnyArray) -> tuple[Bools, Bools]:
    """Which samples have their yaw from north, and which from the vehicle's heading.

    Args:
        flags: (n,) GIMBAL_DEVICE_FLAGS.

    Returns:
        (n,) and (n,); neither where the flags name both frames at once, which is not allowed.
    """
    whole = np.asarray(flags).astype(np.int64)
    in_vehicle, in_earth = (whole & _YAW_IN_VEHICLE_FRAME) != 0, (whole & _YAW_IN_EARTH_FRAME) != 0
    # Older devices set neither: then the lock decides.
    from_north = np.where(in_vehicle | in_earth, in_earth, (whole & _YAW_LOCK) != 0)
    both = in_vehicle & in_earth
    return from_north & ~both, ~from_north & ~both
