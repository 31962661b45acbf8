"""The simulated room: what the bag says agrees with the truth beside it, seen with programs of others."""

from __future__ import annotations

import csv
import io
import json
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation, Slerp

from pipeline.engine.errors import UsageError
from pipeline.geometry.cameras import Camera
from pipeline.lidar.nearby import LocalTiles, returns_near
from pipeline.lidar.reference import reference_depth
from pipeline.lidar.spacing import surface_spacing_m
from pipeline.lidar.sweeps import write_sweeps
from pipeline.lidar.tiles import read_local_tile
from pipeline.lidar.visibility import View, visible_returns
from pipeline.simulation import indoor as module
from pipeline.simulation.indoor import Summary, write_indoor
from pipeline.simulation.indoor_room import Room
from pipeline.sources.records import Sweep

FRAMES = 6
# y up to z up, by hand: x stays, the mocap's y is up, its z points south.
WORLD_FROM_MOCAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def indoor(tmp_path_factory: pytest.TempPathFactory) -> Summary:
    return write_indoor(tmp_path_factory.mktemp("indoor") / "room", frames=FRAMES)


@pytest.fixture(scope="module")
def bag(indoor: Summary) -> dict[str, list[Any]]:
    """Messages by topic, as rosbags decodes them."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    found: dict[str, list[Any]] = {}
    with Reader(indoor.directory / "bag") as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(store.deserialize_cdr(data, connection.msgtype))
    return found


class Truth:
    """The files beside the bag."""

    def __init__(self, folder: Path) -> None:
        rows = list(csv.DictReader(io.StringIO((folder / "truth" / "poses.csv").read_text())))
        self.time_ns = np.array([int(row["time_ns"]) for row in rows])
        self.centre = np.array([[float(row[name]) for name in ("x_m", "y_m", "z_m")] for row in rows])
        xyzw = [[float(row[name]) for name in ("qx", "qy", "qz", "qw")] for row in rows]
        self.rotation = Rotation.from_quat(xyzw).as_matrix()
        self.depth = [np.load(folder / "truth" / "depth" / f"{row['frame']}.npz")["depth_m"] for row in rows]
        self.scene = json.loads((folder / "truth" / "scene.json").read_text())
        camera = self.scene["camera"]
        self.camera = Camera(**{**camera, "distortion": tuple(camera["distortion"])})


@pytest.fixture(scope="module")
def truth(indoor: Summary) -> Truth:
    return Truth(indoor.directory)


def stamp(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def picture(message: Any) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(message.data.tobytes())))


def xyzw(quaternion: Any) -> tuple[float, ...]:
    return quaternion.x, quaternion.y, quaternion.z, quaternion.w


def xyz(vector: Any) -> np.ndarray:
    return np.array([vector.x, vector.y, vector.z])


class Body:
    """Poses of the rigid body in the z-up world, interpolated, and what is mounted on it."""

    def __init__(self, bag: dict[str, list[Any]]) -> None:
        poses = bag["/vrpn_client_node/rig/pose"]
        self.time_ns = np.array([stamp(pose) for pose in poses])
        self.position = np.array([xyz(pose.pose.position) for pose in poses]) @ WORLD_FROM_MOCAP.T
        turned = Rotation.from_quat([xyzw(pose.pose.orientation) for pose in poses])
        self.rotation = Rotation.from_matrix(WORLD_FROM_MOCAP) * turned
        (tree,) = bag["/tf_static"]
        self.mounts = {edge.child_frame_id: edge for edge in tree.transforms}

    def of(self, child: str, time_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations world_from_child (n, 3, 3) and places (n, 3)."""
        seconds, at = ((t - self.time_ns[0]) / 1e9 for t in (self.time_ns, np.asarray(time_ns)))
        rotation = Slerp(seconds, self.rotation)(at)
        position = np.stack([np.interp(at, seconds, self.position[:, i]) for i in range(3)], axis=1)
        mount = self.mounts[child].transform
        turned = rotation * Rotation.from_quat(xyzw(mount.rotation))
        return turned.as_matrix(), position + rotation.apply(xyz(mount.translation))


@pytest.fixture(scope="module")
def body(bag: dict[str, list[Any]]) -> Body:
    return Body(bag)


def points_of(sweep: Any) -> np.ndarray:
    """A sweep as a record array, by the message's own description."""
    kinds = {4: "<u2", 7: "<f4"}
    layout = np.dtype(
        {
            "names": [field.name for field in sweep.fields],
            "formats": [kinds[field.datatype] for field in sweep.fields],
            "offsets": [field.offset for field in sweep.fields],
            "itemsize": sweep.point_step,
        }
    )
    return np.frombuffer(sweep.data.tobytes(), layout)


# ---- the bag


def test_the_bag_holds_what_the_summary_says(indoor: Summary, bag: dict[str, list[Any]]) -> None:
    counts = {topic: len(messages) for topic, messages in bag.items()}
    assert counts == {
        "/tf_static": 1,
        "/vrpn_client_node/rig/pose": indoor.poses,
        "/camera/image_raw/compressed": FRAMES,
        "/camera/camera_info": FRAMES,
        "/velodyne_points": indoor.sweeps,
    }
    assert indoor.returns == sum(sweep.width for sweep in bag["/velodyne_points"])
    assert (indoor.poses, indoor.sweeps) == (1250, 115)
    (tree,) = bag["/tf_static"]
    assert {(edge.header.frame_id, edge.child_frame_id) for edge in tree.transforms} == {
        ("rig", "camera_optical"),
        ("rig", "velodyne"),
    }
    assert {pose.header.frame_id for pose in bag["/vrpn_client_node/rig/pose"]} == {"mocap"}


def test_messages_are_heard_after_their_stamp_and_in_order(indoor: Summary) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    heard, late = [], {}
    with Reader(indoor.directory / "bag") as reader:
        for connection, log_ns, data in reader.messages():
            heard.append(log_ns)
            if connection.topic != "/tf_static":
                message = store.deserialize_cdr(data, connection.msgtype)
                late.setdefault(connection.topic, []).append((log_ns - stamp(message)) / 1e9)
    assert heard == sorted(heard)
    for delays in late.values():
        assert 0.0 < min(delays) <= max(delays) < 0.2


def test_motion_capture_is_y_up_and_errs_as_it_says(truth: Truth, body: Body, bag: dict[str, list[Any]]) -> None:
    # Carried at 1.3 to 1.7 m: that is y in motion capture's frame.
    heights = np.array([pose.pose.position.y for pose in bag["/vrpn_client_node/rig/pose"]])
    assert 1.2 < heights.min() < heights.max() < 1.8
    rate = np.diff(body.time_ns) / 1e9
    np.testing.assert_allclose(rate, 0.01, atol=1e-5)
    # Second differences of a smooth path are noise alone: white noise of sigma gives sqrt(6) sigma.
    shake = np.diff(body.position, n=2, axis=0).std(axis=0) / np.sqrt(6.0)
    assert np.all((shake > 0.0009) & (shake < 0.0011))
    step = (body.rotation[:-1].inv() * body.rotation[1:]).as_rotvec()
    turn = np.degrees(np.diff(step, axis=0).std(axis=0)) / np.sqrt(6.0)
    assert np.all((turn > 0.045) & (turn < 0.055))
    rotation, centre = body.of("camera_optical", truth.time_ns)
    assert np.linalg.norm(centre - truth.centre, axis=1).max() < 0.004
    angle = Rotation.from_matrix(np.swapaxes(rotation, 1, 2) @ truth.rotation).magnitude()
    assert np.degrees(angle).max() < 0.2
    assert truth.scene["pose_noise"]["sigma_m"] == 0.001
    assert truth.scene["pose_noise"]["sigma_deg"] == 0.05


def test_the_first_frame_looks_north_with_the_floor_below(truth: Truth) -> None:
    forward, down = truth.rotation[0][:, 2], truth.rotation[0][:, 1]
    assert forward[1] > 0.95
    assert down[2] < -0.95
    # The wall 4.5 m north of the middle, above the crates; the floor at its lower edge.
    middle, lower = truth.depth[0][80, 150], truth.depth[0][479, 320]
    ray = truth.rotation[0] @ truth.camera.rays(np.array([150.0, 80.0]))
    np.testing.assert_allclose(truth.centre[0][1] + middle * ray[1], 4.5, atol=2e-3)
    ray = truth.rotation[0] @ truth.camera.rays(np.array([320.0, 479.0]))
    np.testing.assert_allclose(truth.centre[0][2] + lower * ray[2], 0.0, atol=2e-3)


def test_images_and_calibration(truth: Truth, bag: dict[str, list[Any]]) -> None:
    assert [stamp(image) for image in bag["/camera/image_raw/compressed"]] == truth.time_ns.tolist()
    for image, info in zip(bag["/camera/image_raw/compressed"], bag["/camera/camera_info"], strict=True):
        assert stamp(image) == stamp(info)
        assert image.header.frame_id == info.header.frame_id == "camera_optical"
        shown = picture(image)
        assert shown.shape == (info.height, info.width, 3) == (480, 640, 3)
        # Well exposed, and rich in texture.
        assert 90 < shown.mean() < 170
        assert np.mean((shown > 5) & (shown < 250)) > 0.98
        assert info.distortion_model == "plumb_bob"
        np.testing.assert_allclose(info.k.reshape(3, 3), truth.camera.matrix)
        np.testing.assert_allclose(info.d, truth.camera.distortion)


def test_neighbouring_frames_obey_the_epipolar_geometry_of_the_true_poses(
    truth: Truth, bag: dict[str, list[Any]]
) -> None:
    sift = cv2.SIFT_create(nfeatures=4000, contrastThreshold=0.02)
    sift_of = [
        sift.detectAndCompute(cv2.cvtColor(picture(image), cv2.COLOR_RGB2GRAY), None)
        for image in bag["/camera/image_raw/compressed"]
    ]
    # Sideways along the wall, and forward into the room.
    for ref, src in ((0, 1), (2, 3), (4, 5)):
        (ref_keys, ref_words), (src_keys, src_words) = sift_of[ref], sift_of[src]
        matches = [
            best
            for best, second in cv2.BFMatcher().knnMatch(ref_words, src_words, k=2)
            if best.distance < 0.75 * second.distance
        ]
        ref_px = np.array([ref_keys[match.queryIdx].pt for match in matches])
        src_px = np.array([src_keys[match.trainIdx].pt for match in matches])
        residual = sampson_px(truth, ref, src, ref_px, src_px)
        good = residual < 2.0
        assert good.sum() > 150, (ref, src, len(matches), good.sum())
        assert 0.01 < np.median(residual[good]) < 0.3
        assert np.median(residual) < 0.3


def sampson_px(truth: Truth, ref: int, src: int, ref_px: np.ndarray, src_px: np.ndarray) -> np.ndarray:
    """First-order distance of matches to the epipolar constraint, px."""
    turn = truth.rotation[src].T @ truth.rotation[ref]
    t = truth.rotation[src].T @ (truth.centre[ref] - truth.centre[src])
    essential = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ turn
    a, b = truth.camera.rays(ref_px), truth.camera.rays(src_px)
    value = np.einsum("ni,ij,nj->n", b, essential, a)
    along_b, along_a = a @ essential.T, b @ essential
    slope = np.sqrt(np.sum(along_b[:, :2] ** 2, axis=1) + np.sum(along_a[:, :2] ** 2, axis=1))
    return np.abs(value) / slope * truth.camera.focal_px


# ---- LiDAR


def in_frame(truth: Truth, index: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depths of points in a frame and the exact depths of its pixels there."""
    in_cam = (points - truth.centre[index]) @ truth.rotation[index]
    in_cam = in_cam[in_cam[:, 2] > 0.3]
    pixels = truth.camera.project(in_cam)
    inside = truth.camera.holds(pixels)
    at = np.clip(np.rint(pixels[inside]).astype(int), 0, (639, 479))
    return in_cam[inside, 2], truth.depth[index][at[:, 1], at[:, 0]]


def placed(sweep: Any, body: Body) -> np.ndarray:
    points = points_of(sweep)
    rotation, centre = body.of("velodyne", stamp(sweep) + np.rint(points["time"].astype(float) * 1e9).astype(np.int64))
    return np.einsum("nij,nj->ni", rotation, np.column_stack([points[axis] for axis in "xyz"]).astype(float)) + centre


def test_sweeps_agree_with_the_exact_depth(truth: Truth, body: Body, bag: dict[str, list[Any]]) -> None:
    sweeps = bag["/velodyne_points"]
    for index in range(FRAMES):
        nearest = min(sweeps, key=lambda sweep: abs(stamp(sweep) + 50_000_000 - truth.time_ns[index]))
        depth, exact = in_frame(truth, index, placed(nearest, body))
        assert len(depth) > 1500
        off = np.abs(depth - exact)
        # Two centimetres of noise along the ray: the median of its amount is 0.67 of that.
        assert 0.008 < np.median(off) < 0.03
        # Where the LiDAR looks past what hides a surface from the camera.
        assert np.mean(off > 0.15) < 0.15


def test_sweeps_have_rings_and_times_of_a_vlp_16(bag: dict[str, list[Any]]) -> None:
    for sweep in bag["/velodyne_points"][::20]:
        points = points_of(sweep)
        assert points.dtype.names == ("x", "y", "z", "intensity", "ring", "time")
        assert sweep.header.frame_id == "velodyne"
        assert (sweep.is_dense, sweep.height, sweep.row_step) == (True, 1, 22 * len(points))
        assert set(points["ring"].tolist()) == set(range(16))
        assert points["time"].min() == 0.0
        assert 0.099 < points["time"].max() < 0.1
        assert np.all(np.diff(points["time"]) > 0.0)
        level = np.hypot(points["x"], points["y"])
        elevation = np.degrees(np.arctan2(points["z"], level))
        np.testing.assert_allclose(elevation, 2.0 * points["ring"] - 15.0, atol=1e-3)
    stamps = np.diff([stamp(sweep) for sweep in bag["/velodyne_points"]])
    np.testing.assert_allclose(stamps, 100_000_000, atol=2000)


def test_the_whole_scan_lies_on_the_room_and_what_is_in_it(body: Body, bag: dict[str, list[Any]]) -> None:
    points = np.concatenate([placed(sweep, body) for sweep in bag["/velodyne_points"][::10]])
    assert np.all(np.abs(points) < (6.2, 4.7, 4.2))
    to_walls = np.min(np.abs(np.stack([6.0 - np.abs(points[:, 0]), 4.5 - np.abs(points[:, 1]), points[:, 2]])), axis=0)
    on_walls = to_walls < 0.1
    assert 0.6 < np.mean(on_walls) < 0.95
    near = to_walls[on_walls]
    # The noise is along the ray, which meets walls aslant.
    assert 0.004 < np.median(near) < 0.02


def test_depths_from_the_sweeps_are_the_exact_ones_also_beside_what_stands_in_the_way(
    truth: Truth, body: Body, bag: dict[str, list[Any]], tmp_path: Path
) -> None:
    sweeps = (
        Sweep(
            stamp(sweep), np.column_stack([points[axis] for axis in "xyz"]).astype(float), points["time"].astype(float)
        )
        for sweep in bag["/velodyne_points"]
        for points in (points_of(sweep),)
    )
    written = write_sweeps(sweeps, lambda instants: body.of("velodyne", instants), tmp_path)
    assert 120_000 < written < 250_000
    tiles = LocalTiles(tuple(read_local_tile(path) for path in sorted(tmp_path.glob("*.laz"))))
    returns = returns_near(tiles, truth.centre, 15.0)
    spacing = surface_spacing_m(returns)
    # By their noise walls are often two voxels thick.
    assert 0.03 < spacing < 0.06
    rng = np.random.default_rng(0)
    for index in range(FRAMES):
        view = View(truth.camera, truth.centre[index], truth.rotation[index])
        visible = visible_returns(view, returns, None, spacing, 15.0)
        pixels = rng.integers((0, 0), (640, 480), (4000, 2)).astype(float)
        found = reference_depth(truth.camera, pixels, visible)
        # Rings from -15 to 15 deg leave the floor at the camera's feet and the ceiling without returns.
        assert 0.4 < np.mean(found.valid) < 0.9
        at = pixels[found.valid].astype(int)
        off = np.abs(found.depth_m[found.valid] - truth.depth[index][at[:, 1], at[:, 0]])
        assert 0.001 < np.median(off) < 0.01
        assert np.mean(off > 0.1) < 0.02


# ---- the folder


def test_rays_from_inside_always_meet_something() -> None:
    room = Room.seeded(1)
    rng = np.random.default_rng(0)
    directions = np.concatenate([rng.normal(size=(5000, 3)), np.eye(3), -np.eye(3)])
    hits = room.cast(np.array([0.5, -2.6, 1.5]), directions)
    p = np.array([0.5, -2.6, 1.5]) + hits.distance[:, None] * directions
    assert np.all(np.isfinite(p))
    assert np.all(np.abs(p - (0.0, 0.0, 2.0)) < (6.0 + 1e-9, 4.5 + 1e-9, 2.0 + 1e-9))
    # East, north, up, west, south, down: the crate north of there is 1 m high.
    assert hits.distance[-6:-3].round(6).tolist() == [5.5, 7.1, 2.5]
    assert hits.distance[-3:].round(6).tolist() == [6.5, 1.9, 1.5]
    assert hits.face[-6:].tolist() == [0, 2, 4, 1, 3, 5]


def test_same_seed_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "scan_times_s", lambda: np.array([0.2, 0.3]))
    for name in ("a", "b"):
        write_indoor(tmp_path / name, seed=3, frames=2)
    write_indoor(tmp_path / "c", seed=4, frames=2)
    a, b, c = (
        {path.relative_to(tmp_path / name).as_posix(): path.read_bytes() for path in (tmp_path / name).rglob("*.*")}
        for name in "abc"
    )
    assert a == b
    assert a.keys() == c.keys()
    assert a["truth/depth/0001.npz"] == c["truth/depth/0001.npz"]
    assert a["bag/bag.db3"] != c["bag/bag.db3"]


def test_the_workflow_names_what_is_there(indoor: Summary, bag: dict[str, list[Any]]) -> None:
    workflow = tomllib.loads((indoor.directory / "workflow.toml").read_text())
    assert list(workflow) == ["ingest", "pair", "match", "refine", "depth", "fuse", "score", "report"]
    ingest = workflow["ingest"]
    assert (indoor.directory / ingest["bags"]).is_dir()
    assert {ingest["pose_topic"], ingest["image_topic"]} <= bag.keys()
    assert ingest["up_axis"] == "y"
    assert "lidar" not in workflow["score"]


@pytest.mark.parametrize("frames", [1, 0, -3, 10**6])
def test_too_few_or_many_frames_are_refused(tmp_path: Path, frames: int) -> None:
    with pytest.raises(UsageError, match="E-EXAMPLE-01"):
        write_indoor(tmp_path / "room", frames=frames)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(UsageError, match="E-EXAMPLE-03"):
        write_indoor(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
