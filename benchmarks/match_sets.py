"""The photo sets that matchers are compared on: their pairs by a real run, their cameras and poses, and what is true.

The example's two flights have exact depths and poses; of the real sets two have exact poses, the others the pose of
their own log alone. Real sets lie in $EPITRANSFER_SHARED or ../shared.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from flight_truth import FlightTruth, TruePose, facts

from pipeline.engine.tables import read_table
from pipeline.flight import PairRow, camera_by_frame, cameras_of, image_locations, poses_of, selected_pairs
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Pose, RelativePose, relative_pose
from pipeline.geometry.rotations import quaternion_from_rotation

PROJECT = Path(__file__).resolve().parents[1]
# What is known of the poses: exact ones beside the logged, the logged ones exact, or nothing but the log.
EXAMPLE, EXACT, LOGGED = "example", "exact", "logged"

_WORKFLOW = """
[ingest]
photos = "{photos}"
logs = "poses.csv"
camera = "camera.yaml"
[pair]
baseline_m = [{shortest}, {longest}]
roi = "image"
above_ground_m = 1.5
max_range_m = {range_m}
max_view_angle_deg = {angle}
[match]
[refine]
[depth]
[fuse]
"""


@dataclass(frozen=True, slots=True)
class PhotoSet:
    """A set of photos, ready to be matched.

    Args:
        name: Its name.
        run: A run folder with its frames, cameras and pairs.
        truth: Folder with the example's truth; None for real photos.
        poses: EXAMPLE, EXACT or LOGGED.
        nearest_m: Range of the nearest point looked for.
        max_range_m: Largest range of a kept depth.
    """

    name: str
    run: Path
    truth: Path | None
    poses: str
    nearest_m: float = 5.0
    max_range_m: float = 100.0


@dataclass(frozen=True)
class Flight:
    """Cameras, poses and photos of a run.

    Args:
        cameras: By frame_id.
        poses: As logged, by frame_id.
        photos: Files, by frame_id.
        pairs: Those selected.
    """

    cameras: dict[str, Camera]
    poses: dict[str, Pose]
    photos: dict[str, str]
    pairs: list[PairRow]

    @classmethod
    def of(cls, run: Path) -> Flight:
        """What a run knows after the stage `pair`."""
        frames = read_table(run / "frames.parquet", "frames")
        return cls(
            camera_by_frame(frames, cameras_of(read_table(run / "cameras.parquet", "cameras"))),
            poses_of(frames),
            image_locations(frames, facts(run, "ingest")["photo_root"], run / "images"),
            selected_pairs(read_table(run / "pairs.parquet", "pairs")),
        )

    def some_pairs(self, most: int) -> list[PairRow]:
        """At most so many pairs, spread evenly over all."""
        if len(self.pairs) <= most:
            return self.pairs
        return [self.pairs[round(i)] for i in np.linspace(0, len(self.pairs) - 1, most)]

    def relative(self, pair: PairRow) -> RelativePose:
        """src_from_ref as logged."""
        return relative_pose(self.poses[pair.ref], self.poses[pair.src])


def exact_relative(ref: TruePose | Pose, src: TruePose | Pose) -> RelativePose:
    """src_from_ref of poses that have no error."""
    translation = src.rotation.T @ (ref.centre - src.centre)
    return RelativePose(src.rotation.T @ ref.rotation, translation, np.zeros((6, 6)))


def shared_folder() -> Path | None:
    """The folder of real photo sets, where there is one."""
    folder = Path(os.environ.get("EPITRANSFER_SHARED") or PROJECT.parent / "shared")
    return folder if (folder / "data").is_dir() else None


def epitransfer(*arguments: str | Path) -> None:
    """Runs the command line on one process.

    Raises:
        RuntimeError: It failed; its words are in the message.
    """
    command = [str(Path(sys.executable).with_name("epitransfer")), *map(str, arguments), "--jobs", "1"]
    done = subprocess.run(command, text=True, capture_output=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr[-2000:]}")


def example_run(example: Path, workflow: str, work: Path) -> Path:
    """Runs a workflow of the example as far as its pairs.

    Args:
        example: What `epitransfer example` wrote.
        workflow: Name of the file.
        work: Folder for the run.

    Returns:
        The run folder.
    """
    run = work / workflow.removesuffix(".toml")
    epitransfer("run", example / workflow, "--out", run, "--to", "pair")
    return run


def example_sets(example: Path, work: Path) -> Iterator[PhotoSet]:
    """The example's two flights.

    Args:
        example: What `epitransfer example` wrote.
        work: Folder for the runs.
    """
    for name, workflow, folder in (
        ("example", "workflow.toml", example),
        ("example lawn", "workflow_lawn.toml", example / "lawn"),
    ):
        run = example_run(example, workflow, work)
        yield PhotoSet(name, run, FlightTruth.of(folder).folder, EXAMPLE)


def real_sets(shared: Path, work: Path) -> Iterator[PhotoSet | str]:
    """The real sets, or a line for one that is not there.

    Args:
        shared: Folder of real photo sets.
        work: Folder for the runs.
    """
    data = shared / "data"
    for name in ("sheffield_cross", "mirafiori_p4m_rtk", "brighton_beach"):
        if not (data / "photos" / name).is_dir():
            yield f"{name}: not in {data / 'photos'}, left out"
            continue
        photos = next(p for p in (data / "photos" / name / "images", data / "photos" / name) if p.is_dir())
        run = work / name
        setting = ("--set", f'ingest.photos="{photos}"')
        epitransfer("run", PROJECT / "workflows" / f"{name}.toml", "--out", run, "--to", "pair", *setting)
        yield PhotoSet(name, run, None, LOGGED)
    for name, write, limits in (
        ("hololens", _hololens, (0.7, 8.0)),
        ("fountain_p11", _fountain, (2.0, 60.0)),
    ):
        folder = data / "truth" / name
        if not folder.is_dir():
            yield f"{name}: not in {data / 'truth'}, left out"
            continue
        workflow = write(folder, work / f"{name}.in")
        epitransfer("run", workflow, "--out", work / name, "--to", "pair")
        yield PhotoSet(name, work / name, None, EXACT, *limits)


def _hololens(folder: Path, work: Path) -> Path:
    """A headset's poses in the forms that ingest reads."""
    rows = [line.split(",") for line in (folder / "selected_frames.csv").read_text().split()[1:]]
    matrices = np.loadtxt(folder / "poses.txt").reshape(-1, 4, 4)
    poses = {name: matrices[int(row)][:3] for name, row in rows}
    text = _WORKFLOW.format(photos=folder / "images", shortest=0.2, longest=0.7, range_m=6.0, angle=30.0)
    return _write(work, text, poses, np.loadtxt(folder / "K.txt"), (540, 360))


def _fountain(folder: Path, work: Path) -> Path:
    """Poses by laser registration: K, then the rotation's rows world_from_cam, then the centre; z points down."""
    upright = np.diag([1.0, -1.0, -1.0])
    poses, calibration, size = {}, np.eye(3), (0, 0)
    for photo in sorted((folder / "images").glob("*.jpg")):
        numbers = np.array((folder / "gt_dense_cameras" / f"{photo.name}.camera").read_text().split(), np.float64)
        calibration, size = numbers[:9].reshape(3, 3), (int(numbers[24]), int(numbers[25]))
        poses[photo.name] = upright @ np.column_stack([numbers[12:21].reshape(3, 3), numbers[21:24]])
    text = _WORKFLOW.format(photos=folder / "images", shortest=0.5, longest=5.0, range_m=20.0, angle=60.0)
    return _write(work, text, poses, calibration, size)


def _write(
    work: Path, workflow: str, world_from_cam: dict[str, Floats], calibration: Floats, size: tuple[int, int]
) -> Path:
    """A workflow beside a trajectory and a calibration.

    Args:
        work: Folder for them.
        workflow: Its text.
        world_from_cam: (3, 4) by name of the photo.
        calibration: (3, 3) of a camera without distortion.
        size: Width and height of the photos.
    """
    work.mkdir(parents=True)
    lines = ["image,x_m,y_m,z_m,qw,qx,qy,qz"]
    for name, matrix in world_from_cam.items():
        numbers = (*matrix[:, 3], *quaternion_from_rotation(matrix[:, :3]))
        lines.append(",".join([name, *(f"{value:.12g}" for value in numbers)]))
    (work / "poses.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    values = ", ".join(f"{value:.9g}" for value in calibration.ravel())
    (work / "camera.yaml").write_text(
        f"image_width: {size[0]}\nimage_height: {size[1]}\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [{values}]\n"
        "distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0, 0, 0, 0, 0]\n",
        encoding="utf-8",
    )
    path = work / "workflow.toml"
    path.write_text(workflow, encoding="utf-8")
    return path
