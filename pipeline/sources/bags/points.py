"""Points of a LiDAR sweep from a point cloud message: fields by name, whatever their layout."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.geometry.arrays import AnyArray, Floats
from pipeline.geometry.rotations import rotation_from_quaternion
from pipeline.sources.bags.images import payload
from pipeline.sources.records import NS_PER_S

# sensor_msgs/PointField and foxglove.PackedElementField count the types differently.
_ROS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_FOXGLOVE = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}
_AXES = ("x", "y", "z")
_TIMES = ("t", "time", "timestamp", "time_offset", "offset_time")
# An instant since 1970 in ns (Livox) is larger than this, one in s (Hesai, RoboSense) is not.
_NANOSECONDS_FROM = 1e15
_SECONDS_FROM = 1e6
# No sweep lasts this long: the points' clock is then another one than the header's.
_LONGEST_S = 10.0


def points_of_message(message: Any, stamp_ns: int) -> tuple[Floats, Floats]:
    """The returns of a sweep.

    Args:
        message: sensor_msgs/PointCloud2 or foxglove.PointCloud, with fields x, y, z.
        stamp_ns: Its header stamp.

    Returns:
        (n, 3) points in the frame that the message names, m, without NaN and returns at the sensor itself; (n,) s after
        the stamp, zeros when the message does not say.

    Raises:
        AttributeError, TypeError, ValueError, OverflowError: Layout and data do not fit.

    Source: sensor_msgs/PointCloud2, sensor_msgs/PointField; Foxglove schemas PointCloud, PackedElementField.
    """
    table = _table(message)
    points = np.stack([table[name].astype(np.float64) for name in _AXES], axis=-1)
    good = np.all(np.isfinite(points), axis=1) & np.any(points != 0.0, axis=1)
    points, delay_s = points[good], _delays(table[good], stamp_ns)
    pose = getattr(message, "pose", None)
    return (points if pose is None else _posed(points, pose)), delay_s


def _table(message: Any) -> AnyArray:
    """The points as a structured array, rows without their padding."""
    ros = hasattr(message, "point_step")
    stride = int(message.point_step if ros else message.point_stride)
    kinds, order = (_ROS, ">" if message.is_bigendian else "<") if ros else (_FOXGLOVE, "<")
    names, formats, offsets = [], [], []
    for field in message.fields:
        kind = kinds.get(int(field.datatype if ros else field.type))
        if kind is not None and field.name in (*_AXES, *_TIMES) and field.name not in names:
            names.append(str(field.name))
            formats.append(order + kind)
            offsets.append(int(field.offset))
    if stride < 1:
        raise ValueError(f"{stride} bytes per point")
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": stride})
    data = np.frombuffer(payload(message.data), np.uint8)
    if not ros:
        return data[: len(data) // stride * stride].view(dtype)
    width, height, step = int(message.width), int(message.height), int(message.row_step)
    row = width * stride
    step = step if height > 1 and step else row
    if step < row or len(data) < step * max(height - 1, 0) + (row if height else 0):
        raise ValueError(f"{len(data)} bytes for {height} rows of {step}")
    if step == row:
        return data[: height * row].view(dtype)
    return np.concatenate([data[at : at + row] for at in range(0, height * step, step)]).view(dtype)


def _delays(table: AnyArray, stamp_ns: int) -> Floats:
    """Instants after the stamp: integers count ns, floats s; large ones count from 1970."""
    name = next((name for name in _TIMES if table.dtype.names and name in table.dtype.names), None)
    if name is None or not len(table):
        return np.zeros(len(table))
    integers = table.dtype[name].kind in "iu"
    values = table[name].astype(np.float64)
    typical = float(np.median(np.abs(values)))
    if integers:
        delay_s = values / NS_PER_S
    elif typical > _NANOSECONDS_FROM:
        delay_s = (values - stamp_ns) / NS_PER_S
    elif typical > _SECONDS_FROM:
        delay_s = values - stamp_ns / NS_PER_S
    else:
        delay_s = values
    return delay_s if float(np.max(np.abs(delay_s))) < _LONGEST_S else np.zeros(len(table))


def _posed(points: Floats, pose: Any) -> Floats:
    """Points in the frame that the cloud is posed in; a pose without a rotation only moves them."""
    q = np.array([pose.orientation.w, pose.orientation.x, pose.orientation.y, pose.orientation.z], np.float64)
    move = np.array([pose.position.x, pose.position.y, pose.position.z], np.float64)
    if not np.all(np.isfinite([*q, *move])):
        raise ValueError("a pose that is no number")
    turn = rotation_from_quaternion(q) if float(np.linalg.norm(q)) > 0.5 else np.eye(3)
    return points @ turn.T + move
