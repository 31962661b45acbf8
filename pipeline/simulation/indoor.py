"""Writes the indoor example: a bag of a rig carried through a room under motion capture, the truth, and a workflow."""

from __future__ import annotations

import csv
import io
import json
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pipeline.engine.errors import UsageError
from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import quaternion_from_rotation
from pipeline.simulation.indoor_bag import (
    CAMERA_FRAME,
    IMAGE_TOPIC,
    LIDAR_FRAME,
    POSE_TOPIC,
    Messages,
    Recorded,
    time_ns,
    write_bag,
)
from pipeline.simulation.indoor_rig import (
    BODY_FROM_CAMERA,
    BODY_FROM_LIDAR,
    CAMERA,
    DURATION_S,
    MOCAP_HZ,
    MOCAP_MARGIN_S,
    MOCAP_SIGMA_DEG,
    MOCAP_SIGMA_M,
    RANGE_SIGMA_M,
    WORLD_FROM_MOCAP,
    Rigid,
    exposures_s,
    mocap_from_body,
    mocap_times_s,
    scan,
    scan_times_s,
    world_from_body,
)
from pipeline.simulation.indoor_room import DEPTH_M, HEIGHT_M, WIDTH_M, Room, render
from pipeline.simulation.render import camera_rays, exposed
from pipeline.simulation.truth import save_depth

FEWEST_FRAMES, MOST_FRAMES = 2, 200
POSE_COLUMNS = ("frame", "time_ns", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")

_WORKFLOW = f"""\
# The synthetic room of this folder, from a bag to scored points:
#     epitransfer run workflow.toml --out run
# Motion capture's frame has y up; the points come in metres of that frame turned to z up.

[ingest]
bags = "bag"
pose_topic = "{POSE_TOPIC}"
image_topic = "{IMAGE_TOPIC}"
up_axis = "y"
frame_spacing_m = 0.2
pose_sigma_m = 0.001
pose_sigma_deg = 0.05

[pair]
baseline_m = [0.3, 1.2]
roi = "image"
above_ground_m = 1.5
max_range_m = 12.0

[match]
nearest_m = 1.0

[refine]
mode = "flight"

[depth]
methods = ["epitransfer", "dlt"]
max_range_m = 15.0

[fuse]
voxel_m = 0.02
tile_m = 20

[score]
max_range_m = 15.0

[report]
"""


@dataclass(frozen=True, slots=True)
class Summary:
    """What was written.

    Args:
        directory: Where.
        frames: Images in the bag.
        poses: Poses of the rigid body.
        sweeps: Turns of the LiDAR.
        returns: Returns in all of them.
    """

    directory: Path
    frames: int
    poses: int
    sweeps: int
    returns: int


def write_indoor(folder: Path, seed: int = 7, frames: int = 24) -> Summary:
    """Writes the indoor example; the folder appears complete or not at all, with the same bytes every time.

    Poses of motion capture err by white noise of `MOCAP_SIGMA_M` and `MOCAP_SIGMA_DEG` on each axis, independent from
    sample to sample, and by nothing else: stamps, the mounts in /tf_static and the calibration are exact. Ranges of the
    LiDAR err by white noise of `RANGE_SIGMA_M`.

    Args:
        folder: Where; absent or empty.
        seed: Of textures and noise; room and path are always the same.
        frames: Images, evenly over the recording.

    Returns:
        What was written.

    Raises:
        UsageError: The folder is not empty, or the number of frames is out of range.
    """
    _check(folder, frames)
    folder = folder.resolve()
    folder.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        beside.chmod(0o755)
        summary = _write(beside, folder, seed, frames)
        beside.rename(folder)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return summary


def _check(folder: Path, frames: int) -> None:
    if not FEWEST_FRAMES <= frames <= MOST_FRAMES:
        raise UsageError(
            "E-EXAMPLE-01", "the number of frames is out of range", found=str(frames),
            expected=f"{FEWEST_FRAMES} to {MOST_FRAMES}", hint="a pair needs two frames",
        )  # fmt: skip
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(
            "E-EXAMPLE-03", "the folder for the example is not empty", where=str(folder),
            expected="a folder that is empty or not there", hint="name another folder, or remove this one first",
        )  # fmt: skip


def _write(beside: Path, folder: Path, seed: int, frames: int) -> Summary:
    (beside / "truth" / "depth").mkdir(parents=True)
    room, times = Room.seeded(seed), exposures_s(frames)
    cameras = world_from_body(times).then(BODY_FROM_CAMERA)
    messages = Messages()
    counts = {"poses": 0, "returns": 0}

    def recorded() -> Iterator[Recorded]:
        yield messages.static(-MOCAP_MARGIN_S, {CAMERA_FRAME: BODY_FROM_CAMERA, LIDAR_FRAME: BODY_FROM_LIDAR})
        seen = mocap_from_body(mocap_times_s(), np.random.default_rng([seed, 10]))
        for at_s, rotation, translation in zip(mocap_times_s(), seen.rotation, seen.translation_m, strict=True):
            counts["poses"] += 1
            yield messages.pose(at_s, rotation, translation)
        for index, turn_s in enumerate(scan_times_s()):
            turn = scan(room, turn_s, np.random.default_rng([seed, 11, index]))
            counts["returns"] += len(turn.ring)
            yield messages.sweep(turn)
        rays = camera_rays(CAMERA)
        for index, at_s in enumerate(times):
            picture, depth = render(room, rays, CAMERA.focal_px, cameras.rotation[index], cameras.translation_m[index])
            save_depth(beside / "truth" / "depth" / f"{index:04d}.npz", depth)
            yield from messages.image(at_s, exposed(picture, np.random.default_rng([seed, 12, index])), CAMERA)

    write_bag(beside / "bag", messages, recorded())
    (beside / "truth" / "poses.csv").write_text(poses_csv(times, cameras), encoding="utf-8")
    (beside / "truth" / "scene.json").write_text(_scene_json(seed, frames), encoding="utf-8")
    (beside / "workflow.toml").write_text(_WORKFLOW, encoding="utf-8")
    return Summary(folder, frames, counts["poses"], len(scan_times_s()), counts["returns"])


def poses_csv(times_s: Floats, world_from_camera: Rigid) -> str:
    """The true poses of the camera in the room's frame, z up: attitude world_from_camera (RDF).

    Args:
        times_s: (n,) exposures since the recording's start.
        world_from_camera: n poses.

    Returns:
        A table with `POSE_COLUMNS`.
    """
    quaternions = quaternion_from_rotation(world_from_camera.rotation)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(POSE_COLUMNS)
    for index, at_s in enumerate(times_s):
        numbers = (*world_from_camera.translation_m[index], *quaternions[index])
        writer.writerow([f"{index:04d}", time_ns(float(at_s)), *(f"{value:.12g}" for value in numbers)])
    return out.getvalue()


def _scene_json(seed: int, frames: int) -> str:
    facts = {
        "seed": seed,
        "frames": frames,
        "duration_s": DURATION_S,
        "world": "metres, z up; the origin is the middle of the floor",
        "room_m": [WIDTH_M, DEPTH_M, HEIGHT_M],
        "world_from_mocap": WORLD_FROM_MOCAP,
        "body_axes": "forward-left-up",
        "body_from_camera": asdict(BODY_FROM_CAMERA),
        "body_from_lidar": asdict(BODY_FROM_LIDAR),
        "camera": asdict(CAMERA),
        "pixel_convention": "pixel (0, 0) is the centre of the top-left pixel",
        "depth": "z in the camera frame (right-down-forward), m, at the pixels' centres",
        "pose_noise": {
            "kind": "white, independent from sample to sample",
            "rate_hz": MOCAP_HZ,
            "sigma_m": MOCAP_SIGMA_M,
            "sigma_deg": MOCAP_SIGMA_DEG,
        },
        "range_sigma_m": RANGE_SIGMA_M,
    }
    return json.dumps(facts, indent=1, default=np.ndarray.tolist) + "\n"
