"""Writes the example: photos, logs, tiles, control points, the truth, and workflows that run them."""

from __future__ import annotations

import errno
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.engine.errors import ResourceError, UsageError
from pipeline.engine.executors import executor_for
from pipeline.geometry.cameras import Camera
from pipeline.simulation.bare import CAMERA_FILE, camera_time_error, camera_yaml, missing_frame, workflows, write_logs
from pipeline.simulation.control import gcp_list, observe
from pipeline.simulation.flight import CONSUMER_DRONE, FEWEST_FRAMES, Trajectory, fly, frame_id, logged_poses
from pipeline.simulation.grid import COMPOUND_CRS, navd88_height
from pipeline.simulation.photos import LoggedPose, save_bare, save_photo
from pipeline.simulation.render import CAMERA, Renderer, camera_rays, exposed
from pipeline.simulation.shading import Shader
from pipeline.simulation.site import UNDULATION_M, Site
from pipeline.simulation.tiles import survey, write_tiles
from pipeline.simulation.truth import poses_csv, save_depth, site_json

MOST_FRAMES = 9999

_WORKFLOW = f"""\
# The synthetic flight of this folder, from photos to scored points:
#     epitransfer run workflow.toml --out run
# Heights in the photos are above NAVD 88, which lies {-UNDULATION_M:g} m above the ellipsoid here.

[ingest]
photos = "photos"
height_datum = "navd88"
geoid = {UNDULATION_M:.1f}
crs = "{COMPOUND_CRS}"

"""
_STAGES = """\
[pair]
baseline_m = [3.0, 16.0]

[match]
matcher = "sift"

[refine]
mode = "none"

[depth]
methods = ["epitransfer", "dlt", "epitransfer-lateral", "epitransfer-vertical"]

[fuse]

[score]
lidar = "lidar/*.laz"
"""


@dataclass(frozen=True, slots=True)
class Summary:
    """What was written.

    Args:
        directory: Where.
        frames: Photos.
        lidar_points: Returns in the tiles.
        control_observations: Lines of the control point list.
    """

    directory: Path
    frames: int
    lidar_points: int
    control_observations: int


@dataclass(frozen=True, slots=True)
class _Share:
    """The frames one process renders; it prepares its site and rays once."""

    folder: Path
    seed: int
    frames: int
    camera: Camera
    indices: tuple[int, ...]


def write_example(directory: Path, frames: int = 24, seed: int = 7, jobs: int = 1, camera: Camera = CAMERA) -> Summary:
    """Writes the example; the folder appears complete or not at all.

    Args:
        directory: Where; absent or empty.
        frames: Number of photos, from `FEWEST_FRAMES`.
        seed: Of everything random.
        jobs: Processes; the bytes do not depend on it.
        camera: The camera; a Brown model, for DewarpData.

    Returns:
        What was written.

    Raises:
        UsageError: The folder is not empty, or a number is out of range.
        ResourceError: The folder cannot be written.
    """
    directory = directory.resolve()
    _check(directory, frames, seed, jobs)
    with _explained(directory):
        directory.parent.mkdir(parents=True, exist_ok=True)
        beside = Path(tempfile.mkdtemp(prefix=f".{directory.name}.", dir=directory.parent))
        try:
            beside.chmod(0o755)
            shares = _shares(beside, frames, seed, jobs, camera)
            observations, returns = _write(beside, shares)
            beside.rename(directory)
        finally:
            shutil.rmtree(beside, ignore_errors=True)
    return Summary(directory, frames, returns, observations)


def logged(site: Site, poses: Trajectory, index: int) -> LoggedPose:
    """A frame's pose in the words of its tags.

    Args:
        site: The site, for its frame and its take-off point: the ground at the origin.
        poses: The poses as logged.
        index: The frame.

    Returns:
        The pose.
    """
    centre = poses.centre_in_enu_m[index]
    latitude, longitude, height = site.frame.geodetic_from_enu(centre)
    return LoggedPose(
        time=poses.exposure(index),
        latitude_deg=float(latitude),
        longitude_deg=float(longitude),
        navd88_m=float(navd88_height(height)),
        above_takeoff_m=float(centre[2] - site.terrain.height(0.0, 0.0)),
        gimbal_rad=poses.angles_rad[index],
    )


def _check(directory: Path, frames: int, seed: int, jobs: int) -> None:
    if not FEWEST_FRAMES <= frames <= MOST_FRAMES:
        raise UsageError(
            "E-EXAMPLE-01",
            "the number of frames is out of range",
            where="--frames",
            found=str(frames),
            expected=f"{FEWEST_FRAMES} to {MOST_FRAMES}",
            hint="both legs of the flight need two frames",
        )
    if seed < 0 or jobs < 1:
        raise UsageError(
            "E-EXAMPLE-02",
            "the seed must not be negative, and at least one process is needed",
            found=f"seed {seed}, jobs {jobs}",
            expected="--seed 0 or more, --jobs 1 or more",
        )
    if directory == Path.cwd():
        raise UsageError(
            "E-EXAMPLE-05",
            "the example cannot replace the folder you are in",
            where=str(directory),
            hint="name a folder in it: epitransfer example example",
        )
    with _explained(directory):
        if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
            raise UsageError(
                "E-EXAMPLE-03",
                "the folder for the example is not empty",
                where=str(directory),
                expected="a folder that is empty or not there",
                hint="name another folder, or remove this one first",
            )


@contextmanager
def _explained(directory: Path) -> Iterator[None]:
    """Turns what the file system refuses into an error with a remedy."""
    try:
        yield
    except OSError as error:
        full = error.errno in {errno.ENOSPC, errno.EDQUOT}
        raise ResourceError(
            "E-EXAMPLE-04",
            "the disk is full" if full else "the example cannot be written",
            where=str(error.filename or directory),
            found=error.strerror or str(error),
            hint="free some space: 24 frames take about 130 MB" if full else "name a folder that you may write to",
        ) from error


def _shares(folder: Path, frames: int, seed: int, jobs: int, camera: Camera) -> list[_Share]:
    """Every `jobs`-th frame to the same process."""
    count = min(jobs, frames)
    return [_Share(folder, seed, frames, camera, tuple(range(first, frames, count))) for first in range(count)]


def _write(folder: Path, shares: list[_Share]) -> tuple[int, int]:
    """Writes everything; returns the numbers of control point observations and LiDAR returns."""
    for name in ("photos", "bare", "logs", "lidar", "truth/depth"):
        (folder / name).mkdir(parents=True)
    with executor_for(len(shares)) as executor:
        for _ in executor.map(_render, shares):
            pass
    camera = shares[0].camera
    site, true_poses = _scene(shares[0].seed, shares[0].frames)
    returns = survey(site)
    write_tiles(site, returns, folder / "lidar")
    observations = observe(site, camera, true_poses)
    texts = {
        "gcp_list.txt": gcp_list(site, observations),
        "truth/poses.csv": poses_csv(site, true_poses),
        "truth/site.json": site_json(site, camera, CONSUMER_DRONE, true_poses, observations),
        "workflow.toml": _WORKFLOW + _STAGES,
        CAMERA_FILE: camera_yaml(camera),
        **workflows(_STAGES),
    }
    write_logs(folder / "logs", site, camera, logged_poses(true_poses, CONSUMER_DRONE, shares[0].seed))
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return len(observations), len(returns.line)


def _scene(seed: int, frames: int) -> tuple[Site, Trajectory]:
    site = Site.seeded(seed)
    return site, fly(site.terrain, frames, seed)


def _render(share: _Share) -> None:
    site, true_poses = _scene(share.seed, share.frames)
    logged_as = logged_poses(true_poses, CONSUMER_DRONE, share.seed)
    renderer = Renderer(share.camera, camera_rays(share.camera), Shader.of(site))
    rotations = true_poses.rotation_enu_from_cam
    for index in share.indices:
        picture, depth = renderer.render(rotations[index], true_poses.centre_in_enu_m[index])
        image = exposed(picture, np.random.default_rng([share.seed, 6, index]))
        name = frame_id(index)
        save_photo(share.folder / "photos" / f"{name}.JPG", image, share.camera, logged(site, logged_as, index))
        if index != missing_frame(share.frames):
            shown = true_poses.exposure(index) + camera_time_error()
            save_bare(share.folder / "bare" / f"{name}.JPG", image, share.camera, shown)
        save_depth(share.folder / "truth" / "depth" / f"{name}.npz", depth)
