"""Runs of real photos in every mode of refinement, also under logs with planted errors, and COLMAP's beside them."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from match_sets import PhotoSet
from measured import Cost, measured
from redraws import turned

from pipeline.engine.tables import read_table
from pipeline.flight import PairRow, poses_of, relative_poses_of, selected_pairs
from pipeline.geometry.arrays import Floats
from pipeline.geometry.poses import Placement, Pose, RelativePose, relative_placement
from pipeline.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion

MODES = ("none", "pair", "flight")
# Our side and COLMAP get one thread each.
THREADS = 1
LEAST_POSITIONS = 3


@dataclass(frozen=True, slots=True)
class Model:
    """What a run of COLMAP left.

    Args:
        cost: Of it.
        folder: Its largest model.
    """

    cost: Cost
    folder: Path

    def __call__(self) -> pycolmap.Reconstruction:
        """As COLMAP left it, in units of its own."""
        return pycolmap.Reconstruction(self.folder)

    def in_metres(self, run: Path) -> pycolmap.Reconstruction:
        """Moved to where the logged positions of a run put it, by the similarity of least squares.

        Raises:
            ValueError: They allow none.
        """
        model, log = self(), logged(run)
        found = model_poses(model, run)
        if len(found) < LEAST_POSITIONS:
            raise ValueError(f"{len(found)} photos with a logged position; a similarity needs {LEAST_POSITIONS}")
        there, here = (np.array([poses[name].centre for name in found]) for poses in (found, log))
        similarity = pycolmap.estimate_sim3d(there, here)
        if similarity is None:
            raise ValueError("no similarity between its cameras and the log")
        model.transform(similarity)
        return model


@dataclass(frozen=True, slots=True)
class Planted:
    """Errors that are new in every frame, drawn with the sigmas that the log states.

    Args:
        position_m: Along each axis.
        gimbal_deg: Of yaw, pitch and roll.
    """

    position_m: float
    gimbal_deg: float


def epitransfer(run: Path, workflow: Path, *arguments: str) -> Cost:
    """Runs the command line on one process."""
    command = [Path(sys.executable).with_name("epitransfer"), "run", workflow, "--out", run, "--jobs", str(THREADS)]
    return measured([*command, *arguments], run.with_name(f"{run.name}.log"))


def matched(some: PhotoSet) -> Cost:
    """Takes a set as far as its matches."""
    nearest = ("--set", f"match.nearest_m={some.nearest_m}")
    return epitransfer(some.run, some.run / "workflow.toml", "--from", "ingest", "--to", "match", *nearest)


def in_modes(some: PhotoSet, last: str = "depth") -> dict[str, tuple[Path, Cost]]:
    """Copies of a set's matched run, taken through `last` in every mode, with what that took.

    Args:
        some: The set.
        last: The last stage.
    """
    out = {}
    for mode in MODES:
        run = some.run.with_name(f"{some.run.name}.{mode}")
        shutil.copytree(some.run, run)
        changed = (f'refine.mode="{mode}"', 'depth.methods=["epitransfer"]', f"depth.max_range_m={some.max_range_m}")
        settings = [part for value in changed for part in ("--set", value)]
        out[mode] = run, epitransfer(run, run / "workflow.toml", "--from", "refine", "--to", last, *settings)
    return out


def planted(some: PhotoSet, inputs: Path, errors: Planted, seed: int) -> PhotoSet:
    """A set of exact poses matched anew under a trajectory that is off by a draw of errors.

    Args:
        some: The set.
        inputs: Its workflow, calibration and trajectory.
        errors: What is planted, and stated in the workflow.
        seed: Of the draw.
    """
    rng = np.random.default_rng([seed, *some.name.encode()])
    folder = inputs.with_name(f"{some.name}.{seed}.in")
    shutil.copytree(inputs, folder)
    head, *lines = (folder / "poses.csv").read_text(encoding="utf-8").splitlines()
    rows = [_off(line.split(","), errors, rng) for line in lines]
    (folder / "poses.csv").write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    run = some.run.with_name(f"{some.name}.{seed}")
    stated = (f"ingest.pose_sigma_m={errors.position_m}", f"ingest.pose_sigma_deg={errors.gimbal_deg}")
    changed = (*stated, f"match.nearest_m={some.nearest_m}")
    epitransfer(run, folder / "workflow.toml", "--to", "match", *[part for one in changed for part in ("--set", one)])
    return PhotoSet(some.name, run, None, some.poses, some.nearest_m, some.max_range_m)


def _off(row: list[str], errors: Planted, rng: np.random.Generator) -> str:
    numbers = np.array(row[1:], np.float64)
    rotation = turned(rotation_from_quaternion(numbers[3:]), rng.normal(size=3) * np.radians(errors.gimbal_deg))
    centre = numbers[:3] + rng.normal(size=3) * errors.position_m
    return ",".join([row[0], *(f"{value:.12g}" for value in (*centre, *quaternion_from_rotation(rotation)))])


def relative_poses(run: Path) -> dict[str, RelativePose]:
    """Of every pair, as refined."""
    return relative_poses_of(read_table(run / "relative_poses.parquet", "relative_poses"))


def exact_poses(poses: Mapping[str, Placement | Pose], pairs: list[PairRow]) -> dict[str, RelativePose]:
    """Of every pair both of whose frames have a pose."""
    none: Floats = np.zeros((6, 6))
    return {
        pair.pair_id: relative_placement(poses[pair.ref], poses[pair.src], none)
        for pair in pairs
        if pair.ref in poses and pair.src in poses
    }


def pairs_of(run: Path) -> list[PairRow]:
    """Those selected."""
    return selected_pairs(read_table(run / "pairs.parquet", "pairs"))


def logged(run: Path) -> dict[str, Pose]:
    """By frame."""
    return poses_of(read_table(run / "frames.parquet", "frames"))


def variant(some: PhotoSet, name: str, first: str, *changed: str) -> Path:
    """A set's matched run, refined as a flight with settings changed.

    Args:
        some: The set.
        name: Of the variant.
        first: The first stage to run again.
        changed: The settings.
    """
    run = some.run.with_name(f"{some.run.name}.{name}")
    shutil.copytree(some.run, run)
    settings = ('refine.mode="flight"', 'depth.methods=["epitransfer"]', *changed)
    last = "score" if (run.with_name(f"{some.run.name}.flight") / "scores").is_dir() else "depth"
    given = [part for value in settings for part in ("--set", value)]
    epitransfer(run, run / "workflow.toml", "--from", first, "--to", last, *given)
    return run


def reconstructed(photos: Path, run: Path) -> Model | str:
    """COLMAP's model of a folder of photos with our camera, held; or why there is none.

    Args:
        photos: The folder.
        run: Of our side, for the camera.
    """
    work = run.with_name(f"{run.name}.colmap")
    work.mkdir()
    script = Path(__file__).with_name("sfm_side.py")
    try:
        cost = measured([sys.executable, script, photos, work, str(THREADS), run], work / "log")
    except RuntimeError as failure:
        return str(failure).strip().splitlines()[-1]
    return Model(cost, work / "model")


def model_poses(model: pycolmap.Reconstruction, run: Path) -> dict[str, Placement]:
    """Of the frames that a model has and a run can use."""
    frames = read_table(run / "frames.parquet", "frames")
    frames = frames.filter(frames.column("usable"))
    names = dict(zip(frames.column("image").to_pylist(), frames.column("frame_id").to_pylist(), strict=True))
    out = {}
    for image in model.images.values():
        if image.has_pose and image.name in names:
            cam_from_enu = image.cam_from_world().matrix()
            out[names[image.name]] = Placement(cam_from_enu[:, :3].T, -cam_from_enu[:, :3].T @ cam_from_enu[:, 3])
    return out
