"""Small bags of every container and encoding, written by the formats' own libraries."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_typestore

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
NS = 1_000_000_000
# Log times come this much after the stamps.
DELAY_NS = 7_000_000
BEGAN_NS = 1_700_000_000 * NS

# Topic, log time, and the message as made by `ros`, or a protobuf message, or a mapping for JSON.
Row = tuple[str, int, Any]


def ros(kind: str, version: int = 2, **fields: Any) -> Any:
    """A ROS message."""
    store = ROS1 if version == 1 else ROS2
    return store.types[f"{kind.partition('/')[0]}/msg/{kind.partition('/')[2]}"](**fields)


def header(time_ns: int, frame: str = "base_link", version: int = 2) -> Any:
    stamp = ros("builtin_interfaces/Time", version, sec=time_ns // NS, nanosec=time_ns % NS)
    extra = {"seq": 0} if version == 1 else {}
    return ros("std_msgs/Header", version, stamp=stamp, frame_id=frame, **extra)


def fix(time_ns: int, latitude: float = 45.0, status: int = 0, kind: int = 2, version: int = 2) -> Any:
    return ros(
        "sensor_msgs/NavSatFix", version, header=header(time_ns, version=version),
        status=ros("sensor_msgs/NavSatStatus", version, status=status, service=1), latitude=latitude, longitude=7.25,
        altitude=512.125, position_covariance=np.array([0.04, 0, 0, 0, 0.16, 0, 0, 0, 0.25]),
        position_covariance_type=kind,
    )  # fmt: skip


def vector(x: float, y: float, z: float, version: int = 2, kind: str = "Vector3") -> Any:
    return ros(f"geometry_msgs/{kind}", version, x=x, y=y, z=z)


def quaternion(w: float, x: float, y: float, z: float, version: int = 2) -> Any:
    return ros("geometry_msgs/Quaternion", version, x=x, y=y, z=z, w=w)


def imu(
    time_ns: int, q: Sequence[float] = (1.0, 0.0, 0.0, 0.0), first_variance: float = 0.0, version: int = 2,
    frame: str = "base_link",
) -> Any:  # fmt: skip
    covariance = np.array([first_variance, *np.zeros(8)])
    return ros(
        "sensor_msgs/Imu", version, header=header(time_ns, frame, version), orientation=quaternion(*q, version),
        orientation_covariance=covariance, angular_velocity=vector(0, 0, 0, version),
        angular_velocity_covariance=np.zeros(9), linear_acceleration=vector(0, 0, 0, version),
        linear_acceleration_covariance=np.zeros(9),
    )  # fmt: skip


def pose(time_ns: int, x: float = 0.0, q: Sequence[float] = (1.0, 0.0, 0.0, 0.0), frame: str = "map") -> Any:
    inner = ros("geometry_msgs/Pose", position=vector(x, 2.0, 3.0, kind="Point"), orientation=quaternion(*q))
    return ros("geometry_msgs/PoseStamped", header=header(time_ns, frame), pose=inner)


def edge(time_ns: int, parent: str, child: str, move: Sequence[float], q: Sequence[float]) -> Any:
    motion = ros("geometry_msgs/Transform", translation=vector(*move), rotation=quaternion(*q))
    return ros("geometry_msgs/TransformStamped", header=header(time_ns, parent), child_frame_id=child, transform=motion)


def tree(*edges: Any) -> Any:
    return ros("tf2_msgs/TFMessage", transforms=list(edges))


def camera_info(time_ns: int, model: str = "plumb_bob", focal: float = 900.0, **changes: Any) -> Any:
    region = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0) | changes.pop("roi", {})
    fields = {
        "header": header(time_ns, changes.pop("frame", "camera")),
        "height": 600, "width": 800, "distortion_model": model, "d": np.array([-0.1, 0.02, 0.001, -0.002, 0.0]),
        "k": np.array([focal, 0, 410, 0, focal, 290, 0, 0, 1.0]), "r": np.eye(3).ravel(), "p": np.zeros(12),
        "binning_x": 0, "binning_y": 0, "roi": ros("sensor_msgs/RegionOfInterest", **region, do_rectify=False),
    }  # fmt: skip
    return ros("sensor_msgs/CameraInfo", **(fields | changes))


def image(time_ns: int, pixels: Any = None, encoding: str = "mono8", frame: str = "camera", **changes: Any) -> Any:
    pixels = np.zeros((4, 6), np.uint8) if pixels is None else np.ascontiguousarray(pixels)
    fields = {
        "header": header(time_ns, frame), "height": pixels.shape[0], "width": pixels.shape[1], "encoding": encoding,
        "is_bigendian": 0, "step": pixels.strides[0], "data": pixels.reshape(-1).view(np.uint8),
    }  # fmt: skip
    return ros("sensor_msgs/Image", **(fields | changes))


def compressed(time_ns: int, data: bytes, form: str) -> Any:
    return ros(
        "sensor_msgs/CompressedImage", header=header(time_ns, "camera"), format=form, data=np.frombuffer(data, np.uint8)
    )


def write_ros1(path: Path, rows: Iterable[Row], compression: str = "none", chunk: int = 1 << 20) -> Path:
    """A ROS 1 bag."""
    writer = Writer1(path)
    if compression != "none":
        writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    writer.chunk_threshold = chunk
    with writer:
        connections: dict[str, Any] = {}
        for topic, log_ns, message in rows:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            writer.write(connections[topic], log_ns, ROS1.serialize_ros1(message, kind))
    return path


def write_folder(path: Path, rows: Iterable[Row], storage: str = "sqlite3", mode: str = "none") -> Path:
    """A ROS 2 bag folder."""
    writer = Writer2(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if mode != "none":
        writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, log_ns, message in rows:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(connections[topic], log_ns, ROS2.serialize_cdr(message, kind))
    return path


def write_mcap(
    path: Path, rows: Iterable[Row], encoding: str = "cdr", compression: str = "none", chunk: int = 1 << 20,
    **options: Any,
) -> Path:  # fmt: skip
    """An MCAP file; JSON rows are (type name, content)."""
    with path.open("wb") as stream:
        writer = McapWriter(
            stream, chunk_size=chunk, compression=CompressionType[compression.upper()], **options
        )  # fmt: skip
        writer.start(profile="ros2" if encoding == "cdr" else "", library="test")
        channels: dict[str, int] = {}
        for topic, log_ns, message in rows:
            name, kind, schema, data = _encoded(message, encoding)
            if topic not in channels:
                number = writer.register_schema(name, kind, schema)
                channels[topic] = writer.register_channel(topic, encoding, number)
            writer.add_message(channels[topic], log_ns, data, log_ns)
        writer.finish()
    return path


def _encoded(message: Any, encoding: str) -> tuple[str, str, bytes, bytes]:
    """Schema name, encoding and text, and the message's bytes."""
    if encoding == "json":
        name, content = message
        return name, "jsonschema", b"{}", json.dumps(content).encode()
    if encoding == "protobuf":
        kind = type(message)
        schema = build_file_descriptor_set(kind).SerializeToString(deterministic=True)
        return kind.DESCRIPTOR.full_name, "protobuf", schema, message.SerializeToString()
    kind = message.__msgtype__
    if encoding == "ros1":
        definition = ROS1.generate_msgdef(kind)[0]
        return kind.replace("/msg/", "/"), "ros1msg", definition.encode(), bytes(ROS1.serialize_ros1(message, kind))
    definition = ROS2.generate_msgdef(kind, ros_version=2)[0]
    return kind, "ros2msg", definition.encode(), bytes(ROS2.serialize_cdr(message, kind))


UNINDEXED = {
    "index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False,
    "use_summary_offsets": False,
}  # fmt: skip
