"""The whole chain with refine.mode = flight beside COLMAP's full reconstruction of the same photos.

usage: python benchmarks/sfm.py EXAMPLE [WORK]

EXAMPLE is a folder that `epitransfer example` made. Each side is a process of its own with two threads and an empty
folder. COLMAP gets the photos alone: it extracts, matches all pairs and maps with its default options; its model is
brought to metres by the similarity that fits its cameras best to the logged positions. It runs once more with the
camera's calibration given, which our side takes from the tags. WORK keeps what both sides leave; else it is removed.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from flight_truth import FlightTruth
from measured import Cost, measured
from refined import points_of
from whole_path import Observed, colmap_observations, our_observations

from pipeline.engine.runfolder import RunFolder
from pipeline.engine.tables import read_table
from pipeline.flight import camera_by_frame, cameras_of, poses_of
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera

THREADS = 2
MAX_RANGE_M = 100.0
AS_GIVEN, CALIBRATED = "COLMAP", "COLMAP, camera given"


@dataclass(frozen=True, slots=True)
class Side:
    """What one run of COLMAP left.

    Args:
        cost: Of the whole.
        seconds: Of its steps.
        model: Aligned to the logged positions.
    """

    cost: Cost
    seconds: Mapping[str, float]
    model: pycolmap.Reconstruction


def colmap(photos: Path, work: Path, run: Path, *, calibrated: bool) -> Side:
    """Runs COLMAP.

    Args:
        photos: The photos.
        work: Folder for it, to be made.
        run: Of our side, for the logged positions and the camera.
        calibrated: Whether it gets the camera.
    """
    work.mkdir()
    script = Path(__file__).with_name("sfm_side.py")
    given = [run] if calibrated else []
    cost = measured([sys.executable, script, photos, work, str(THREADS), *given], work / "log")
    seconds = json.loads((work / "seconds.json").read_text(encoding="utf-8"))
    model = pycolmap.Reconstruction(work / "model")
    align(model, run)
    return Side(cost, seconds, model)


def align(model: pycolmap.Reconstruction, run: Path) -> None:
    """Moves a model to where the logged positions put it, by the similarity of least squares.

    Raises:
        ValueError: They allow none.
    """
    frames = read_table(run / "frames.parquet", "frames")
    logged = poses_of(frames)
    names = dict(zip(frames.column("image").to_pylist(), frames.column("frame_id").to_pylist(), strict=True))
    images = [image for image in model.images.values() if image.has_pose]
    there = np.array([image.projection_center() for image in images])
    here = np.array([logged[names[image.name]].centre for image in images])
    found = pycolmap.estimate_sim3d(there, here)
    if found is None:
        raise ValueError("no similarity between COLMAP's cameras and the log")
    model.transform(found)


def errors(found: Observed, truth: FlightTruth, cameras: Mapping[str, Camera]) -> Floats:
    """(n,) relative errors of depths with a truth in range."""
    out = []
    for name, camera in cameras.items():
        rows = np.flatnonzero(found.frame_id == name)
        depth = truth.depths(name, found.pixels[rows])
        in_range = depth * np.linalg.norm(camera.rays(found.pixels[rows]), axis=1) <= MAX_RANGE_M
        out.append(np.abs(found.depth_m[rows] / depth - 1.0)[in_range])
    return np.concatenate(out)


def accuracy(run: Path, truth: FlightTruth, sides: Mapping[str, Side]) -> Iterator[str]:
    """The rows of the table of errors."""
    frames = read_table(run / "frames.parquet", "frames")
    cameras = camera_by_frame(frames, cameras_of(read_table(run / "cameras.parquet", "cameras")))
    yield f"{'':36}{'with truth':>12}{'median':>10}{'AbsRel':>10}{'within 1 %':>12}"
    rows = {"epitransfer kept depths": errors(our_observations(run), truth, cameras)}
    rows["epitransfer points"] = points_of(run, truth)[0]
    for name, side in sides.items():
        observed, nearest = colmap_observations(side.model, run)
        rows[f"{name} observations"] = errors(observed, truth, cameras)
        rows[f"{name} points"] = errors(observed.where(nearest), truth, cameras)
    for name, error in rows.items():
        cells = f"{np.median(error):10.4f}{np.mean(error):10.4f}{np.mean(error <= 0.01):12.1%}"
        yield f"{name:36}{len(error):12,}{cells}"


def costs(ours: Cost, sides: Mapping[str, Side]) -> Iterator[str]:
    """What each side took, as multiples of ours."""
    yield f"{'':28}{'wall':>8}{'CPU':>8}{'memory':>8}"
    yield f"{'epitransfer':28}" + f"{1.0:8.2f}" * 3
    for name, side in sides.items():
        cost = side.cost
        ratios = (cost.wall_s / ours.wall_s, cost.cpu_s / ours.cpu_s, cost.memory_mib / ours.memory_mib)
        yield f"{name:28}" + "".join(f"{ratio:8.2f}" for ratio in ratios)


def steps(run: Path, ours: Cost, sides: Mapping[str, Side]) -> Iterator[str]:
    """Which of our steps takes what share of which of COLMAP's, by wall time."""
    folder = RunFolder(run)
    seconds = {name: (folder.record(name) or {})["seconds"] for name in ("match", "refine", "depth", "fuse")}
    said = ", ".join(f"{name} {value:.1f}" for name, value in seconds.items())
    yield f"{'epitransfer':28}whole {ours.wall_s:.1f} s: {said}"
    after = seconds["refine"] + seconds["depth"] + seconds["fuse"]
    for name, side in sides.items():
        said = ", ".join(f"{step} {value:.1f}" for step, value in side.seconds.items())
        yield f"{name:28}whole {side.cost.wall_s:.1f} s: {said}"
        whole = ours.wall_s / side.cost.wall_s
        per_map = [part / side.seconds["map"] for part in (seconds["refine"], after)]
        before = seconds["match"] / (side.seconds["extract"] + side.seconds["match"])
        yield f"{'':4}whole chain / whole{whole:10.3f}    match / extract and match{before:10.3f}"
        yield f"{'':4}refine / map{per_map[0]:17.3f}    refine, depth and fuse / map{per_map[1]:8.3f}"


def main(example: Path, work: Path) -> None:
    """Runs both sides and prints the tables."""
    truth = FlightTruth.of(example)
    photos = example / "photos"
    # Read once, so that neither side pays for the disk.
    size = sum(len(path.read_bytes()) for path in photos.iterdir())
    work.mkdir(parents=True, exist_ok=True)
    run = work / "run"
    command = Path(sys.executable).with_name("epitransfer")
    changed = ("--set", 'refine.mode="flight"', "--set", 'depth.methods=["epitransfer"]')
    arguments = ("--out", run, "--to", "fuse", "--jobs", str(THREADS), *changed)
    ours = measured([command, "run", example / "workflow.toml", *arguments], work / "ours.log")
    sides = {
        name: colmap(photos, work / folder, run, calibrated=name == CALIBRATED)
        for name, folder in ((AS_GIVEN, "colmap"), (CALIBRATED, "colmap_calibrated"))
    }
    print(f"{len(truth.poses)} photos ({size / 2**20:.0f} MiB) to poses and points on {THREADS} threads, one run each;")
    print(f"COLMAP {pycolmap.__version__}, full reconstruction with default options; as multiples of ours\n")
    for line in (*costs(ours, sides), "", *steps(run, ours, sides)):
        print(line)
    print(f"\nrelative errors against the ray-cast truth within {MAX_RANGE_M:g} m, outlines left out\n")
    for line in accuracy(run, truth, sides):
        print(line)
    for name, side in sides.items():
        model = side.model
        print(
            f"{name}: {model.num_reg_images()} images, {model.num_points3D():,} points, "
            f"mean reprojection error {model.compute_mean_reprojection_error():.2f} px"
        )


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit("usage: python benchmarks/sfm.py EXAMPLE [WORK]")
    if len(sys.argv) == 3:
        main(Path(sys.argv[1]), Path(sys.argv[2]))
    else:
        with tempfile.TemporaryDirectory(prefix="sfm.") as folder:
            main(Path(sys.argv[1]), Path(folder))
