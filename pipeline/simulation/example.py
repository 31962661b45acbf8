"""Writes the example: photos, logs, tiles, control points, the truth, workflows; a second flight over a lawn."""

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
from pipeline.simulation.lawn import fly_lawn, lawn_frames, lawn_seed, lawn_site
from pipeline.simulation.lawn_looks import LawnShader
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
_LAWN_FOLDER = "lawn"
_LAWN_FILE = "workflow_lawn.toml"
_LAWN_WORKFLOW = f"""\
# A second, short flight over a lawn and a wide roof, on which there is little to match:
#     epitransfer run {_LAWN_FILE} --out run_lawn
# Heights in the photos are above NAVD 88, which lies {-UNDULATION_M:g} m above the ellipsoid here.

[ingest]
photos = "{_LAWN_FOLDER}/photos"
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
mode = "flight"

[depth]
methods = ["epitransfer", "dlt", "epitransfer-lateral", "epitransfer-vertical"]

[fuse]

[score]
lidar = "{lidar}"
"""
_CONTROL = """\
control_points = "gcp_list.txt"
control_height_datum = "navd88"
"""
# A translation takes three points.
_FEWEST_CONTROL = 3
_REPORT = """\

[report]
"""


@dataclass(frozen=True, slots=True)
class Summary:
    """What was written.

    Args:
        directory: Where.
        frames: Photos.
        lidar_points: Returns in the tiles.
        control_observations: Lines of the control point list.
        lawn_frames: Photos of the second flight.
        lawn_points: Returns in its tiles.
    """

    directory: Path
    frames: int
    lidar_points: int
    control_observations: int
    lawn_frames: int
    lawn_points: int


@dataclass(frozen=True, slots=True)
class _Flight:
    """What one of the two flights is made from.

    Args:
        folder: Where its photos and its truth go.
        seed: Its own.
        frames: Photos.
        lawn: Whether it is the second one; it is written with tags alone, without the bare photos and the logs.
    """

    folder: Path
    seed: int
    frames: int
    lawn: bool

    def scene(self) -> tuple[Site, Trajectory]:
        """Its site and its true poses."""
        if self.lawn:
            site = lawn_site(self.seed)
            return site, fly_lawn(site, self.frames)
        site = Site.seeded(self.seed)
        return site, fly(site.terrain, self.frames, self.seed)

    def shader(self, site: Site) -> Shader:
        """Its looks."""
        return LawnShader.of(site) if self.lawn else Shader.of(site)


@dataclass(frozen=True, slots=True)
class _Share:
    """The frames of each flight that one process renders; it prepares each site and the rays once."""

    camera: Camera
    frames: tuple[tuple[_Flight, tuple[int, ...]], ...]


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
            flights = (
                _Flight(beside, seed, frames, lawn=False),
                _Flight(beside / _LAWN_FOLDER, lawn_seed(seed), lawn_frames(frames), lawn=True),
            )
            _render_all(flights, jobs, camera)
            observations, returns = _write(flights[0], camera)
            lawn_returns = _write_lawn(flights[1], camera)
            beside.rename(directory)
        finally:
            shutil.rmtree(beside, ignore_errors=True)
    return Summary(directory, frames, returns, observations, flights[1].frames, lawn_returns)


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


def _render_all(flights: tuple[_Flight, ...], jobs: int, camera: Camera) -> None:
    """Renders every photo; every `jobs`-th frame of each flight goes to the same process."""
    for flight in flights:
        for name in ("photos", "lidar", "truth/depth", *(() if flight.lawn else ("bare", "logs"))):
            (flight.folder / name).mkdir(parents=True)
    count = min(jobs, max(flight.frames for flight in flights))
    shares = [
        _Share(camera, tuple((flight, tuple(range(first, flight.frames, count))) for flight in flights))
        for first in range(count)
    ]
    with executor_for(len(shares)) as executor:
        for _ in executor.map(_render, shares):
            pass


def _render(share: _Share) -> None:
    rays = camera_rays(share.camera)
    for flight, indices in share.frames:
        if indices:
            _render_some(flight, Renderer(share.camera, rays, flight.shader(flight.scene()[0])), indices)


def _render_some(flight: _Flight, renderer: Renderer, indices: tuple[int, ...]) -> None:
    site, true_poses = flight.scene()
    logged_as = logged_poses(true_poses, CONSUMER_DRONE, flight.seed)
    rotations, camera = true_poses.rotation_enu_from_cam, renderer.camera
    for index in indices:
        picture, depth = renderer.render(rotations[index], true_poses.centre_in_enu_m[index])
        image = exposed(picture, np.random.default_rng([flight.seed, 6, index]))
        name = frame_id(index)
        save_photo(flight.folder / "photos" / f"{name}.JPG", image, camera, logged(site, logged_as, index))
        if not flight.lawn and index != missing_frame(flight.frames):
            shown = true_poses.exposure(index) + camera_time_error()
            save_bare(flight.folder / "bare" / f"{name}.JPG", image, camera, shown)
        save_depth(flight.folder / "truth" / "depth" / f"{name}.npz", depth)


def _write(flight: _Flight, camera: Camera) -> tuple[int, int]:
    """Writes what goes with the photos; returns the numbers of control point observations and LiDAR returns."""
    site, true_poses = flight.scene()
    returns = survey(site)
    write_tiles(site, returns, flight.folder / "lidar")
    observations = observe(site, camera, true_poses)
    control = _CONTROL if len({seen.point for seen in observations}) >= _FEWEST_CONTROL else ""
    texts = {
        "gcp_list.txt": gcp_list(site, observations),
        "truth/poses.csv": poses_csv(site, true_poses),
        "truth/site.json": site_json(site, camera, CONSUMER_DRONE, true_poses, observations),
        "workflow.toml": _WORKFLOW + _STAGES.format(lidar="lidar/*.laz") + control + _REPORT,
        CAMERA_FILE: camera_yaml(camera),
        **workflows(_STAGES.format(lidar="lidar/*.laz")),
    }
    write_logs(flight.folder / "logs", site, camera, logged_poses(true_poses, CONSUMER_DRONE, flight.seed))
    _write_texts(flight.folder, texts)
    return len(observations), len(returns.line)


def _write_lawn(flight: _Flight, camera: Camera) -> int:
    """Writes what goes with the second flight's photos, and its workflow beside the first's; returns the returns."""
    site, true_poses = flight.scene()
    returns = survey(site)
    write_tiles(site, returns, flight.folder / "lidar")
    texts = {
        "truth/poses.csv": poses_csv(site, true_poses),
        "truth/site.json": site_json(site, camera, CONSUMER_DRONE, true_poses, []),
        f"../{_LAWN_FILE}": _LAWN_WORKFLOW + _STAGES.format(lidar=f"{_LAWN_FOLDER}/lidar/*.laz"),
    }
    _write_texts(flight.folder, texts)
    return len(returns.line)


def _write_texts(folder: Path, texts: dict[str, str]) -> None:
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
