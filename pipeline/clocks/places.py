"""A camera's clock from where its photos say they were: the offset that puts them on the log's track."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats

_STEP_S = 0.5
_MOST_PHOTOS = 60
# Positions in photos are rounded and lag behind; a track that passes further away is not theirs.
_FARTHEST_M = 15.0
# Another offset, this far from the best, must be this much worse.
_APART_S = 3.0
_WORSE = 1.5
_LEAST_SPEED_M_S = 0.5
# A receiver's position tags are the last fix before the exposure: their lag is not noise and does not average out.
_LAG_SIGMA_S = 0.1


@dataclass(frozen=True, slots=True)
class PlaceFit:
    """The offset that the positions say.

    Args:
        offset_s: Log clock minus photo clock.
        sigma_s: One sigma.
        residual_m: Median distance between photos and track.
        anchors: Photos used.
        problem: Why the positions do not decide; empty when they do.
    """

    offset_s: float
    sigma_s: float
    residual_m: float
    anchors: int
    problem: str = ""


def offset_by_place(photo_s: Floats, photo_m: Floats, track_s: Floats, track_m: Floats) -> PlaceFit | None:
    """Finds the offset between photos and a track.

    Args:
        photo_s: (n,) photo times on the camera's clock.
        photo_m: (n, 2) where the photos say they were, level metres.
        track_s: (m,) times of the track on the log's clock, in order.
        track_m: (m, 2) the track in the same frame.

    Returns:
        The fit; None when there are too few photos, or the track is too short.
    """
    if len(photo_s) < 3 or len(track_s) < 3:
        return None
    chosen = np.unique(np.linspace(0, len(photo_s) - 1, min(len(photo_s), _MOST_PHOTOS)).astype(np.int64))
    time_s, place_m = photo_s[chosen], photo_m[chosen]
    low, high = float(track_s[0] - time_s[0]), float(track_s[-1] - time_s[-1])
    # A photo or two may have been taken before the log began or after it ended.
    slack = 0.2 * float(np.ptp(time_s)) + _STEP_S
    offsets = np.arange(low - slack, high + slack + _STEP_S, _STEP_S)
    if high + slack < low - slack or len(offsets) < 2:
        return None
    cost = np.array([_cost(offset, time_s, place_m, track_s, track_m) for offset in offsets])
    coarse = float(offsets[int(np.argmin(cost))])
    fine = np.arange(coarse - _STEP_S, coarse + _STEP_S, 0.01)
    fine_cost = np.array([_cost(offset, time_s, place_m, track_s, track_m, mean=True) for offset in fine])
    best = float(fine[int(np.argmin(fine_cost))])
    residual_m = _cost(best, time_s, place_m, track_s, track_m)
    rivals = cost[np.abs(offsets - best) > _APART_S]
    speed = _speed(track_s, track_m)
    sigma_s = float(np.hypot(residual_m / max(speed, _LEAST_SPEED_M_S) / np.sqrt(len(time_s)), _LAG_SIGMA_S))
    problem = ""
    if residual_m > _FARTHEST_M:
        problem = f"the photos' positions are {residual_m:.0f} m from the track at best"
    elif speed < _LEAST_SPEED_M_S:
        problem = "the vehicle hardly moved, so positions do not tell times"
    elif len(rivals) and float(rivals.min()) < _WORSE * residual_m + 1.0:
        problem = "several offsets put the photos on the track equally well"
    return PlaceFit(best, sigma_s, residual_m, len(time_s), problem)


def _cost(
    offset_s: float, time_s: Floats, place_m: Floats, track_s: Floats, track_m: Floats, *, mean: bool = False
) -> float:
    """Median (or clipped mean) distance of photos from where the track is at their times; far off the log's ends."""
    at = time_s + offset_s
    there = np.column_stack([np.interp(at, track_s, track_m[:, k]) for k in range(2)])
    distance = np.linalg.norm(there - place_m, axis=1)
    distance = np.where((at < track_s[0]) | (at > track_s[-1]), 1e6, distance)
    return float(np.mean(np.minimum(distance, 4.0 * _FARTHEST_M)) if mean else np.median(distance))


def _speed(track_s: Floats, track_m: Floats) -> float:
    """Median speed while moving at all, m/s."""
    step_s = np.diff(track_s)
    speed = np.linalg.norm(np.diff(track_m, axis=0), axis=1)[step_s > 0] / step_s[step_s > 0]
    moving = speed[speed > _LEAST_SPEED_M_S]
    return float(np.median(moving)) if len(moving) else 0.0
