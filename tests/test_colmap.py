"""COLMAP models: read as COLMAP means them, with its own projection as the judge, and written so that it agrees."""

import shutil
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import typer
from fuzzing import check, mutations_wanted, survives
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from pipeline.engine.errors import InputError, ResourceError
from pipeline.engine.tables import write_table
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from pipeline.points.colmap_export import export_colmap
from pipeline.sources.colmap import is_format, read
from pipeline.sources.records import FlightLog
from schemas import TABLES
from stages.export import command

MODELS = {
    "SIMPLE_PINHOLE": [700, 401.5, 298],
    "PINHOLE": [700, 705, 401.5, 298],
    "SIMPLE_RADIAL": [700, 401.5, 298, -0.08],
    "RADIAL": [700, 401.5, 298, -0.08, 0.02],
    "OPENCV": [700, 705, 401.5, 298, -0.08, 0.02, 1e-3, -2e-3],
    "FULL_OPENCV": [700, 705, 401.5, 298, -0.08, 0.02, 1e-3, -2e-3, 0.003, 0.01, -0.002, 0.001],
    "OPENCV_FISHEYE": [700, 705, 401.5, 298, -0.02, 0.01, -0.003, 0.001],
}
NAMES = ("b/DJI_0002.JPG", "a/DJI 0001.JPG", "0003")


def model(
    name: str = "OPENCV", parameters: list[float] | None = None, images: tuple[str, ...] = NAMES
) -> pycolmap.Reconstruction:
    """Images with 2D points, by the library."""
    made = pycolmap.Reconstruction()
    parameters = parameters or MODELS[name]
    made.add_camera_with_trivial_rig(pycolmap.Camera(model=name, width=800, height=600, params=parameters, camera_id=7))
    rng = np.random.default_rng(5)
    for number, image in enumerate(images, 1):
        rotation = pycolmap.Rotation3d(Rotation.random(random_state=number).as_quat())
        places = rng.uniform(0, 600, (4, 2))
        made.add_image_with_trivial_frame(
            pycolmap.Image(name=image, keypoints=places, camera_id=7, image_id=number),
            pycolmap.Rigid3d(rotation, rng.normal(size=3)),
        )
    return made


def written(folder: Path, made: pycolmap.Reconstruction, *, text: bool = False) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (made.write_text if text else made.write_binary)(str(folder))
    return folder


def read_checked(folder: Path) -> FlightLog:
    log = read(str(folder))
    check(log)
    return log


def pixels(log: FlightLog, image: str, points: np.ndarray) -> np.ndarray:
    """Pixels of world points in an image, OpenCV's pixel centre."""
    (poses,) = log.poses
    at = poses.image.index(image)
    (camera,) = [c.camera for c in log.cameras if c.stream == log.facts["camera_of_image"][image]]
    in_cam = (points - poses.position_m[at]) @ rotation_from_quaternion(poses.q_wxyz[at])
    return camera.project(in_cam)


def in_front(image: pycolmap.Image, count: int = 50) -> np.ndarray:
    """World points that an image sees, all over it."""
    rng = np.random.default_rng(3)
    in_cam = np.column_stack([rng.uniform(-0.5, 0.5, count), rng.uniform(-0.4, 0.4, count), np.ones(count)])
    in_cam *= rng.uniform(2.0, 9.0, (count, 1))
    return np.array([image.cam_from_world().inverse() * point for point in in_cam])


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("name", MODELS)
def test_points_are_projected_where_colmap_projects_them(tmp_path: Path, name: str, text: bool) -> None:
    made = model(name)
    log = read_checked(written(tmp_path / "m", made, text=text))
    assert log.losses == ()
    assert dict(log.counts) == {"images": 3, "cameras": 1}
    for image in made.images.values():
        points = in_front(image)
        expected = np.array([image.project_point(point) for point in points])
        # The centre of the top-left pixel is (0.5, 0.5) there and (0, 0) here.
        assert pixels(log, image.name, points) + 0.5 == pytest.approx(expected, abs=1e-9)


def test_poses_are_of_the_images(tmp_path: Path) -> None:
    made = model()
    log = read_checked(written(tmp_path / "m", made))
    (poses,) = log.poses
    assert poses.image == tuple(sorted(NAMES))
    assert (poses.of, poses.axes, poses.stream) == ("camera", "rdf", "m")
    assert not np.any(poses.time_ns)
    for image in made.images.values():
        at = poses.image.index(image.name)
        assert poses.position_m[at] == pytest.approx(image.projection_center(), abs=1e-12)
        world_from_cam = image.cam_from_world().rotation.matrix().T
        assert rotation_from_quaternion(poses.q_wxyz[at]) == pytest.approx(world_from_cam, abs=1e-12)
    assert log.facts["camera_of_image"] == dict.fromkeys(NAMES, "7")
    assert "no times" in log.time_base.problem


def test_the_format_is_a_folder_with_both_files(tmp_path: Path) -> None:
    folder = written(tmp_path / "m", model())
    assert is_format(b"", str(folder))
    assert not is_format(b"", str(tmp_path))
    assert not is_format(b"x", str(folder))
    (folder / "images.bin").unlink()
    assert not is_format(b"", str(folder))
    with pytest.raises(InputError, match=r"no images\.bin or images\.txt"):
        read(str(folder))
    assert is_format(b"", str(written(tmp_path / "t", model(), text=True)))


def test_text_with_and_without_points(tmp_path: Path) -> None:
    """Known-pose models are typed by hand: an empty line behind each image, or none."""
    (tmp_path / "cameras.txt").write_text("# c\n1 PINHOLE 800 600 700 705 400 300\n")
    lines = [f"{n} 1 0 0 0 {n} 0 0 1 {name}" for n, name in enumerate(NAMES, 1)]
    for between in ("\n\n", "\n", "\n10.5 20.5 -1 30 40 7\n", "\r\n\r\n"):
        (tmp_path / "images.txt").write_bytes(("# i\n" + between.join(lines) + between).encode())
        (poses,) = read_checked(tmp_path).poses
        assert poses.image == tuple(sorted(NAMES))
        assert poses.position_m[poses.image.index(NAMES[1])].tolist() == [-2.0, 0.0, 0.0]


def test_a_long_line_of_points_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 800 600 700 705 400 300\n")
    long = " ".join(["123.456 234.567 -1"] * 20_000)
    (tmp_path / "images.txt").write_text(f"1 1 0 0 0 1 0 0 1 a.jpg\n{long}\n2 1 0 0 0 2 0 0 1 b.jpg\n{long}\n")
    log = read_checked(tmp_path)
    assert log.poses[0].image == ("a.jpg", "b.jpg")
    assert log.losses == ()


def test_a_model_without_an_equal_is_refused_by_name(tmp_path: Path) -> None:
    made = model("FOV", [700, 705, 400, 300, 0.9])
    for text in (False, True):
        with pytest.raises(InputError, match=r"E-COLMAP-02(.|\n)*camera 7\n(.|\n)*FOV"):
            read(str(written(tmp_path / f"m{text}", made, text=text)))


def test_an_image_comes_once(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 800 600 700 705 400 300\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 1 0 0 1 a.jpg\n\n2 1 0 0 0 2 0 0 1 a.jpg\n\n")
    with pytest.raises(InputError, match=r"image a\.jpg several times"):
        read(str(tmp_path))


def test_an_unknown_camera_is_told_and_the_pose_kept(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 800 600 700 705 400 300\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 1 0 0 1 a.jpg\n\n2 1 0 0 0 2 0 0 5 b.jpg\n\n")
    log = read_checked(tmp_path)
    assert log.poses[0].image == ("a.jpg", "b.jpg")
    assert log.facts["camera_of_image"] == {"a.jpg": "1"}
    assert log.losses == ("1 images (b.jpg) name a camera that the model does not hold",)


def test_a_model_cut_short_gives_the_images_before_the_cut(tmp_path: Path) -> None:
    """The library goes on reading a cut file for ever."""
    folder = written(tmp_path / "m", model())
    data = (folder / "images.bin").read_bytes()
    # The count; then per image 64 bytes, its name with a zero, and the count and places of its four points.
    begins = 8 + np.cumsum([0, *(64 + len(name) + 1 + 8 + 4 * 24 for name in NAMES)])
    posed = [int(begin) + 64 + len(name) + 1 for begin, name in zip(begins, NAMES, strict=False)]
    assert begins[-1] == len(data)
    for length in range(len(data)):
        (folder / "images.bin").write_bytes(data[:length])
        whole = sum(length >= end for end in posed)
        if not whole:
            with pytest.raises(InputError, match=r"E-COLMAP-01(.|\n)*images\.bin"):
                read(str(folder))
            continue
        log = read_checked(folder)
        assert len(log.poses[0].image) == whole, length
        assert [f"{3 - whole} of 3 images lost" in loss for loss in log.losses] == [True] * (whole < 3)


def test_a_lying_count_ends(tmp_path: Path) -> None:
    folder = written(tmp_path / "m", model())
    data = (folder / "images.bin").read_bytes()
    (folder / "images.bin").write_bytes(struct.pack("<Q", 2**63) + data[8:])
    log = read_checked(folder)
    assert len(log.poses[0].image) == 3
    assert "images lost" in log.losses[0]
    cameras = (folder / "cameras.bin").read_bytes()
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", 2**63) + cameras[8:])
    (folder / "images.bin").write_bytes(struct.pack("<Q", 2) + data[8:])
    log = read_checked(folder)
    assert len(log.cameras) == 1
    assert [("damaged behind 1 cameras" in loss, "behind the last image" in loss) for loss in log.losses] == [
        (True, False),
        (False, True),
    ]


@pytest.mark.parametrize("file", ["images.bin", "cameras.bin", "images.txt", "cameras.txt"])
def test_fuzz_a_model(tmp_path: Path, file: str) -> None:
    many = model(images=tuple(f"DJI_{number:04}.JPG" for number in range(40)))
    folder = written(tmp_path / "m", many, text=file.endswith(".txt"))
    outcomes = survives(lambda _: read(str(folder)), (folder / file).read_bytes(), folder / file, mutations_wanted())
    assert outcomes["whole"] + outcomes["partial"] > 0.3 * sum(outcomes.values())


CAMERAS = {
    "plain": Camera("pinhole", 800, 600, 700.0, 705.0, 399.5, 298.25),
    "lens": Camera("brown", 800, 600, 700.0, 705.0, 399.5, 298.25, (-0.08, 0.02, 1e-3, -2e-3, 0.003)),
    "mild": Camera("brown", 800, 600, 700.0, 705.0, 399.5, 298.25, (-0.08, 0.02, 1e-3, -2e-3)),
    "wide": Camera("fisheye", 800, 600, 300.0, 300.0, 399.5, 298.25, (-0.02, 0.01, -0.003, 0.001)),
}


def run_folder(folder: Path, *, refined: bool = False) -> dict[str, tuple[np.ndarray, np.ndarray, Camera]]:
    """Frames, cameras and poses of a run: five frames, the last of them not usable."""
    folder.mkdir()
    rng = np.random.default_rng(2)
    frames, poses, expected = [], [], {}
    sigmas = [c.name for c in TABLES["poses"].columns if "sigma" in c.name]
    for number, camera_id in enumerate(("plain", "lens", "mild", "wide", "plain")):
        rotation, centre = Rotation.random(random_state=number).as_matrix(), rng.normal(size=3) * 50.0
        moved = centre + 0.25 if refined else centre
        row = {
            "frame_id": f"F{number}", "image": f"day/F {number}.JPG", "image_sha256": "0", "camera_id": camera_id,
            "time_source": "", "height_datum": "ellipsoidal", "pose_source": "", "usable": number < 4, "problem": "",
            **dict.fromkeys(sigmas + [f"own_{name}" for name in sigmas], 0.1),
        }  # fmt: skip
        pose = dict(zip(("qw", "qx", "qy", "qz"), quaternion_from_rotation(rotation), strict=True))
        place = ("east_m", "north_m", "up_m")
        frames.append(row | pose | dict(zip(place, centre, strict=True)))
        if number < 4:
            named = {"frame_id": f"F{number}", "cov": [0.0] * 36, "refined": True, "problem": ""}
            named |= dict.fromkeys(sigmas, 0.1)
            poses.append(named | pose | dict(zip(place, moved, strict=True)))
            expected[f"day/F {number}.JPG"] = (rotation, moved, CAMERAS[camera_id])
    cameras = [
        {"camera_id": name, "model": c.model, "width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx,
         "cy": c.cy, "distortion": list(c.distortion), "source": ""}
        for name, c in CAMERAS.items()
    ]  # fmt: skip
    write_table(folder / "frames.parquet", TABLES["frames"].from_rows(frames))
    write_table(folder / "cameras.parquet", TABLES["cameras"].from_rows(cameras))
    if refined:
        write_table(folder / "refined_cameras.parquet", TABLES["refined_cameras"].from_rows(cameras))
        write_table(folder / "poses.parquet", TABLES["poses"].from_rows(poses))
    return expected


@pytest.mark.parametrize("refined", [False, True])
def test_a_run_is_exported_as_colmap_sees_it(tmp_path: Path, refined: bool) -> None:
    expected = run_folder(tmp_path / "run", refined=refined)
    assert export_colmap(tmp_path / "run", tmp_path / "out.colmap") == 4
    seen = pycolmap.Reconstruction(str(tmp_path / "out.colmap"))
    assert {image.name for image in seen.images.values()} == expected.keys()
    for image in seen.images.values():
        rotation, centre, camera = expected[image.name]
        assert image.projection_center() == pytest.approx(centre, abs=1e-9)
        points = in_front(image)
        here = camera.project((points - centre) @ rotation)
        assert np.array([image.project_point(point) for point in points]) == pytest.approx(here + 0.5, abs=1e-9)
    log = read_checked(tmp_path / "out.colmap")
    assert log.losses == ()
    for name, (rotation, centre, camera) in expected.items():
        points = in_front(seen.find_image_with_name(name))
        here = camera.project((points - centre) @ rotation)
        assert pixels(log, name, points) == pytest.approx(here, abs=1e-9)


def test_the_same_run_gives_the_same_bytes(tmp_path: Path) -> None:
    run_folder(tmp_path / "run")
    for name in ("a.colmap", "b.colmap"):
        export_colmap(tmp_path / "run", tmp_path / name)
    files = sorted(path.name for path in (tmp_path / "a.colmap").iterdir())
    assert files == ["cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin"]
    for file in files:
        assert (tmp_path / "a.colmap" / file).read_bytes() == (tmp_path / "b.colmap" / file).read_bytes()


def test_an_older_model_is_replaced_and_what_lies_beside_it_stays(tmp_path: Path) -> None:
    run_folder(tmp_path / "run")
    target = tmp_path / "out.colmap"
    written(target, model())
    (target / "images").mkdir()
    (target / "images" / "a.jpg").write_text("a photo")
    assert export_colmap(tmp_path / "run", target) == 4
    assert read(str(target)).counts["images"] == 4
    assert (target / "images" / "a.jpg").read_text() == "a photo"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.colmap", "run"]


def test_what_cannot_be_exported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="frames is missing"):
        export_colmap(tmp_path / "absent", tmp_path / "out.colmap")
    run_folder(tmp_path / "run")
    with pytest.raises(ResourceError, match="E-EXPORT-02"):
        export_colmap(tmp_path / "run", tmp_path / "absent" / "out.colmap")
    (tmp_path / "file.colmap").write_text("")
    with pytest.raises(ResourceError, match="E-EXPORT-02"):
        export_colmap(tmp_path / "run", tmp_path / "file.colmap")

    def on_a_full_disk(_: pycolmap.Reconstruction, folder: str) -> None:
        (Path(folder) / "images.bin").write_bytes(bytes(20))

    monkeypatch.setattr(pycolmap.Reconstruction, "write_binary", on_a_full_disk)
    with pytest.raises(ResourceError, match="is the disk full"):
        export_colmap(tmp_path / "run", tmp_path / "out.colmap")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file.colmap", "run"]
    shutil.rmtree(tmp_path / "run")


def test_the_command_says_what_it_wrote(tmp_path: Path) -> None:
    run_folder(tmp_path / "run")
    app = typer.Typer()
    app.command()(command)
    done = CliRunner().invoke(app, [str(tmp_path / "run"), "--to", str(tmp_path / "out.colmap")])
    assert done.exit_code == 0, done.output
    assert "out.colmap: 4 images" in done.stdout
