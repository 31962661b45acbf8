"""The recording of the rig as a ROS 2 bag: poses of motion capture, compressed images, calibration, LiDAR sweeps.

Sources: ROS 2 common interfaces (sensor_msgs, geometry_msgs, tf2_msgs); REP 103 (axes), REP 105 (frames).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from pipeline.geometry.arrays import Bytes, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import quaternion_from_rotation
from pipeline.simulation.indoor_rig import Rigid, Scan

POSE_TOPIC = "/vrpn_client_node/rig/pose"
IMAGE_TOPIC, INFO_TOPIC = "/camera/image_raw/compressed", "/camera/camera_info"
SWEEP_TOPIC, STATIC_TOPIC = "/velodyne_points", "/tf_static"
MOCAP_FRAME, BODY_FRAME, CAMERA_FRAME, LIDAR_FRAME = "mocap", "rig", "camera_optical", "velodyne"
# 2024-06-03T09:00:00Z.
START_NS = 1_717_405_200_000_000_000
JPEG_QUALITY = 95
_NS = 1_000_000_000
# How long after its stamp each message reaches the recorder, s.
_POSE_LATE_S, _IMAGE_LATE_S, _SWEEP_LATE_S = 0.004, 0.038, 0.104
_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 22,
    }
)
# sensor_msgs/PointField: UINT16 and FLOAT32.
_POINT_TYPES = {"u": 4, "f": 7}
_TRANSIENT_LOCAL = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    QosTime(0, 0),
    QosTime(0, 0),
    QosLiveliness.AUTOMATIC,
    QosTime(0, 0),
    avoid_ros_namespace_conventions=False,
)


@dataclass(frozen=True, slots=True)
class Recorded:
    """A message on its way to the bag.

    Args:
        topic: Where it was heard.
        at_s: When, since the recording's start.
        message: Of the topic's type.
    """

    topic: str
    at_s: float
    message: Any


class Messages:
    """Makes the messages of the rig; times are seconds since the recording's start."""

    def __init__(self) -> None:
        self.store = get_typestore(Stores.ROS2_HUMBLE)

    def of_type(self, name: str) -> Any:
        """The class of a message type, "sensor_msgs/msg/Image"."""
        return self.store.types[name]

    def serialized(self, message: Any) -> bytes:
        """A message as CDR."""
        return bytes(self.store.serialize_cdr(message, message.__msgtype__))

    def static(self, at_s: float, children: dict[str, Rigid]) -> Recorded:
        """Where sensors sit on the body."""
        edge, tree = self.of_type("geometry_msgs/msg/TransformStamped"), self.of_type("tf2_msgs/msg/TFMessage")
        motion, vector = self.of_type("geometry_msgs/msg/Transform"), self.of_type("geometry_msgs/msg/Vector3")
        edges = [
            edge(
                self._header(at_s, BODY_FRAME),
                child,
                motion(vector(*map(float, pose.translation_m)), self._quaternion(pose.rotation)),
            )
            for child, pose in children.items()
        ]
        return Recorded(STATIC_TOPIC, at_s, tree(edges))

    def pose(self, at_s: float, rotation: Floats, translation_m: Floats) -> Recorded:
        """A pose of the rigid body in motion capture's frame."""
        stamped, pose = self.of_type("geometry_msgs/msg/PoseStamped"), self.of_type("geometry_msgs/msg/Pose")
        point = self.of_type("geometry_msgs/msg/Point")(*map(float, translation_m))
        message = stamped(self._header(at_s, MOCAP_FRAME), pose(point, self._quaternion(rotation)))
        return Recorded(POSE_TOPIC, at_s + _POSE_LATE_S, message)

    def image(self, at_s: float, picture: Bytes, camera: Camera) -> Iterator[Recorded]:
        """An image as JPEG, and its calibration.

        Args:
            at_s: The exposure.
            picture: (height, width, 3) red, green, blue.
            camera: A Brown model of five coefficients.
        """
        jpeg = cv2.imencode(".jpg", picture[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1]
        header = self._header(at_s, CAMERA_FRAME)
        compressed = self.of_type("sensor_msgs/msg/CompressedImage")(header, "jpeg", jpeg.reshape(-1))
        yield Recorded(IMAGE_TOPIC, at_s + _IMAGE_LATE_S, compressed)
        region = self.of_type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, do_rectify=False)
        projection = np.column_stack([camera.matrix, np.zeros(3)])
        info = self.of_type("sensor_msgs/msg/CameraInfo")(
            header, camera.height, camera.width, "plumb_bob", np.array(camera.distortion), camera.matrix.reshape(-1),
            np.eye(3).reshape(-1), projection.reshape(-1), 0, 0, region,
        )  # fmt: skip
        yield Recorded(INFO_TOPIC, at_s + _IMAGE_LATE_S, info)

    def sweep(self, turn: Scan) -> Recorded:
        """A turn of the LiDAR, with the instant of each return after the stamp."""
        points = np.zeros(len(turn.ring), _POINT)
        points["x"], points["y"], points["z"] = turn.p_in_lidar_m.T
        points["intensity"], points["ring"], points["time"] = turn.intensity, turn.ring, turn.delay_s
        field = self.of_type("sensor_msgs/msg/PointField")
        names = _POINT.names or ()
        fields = [field(name, _POINT.fields[name][1], _POINT_TYPES[_POINT[name].kind], 1) for name in names]  # type: ignore[index]
        cloud = self.of_type("sensor_msgs/msg/PointCloud2")(
            self._header(turn.begin_s, LIDAR_FRAME), 1, len(points), fields, is_bigendian=False,
            point_step=_POINT.itemsize, row_step=points.nbytes, data=points.view(np.uint8).reshape(-1), is_dense=True,
        )  # fmt: skip
        return Recorded(SWEEP_TOPIC, turn.begin_s + _SWEEP_LATE_S, cloud)

    def _header(self, at_s: float, frame: str) -> Any:
        stamp_ns = time_ns(at_s)
        stamp = self.of_type("builtin_interfaces/msg/Time")(stamp_ns // _NS, stamp_ns % _NS)
        return self.of_type("std_msgs/msg/Header")(stamp, frame)

    def _quaternion(self, rotation: Floats) -> Any:
        w, x, y, z = map(float, quaternion_from_rotation(rotation))
        return self.of_type("geometry_msgs/msg/Quaternion")(x, y, z, w)


def time_ns(at_s: float) -> int:
    """An instant of the recording, UTC, ns since 1970; whole microseconds."""
    return START_NS + round(at_s * 1e6) * 1000


def write_bag(folder: Path, messages: Messages, recorded: Iterable[Recorded]) -> None:
    """Writes a bag, its messages in the order they were heard.

    Args:
        folder: The bag's folder; must not exist.
        messages: What made them.
        recorded: The messages.
    """
    # Serialised one by one: pixels and points are held once.
    held = [
        (time_ns(item.at_s), item.topic, item.message.__msgtype__, messages.serialized(item.message))
        for item in recorded
    ]
    held.sort(key=lambda entry: entry[:2])
    with Writer(folder, version=8) as writer:
        connections = {
            topic: writer.add_connection(
                topic,
                kind,
                typestore=messages.store,
                offered_qos_profiles=[_TRANSIENT_LOCAL] if topic == STATIC_TOPIC else (),
            )
            for topic, kind in dict.fromkeys((topic, kind) for _, topic, kind, _ in held)
        }
        for at_ns, topic, _, data in held:
            writer.write(connections[topic], at_ns, data)
