"""What the drone's recorder sees during the simulated flight: streams through the logged poses, and the triggers."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta

import numpy as np
from scipy.interpolate import CubicSpline

from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import ENU_FROM_NED, ned_from_frd
from pipeline.simulation.flight import FIRST_EXPOSURE, Trajectory
from pipeline.simulation.grid import navd88_height
from pipeline.simulation.site import Site

# From the antenna to the camera, in the body's forward-right-down axes.
LEVER_ARM_M = (0.12, 0.03, 0.18)
# The autopilot starts this long before the first exposure.
BOOTED_BEFORE_S = 75.0
_BEFORE_S, _AFTER_S = 6.0, 4.0
_POSITION_HZ, _ATTITUDE_HZ, _RECEIVER_HZ = 10.0, 50.0, 5.0
# Test shots that left no photo: seconds after the first exposure; not on the rhythm of the others.
EXTRA_TRIGGERS_S = (-3.3, 36.7)
SIGMA_HORIZONTAL_M, SIGMA_VERTICAL_M = 0.26, 0.26


@dataclass(frozen=True, slots=True)
class Recording:
    """Streams of a flight, every instant in seconds since the autopilot's boot.

    Args:
        boot_utc_ns: UTC of the boot, ns since 1970.
        position_s: (n,) instants of the navigation's positions.
        latitude_deg: (n,) of the antenna.
        longitude_deg: (n,) of the antenna.
        ellipsoidal_m: (n,) of the antenna.
        amsl_m: (n,) of the antenna, above NAVD 88.
        above_home_m: (n,) of the antenna.
        velocity_ned_m_s: (n, 3).
        receiver: (r,) indices of the positions that the GNSS receiver reports.
        attitude_s: (m,) instants of the attitudes.
        vehicle_rad: (m, 3) yaw from true north, pitch, roll of the body.
        gimbal_rad: (m, 3) yaw from true north, pitch, roll of the optical axis.
        trigger_s: (k,) instants of all triggers, those of the photos and the extra ones, in order.
        photo_of_trigger: (k,) index of the frame, -1 for a trigger that left no photo.
    """

    boot_utc_ns: int
    position_s: Floats
    latitude_deg: Floats
    longitude_deg: Floats
    ellipsoidal_m: Floats
    amsl_m: Floats
    above_home_m: Floats
    velocity_ned_m_s: Floats
    receiver: tuple[int, ...]
    attitude_s: Floats
    vehicle_rad: Floats
    gimbal_rad: Floats
    trigger_s: Floats
    photo_of_trigger: tuple[int, ...]

    def utc_ns(self, seconds_since_boot: Floats) -> np.ndarray:
        """UTC of instants, ns since 1970."""
        return self.boot_utc_ns + np.rint(np.asarray(seconds_since_boot) * 1e9).astype(np.int64)


def record(site: Site, logged: Trajectory) -> Recording:
    """The streams of a flight whose pose at each exposure is the logged one.

    A smooth path is laid through the logged poses, so that whoever interpolates the streams at the exposures finds the
    poses that DJI's tags of the same flight hold.

    Args:
        site: The site, for its frame and its take-off point.
        logged: The poses as logged, noise included.

    Returns:
        The recording.
    """
    times = logged.time_s
    begin, end = times[0] - _BEFORE_S, times[-1] + _AFTER_S
    position_s = np.arange(begin, end, 1.0 / _POSITION_HZ) + 0.013
    attitude_s = np.arange(begin, end, 1.0 / _ATTITUDE_HZ) + 0.007
    gimbal = _path(times, logged.angles_rad)
    centre = _path(times, logged.centre_in_enu_m)
    antenna = centre(position_s) - lever_in_enu_m(vehicle_rad(position_s, gimbal(position_s)))
    velocity = np.gradient(antenna, position_s, axis=0)
    latitude, longitude, height = site.frame.geodetic_from_enu(antenna)
    shots = np.concatenate([times, times[0] + np.array(EXTRA_TRIGGERS_S)])
    order = np.argsort(shots)
    photo = np.where(order < len(times), order, -1)
    booted = FIRST_EXPOSURE - timedelta(seconds=BOOTED_BEFORE_S)
    every = round(_POSITION_HZ / _RECEIVER_HZ)
    return Recording(
        boot_utc_ns=round(booted.timestamp() * 1000.0) * 1_000_000,
        position_s=position_s + BOOTED_BEFORE_S,
        latitude_deg=latitude,
        longitude_deg=longitude,
        ellipsoidal_m=height,
        amsl_m=np.asarray(navd88_height(height)),
        above_home_m=antenna[:, 2] - float(site.terrain.height(0.0, 0.0)),
        velocity_ned_m_s=velocity @ ENU_FROM_NED,
        receiver=tuple(range(0, len(position_s), every)),
        attitude_s=attitude_s + BOOTED_BEFORE_S,
        vehicle_rad=vehicle_rad(attitude_s, gimbal(attitude_s)),
        gimbal_rad=gimbal(attitude_s),
        trigger_s=shots[order] + BOOTED_BEFORE_S,
        photo_of_trigger=tuple(int(index) for index in photo),
    )


def vehicle_rad(time_s: Floats, gimbal_rad: Floats) -> Floats:
    """Attitude of the body under a gimbal: its heading near the gimbal's, nose down, swaying.

    Args:
        time_s: (n,) since the first exposure.
        gimbal_rad: (n, 3) yaw, pitch, roll of the optical axis.

    Returns:
        (n, 3) yaw, pitch, roll.
    """
    sway = np.radians(2.0)
    return np.column_stack(
        [
            gimbal_rad[:, 0] + sway * np.sin(0.5 * time_s),
            np.radians(-4.0) + sway * np.sin(0.7 * time_s),
            sway * np.sin(0.9 * time_s + 1.0),
        ]
    )


def lever_in_enu_m(body_rad: Floats) -> Floats:
    """From the antenna to the camera, (n, 3) ENU, for attitudes (n, 3) of the body."""
    out: Floats = ned_from_frd(*body_rad.T) @ np.array(LEVER_ARM_M) @ ENU_FROM_NED.T
    return out


def _path(time_s: Floats, values: Floats) -> CubicSpline:
    """A smooth curve through values at the exposures, held still outside them."""
    ends = np.array([time_s[0] - 60.0, time_s[-1] + 60.0])
    padded = np.concatenate([ends[:1], time_s, ends[1:]])
    return CubicSpline(padded, np.concatenate([values[:1], values, values[-1:]]), bc_type="clamped")
