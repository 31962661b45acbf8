"""Calibrations in bags: sensor_msgs/CameraInfo and foxglove.CameraCalibration to a camera."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pipeline.geometry.cameras import Camera
from pipeline.sources.calibration import camera_of_values


def camera_of_message(message: Any) -> Camera | None:
    """The camera of a calibration message, for the images as they are published.

    Args:
        message: With D, K (ROS 1, Foxglove) or d, k (ROS 2), and binning and region of interest where it has them.

    Returns:
        The camera; None when the message says that it is not calibrated.

    Raises:
        InputError: The lens model is not known, or no lens can be like it.
        AttributeError, TypeError, ValueError, OverflowError: It is no such message.

    Source: sensor_msgs/CameraInfo: K is of the full resolution; the region is cut out first, and then binned.
    """
    matrix = [float(value) for value in either(message, "k", "K")]
    distortion = [float(value) for value in either(message, "d", "D")]
    if not matrix or matrix[0] == 0.0:
        return None
    width, height = int(message.width), int(message.height)
    camera = camera_of_values(str(message.distortion_model), width, height, matrix, distortion)
    region = getattr(message, "roi", None)
    if region is not None and region.width and region.height:
        camera = replace(
            camera,
            width=int(region.width),
            height=int(region.height),
            cx=camera.cx - int(region.x_offset),
            cy=camera.cy - int(region.y_offset),
        )
    across = max(int(getattr(message, "binning_x", 1)), 1)
    down = max(int(getattr(message, "binning_y", 1)), 1)
    if (across, down) == (1, 1):
        return camera
    # Cameras bin whole blocks: a remainder at the right and at the bottom is cut off before.
    binned = camera.width // across, camera.height // down
    if min(binned) < 1:
        raise ValueError(f"binning {across} x {down} of {camera.width} x {camera.height} px")
    camera = replace(camera, width=binned[0] * across, height=binned[1] * down)
    return camera.scaled(*binned)


def either(message: Any, *names: str) -> Any:
    """The first field that the message has.

    Raises:
        AttributeError: None of them.
    """
    for name in names:
        if hasattr(message, name):
            return getattr(message, name)
    raise AttributeError(f"no field {' or '.join(names)}")
