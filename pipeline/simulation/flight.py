"""The flight: a forward and a sideways leg, and the error a consumer drone's log makes about them."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import enu_from_cam
from pipeline.simulation.site import HEADING_RAD, place
from pipeline.simulation.terrain import Terrain

# Not on a whole second: a camera clock whose fractions are all zero would be taken for one that has none.
FIRST_EXPOSURE = datetime(2024, 6, 1, 15, 0, 0, 340_000, tzinfo=UTC)
FORWARD, SIDEWAYS = "forward", "sideways"
ABOVE_GROUND_M = 31.0
SPACING_M = 5.0
PITCH_RAD = np.radians(-20.0)
FEWEST_FRAMES = 4
_INTERVAL_S = 2.0
_TURN_S = 40.0
_FORWARD_SHARE = 14.0 / 24.0
# Where the sideways leg begins: forward and right of the flight's start.
_SIDEWAYS_START_M = (6.0, -22.0)


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """One sigma of what a consumer drone's log gets wrong: a part of each frame's own, and one common to the flight.

    Args:
        yaw_deg: Own heading error.
        pitch_deg: Own pitch error.
        roll_deg: Own roll error.
        position_m: Own position error along each axis; 7.5 cm between two frames.
        common_yaw_deg: Heading error of the whole flight.
        common_position_m: Position error of the whole flight along each axis.
    """

    yaw_deg: float = 0.25
    pitch_deg: float = 0.08
    roll_deg: float = 0.08
    position_m: float = 0.053
    common_yaw_deg: float = 0.25
    common_position_m: float = 0.25


CONSUMER_DRONE = PoseNoise()


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Camera poses in order of time.

    Args:
        time_s: (n,) since `FIRST_EXPOSURE`.
        leg: n names, FORWARD or SIDEWAYS.
        centre_in_enu_m: (n, 3) camera centres, m.
        angles_rad: (n, 3) yaw (from the frame's north), pitch and roll of the optical axis.
    """

    time_s: Floats
    leg: tuple[str, ...]
    centre_in_enu_m: Floats
    angles_rad: Floats

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def rotation_enu_from_cam(self) -> Floats:
        """(n, 3, 3) attitudes, ENU from camera RDF."""
        return enu_from_cam(self.angles_rad[:, 0], self.angles_rad[:, 1], self.angles_rad[:, 2])

    def exposure(self, index: int) -> datetime:
        """The instant of a frame, UTC."""
        return FIRST_EXPOSURE + timedelta(seconds=float(self.time_s[index]))


def frame_id(index: int) -> str:
    """The name of a frame, DJI's way."""
    return f"DJI_{index + 1:04d}"


def fly(terrain: Terrain, frames: int, seed: int) -> Trajectory:
    """The true poses of a flight: level, 20 degrees down, 5 m between frames; forward, then sideways.

    Args:
        terrain: The ground that the height is kept over, at the start.
        frames: Number of frames, at least `FEWEST_FRAMES`.
        seed: Of the small unsteadiness.

    Returns:
        The poses.
    """
    forward = min(max(round(frames * _FORWARD_SHARE), 2), frames - 2)
    rng = np.random.default_rng([seed, 2])
    step = np.arange(frames, dtype=np.float64)
    sideways = step >= forward
    along = np.where(sideways, _SIDEWAYS_START_M[0], SPACING_M * step)
    across = np.where(sideways, _SIDEWAYS_START_M[1] + SPACING_M * (step - forward), 0.0)
    unsteady = rng.normal(0.0, 1.0, (frames, 6)) * (0.15, 0.15, 0.3, *np.radians((1.0, 0.6, 0.4)))
    level = place(np.column_stack([along, across]) + unsteady[:, :2])
    up = float(terrain.height(0.0, 0.0)) + ABOVE_GROUND_M + unsteady[:, 2]
    return Trajectory(
        time_s=_INTERVAL_S * step + np.where(sideways, _TURN_S, 0.0),
        leg=tuple(SIDEWAYS if s else FORWARD for s in sideways),
        centre_in_enu_m=np.column_stack([level, up]),
        angles_rad=unsteady[:, 3:] + (HEADING_RAD, PITCH_RAD, 0.0),
    )


def noisy_poses(true_poses: Trajectory, noise: PoseNoise, rng: np.random.Generator) -> Trajectory:
    """One draw of the log that such a flight would leave.

    Args:
        true_poses: The truth.
        noise: Standard deviations.
        rng: Where the draw comes from; each call takes the same number of values from it.

    Returns:
        The poses as logged.
    """
    n = len(true_poses)
    own_m = rng.normal(0.0, 1.0, (n, 3)) * noise.position_m
    own_deg = rng.normal(0.0, 1.0, (n, 3)) * (noise.yaw_deg, noise.pitch_deg, noise.roll_deg)
    common_m = rng.normal(0.0, 1.0, 3) * noise.common_position_m
    common_deg = np.array([rng.normal(0.0, 1.0) * noise.common_yaw_deg, 0.0, 0.0])
    return Trajectory(
        true_poses.time_s,
        true_poses.leg,
        true_poses.centre_in_enu_m + own_m + common_m,
        true_poses.angles_rad + np.radians(own_deg + common_deg),
    )


def logged_poses(true_poses: Trajectory, noise: PoseNoise, seed: int) -> Trajectory:
    """The draw that the example's photos carry."""
    return noisy_poses(true_poses, noise, np.random.default_rng([seed, 3]))
