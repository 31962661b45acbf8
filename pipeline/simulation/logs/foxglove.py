"""The simulated flight in Foxglove's schemas: an MCAP file of protobuf messages."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.writer import Writer

from pipeline.geometry.cameras import Camera
from pipeline.simulation.logs.ros_frames import BODY_FRAME, CAMERA_FRAME, position_covariance_m2, ros_frames
from pipeline.simulation.recording import Recording

FIX, ATTITUDE, TREE, CALIBRATION = "/fix", "/attitude", "/tf", "/camera/calibration"
WORLD_FRAME = "enu"
_MODELS = {"pinhole": "plumb_bob", "brown": "plumb_bob", "fisheye": "kannala_brandt"}

_Timed = tuple[int, str, Any]


def write_foxglove(recording: Recording, camera: Camera, path: Path) -> None:
    """Writes an MCAP file, the same bytes for the same recording.

    It holds antenna positions, the body's attitude, the camera on its gimbal, and one calibration per exposure, whose
    image is on the card.

    Args:
        recording: What the recorder sees.
        camera: Of the photos.
        path: The file.

    Source: Foxglove schemas LocationFix, PoseInFrame, FrameTransform, CameraCalibration.
    """
    timed: list[_Timed] = [*_fixes(recording), *_attitudes(recording), *_exposures(recording, camera)]
    timed.sort(key=lambda item: item[0])
    with path.open("wb") as stream, Writer(stream) as writer:
        for time_ns, topic, message in timed:
            writer.write_message(topic, message, log_time=time_ns, publish_time=time_ns)


def _fixes(recording: Recording) -> Iterator[_Timed]:
    columns = (recording.latitude_deg, recording.longitude_deg, recording.ellipsoidal_m)
    for time_ns, latitude, longitude, altitude in zip(
        recording.utc_ns(recording.position_s).tolist(), *(column.tolist() for column in columns), strict=True
    ):
        message = LocationFix(
            timestamp=_stamp(time_ns), frame_id=BODY_FRAME, latitude=latitude, longitude=longitude, altitude=altitude,
            position_covariance=position_covariance_m2().tolist(),
            position_covariance_type=LocationFix.PositionCovarianceType.DIAGONAL_KNOWN,
        )  # fmt: skip
        yield time_ns, FIX, message


def _attitudes(recording: Recording) -> Iterator[_Timed]:
    frames = ros_frames(recording)
    lever = _vector(*frames.lever_m.tolist())
    times = recording.utc_ns(recording.attitude_s).tolist()
    for time_ns, body, view in zip(times, frames.body_wxyz.tolist(), frames.camera_wxyz.tolist(), strict=True):
        stamp = _stamp(time_ns)
        pose = Pose(position=_vector(0.0, 0.0, 0.0), orientation=_quaternion(*body))
        yield time_ns, ATTITUDE, PoseInFrame(timestamp=stamp, frame_id=WORLD_FRAME, pose=pose)
        edge = FrameTransform(
            timestamp=stamp, parent_frame_id=BODY_FRAME, child_frame_id=CAMERA_FRAME, translation=lever,
            rotation=_quaternion(*view),
        )  # fmt: skip
        yield time_ns, TREE, edge


def _exposures(recording: Recording, camera: Camera) -> Iterator[_Timed]:
    distortion = camera.distortion or (0.0,) * 5
    k = camera.matrix
    for time_ns in recording.utc_ns(recording.trigger_s).tolist():
        message = CameraCalibration(
            timestamp=_stamp(time_ns), frame_id=CAMERA_FRAME, width=camera.width, height=camera.height,
            distortion_model="rational_polynomial" if len(distortion) > 5 else _MODELS[camera.model], D=distortion,
            K=k.ravel().tolist(), R=np.eye(3).ravel().tolist(), P=np.column_stack([k, np.zeros(3)]).ravel().tolist(),
        )  # fmt: skip
        yield time_ns, CALIBRATION, message


def _stamp(time_ns: int) -> Timestamp:
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanoseconds)


def _vector(x: float, y: float, z: float) -> Vector3:
    return Vector3(x=x, y=y, z=z)


def _quaternion(w: float, x: float, y: float, z: float) -> Quaternion:
    return Quaternion(w=w, x=x, y=y, z=z)
