"""The same flight as other drones bring it home: photos that know nothing of it, and a log on another clock."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from pipeline.geometry.cameras import Camera
from pipeline.simulation.flight import Trajectory
from pipeline.simulation.grid import COMPOUND_CRS
from pipeline.simulation.logs.dataflash import dataflash
from pipeline.simulation.logs.foxglove import write_foxglove
from pipeline.simulation.logs.ros2 import write_ros2
from pipeline.simulation.logs.tlog import tlog
from pipeline.simulation.logs.ulog import ulog
from pipeline.simulation.recording import LEVER_ARM_M, record
from pipeline.simulation.site import UNDULATION_M, Site

# The camera's clock against UTC.
CLOCK_ERROR_S = -37.0
CAMERA_FILE = "camera.yaml"
_HEAD = """\
# The same flight from bare photos and {what}:
#     epitransfer run {name} --out run
# The camera's clock is {error:g} s off and one photo is missing; the log has two triggers that left none.

[ingest]
photos = "bare"
logs = "logs/{log}"
camera = "{camera}"
{mount}geoid = {geoid:.1f}
crs = "{crs}"
"""


@dataclass(frozen=True, slots=True)
class LoggedAs:
    """One of the forms the flight's log is written in.

    Args:
        key: Name of the workflow.
        log: Its file or folder below `logs`.
        what: For people.
        lever: Whether the workflow has to state the lever arm: bags carry it in their transforms.
    """

    key: str
    log: str
    what: str
    lever: bool

    @property
    def workflow(self) -> str:
        """The workflow's file name."""
        return f"workflow_{self.key}.toml"


FORMS = (
    LoggedAs("bin", "flight.BIN", "an ArduPilot DataFlash log", lever=True),
    LoggedAs("ulg", "flight.ulg", "a PX4 ULog", lever=True),
    LoggedAs("tlog", "flight.tlog", "a MAVLink telemetry log", lever=True),
    LoggedAs("mcap", "flight.mcap", "an MCAP with Foxglove schemas", lever=False),
    LoggedAs("ros2", "ros2", "a ROS 2 bag", lever=False),
)


def missing_frame(frames: int) -> int:
    """The frame whose photo is not on the card."""
    return frames // 4


def camera_time_error() -> timedelta:
    """What the camera's clock shows less UTC."""
    return timedelta(seconds=CLOCK_ERROR_S)


def write_logs(folder: Path, site: Site, camera: Camera, logged: Trajectory) -> None:
    """Writes the flight's log in every form.

    Args:
        folder: Where; it exists.
        site: The site.
        camera: The camera, for bags that carry its calibration.
        logged: The poses as logged, noise included.
    """
    recording = record(site, logged)
    (folder / "flight.BIN").write_bytes(dataflash(recording))
    (folder / "flight.ulg").write_bytes(ulog(recording))
    (folder / "flight.tlog").write_bytes(tlog(recording))
    write_foxglove(recording, camera, folder / "flight.mcap")
    write_ros2(recording, camera, folder / "ros2")


def workflows(stages: str) -> dict[str, str]:
    """A workflow for every form.

    Args:
        stages: The sections after [ingest].

    Returns:
        File name to text.
    """
    lever = ", ".join(f"{value:g}" for value in LEVER_ARM_M)
    return {
        form.workflow: _HEAD.format(
            what=form.what,
            name=form.workflow,
            error=CLOCK_ERROR_S,
            log=form.log,
            camera=CAMERA_FILE,
            mount=f"mount = {{ lever_arm_m = [{lever}] }}   # antenna to camera: forward, right, down\n" * form.lever,
            geoid=UNDULATION_M,
            crs=COMPOUND_CRS,
        )
        + "\n"
        + stages
        for form in FORMS
    }


def camera_yaml(camera: Camera) -> str:
    """The camera as ROS's camera_calibration writes it."""
    k = (camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0)
    return (
        f"image_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: simulated\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{', '.join(f'{v:.12g}' for v in k)}]\n"
        "distortion_model: plumb_bob\n"
        f"distortion_coefficients:\n  rows: 1\n  cols: {len(camera.distortion)}\n"
        f"  data: [{', '.join(f'{v:.12g}' for v in camera.distortion)}]\n"
    )
