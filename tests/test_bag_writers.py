"""The simulated flight as a ROS 2 bag and in Foxglove's schemas: read back whole, here and by the libraries."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzzing import check
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import enu_from_cam, ned_from_frd, rotation_from_quaternion
from pipeline.simulation.flight import CONSUMER_DRONE, fly, logged_poses
from pipeline.simulation.logs.foxglove import write_foxglove
from pipeline.simulation.logs.ros2 import write_ros2
from pipeline.simulation.recording import LEVER_ARM_M, SIGMA_HORIZONTAL_M, SIGMA_VERTICAL_M, Recording, record
from pipeline.simulation.render import CAMERA
from pipeline.simulation.site import Site
from pipeline.sources.logs import read_log
from pipeline.sources.records import FlightLog

ENU_FROM_NED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def recording() -> Recording:
    site = Site.seeded(7)
    return record(site, logged_poses(fly(site.terrain, 3, 7), CONSUMER_DRONE, 7))


@pytest.fixture(scope="module")
def bag(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ros2") / "flight"
    write_ros2(recording, CAMERA, folder)
    return folder


@pytest.fixture(scope="module")
def mcap(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("foxglove") / "flight.mcap"
    write_foxglove(recording, CAMERA, path)
    return path


def check_flight(log: FlightLog, recording: Recording, body_from_flu: np.ndarray, camera_info: str) -> None:
    """Everything but the body's attitude, whose rotations ENU_from_FLU are given."""
    check(log)
    assert log.losses == ()
    (positions,), (logged,), (events,) = log.positions, log.cameras, log.events
    np.testing.assert_array_equal(positions.time_ns, recording.utc_ns(recording.position_s))
    for name in ("latitude_deg", "longitude_deg", "ellipsoidal_m"):
        np.testing.assert_array_equal(getattr(positions, name), getattr(recording, name))
    np.testing.assert_allclose(positions.sigma_horizontal_m, SIGMA_HORIZONTAL_M, rtol=1e-15)
    np.testing.assert_allclose(positions.sigma_vertical_m, SIGMA_VERTICAL_M, rtol=1e-15)
    assert (logged.camera, logged.stream, logged.frame) == (CAMERA, camera_info, "camera_optical_frame")
    np.testing.assert_array_equal(events.time_ns, recording.utc_ns(recording.trigger_s))
    assert (events.stream, events.feedback) == (camera_info, True)
    (tree_,) = (stream for stream in log.poses if stream.stream == "/tf base_link>camera_optical_frame")
    np.testing.assert_array_equal(tree_.time_ns, recording.utc_ns(recording.attitude_s))
    assert (tree_.parent, tree_.child, tree_.of, tree_.axes) == ("base_link", logged.frame, "body", "flu")
    seen = body_from_flu @ rotation_from_quaternion(tree_.q_wxyz)
    np.testing.assert_allclose(seen, enu_from_cam(*recording.gimbal_rad.T), atol=1e-14)
    # Behind the antenna nothing is lost: forward stays, right and down change their signs.
    np.testing.assert_array_equal(tree_.position_m, [LEVER_ARM_M * np.array([1.0, -1.0, -1.0])] * len(seen))


def test_the_flight_as_a_ros2_bag(recording: Recording, bag: Path) -> None:
    log = read_log(str(bag))
    (attitudes,) = log.attitudes
    ned = rotation_from_quaternion(attitudes.q_wxyz)
    np.testing.assert_allclose(ned, ned_from_frd(*recording.vehicle_rad.T), atol=1e-14)
    np.testing.assert_array_equal(attitudes.time_ns, recording.utc_ns(recording.attitude_s))
    check_flight(log, recording, ENU_FROM_NED @ ned @ FLU_FROM_FRD, "/camera/camera_info")
    assert log.kind == "ROS 2 bag"


def test_the_flight_in_foxglove_schemas(recording: Recording, mcap: Path) -> None:
    log = read_log(str(mcap))
    (pose_,) = (stream for stream in log.poses if stream.stream == "/attitude")
    enu = rotation_from_quaternion(pose_.q_wxyz)
    expected = ENU_FROM_NED @ ned_from_frd(*recording.vehicle_rad.T) @ FLU_FROM_FRD
    np.testing.assert_allclose(enu, expected, atol=1e-14)
    assert (pose_.parent, log.attitudes, log.kind) == ("enu", (), "MCAP")
    check_flight(log, recording, enu, "/camera/calibration")


def test_libraries_read_the_written_flight(recording: Recording, bag: Path, mcap: Path) -> None:
    n, m, k = len(recording.position_s), len(recording.attitude_s), len(recording.trigger_s)
    with AnyReader([bag]) as reader:
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        infos = [connection for connection in reader.connections if connection.topic == "/camera/camera_info"]
        _, _, raw = next(reader.messages(infos))
        info: Any = reader.deserialize(raw, infos[0].msgtype)
    assert counts == {"/fix": n, "/imu": m, "/tf": m, "/camera/camera_info": k}
    assert (info.width, info.k[0], info.d.tolist()) == (CAMERA.width, CAMERA.fx, list(CAMERA.distortion))
    with mcap.open("rb") as stream:
        messages = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages(["/fix"]))
    assert [found.decoded_message.latitude for found in messages] == recording.latitude_deg.tolist()
    assert messages[0].message.log_time == recording.utc_ns(recording.position_s)[0]


def test_written_flights_are_the_same_bytes(recording: Recording, bag: Path, mcap: Path, tmp_path: Path) -> None:
    write_foxglove(recording, CAMERA, tmp_path / "again.mcap")
    write_ros2(recording, CAMERA, tmp_path / "flight")
    pairs = [(mcap, tmp_path / "again.mcap"), *((bag / name, tmp_path / "flight" / name) for name in
             ("metadata.yaml", "flight.db3"))]  # fmt: skip
    for one, other in pairs:
        assert hashlib.sha256(one.read_bytes()).digest() == hashlib.sha256(other.read_bytes()).digest(), one.name


@pytest.mark.parametrize("camera", [
    Camera("pinhole", 640, 480, 500.0, 501.0, 320.0, 240.0),
    Camera("fisheye", 640, 480, 500.0, 501.0, 320.0, 240.0, (0.01, -0.02, 0.003, 0.0)),
    Camera("brown", 640, 480, 500.0, 501.0, 320.0, 240.0, (0.1, 0.02, 0.001, 0.002, 0.03, 0.01, 0.02, 0.03)),
])  # fmt: skip
def test_every_lens_goes_through(recording: Recording, camera: Camera, tmp_path: Path) -> None:
    write_foxglove(recording, camera, tmp_path / "flight.mcap")
    write_ros2(recording, camera, tmp_path / "flight")
    for path in (tmp_path / "flight.mcap", tmp_path / "flight"):
        assert [logged.camera for logged in read_log(str(path)).cameras] == [camera]
