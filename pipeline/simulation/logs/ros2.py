"""The simulated flight as a companion computer records it: a ROS 2 bag in a SQLite file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from pipeline.geometry.cameras import Camera
from pipeline.simulation.logs.ros_frames import BODY_FRAME, CAMERA_FRAME, position_covariance_m2, ros_frames
from pipeline.simulation.recording import Recording

FIX, IMU, TREE, CAMERA_INFO = "/fix", "/imu", "/tf", "/camera/camera_info"
_TYPES = {
    FIX: "sensor_msgs/msg/NavSatFix",
    IMU: "sensor_msgs/msg/Imu",
    TREE: "tf2_msgs/msg/TFMessage",
    CAMERA_INFO: "sensor_msgs/msg/CameraInfo",
}
_MODELS = {"pinhole": "plumb_bob", "brown": "plumb_bob", "fisheye": "equidistant"}
_NS_PER_S = 1_000_000_000
_DIAGONAL_KNOWN = 2

_Timed = tuple[int, str, Any]


def write_ros2(recording: Recording, camera: Camera, folder: Path) -> None:
    """Writes a ROS 2 bag.

    It holds antenna positions, the body's attitude, the camera on its gimbal, and one camera_info per exposure, whose
    image is on the card.

    Args:
        recording: What the recorder sees.
        camera: Of the photos.
        folder: The bag; must not exist.

    Source: sensor_msgs, tf2_msgs of ROS 2 Humble; REP 103, 104, 145.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    messages = _Messages(store.types)
    timed: list[_Timed] = [
        *messages.fixes(recording), *messages.attitudes(recording), *messages.exposures(recording, camera),
    ]  # fmt: skip
    timed.sort(key=lambda item: item[0])
    with Writer(folder, version=9) as writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in _TYPES.items()}
        for time_ns, topic, message in timed:
            writer.write(connections[topic], time_ns, store.serialize_cdr(message, _TYPES[topic]))


class _Messages:
    """Makes messages of the types of a store."""

    def __init__(self, types: dict[str, Any]) -> None:
        self._types = types

    def fixes(self, recording: Recording) -> Iterator[_Timed]:
        status = self._new("sensor_msgs/msg/NavSatStatus", status=0, service=1)
        columns = (recording.latitude_deg, recording.longitude_deg, recording.ellipsoidal_m)
        for time_ns, *place in zip(recording.utc_ns(recording.position_s).tolist(), *columns, strict=True):
            latitude, longitude, altitude = map(float, place)
            message = self._new(
                _TYPES[FIX], header=self._header(time_ns, BODY_FRAME), status=status, latitude=latitude,
                longitude=longitude, altitude=altitude, position_covariance=position_covariance_m2(),
                position_covariance_type=_DIAGONAL_KNOWN,
            )  # fmt: skip
            yield time_ns, FIX, message

    def attitudes(self, recording: Recording) -> Iterator[_Timed]:
        frames = ros_frames(recording)
        lever = self._vector(*frames.lever_m.tolist())
        unknown = np.zeros(9)
        # REP 145 by way of sensor_msgs/Imu: -1 says that there is no such measurement.
        missing = np.array([-1.0, *np.zeros(8)])
        times = recording.utc_ns(recording.attitude_s).tolist()
        for time_ns, body, view in zip(times, frames.body_wxyz.tolist(), frames.camera_wxyz.tolist(), strict=True):
            yield time_ns, IMU, self._new(
                _TYPES[IMU], header=self._header(time_ns, BODY_FRAME), orientation=self._quaternion(*body),
                orientation_covariance=unknown, angular_velocity=self._vector(0.0, 0.0, 0.0),
                angular_velocity_covariance=missing, linear_acceleration=self._vector(0.0, 0.0, 0.0),
                linear_acceleration_covariance=missing,
            )  # fmt: skip
            motion = self._new("geometry_msgs/msg/Transform", translation=lever, rotation=self._quaternion(*view))
            edge = self._new(
                "geometry_msgs/msg/TransformStamped", header=self._header(time_ns, BODY_FRAME),
                child_frame_id=CAMERA_FRAME, transform=motion,
            )  # fmt: skip
            yield time_ns, TREE, self._new(_TYPES[TREE], transforms=[edge])

    def exposures(self, recording: Recording, camera: Camera) -> Iterator[_Timed]:
        k = camera.matrix
        distortion = np.array(camera.distortion or (0.0,) * 5)
        whole = self._new(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )  # fmt: skip
        model = "rational_polynomial" if len(distortion) > 5 else _MODELS[camera.model]
        for time_ns in recording.utc_ns(recording.trigger_s).tolist():
            yield time_ns, CAMERA_INFO, self._new(
                _TYPES[CAMERA_INFO], header=self._header(time_ns, CAMERA_FRAME), height=camera.height,
                width=camera.width, distortion_model=model, d=distortion, k=k.ravel(), r=np.eye(3).ravel(),
                p=np.column_stack([k, np.zeros(3)]).ravel(), binning_x=0, binning_y=0, roi=whole,
            )  # fmt: skip

    def _new(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def _header(self, time_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(time_ns, _NS_PER_S)
        stamp = self._new("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self._new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _vector(self, x: float, y: float, z: float) -> Any:
        return self._new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _quaternion(self, w: float, x: float, y: float, z: float) -> Any:
        return self._new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
