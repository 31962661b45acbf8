"""Trajectories as text: TUM, and the plain CSV that anything can be converted to; exact poses of real images."""

import itertools
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from fuzzing import check, mutations_wanted, survives
from hypothesis import given
from hypothesis import strategies as st
from oracles import fundamental
from scipy.spatial.transform import Rotation

from pipeline.engine.errors import InputError
from pipeline.geometry.rotations import ENU_FROM_NED, FRD_FROM_RDF, gimbal_angles, rotation_from_quaternion
from pipeline.sources.records import FlightLog
from pipeline.sources.trajectory import is_format, read

TUM = """# ground truth trajectory
# timestamp tx ty tz qx qy qz qw
1305031102.1758 1.3405 0.6266 1.6575 0.6574 0.6126 -0.2949 -0.3248
1305031102.1858 1.3303 0.6256 1.6464 0.6579 0.6161 -0.2932 -0.3189
1305031102.195812345 1.3160 0.6254 1.6302 0.6609 0.6199 -0.2893 -0.3086
"""
HALF = float(np.sqrt(0.5))
# Straight down with the image's top to the north, as conventions.md has it: x east, y south, z down.
DOWN_Q = "0,1,0,0"


def read_text(folder: Path, text: str, name: str = "t.csv") -> FlightLog:
    path = folder / name
    path.write_text(text)
    log = read(str(path))
    check(log)
    return log


def test_a_tum_file(tmp_path: Path) -> None:
    log = read_text(tmp_path, TUM, "groundtruth.txt")
    (poses,) = log.poses
    # To the last digit, which a double of seconds since 1970 does not hold.
    assert poses.time_ns.tolist() == [1305031102175800000, 1305031102185800000, 1305031102195812345]
    assert poses.position_m[0].tolist() == [1.3405, 0.6266, 1.6575]
    expected = Rotation.from_quat([0.6574, 0.6126, -0.2949, -0.3248]).as_matrix()
    assert rotation_from_quaternion(poses.q_wxyz[0]) == pytest.approx(expected, abs=1e-12)
    assert (poses.of, poses.axes, poses.image, poses.stream) == ("camera", "rdf", (), "groundtruth.txt")
    assert (log.time_base.epoch, log.kind, dict(log.counts)) == ("utc", "TUM trajectory", {"poses": 3})
    assert log.losses == ()
    relative = read_text(tmp_path, TUM.replace("1305031102", "12"), "t.tum")
    assert relative.time_base.epoch == "boot"
    assert relative.poses[0].time_ns[0] == 12_175_800_000


def test_lines_out_of_order_are_sorted(tmp_path: Path) -> None:
    lines = TUM.splitlines()
    log = read_text(tmp_path, "\n".join([lines[4], lines[2], lines[3]]), "t.tum")
    assert log.poses[0].position_m[:, 0].tolist() == [1.3405, 1.3303, 1.3160]


@pytest.mark.parametrize(
    "bad",
    [
        "1305031103 1 2 3 0 0 0", "1305031103 1 2 3 0 0 0 1 9", "x 1 2 3 0 0 0 1", "1305031103 1 2 nan 0 0 0 1",
        "1305031103 1 2 3 0 0 0 0", "1305031103 1 2 3 0 0 0 1.02", "1305031103000000000 1 2 3 0 0 0 1",
        "-5 1 2 3 0 0 0 1", "1e999999999 1 2 3 0 0 0 1",
    ],
)  # fmt: skip
def test_a_bad_line_in_twenty_is_left_out_and_a_second_is_too_many(tmp_path: Path, bad: str) -> None:
    good = [f"{1305031102 + n} 1 2 3 0 0 0 1" for n in range(19)]
    log = read_text(tmp_path, "\n".join([*good[:3], bad, *good[3:]]), "t.tum")
    assert len(log.poses[0].time_ns) == 19
    assert log.losses == ("1 of 20 lines are no poses and were left out: 4",)
    with pytest.raises(InputError, match=r"E-TRAJ-01(.|\n)*t\.tum:4\n(.|\n)*2 of 20 lines are no poses"):
        read_text(tmp_path, "\n".join([*good[:3], bad, bad, *good[3:18]]), "t.tum")


def test_a_cut_file_gives_the_lines_before_the_cut(tmp_path: Path) -> None:
    log = read_text(tmp_path, TUM[:-30], "t.tum")
    assert len(log.poses[0].time_ns) == 2
    assert log.losses == ("1 of 3 lines are no poses and were left out: 5",)


def test_a_csv_of_geodetic_positions_and_gimbal_angles(tmp_path: Path) -> None:
    log = read_text(
        tmp_path,
        "time;latitude_deg;longitude_deg;ellipsoidal_m;above_home_m;yaw_deg;pitch_deg;roll_deg;sigma_horizontal_m\n"
        "2024-06-01T10:00:01.500+02:00;47.1;8.5;460.5;;90;-90;0;0.02\n"
        "2024-06-01T08:00:00Z;47.0;8.5;460.0;60.0;0;-90;0;\n",
    )
    (positions,), (attitudes,) = log.positions, log.attitudes
    assert positions.time_ns[0] == int(datetime(2024, 6, 1, 8, tzinfo=UTC).timestamp()) * 10**9
    assert np.diff(positions.time_ns).tolist() == [1_500_000_000]
    assert positions.latitude_deg.tolist() == [47.0, 47.1]
    assert positions.ellipsoidal_m.tolist() == [460.0, 460.5]
    assert positions.above_home_m[0] == 60.0
    assert np.isnan([*positions.amsl_m, positions.above_home_m[1], positions.sigma_horizontal_m[0]]).all()
    assert positions.sigma_horizontal_m[1] == 0.02
    assert np.isnan(positions.sigma_vertical_m).all()
    assert (attitudes.of, attitudes.frame) == ("gimbal", "ned")
    ned_from_frd = rotation_from_quaternion(attitudes.q_wxyz)
    # The optical axis goes down; the image's top (forward-right-down: minus z) points north at yaw 0, east at 90.
    assert ned_from_frd @ (1.0, 0.0, 0.0) == pytest.approx(np.array([[0.0, 0.0, 1.0]] * 2), abs=1e-12)
    assert ned_from_frd @ (0.0, 0.0, -1.0) == pytest.approx(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), abs=1e-12)
    assert log.time_base.epoch == "utc"


def test_quaternions_and_angles_mean_the_same(tmp_path: Path) -> None:
    head = "image,latitude_deg,longitude_deg,amsl_m,"
    by_q = read_text(tmp_path, f"{head}qw,qx,qy,qz\na.jpg,47,8,400,{DOWN_Q}\n").attitudes[0]
    by_angles = read_text(tmp_path, f"{head}yaw_deg,pitch_deg,roll_deg\na.jpg,47,8,400,0,-90,0\n").attitudes[0]
    assert abs(by_q.q_wxyz[0] @ by_angles.q_wxyz[0]) == pytest.approx(1.0)
    assert by_q.image == ("a.jpg",)
    local = "image,x_m,y_m,z_m,"
    q = read_text(tmp_path, f"{local}qw,qx,qy,qz\na.jpg,1,2,3,{DOWN_Q}\n").poses[0]
    angles = read_text(tmp_path, f"{local}yaw_deg,pitch_deg,roll_deg\na.jpg,1,2,3,0,-90,0\n").poses[0]
    assert abs(q.q_wxyz[0] @ angles.q_wxyz[0]) == pytest.approx(1.0)
    world_from_cam = rotation_from_quaternion(q.q_wxyz[0])
    assert gimbal_angles(world_from_cam) == pytest.approx([0.0, -np.pi / 2, 0.0], abs=1e-7)
    ned = rotation_from_quaternion(by_q.q_wxyz[0])
    assert ENU_FROM_NED @ ned @ FRD_FROM_RDF == pytest.approx(world_from_cam, abs=1e-12)


def test_columns_are_found_by_name(tmp_path: Path) -> None:
    names = ["image", "time", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz", "remark"]
    cells = ["a.jpg", "12.5", "1", "2", "3", str(HALF), "0", "0", str(-HALF), "fine"]
    first = read_text(tmp_path, f"{','.join(names)}\n{','.join(cells)}\n").poses[0]
    for delimiter in ("\t", ";", ","):
        text = f"\ufeff{delimiter.join(names[::-1])}\r\n{delimiter.join(cells[::-1])}\r\n"
        poses = read_text(tmp_path, text.upper() if delimiter == ";" else text).poses[0]
        assert poses.image[0].lower() == "a.jpg"
        assert poses.time_ns.tolist() == first.time_ns.tolist() == [12_500_000_000]
        assert np.array_equal(poses.q_wxyz, first.q_wxyz)
        assert poses.position_m.tolist() == [[1.0, 2.0, 3.0]]
    quoted = read_text(tmp_path, 'image,x_m,y_m,z_m,qw,qx,qy,qz\n"a, b.jpg",1,2,3,1,0,0,0\n').poses[0]
    assert quoted.image == ("a, b.jpg",)


def test_rows_of_images_have_no_times(tmp_path: Path) -> None:
    log = read_text(tmp_path, "image,x_m,y_m,z_m,qw,qx,qy,qz\nb.jpg,1,2,3,1,0,0,0\na.jpg,4,5,6,1,0,0,0\n")
    assert log.poses[0].image == ("b.jpg", "a.jpg")
    assert log.poses[0].time_ns.tolist() == [0, 0]
    assert "no times" in log.time_base.problem


@pytest.mark.parametrize(
    ("header", "missing"),
    [
        ("image,x_m,y_m,qw,qx,qy,qz", "z_m"),
        ("image,x_m,y_m,z_m", "qw, qx, qy, qz or yaw_deg"),
        ("time,latitude_deg,ellipsoidal_m,yaw_deg,pitch_deg,roll_deg", "x_m, y_m, z_m"),
        ("time,latitude_deg,longitude_deg,yaw_deg,pitch_deg", "yaw_deg, pitch_deg, roll_deg"),
    ],
)
def test_missing_columns_are_named(tmp_path: Path, header: str, missing: str) -> None:
    with pytest.raises(InputError, match=r"E-TRAJ-02(.|\n)*t\.csv:1") as caught:
        read_text(tmp_path, f"{header}\n1,2,3,4,5,6,7,8\n")
    assert missing in caught.value.expected


@pytest.mark.parametrize(
    ("row", "why"),
    [
        ("2024-06-01T10:00:00,47,8,1", "without its zone"),
        ("2024-06-01T10:00:00Z,91,8,1", "latitude and longitude"),
        ("2024-06-01T10:00:00Z,47,8,inf", "not finite"),
        ("2024-06-01T10:00:00Z,47", "2 columns"),
        ("2024-06-01T10:00:00Z,47\u00b0,8,1", "could not convert"),
        ("", "nothing there"),
    ],
)
def test_what_is_wrong_with_a_row_is_said(tmp_path: Path, row: str, why: str) -> None:
    with pytest.raises(InputError, match=f"E-TRAJ-01(.|\n)*{why}"):
        read_text(tmp_path, f"time,latitude_deg,longitude_deg,amsl_m\n{row}\n")


def test_an_image_has_one_row(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"several rows for image a\.jpg"):
        read_text(tmp_path, "image,x_m,y_m,z_m,qw,qx,qy,qz\n" + "a.jpg,1,2,3,1,0,0,0\n" * 2)


def test_positions_alone_are_a_trajectory(tmp_path: Path) -> None:
    log = read_text(tmp_path, "time,latitude_deg,longitude_deg,amsl_m\n1700000000.25,47,8,400\n")
    assert log.attitudes == ()
    assert log.positions[0].time_ns.tolist() == [1_700_000_000_250_000_000]


@pytest.mark.parametrize(
    ("head", "known"),
    [
        (TUM, True),
        ("time,latitude_deg,longitude_deg,amsl_m\n", True),
        ("IMAGE\tX_m\ty_m\tz_m\n", True),
        ("latitude_deg,longitude_deg\n1,2\n", False),
        ("time(millisecond),datetime(utc),latitude,longitude\n", False),
        ("1 2 3 4 5 6 7\n", False),
        ("# comment only\n", False),
        ("", False),
    ],
)
def test_the_format_is_told_by_its_first_line(head: str, known: bool) -> None:
    assert is_format(head.encode(), "any.txt") == known


@given(st.one_of(st.text(max_size=200), st.binary(max_size=200).map(lambda data: data.decode("latin-1"))))
def test_any_line_after_good_ones(tmp_path_factory: pytest.TempPathFactory, junk: str) -> None:
    folder = tmp_path_factory.getbasetemp()
    good = "\n".join(f"{n + 1}.5 1 2 3 0 0 0 1" for n in range(400))
    log = read_text(folder, f"{good}\n{junk.encode('utf-8', 'replace').decode()}\n", "t.tum")
    assert len(log.poses[0].time_ns) >= 400


def keypoints(path: Path, window: tuple[slice, slice] = (slice(None), slice(None))) -> tuple[np.ndarray, np.ndarray]:
    """Places in the whole image, and descriptors, of SIFT in a window of it."""
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)[window]
    found, descriptors = cv2.SIFT_create(nfeatures=4000).detectAndCompute(picture, None)
    corner = (window[1].start or 0, window[0].start or 0)
    return np.array([point.pt for point in found]) + corner, descriptors


def epipolar_px(pair: list[tuple], matrix: np.ndarray, poses: list[tuple]) -> np.ndarray:
    """Distances of SIFT matches from their epipolar lines under given poses."""
    (points_a, descriptors_a), (points_b, descriptors_b) = pair
    nearest = cv2.BFMatcher().knnMatch(descriptors_a, descriptors_b, k=2)
    good = [first for first, second in nearest if first.distance < 0.7 * second.distance]
    a = points_a[[match.queryIdx for match in good]]
    b = points_b[[match.trainIdx for match in good]]
    (ra, ca), (rb, cb) = poses
    lines = np.column_stack([a, np.ones(len(a))]) @ fundamental(matrix, rb.T @ ra, rb.T @ (ca - cb)).T
    return np.abs(np.sum(lines[:, :2] * b, axis=1) + lines[:, 2]) / np.linalg.norm(lines[:, :2], axis=1)


def written_csv(path: Path, names: list[str], rotations: np.ndarray, centres: np.ndarray) -> None:
    lines = ["image,x_m,y_m,z_m,qw,qx,qy,qz"]
    for name, rotation, centre in zip(names, rotations, centres, strict=True):
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        lines.append(",".join([name, *(f"{value:.12g}" for value in (*centre, w, x, y, z))]))
    path.write_text("\n".join(lines))


def read_poses(path: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    log = read(str(path))
    assert log.losses == ()
    (poses,) = log.poses
    rotations = rotation_from_quaternion(poses.q_wxyz)
    return {name: (rotations[n], poses.position_m[n]) for n, name in enumerate(poses.image)}


@pytest.mark.real
def test_headset_poses_fit_their_images(shared: Path, tmp_path: Path) -> None:
    """4x4 matrices without names: the row of each image has to be added, and the CSV carries both."""
    folder = shared / "data/truth/hololens"
    rows = [line.split(",") for line in (folder / "selected_frames.csv").read_text().split()[1:]]
    matrices = np.loadtxt(folder / "poses.txt").reshape(-1, 4, 4)[[int(row) for _, row in rows]]
    written_csv(tmp_path / "poses.csv", [name for name, _ in rows], matrices[:, :3, :3], matrices[:, :3, 3])
    poses = read_poses(tmp_path / "poses.csv")
    assert len(poses) == 20
    matrix = np.loadtxt(folder / "K.txt")
    found = {name: keypoints(folder / "images" / name) for name in poses}
    medians, shares, transposed = [], [], []
    for pair in itertools.combinations(sorted(poses), 2):
        if not 0.2 < np.linalg.norm(poses[pair[0]][1] - poses[pair[1]][1]) < 0.7:
            continue
        both = [found[name] for name in pair]
        distances = epipolar_px(both, matrix, [poses[name] for name in pair])
        if len(distances) < 20:
            continue
        medians.append(np.median(distances[distances < 5.0]))
        shares.append(np.mean(distances < 5.0))
        transposed.append(np.median(epipolar_px(both, matrix, [(poses[name][0].T, poses[name][1]) for name in pair])))
    # The headset's own poses: pairs turned by 15 deg and more, with few matches, lie up to 2 px off.
    assert len(medians) == 30
    assert 0.5 < np.median(medians) < 1.0
    assert 0.1 < min(medians) < 0.3
    assert np.mean(np.array(medians) < 1.3) > 0.85
    assert np.median(shares) > 0.8
    # Cam-from-world taken for world-from-cam fits nothing.
    assert np.median(transposed) > 10.0


@pytest.mark.real
def test_surveyed_poses_fit_their_images(shared: Path, tmp_path: Path) -> None:
    folder = shared / "data/truth/fountain_p11"
    names = ["0004.jpg", "0005.jpg", "0006.jpg"]
    lines = [np.loadtxt(folder / f"gt_dense_cameras/{name}.camera", max_rows=3, skiprows=4) for name in names]
    centres = [np.loadtxt(folder / f"gt_dense_cameras/{name}.camera", max_rows=1, skiprows=7) for name in names]
    written_csv(tmp_path / "poses.csv", names, np.array(lines), np.array(centres))
    poses = read_poses(tmp_path / "poses.csv")
    matrix = np.loadtxt(folder / "gt_dense_cameras/0004.jpg.camera", max_rows=3)
    window = (slice(400, 1700), slice(700, 2300))
    found = {name: keypoints(folder / "images" / name, window) for name in names}
    for pair, expected_px in ((names[:2], 0.16), (names[1:], 0.23), (names[::2], 0.31)):
        distances = epipolar_px([found[name] for name in pair], matrix, [poses[name] for name in pair])
        inliers = distances[distances < 5.0]
        assert np.median(inliers) == pytest.approx(expected_px, rel=0.35), pair
        assert len(inliers) > 300


@pytest.mark.real
def test_fuzz_a_trajectory(shared: Path, tmp_path: Path) -> None:
    matrices = np.loadtxt(shared / "data/truth/hololens/poses.txt").reshape(-1, 4, 4)[:80]
    written_csv(tmp_path / "t.csv", [f"{n:05}.png" for n in range(80)], matrices[:, :3, :3], matrices[:, :3, 3])
    csv = (tmp_path / "t.csv").read_bytes()
    tum = "\n".join(
        f"{1.6e9 + 0.1 * n:.6f} {' '.join(map(str, m[:3, 3]))} "
        f"{' '.join(map(str, Rotation.from_matrix(m[:3, :3]).as_quat()))}"
        for n, m in enumerate(matrices)
    ).encode()
    geodetic = b"time,latitude_deg,longitude_deg,amsl_m,yaw_deg,pitch_deg,roll_deg,sigma_vertical_m\n" + b"".join(
        f"2024-06-01T10:00:{n % 60:02}Z,{47 + n / 1e5},8.5,400,{n},-60,0,0.03\n".encode() for n in range(80)
    )
    for data in (csv, tum, geodetic):
        outcomes = survives(read, data, tmp_path / "t.csv", mutations_wanted())
        assert outcomes["whole"] + outcomes["partial"] > outcomes["refused"]
