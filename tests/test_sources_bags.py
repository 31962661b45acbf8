"""ROS bags and MCAP: counts and values against the formats' libraries, one content in every container and encoding."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_files import (
    BEGAN_NS,
    DELAY_NS,
    NS,
    Row,
    camera_info,
    edge,
    fix,
    header,
    image,
    imu,
    pose,
    ros,
    tree,
    write_folder,
    write_mcap,
    write_ros1,
)  # fmt: skip
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from fuzzing import check
from hypothesis import given
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from pipeline.geometry.rotations import ned_from_frd, rotation_from_quaternion
from pipeline.sources.bags import mcap as mcap_bag
from pipeline.sources.bags import rosbag
from pipeline.sources.bags.frame_tree import transform_between
from pipeline.sources.logs import read_log
from pipeline.sources.records import FixedTransform, FlightLog

REAL = (
    "evo/ROS_example.bag", "evo/nav2_turtlebot.mcap", "robot_localization/test1.bag",
    "kapture_t265/trimmed_locoffice.bag",
)  # fmt: skip
# Yaw 30 deg, pitch 10 deg, roll -5 deg as NED_from_FRD.
TURN = ned_from_frd(*np.radians([30.0, 10.0, -5.0]))
ENU_FROM_NED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])


def wxyz(rotation: np.ndarray) -> list[float]:
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True).tolist()


def content(path: Path, rows: list[Row]) -> FlightLog:
    log = read_log(str(write_mcap(path / "bag.mcap", rows)))
    check(log)
    return log


def at(second: float) -> int:
    return BEGAN_NS + round(second * NS)


# Real bags.


@pytest.mark.real
@pytest.mark.parametrize("name", REAL)
def test_real_bags_have_what_the_library_counts(shared: Path, name: str) -> None:
    path = shared / "data/bags" / name
    log = read_log(str(path))
    check(log)
    assert log.losses == ()
    with AnyReader([path]) as reader:
        assert log.counts == {topic: info.msgcount for topic, info in reader.topics.items()}
        assert log.facts["duration_s"] == pytest.approx(reader.duration / NS, abs=1e-8)
    streams = (*log.positions, *log.attitudes, *log.images, *(pose for pose in log.poses if ">" not in pose.stream))
    assert streams
    assert {stream.stream: len(stream.time_ns) for stream in streams}.items() <= log.counts.items()


@pytest.mark.real
def test_a_real_trajectory(shared: Path) -> None:
    path = shared / "data/bags/evo/ROS_example.bag"
    (poses,) = (stream for stream in read_log(str(path)).poses if stream.stream == "groundtruth")
    with AnyReader([path]) as reader:
        wanted = [connection for connection in reader.connections if connection.topic == "groundtruth"]
        rows = []
        for connection, _, raw in reader.messages(wanted):
            found: Any = reader.deserialize(raw, connection.msgtype)
            p, q, stamp = found.pose.position, found.pose.orientation, found.header.stamp
            rows.append((stamp.sec * NS + stamp.nanosec, p.x, p.y, p.z, q.w, q.x, q.y, q.z))
    times, *expected = zip(*rows, strict=True)
    np.testing.assert_array_equal(poses.time_ns, times)
    np.testing.assert_array_equal(poses.position_m, np.transpose(expected[:3]))
    np.testing.assert_allclose(poses.q_wxyz, np.transpose(expected[3:]), atol=1e-6)
    assert (poses.of, poses.axes, poses.child) == ("body", "flu", "")


@pytest.mark.real
def test_a_real_vehicle_with_gnss(shared: Path) -> None:
    log = read_log(str(shared / "data/bags/robot_localization/test1.bag"))
    (positions,), (attitudes,) = log.positions, log.attitudes
    # East of Boston, as logged; the receiver's position is the only one with a height.
    assert positions.latitude_deg[0] == pytest.approx(42.375812, abs=1e-9)
    assert positions.ellipsoidal_m[:2].tolist() == pytest.approx([7.3, 7.2])
    assert (positions.sigma_horizontal_m[0], positions.sigma_vertical_m[0]) == (pytest.approx(0.9), pytest.approx(1.8))
    assert np.all(np.isnan(positions.amsl_m))
    # robot_localization's launch file for this bag mounts the IMU on its side: yaw -90, roll 90 deg. The robot on
    # wheels stays level, which a mixed-up convention turns over.
    assert log.facts["attitude_frames"] == {"/imu/data": "imu_link"}
    flu_from_imu = Rotation.from_euler("ZYX", [-90.0, 0.0, 90.0], degrees=True).as_matrix()
    ned_from_imu = rotation_from_quaternion(attitudes.q_wxyz) @ FLU_FROM_FRD
    down = (ned_from_imu @ flu_from_imu.T)[:, 2, 2]
    assert -1.0 <= down.min() <= down.max() < -0.98
    assert (attitudes.of, attitudes.frame) == ("vehicle", "ned")


@pytest.mark.real
def test_real_simulated_time_and_transforms(shared: Path) -> None:
    log = read_log(str(shared / "data/bags/evo/nav2_turtlebot.mcap"))
    assert log.time_base.epoch == "boot"
    assert "simulated" in log.time_base.problem
    streams = {stream.stream: (stream.parent, stream.child, len(stream.time_ns)) for stream in log.poses}
    assert streams["/odom"] == ("odom", "base_link", 2639)
    assert streams["/tf odom>base_link"] == ("odom", "base_link", 2639)
    assert streams["/amcl_pose"] == ("map", "", 135)
    move, turn = transform_between(log.transforms, "base_link", "oakd_rgb_camera_optical_frame")
    # The TurtleBot 4's OAK-D looks forward: its optical z axis is the body's x.
    np.testing.assert_allclose(rotation_from_quaternion(turn)[:, 2], [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(move, [-0.0596, 0.0, 0.24353], atol=1e-9)


# One content in every container and encoding.


def rows_of(version: int = 2) -> list[Row]:
    out: list[Row] = []
    for n in range(6):
        t = at(0.1 * n)
        q = wxyz(ENU_FROM_NED @ TURN @ FLU_FROM_FRD)
        out += [("/fix", t + DELAY_NS, fix(t, 45.0 + n * 1e-5, version=version))]
        out += [("/imu", t + DELAY_NS + 1, imu(t, q, version=version))]
    return out


def write_protobuf(path: Path, **options: Any) -> Path:
    rows: list[Row] = []
    for n in range(6):
        message = LocationFix(latitude=45.0 + n * 1e-5, longitude=7.25, altitude=512.125, frame_id="base_link")
        message.timestamp.FromNanoseconds(at(0.1 * n))
        message.position_covariance[:] = [0.04, 0, 0, 0, 0.16, 0, 0, 0, 0.25]
        message.position_covariance_type = 2
        rows.append(("/fix", at(0.1 * n) + DELAY_NS, message))
    return write_mcap(path, rows, "protobuf", **options)


def write_json(path: Path, **options: Any) -> Path:
    rows: list[Row] = []
    for n in range(6):
        stamp = {"sec": at(0.1 * n) // NS, "nsec": at(0.1 * n) % NS}
        place = {"latitude": 45.0 + n * 1e-5, "longitude": 7.25, "altitude": 512.125}
        more = {"position_covariance": [0.04, 0, 0, 0, 0.16, 0, 0, 0, 0.25], "position_covariance_type": 2}
        message = {"timestamp": stamp, "frame_id": "base_link", **place, **more}
        rows.append(("/fix", at(0.1 * n) + DELAY_NS, ("foxglove.LocationFix", message)))
    return write_mcap(path, rows, "json", **options)


def containers(folder: Path) -> Iterator[Path]:
    """The same fixes, in all ways to store them."""
    for compression in ("none", "bz2", "lz4"):
        yield write_ros1(folder / f"{compression}.bag", rows_of(1), compression, 300)
    for compression in ("none", "lz4", "zstd"):
        yield write_mcap(folder / f"ros1-{compression}.mcap", rows_of(1), "ros1", compression, 300)
        yield write_mcap(folder / f"cdr-{compression}.mcap", rows_of(), "cdr", compression, 300)
        yield write_protobuf(folder / f"protobuf-{compression}.mcap", compression=compression, chunk=300)
        yield write_json(folder / f"json-{compression}.mcap", compression=compression, chunk=300)
    yield write_mcap(folder / "unchunked.mcap", rows_of(), use_chunking=False)
    yield write_folder(folder / "db3", rows_of())
    yield folder / "db3/db3.db3"
    yield write_folder(folder / "mcap", rows_of(), "mcap")
    yield write_folder(folder / "messages", rows_of(), mode="message")
    yield write_folder(folder / "file", rows_of(), mode="file")
    yield write_folder(folder / "storage", rows_of(), "mcap", "storage")


def test_every_container_and_encoding(tmp_path: Path) -> None:
    for path in containers(tmp_path):
        log = read_log(str(path))
        check(log)
        assert log.losses == (), path
        (positions,) = log.positions
        assert (positions.stream, positions.fused, log.counts["/fix"]) == ("/fix", False, 6), path
        assert positions.time_ns.tolist() == [at(0.1 * n) for n in range(6)], path
        assert positions.latitude_deg.tolist() == [45.0 + n * 1e-5 for n in range(6)], path
        assert set(positions.longitude_deg) == {7.25}
        assert set(positions.ellipsoidal_m) == {512.125}
        np.testing.assert_allclose(positions.sigma_horizontal_m, math.sqrt(0.1), rtol=1e-15)
        np.testing.assert_allclose(positions.sigma_vertical_m, 0.5, rtol=1e-15)
        if "/imu" in log.counts:
            (attitudes,) = log.attitudes
            np.testing.assert_allclose(rotation_from_quaternion(attitudes.q_wxyz), [TURN] * 6, atol=1e-15)
        assert log.time_base.epoch == "utc"
        assert log.facts["topics"].keys() == log.counts.keys()


def test_formats_are_told_apart(tmp_path: Path) -> None:
    for path in containers(tmp_path):
        head = b"" if path.is_dir() else path.read_bytes()[:4096]
        found = (mcap_bag.is_format(head, str(path)), rosbag.is_format(head, str(path)))
        assert found == (path.suffix == ".mcap", path.suffix != ".mcap"), path
    assert not rosbag.is_format(b"SQLite format 3\x00", "survey.gpkg")
    assert not rosbag.is_format(b"", str(tmp_path))


# What messages mean.


def test_fixes_that_are_none(tmp_path: Path) -> None:
    rows = [("/fix", at(n), fix(at(n), status=-1 if n == 2 else 0, kind=0 if n == 0 else 2)) for n in range(5)]
    rows.append(("/fix", at(5), fix(at(5), latitude=math.nan)))
    log = content(tmp_path, rows)
    (positions,) = log.positions
    assert [(t - BEGAN_NS) // NS for t in positions.time_ns.tolist()] == [0, 1, 3, 4]
    assert positions.segment.tolist() == [0, 0, 1, 1]
    assert np.isnan(positions.sigma_horizontal_m).tolist() == [True, False, False, False]
    assert log.losses == ("/fix: 2 of 6 messages have no fix and were left out",)


def test_without_stamps_log_time_counts(tmp_path: Path) -> None:
    rows: list[Row] = [("/fix", at(n), fix(0)) for n in range(3)] + [("/image", at(n), image(0)) for n in range(3)]
    log = content(tmp_path, rows)
    assert log.positions[0].time_ns.tolist() == [at(n) for n in range(3)]
    assert log.images[0].note == "log time: no header stamps"
    assert log.losses == ("/fix: log time: no header stamps",)
    # One camera that stamps by its own uptime does not turn the bag's clock.
    rows += [("/imu", at(n), imu(at(n) - DELAY_NS)) for n in range(3)] + [("/up", at(n), image(n * NS)) for n in (5, 6)]
    log = content(tmp_path, rows)
    assert log.time_base.epoch == "utc"
    assert log.images[1].time_ns.tolist() == [at(5), at(6)]
    assert log.images[1].note == "log time: header stamps of another clock"


def test_late_messages_take_their_place_and_impossible_times_go(tmp_path: Path) -> None:
    seconds = [0.0, 0.2, 0.1, 0.3, 4e8, 0.4]
    log = content(tmp_path, [("/pose", at(0.5), pose(at(s), s)) for s in seconds])
    assert log.poses[0].position_m[:, 0].tolist() == [0.0, 0.1, 0.2, 0.3, 0.4]
    assert log.losses == ("/pose: 1 of 6 messages have an impossible time and were left out",)


def test_an_imu_without_orientation(tmp_path: Path) -> None:
    rows: list[Row] = [("/raw", at(n), imu(at(n), first_variance=-1.0)) for n in range(3)]
    rows += [("/zero", at(n), imu(at(n), (0.0, 0.0, 0.0, 0.0))) for n in range(3)]
    log = content(tmp_path, rows)
    assert log.attitudes == ()
    assert log.losses == ("/zero: 3 of 3 messages hold no rotation and were left out",)


def test_an_imu_on_its_side_tells_the_bodys_attitude(tmp_path: Path) -> None:
    side = Rotation.from_euler("ZYX", [-90.0, 0.0, 90.0], degrees=True).as_matrix()
    sensor = wxyz(ENU_FROM_NED @ TURN @ FLU_FROM_FRD @ side)
    mount = tree(edge(at(0), "base_link", "imu_link", (0.1, 0.2, 0.3), wxyz(side)))
    rows: list[Row] = [("/imu", at(n), imu(at(n), sensor, frame="imu_link")) for n in range(3)]
    turned = content(tmp_path, [("/tf_static", at(0), mount), *rows])
    np.testing.assert_allclose(rotation_from_quaternion(turned.attitudes[0].q_wxyz), [TURN] * 3, atol=1e-15)
    assert turned.facts["attitude_frames"] == {"/imu": "base_link"}
    assert content(tmp_path, rows).facts["attitude_frames"] == {"/imu": "imu_link"}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, ("brown", 800, 600, 900.0, 410.0, 290.0)),
        ({"d": np.zeros(5)}, ("pinhole", 800, 600, 900.0, 410.0, 290.0)),
        ({"model": "rational_polynomial", "d": np.arange(8) * 1e-3}, ("brown", 800, 600, 900.0, 410.0, 290.0)),
        ({"model": "equidistant", "d": np.full(4, 0.01)}, ("fisheye", 800, 600, 900.0, 410.0, 290.0)),
        # Half the pixels: the centre of a binned pixel lies between those of its four.
        ({"binning_x": 2, "binning_y": 2}, ("brown", 400, 300, 450.0, 204.75, 144.75)),
        ({"roi": {"x_offset": 100, "y_offset": 50, "width": 600, "height": 400}},
         ("brown", 600, 400, 900.0, 310.0, 240.0)),
        ({"roi": {"x_offset": 100, "y_offset": 50, "width": 601, "height": 400}, "binning_x": 4, "binning_y": 4},
         ("brown", 150, 100, 225.0, 310.5 / 4 - 0.5, 240.5 / 4 - 0.5)),
    ],
)  # fmt: skip
def test_camera_info(tmp_path: Path, changes: dict[str, Any], expected: tuple[Any, ...]) -> None:
    (logged,) = content(tmp_path, [("/camera_info", at(0), camera_info(at(0), **changes))]).cameras
    camera = logged.camera
    assert (camera.model, camera.width, camera.height, camera.fx, camera.cx, camera.cy) == pytest.approx(expected)
    assert logged.frame == "camera"


@pytest.mark.parametrize(
    ("changes", "told"),
    [({"focal": 0.0}, "not calibrated"), ({"model": "cubic"}, "cubic"), ({"height": 0}, "not of a camera"),
     ({"d": np.array([math.nan] * 5)}, "not of a camera")],
)  # fmt: skip
def test_camera_info_that_is_no_camera(tmp_path: Path, changes: dict[str, Any], told: str) -> None:
    log = content(tmp_path, [("/camera_info", at(n), camera_info(at(n), **changes)) for n in range(2)])
    assert log.cameras == ()
    assert told in log.losses[0]


def test_a_calibration_that_changes(tmp_path: Path) -> None:
    rows = [("/camera_info", at(n), camera_info(at(n), focal=900.0 + (n > 2))) for n in range(5)]
    log = content(tmp_path, rows)
    assert log.cameras[0].camera.fx == 900.0
    assert log.losses == ("/camera_info: 2 messages differ from the first calibration, which is used",)


def test_exposures_of_a_camera_whose_images_are_on_the_card(tmp_path: Path) -> None:
    rows: list[Row] = [("/cam/camera_info", at(n), camera_info(at(n) - DELAY_NS)) for n in range(4)]
    (events,) = content(tmp_path, rows).events
    assert events.time_ns.tolist() == [at(n) - DELAY_NS for n in range(4)]
    assert (events.stream, events.feedback, events.sigma_s) == ("/cam/camera_info", True, 0.001)
    assert set(events.number) == {-1}
    # With images of the same frame in the bag, whatever their topic, its calibrations are no events.
    assert content(tmp_path, [*rows, ("/other/image", at(0), image(at(0)))]).events == ()
    assert content(tmp_path, [*rows, ("/cam/image_raw", at(0), image(at(0), frame=""))]).events == ()
    assert len(content(tmp_path, [*rows, ("/cam/image_raw", at(0), image(at(0), frame="thermal"))]).events) == 1
    assert content(tmp_path, rows[:1]).events == ()


def test_triggers_by_time_reference(tmp_path: Path) -> None:
    stamp = ros("builtin_interfaces/Time", sec=3, nanosec=4)
    rows = [
        (topic, at(n), ros("sensor_msgs/TimeReference", header=header(at(n)), time_ref=stamp, source=source))
        for n in range(3)
        for topic, source in (("/line", "camera trigger"), ("/trigger", ""), ("/gps_time", "gps"))
    ]
    events = content(tmp_path, rows).events
    assert {stream.stream: (len(stream.time_ns), stream.feedback, stream.sigma_s) for stream in events} == {
        "/line": (3, False, 0.01),
        "/trigger": (3, False, 0.01),
    }


def test_transform_trees(tmp_path: Path) -> None:
    still = (at(0), "gimbal", "camera", (0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
    rows: list[Row] = [("/tf_static", at(0), tree(edge(at(0), "/base", "/gimbal", (1, 2, 3), (0.5, 0.5, 0.5, 0.5))))]
    rows += [("/tf", at(n), tree(edge(at(n), "map", "base", (n, 0, 0), (1, 0, 0, 0)), edge(*still))) for n in range(3)]
    log = content(tmp_path, rows)
    assert {(stream.stream, stream.parent, stream.child) for stream in log.poses} == {
        ("/tf map>base", "map", "base"), ("/tf gimbal>camera", "gimbal", "camera"),
    }  # fmt: skip
    # A dynamic edge that never changes is what ROS 1's static_transform_publisher leaves.
    assert {(fixed.parent, fixed.child, fixed.source) for fixed in log.transforms} == {
        ("base", "gimbal", "/tf_static"), ("gimbal", "camera", "/tf"),
    }  # fmt: skip
    move, turn = transform_between(log.transforms, "base", "camera")
    # The half-way turn about (1, 1, 1) takes z to x.
    np.testing.assert_allclose(move, [2.0, 2.0, 3.0], atol=1e-15)
    np.testing.assert_allclose(turn, [0.5] * 4, atol=1e-15)
    assert transform_between(log.transforms, "base", "map") is None


def test_foxglove_transforms(tmp_path: Path) -> None:
    """Alone and in lists; one that came once, as fixed ones do, is fixed."""
    rows: list[Row] = []
    for n in range(3):
        moving = FrameTransform(parent_frame_id="map", child_frame_id="base")
        moving.timestamp.FromNanoseconds(at(n))
        moving.translation.x, moving.rotation.w = float(n), 1.0
        rows += [("/moves", at(n), moving), ("/list", at(n), FrameTransforms(transforms=[moving]))]
    fixed = FrameTransform(parent_frame_id="base", child_frame_id="camera", timestamp=moving.timestamp)
    fixed.translation.z, fixed.rotation.x = 0.5, 1.0
    log = read_log(str(write_mcap(tmp_path / "bag.mcap", [*rows, ("/once", at(0), fixed)], "protobuf")))
    check(log)
    assert {stream.stream: stream.position_m[:, 0].tolist() for stream in log.poses} == {
        "/moves map>base": [0.0, 1.0, 2.0], "/list map>base": [0.0, 1.0, 2.0], "/once base>camera": [0.0],
    }  # fmt: skip
    (transform,) = log.transforms
    assert (transform.parent, transform.child, transform.source) == ("base", "camera", "/once")
    assert (transform.translation_m.tolist(), transform.q_wxyz.tolist()) == ([0.0, 0.0, 0.5], [0.0, 1.0, 0.0, 0.0])


@given(st.lists(st.floats(-1.0, 1.0), min_size=21, max_size=21), st.integers(0, 3), st.integers(0, 3))
def test_transforms_compose_both_ways(numbers: list[float], first: int, last: int) -> None:
    """A chain of frames 0>1<2>3 against homogeneous matrices."""
    links, whole = [], {0: np.eye(4)}
    for n, (parent, child) in enumerate(((0, 1), (2, 1), (2, 3))):
        v = np.array(numbers[7 * n : 7 * n + 7])
        q = np.add(v[3:], (2.0, 0.0, 0.0, 0.0))
        links.append(FixedTransform(str(parent), str(child), v[:3], q / np.linalg.norm(q), ""))
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = Rotation.from_quat(q, scalar_first=True).as_matrix(), v[:3]
        known, other, step = (parent, child, step) if parent in whole else (child, parent, np.linalg.inv(step))
        whole[other] = whole[known] @ step
    move, turn = transform_between(links, str(first), str(last))
    expected = np.linalg.inv(whole[first]) @ whole[last]
    np.testing.assert_allclose(move, expected[:3, 3], atol=1e-9)
    np.testing.assert_allclose(rotation_from_quaternion(turn), expected[:3, :3], atol=1e-9)
