"""Columns of numbers from decoded messages of any encoding; no message and no payload is kept."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from pipeline.engine.errors import InputError
from pipeline.geometry.cameras import Camera
from pipeline.sources.bags.cameras import camera_of_message, either
from pipeline.sources.bags.columns import Columns
from pipeline.sources.bags.container import Topic
from pipeline.sources.records import NS_PER_S

Edge = tuple[str, str, str]


@dataclass(slots=True)
class Payloads:
    """Images or sweeps of one topic.

    Args:
        samples: Their times.
        frame: The sensor's coordinate frame.
        encoding: Of images, as the first one says.
        width: Of images, 0 when only decoding would tell.
        height: Of images, 0 when only decoding would tell.
        fields: Of points.
        points: In all sweeps.
    """

    samples: Columns
    frame: str
    encoding: str = ""
    width: int = 0
    height: int = 0
    fields: tuple[str, ...] = ()
    points: int = 0


@dataclass(slots=True)
class Calibration:
    """Calibration messages of one topic.

    Args:
        samples: Their times.
        frame: The camera's coordinate frame.
        first: The camera; None when it is not calibrated, or why it is none.
        changes: Messages that say something else than the first.
    """

    samples: Columns
    frame: str
    first: Camera | str | None
    changes: int = 0


@dataclass(slots=True)
class BagMessages:
    """Takes messages one by one.

    Args:
        fixes: By topic: latitude, longitude, altitude, sigmas, and how many fixes had been lost before.
        lost_fixes: Fixes without a position, by topic.
        attitudes: By topic and frame of the sensor: quaternions.
        poses: By topic, parent and child: position and quaternion.
        edges: Of transform trees, by topic, parent and child: translation and quaternion.
        static: Of latched transform trees, by topic, parent and child.
        static_changes: Latched transforms that were followed by different ones.
        images: By topic.
        sweeps: By topic.
        calibrations: By topic.
        triggers: By topic.
    """

    fixes: dict[str, Columns] = field(default_factory=dict)
    lost_fixes: Counter[str] = field(default_factory=Counter)
    attitudes: dict[tuple[str, str], Columns] = field(default_factory=dict)
    poses: dict[Edge, Columns] = field(default_factory=dict)
    edges: dict[Edge, Columns] = field(default_factory=dict)
    static: dict[Edge, tuple[float, ...]] = field(default_factory=dict)
    static_changes: Counter[Edge] = field(default_factory=Counter)
    images: dict[str, Payloads] = field(default_factory=dict)
    sweeps: dict[str, Payloads] = field(default_factory=dict)
    calibrations: dict[str, Calibration] = field(default_factory=dict)
    triggers: dict[str, Columns] = field(default_factory=dict)

    def add(self, topic: Topic, log_ns: int, message: Any) -> None:
        """Takes a message of a wanted topic.

        Args:
            topic: Its topic.
            log_ns: When it was recorded.
            message: Decoded, with the fields of its type.

        Raises:
            AttributeError, TypeError, ValueError, OverflowError, IndexError: Not of the type that it should be.
        """
        _TAKE[kind_of(topic.type)](self, topic.name, log_ns, message)

    def streams(self) -> list[Columns]:
        """All columns that have times."""
        out = [*self.fixes.values(), *self.attitudes.values(), *self.poses.values(), *self.edges.values()]
        out += self.triggers.values()
        out += [payloads.samples for payloads in (*self.images.values(), *self.sweeps.values())]
        return out + [calibration.samples for calibration in self.calibrations.values()]


def kind_of(type_name: str) -> str:
    """A message type without its system's notation: "sensor_msgs/Imu", "foxglove/LocationFix"."""
    name = type_name.replace("/msg/", "/").replace("foxglove_msgs/", "foxglove/")
    return f"foxglove/{name[9:]}" if name.startswith("foxglove.") else name


def is_wanted(topic: Topic) -> bool:
    """Whether messages of a topic become records."""
    return kind_of(topic.type) in _TAKE


def stamp_ns(message: Any) -> int:
    """A message's header stamp, or Foxglove's timestamp; 0 when it has none.

    Raises:
        AttributeError, TypeError, ValueError: It is not a time.
    """
    header = getattr(message, "header", None)
    stamp = getattr(message, "timestamp", None) if header is None else header.stamp
    if stamp is None:
        return 0
    seconds, nanoseconds = either(stamp, "sec", "seconds", "secs"), either(stamp, "nanosec", "nsec", "nanos", "nsecs")
    return int(seconds) * NS_PER_S + int(nanoseconds)


def frame_of(message: Any) -> str:
    """A message's coordinate frame, empty when it names none."""
    header = getattr(message, "header", message)
    return _frame(getattr(header, "frame_id", ""))


def _frame(name: Any) -> str:
    # ROS 1 knew both "/map" and "map" for one frame.
    return str(name).removeprefix("/")


def _xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _wxyz(quaternion: Any) -> tuple[float, float, float, float]:
    return quaternion.w, quaternion.x, quaternion.y, quaternion.z


def _sigmas(message: Any) -> tuple[float, float]:
    """One sigma of east and north, and of up, from an ENU covariance in m^2; NaN where it is not known (type 0)."""
    known = int(message.position_covariance_type) != 0
    covariance = message.position_covariance
    if not known or len(covariance) != 9:
        return math.nan, math.nan
    level, up = (float(covariance[0]) + float(covariance[4])) / 2.0, float(covariance[8])
    return (math.sqrt(level) if level > 0.0 else math.nan), (math.sqrt(up) if up > 0.0 else math.nan)


def _fix(to: BagMessages, topic: str, log_ns: int, message: Any) -> None:
    samples = to.fixes.setdefault(topic, Columns(6))
    status = getattr(message, "status", None)
    latitude, longitude = float(message.latitude), float(message.longitude)
    placed = abs(latitude) <= 90.0 and abs(longitude) <= 180.0
    if not placed or (status is not None and int(status.status) < 0):
        to.lost_fixes[topic] += 1
        return
    lost = to.lost_fixes[topic]
    values = (latitude, longitude, float(message.altitude), *_sigmas(message), float(lost))
    samples.add(stamp_ns(message), log_ns, values)


def _imu(to: BagMessages, topic: str, log_ns: int, message: Any) -> None:
    # A driver without an orientation says so by a covariance of -1 (sensor_msgs/Imu).
    if float(message.orientation_covariance[0]) != -1.0:
        samples = to.attitudes.setdefault((topic, frame_of(message)), Columns(4))
        samples.add(stamp_ns(message), log_ns, _wxyz(message.orientation))


def _pose(to: BagMessages, topic: str, log_ns: int, message: Any) -> None:
    pose = getattr(message.pose, "pose", message.pose)
    key = topic, frame_of(message), _frame(getattr(message, "child_frame_id", ""))
    values = (*_xyz(pose.position), *_wxyz(pose.orientation))
    to.poses.setdefault(key, Columns(7)).add(stamp_ns(message), log_ns, values)


def _transform(to: BagMessages, topic: str, log_ns: int, message: Any) -> None:
    """A transform on its own: motion capture."""
    key = topic, frame_of(message), _frame(message.child_frame_id)
    values = (*_xyz(message.transform.translation), *_wxyz(message.transform.rotation))
    to.poses.setdefault(key, Columns(7)).add(stamp_ns(message), log_ns, values)


def _tree(to: BagMessages, topic: str, log_ns: int, message: Any) -> None:
    for edge in message.transforms:
        _edge(to, topic, log_ns, edge)


def _edge(to: BagMessages, topic: str, log_ns: int, edge: Any) -> None:
    """One transform of a tree: ROS has it in a field of its own, Foxglove in the message."""
    parent = _frame(edge.parent_frame_id) if hasattr(edge, "parent_frame_id") else frame_of(edge)
    key = topic, parent, _frame(edge.child_frame_id)
    motion = getattr(edge, "transform", edge)
    values = tuple(float(value) for value in (*_xyz(motion.translation), *_wxyz(motion.rotation)))
    if topic.endswith("tf_static"):
        to.static_changes[key] += to.static.get(key, values) != values
        to.static[key] = values
    else:
        to.edges.setdefault(key, Columns(7)).add(stamp_ns(edge), log_ns, values)


def _image(to: BagMessages, topic: str, log_ns: int, message: Any) -> None:
    if topic not in to.images:
        size = int(getattr(message, "width", 0)), int(getattr(message, "height", 0))
        to.images[topic] = Payloads(Columns(0), frame_of(message), str(either(message, "encoding", "format")), *size)
    to.images[topic].samples.add(stamp_ns(message), log_ns)


def _sweep(to: BagMessages, topic: str, log_ns: int, message: Any) -> None:
    if hasattr(message, "point_step"):
        points = int(message.width) * int(message.height)
    else:
        # JSON has bytes in base 64: four characters for three.
        size = len(message.data) * 3 // 4 if isinstance(message.data, str) else len(message.data)
        points = size // max(int(message.point_stride), 1)
    if topic not in to.sweeps:
        fields = tuple(str(item.name) for item in message.fields)
        to.sweeps[topic] = Payloads(Columns(0), frame_of(message), fields=fields)
    to.sweeps[topic].samples.add(stamp_ns(message), log_ns)
    to.sweeps[topic].points += points


def _calibration(to: BagMessages, topic: str, log_ns: int, message: Any) -> None:
    found: Camera | str | None
    try:
        found = camera_of_message(message)
    except InputError as error:
        found = f"{error.message}: {error.found}"
    known = to.calibrations.setdefault(topic, Calibration(Columns(0), frame_of(message), found))
    known.samples.add(stamp_ns(message), log_ns)
    known.changes += found != known.first


def _time_reference(to: BagMessages, topic: str, log_ns: int, message: Any) -> None:
    """Of a trigger line; others tell the time and no more."""
    said = f"{topic} {message.source}".lower()
    if "trigger" in said or "camera" in said:
        to.triggers.setdefault(topic, Columns(0)).add(stamp_ns(message), log_ns)


_TAKE: dict[str, Callable[[BagMessages, str, int, Any], None]] = {
    "sensor_msgs/NavSatFix": _fix,
    "foxglove/LocationFix": _fix,
    "sensor_msgs/Imu": _imu,
    "geometry_msgs/PoseStamped": _pose,
    "geometry_msgs/PoseWithCovarianceStamped": _pose,
    "nav_msgs/Odometry": _pose,
    "foxglove/PoseInFrame": _pose,
    "geometry_msgs/TransformStamped": _transform,
    "tf2_msgs/TFMessage": _tree,
    "tf/tfMessage": _tree,
    "foxglove/FrameTransforms": _tree,
    "foxglove/FrameTransform": _edge,
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _image,
    "foxglove/RawImage": _image,
    "foxglove/CompressedImage": _image,
    "foxglove/CompressedVideo": _image,
    "sensor_msgs/PointCloud2": _sweep,
    "foxglove/PointCloud": _sweep,
    "sensor_msgs/CameraInfo": _calibration,
    "foxglove/CameraCalibration": _calibration,
    "sensor_msgs/TimeReference": _time_reference,
}
