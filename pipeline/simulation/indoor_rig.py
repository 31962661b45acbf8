"""A rig carried through the room: its path, its camera and its LiDAR, and how motion capture sees it.

Frames: world is the room's, z up; the rig's rigid body is forward-left-up (ROS REP 103); the camera right-down-forward.
Motion capture has its own frame with y up, as OptiTrack's Motive by default: x stays, y is up, z is the world's -y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import rotation_from_vector
from pipeline.simulation.indoor_room import Room

DURATION_S = 12.0
CAMERA = Camera("brown", 640, 480, 431.3, 430.6, 322.4, 237.8, (-0.04, 0.015, 0.0004, -0.0003, 0.0))
# A proper rotation of +90 deg about x.
WORLD_FROM_MOCAP: Floats = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
# What motion capture errs by: white from sample to sample, alike on every axis; its stamps are exact, and the rigid
# body's axes are the body's own.
MOCAP_HZ, MOCAP_SIGMA_M, MOCAP_SIGMA_DEG = 100.0, 0.001, 0.05
MOCAP_MARGIN_S = 0.25

_FLU_FROM_RDF: Floats = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# Knots of the path: east, north, up (m), yaw (counterclockwise from east), nose down, roll (deg). First it goes
# sideways along the south wall, looking north; then forward and to the left.
_KNOTS = np.array(
    [
        (-3.6, -2.6, 1.40, 82.0, 6.0, 1.0),
        (-1.3, -2.9, 1.60, 93.0, 9.0, -2.0),
        (1.1, -2.6, 1.35, 96.0, 5.0, 2.0),
        (3.2, -2.7, 1.55, 104.0, 8.0, -1.0),
        (2.8, -1.3, 1.45, 116.0, 7.0, 1.5),
        (2.0, -0.1, 1.60, 124.0, 9.0, -1.0),
    ]
)
# A VLP-16: 16 rings, 2 deg apart, 10 turns a second; every second of its firings, to keep the bag small.
RINGS, SWEEP_S, RANGE_SIGMA_M = 16, 0.1, 0.02
_COLUMNS, _LASER_S = 900, 2.304e-6
_SWEEPS_FROM_S, _SWEEPS_TO_S = 0.2, DURATION_S - 0.3


@dataclass(frozen=True, slots=True)
class Rigid:
    """A rigid transform a_from_b.

    Args:
        rotation: (3, 3) or (n, 3, 3).
        translation_m: (3,) or (n, 3) origin of b in a.
    """

    rotation: Floats
    translation_m: Floats

    def then(self, other: Rigid) -> Rigid:
        """a_from_c, of this a_from_b and another b_from_c."""
        return Rigid(
            self.rotation @ other.rotation,
            np.einsum("...ij,...j->...i", self.rotation, other.translation_m) + self.translation_m,
        )


def _turn(axis: int, angle_deg: Floats | float) -> Floats:
    vector = np.zeros((*np.shape(angle_deg), 3))
    vector[..., axis] = np.radians(angle_deg)
    return rotation_from_vector(vector)


BODY_FROM_CAMERA = Rigid(_turn(2, 1.5) @ _turn(1, 3.0) @ _FLU_FROM_RDF, np.array([0.11, 0.02, -0.04]))
BODY_FROM_LIDAR = Rigid(_turn(2, 35.0) @ _turn(1, -2.0), np.array([-0.05, 0.01, 0.13]))


def world_from_body(time_s: Floats) -> Rigid:
    """Where the rig truly is.

    Args:
        time_s: (n,) since the recording's start.

    Returns:
        n transforms.
    """
    knots_s = np.linspace(0.0, DURATION_S, len(_KNOTS))
    path = CubicSpline(knots_s, _KNOTS, bc_type="natural")(time_s)
    return Rigid(_turn(2, path[:, 3]) @ _turn(1, path[:, 4]) @ _turn(0, path[:, 5]), path[:, :3])


def exposures_s(frames: int) -> Floats:
    """(frames,) instants of the images, evenly over the recording."""
    return np.linspace(0.5, DURATION_S - 0.5, frames)


def mocap_times_s() -> Floats:
    """(n,) instants of motion capture's samples, from before the recording until after it."""
    return np.arange(-MOCAP_MARGIN_S, DURATION_S + MOCAP_MARGIN_S, 1.0 / MOCAP_HZ)


def mocap_from_body(time_s: Floats, rng: np.random.Generator) -> Rigid:
    """Poses of the rigid body as motion capture reports them, in its y-up frame.

    Args:
        time_s: (n,) since the recording's start.
        rng: Of the noise.
    """
    true = world_from_body(time_s)
    turned = rotation_from_vector(np.radians(MOCAP_SIGMA_DEG) * rng.standard_normal((len(time_s), 3)))
    moved = MOCAP_SIGMA_M * rng.standard_normal((len(time_s), 3))
    return Rigid(WORLD_FROM_MOCAP.T @ true.rotation @ turned, (true.translation_m + moved) @ WORLD_FROM_MOCAP)


@dataclass(frozen=True, slots=True)
class Scan:
    """One turn of the LiDAR.

    Args:
        begin_s: Stamp, since the recording's start.
        p_in_lidar_m: (n, 3) returns in the sensor's frame at their own instants.
        delay_s: (n,) after the stamp.
        ring: (n,) 0 the lowest.
        intensity: (n,).
    """

    begin_s: float
    p_in_lidar_m: Floats
    delay_s: Floats
    ring: Ints
    intensity: Floats


def scan_times_s() -> Floats:
    """(n,) stamps of the LiDAR's turns."""
    return np.arange(_SWEEPS_FROM_S, _SWEEPS_TO_S, SWEEP_S)


def scan(room: Room, begin_s: float, rng: np.random.Generator) -> Scan:
    """One turn of the LiDAR, clockwise from its x axis, while the rig moves on.

    Args:
        room: What it sees.
        begin_s: When it begins.
        rng: Of the noise of its ranges.
    """
    ring = np.tile(np.arange(RINGS), _COLUMNS)
    column = np.repeat(np.arange(_COLUMNS), RINGS)
    delay = column * (SWEEP_S / _COLUMNS) + ring * _LASER_S
    azimuth, elevation = -2.0 * np.pi * delay / SWEEP_S, np.radians(2.0 * ring - 15.0)
    direction = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    # The rings of a column fire within 35 us, in which the rig moves by some hundredths of a millimetre.
    sensor = world_from_body(begin_s + delay.reshape(-1, RINGS).mean(axis=1)).then(BODY_FROM_LIDAR)
    looking = np.einsum("cij,crj->cri", sensor.rotation, direction.reshape(-1, RINGS, 3)).reshape(-1, 3)
    hits = room.cast(np.repeat(sensor.translation_m, RINGS, axis=0), looking)
    distance = hits.distance + RANGE_SIGMA_M * rng.standard_normal(len(ring))
    intensity = 20.0 + 8.0 * (hits.thing % 7) + 3.0 * hits.face
    return Scan(begin_s, distance[:, None] * direction, delay, ring, intensity)
