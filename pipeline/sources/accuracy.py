"""How far a logged pose may be off: sigmas per class of drone, the whole and the part that is new in each frame.

The attitude figures were measured by comparing logged poses with what image matches say (epipolar residual, joint fit
of one common misalignment and one pose per frame). Relative rotation between neighbours gives the own part (times the
square root of two), the baseline's direction in the camera the common part. Yaw, pitch, roll in degrees:

    drone (flight)                 neighbours differ by    common misalignment
    FC300S, 16 pairs, pitch -75    0.33, 0.14, 0.13        -2.8, -1.4, +0.9
    FC300S, 2 pairs, nadir         0.63, 0.36, 0.12        -1.6 and -2.9 (yaw)
    FC6360 RTK, 5 pairs, nadir     0.18, 0.07, 0.04        -1.6, +0.5, -0.5
    FC220, one hover, 4 points     -                       -2.2, +3.2 (order of magnitude)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from pipeline.geodesy.heights import TAKEOFF
from pipeline.sources.dji import RTK_FIXED, RTK_SINGLE, Fix


@dataclass(frozen=True, slots=True)
class LoggedSigmas:
    """One sigma of a pose error, whole and own; east, north, up in m; yaw, pitch, roll in degrees."""

    position_m: tuple[float, float, float]
    attitude_deg: tuple[float, float, float]
    own_position_m: tuple[float, float, float]
    own_attitude_deg: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class TimingSigmas:
    """One sigma of what an exposure's uncertain instant, and lines between samples, add to a pose; new in each frame.

    Args:
        position_m: East, north, up.
        attitude_deg: Yaw, pitch, roll.
    """

    position_m: tuple[float, float, float]
    attitude_deg: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class DroneClass:
    """What is known of a class of drones when the photo itself does not say.

    Args:
        horizontal_m: One sigma of east and of north without RTK, m.
        vertical_m: One sigma of a GNSS height without RTK, m.
        barometer_m: One sigma of the height above take-off, m.
        attitude_deg: Whole error of yaw, pitch, roll, deg.
        own_position_m: Own part of east, north, up without RTK, m.
        own_attitude_deg: Own part of yaw, pitch, roll, deg.
    """

    horizontal_m: float = 1.5
    vertical_m: float = 3.0
    barometer_m: float = 0.5
    attitude_deg: tuple[float, float, float] = (2.5, 1.5, 1.0)
    own_position_m: tuple[float, float, float] = (0.053, 0.053, 0.053)
    own_attitude_deg: tuple[float, float, float] = (0.25, 0.08, 0.08)


CONSUMER = DroneClass()
# Receivers and gimbals of 2015: neighbours' baselines are off by 0.21 m across and 0.16 m in height.
PHANTOM_3 = DroneClass(own_position_m=(0.15, 0.15, 0.12), own_attitude_deg=(0.3, 0.12, 0.1))
SURVEY = DroneClass(attitude_deg=(1.6, 0.5, 0.5))
# The simulated example flight states its noise; these are its numbers, not an opinion.
SIMULATED = DroneClass(
    horizontal_m=0.26, vertical_m=0.26, barometer_m=0.26, attitude_deg=(0.3536, 0.08, 0.08),
    own_position_m=(0.053, 0.053, 0.053), own_attitude_deg=(0.25, 0.08, 0.08),
)  # fmt: skip
CLASS_OF_MODEL = {
    "EPISIM": SIMULATED,
    **dict.fromkeys(("FC300C", "FC300S", "FC300X", "FC300XW", "FC330", "FC350"), PHANTOM_3),
    **dict.fromkeys(("FC6310R", "FC6360", "M3E", "ZenmuseP1"), SURVEY),
}


def drone_class(model: str, rtk_flag: int | None) -> DroneClass:
    """The class of a photo's drone; an unknown model that logs an RTK flag is a survey drone."""
    known = CLASS_OF_MODEL.get(model.strip())
    return known or (SURVEY if rtk_flag is not None and rtk_flag >= RTK_SINGLE else CONSUMER)


def local_sigmas(position_m: float, attitude_deg: float) -> LoggedSigmas:
    """Sigmas of poses in a frame of their own: all of the error is new in each; there is no place to be off from."""
    position, attitude = (position_m,) * 3, (attitude_deg,) * 3
    return LoggedSigmas(position, attitude, position, attitude)


def widened(sigmas: LoggedSigmas, timing: TimingSigmas | None) -> LoggedSigmas:
    """Sigmas with those of the timing in quadrature, in the whole and in the own part."""
    if timing is None:
        return sigmas
    added = (timing.position_m, timing.attitude_deg, timing.position_m, timing.attitude_deg)
    parts = (sigmas.position_m, sigmas.attitude_deg, sigmas.own_position_m, sigmas.own_attitude_deg)
    return LoggedSigmas(*(_hypot(part, more) for part, more in zip(parts, added, strict=True)))


def _hypot(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
    return math.hypot(a[0], b[0]), math.hypot(a[1], b[1]), math.hypot(a[2], b[2])


def pose_sigmas(model: str, fix: Fix, height_datum: str) -> LoggedSigmas:
    """The sigmas of a photo's pose.

    RTK sigmas as logged are taken as independent from frame to frame; without RTK the error is nearly common to
    neighbours, and only a small part is new in each. A height above take-off has the barometer's sigma.

    Args:
        model: EXIF model.
        fix: Quality and sigmas as logged.
        height_datum: What the height is measured from.

    Returns:
        The sigmas.
    """
    kind = drone_class(model, fix.rtk_flag)
    east = north = kind.horizontal_m
    up = kind.vertical_m
    own = kind.own_position_m
    logged = fix.sigma_east_m, fix.sigma_north_m, fix.sigma_up_m
    if (fix.rtk_flag or 0) >= RTK_SINGLE and all(sigma is not None for sigma in logged):
        east, north, up = (sigma for sigma in logged if sigma is not None)
        if fix.rtk_flag == RTK_FIXED:
            own = (east, north, up)
    elif fix.sigma_horizontal_m is not None:
        east = north = fix.sigma_horizontal_m
        up = fix.sigma_vertical_m if fix.sigma_vertical_m is not None else up
    if height_datum == TAKEOFF:
        up, own = kind.barometer_m, (own[0], own[1], kind.own_position_m[2])
    return LoggedSigmas(
        (east, north, up),
        kind.attitude_deg,
        (min(own[0], east), min(own[1], north), min(own[2], up)),
        kind.own_attitude_deg,
    )
