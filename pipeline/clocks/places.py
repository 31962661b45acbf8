"""A camera's clock from where its photos say they were: the offset that puts them on the log's track."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats

_STEP_S = 0.5
_FINE_S = 0.01
_MOST_PHOTOS = 60
# Positions in photos are rounded and lag behind; a track that passes further away is not theirs.
_FARTHEST_M = 15.0
# No photo is nearer to the track than its rounding and the receiver's noise.
_LEAST_SIGMA_M = 0.5
# Another offset, this far from the best, must be this much less likely (log-odds); so many of them are looked at.
_APART_S = 3.0
_MARGIN = 10.0
_RIVALS = 8
_LEAST_SPEED_M_S = 0.5
# A receiver's position tags are the last fix before the exposure: their lag is not noise and does not average out.
_LAG_SIGMA_S = 0.1
_CHUNK = 4096


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
    near = np.flatnonzero(_nearest_m(photo_m, track_m) <= _FARTHEST_M)
    if len(near) < 3:
        least_m = float(np.median(_nearest_m(photo_m, track_m)))
        return PlaceFit(0.0, np.inf, least_m, 0, f"the photos' positions are {least_m:.0f} m from the track at best")
    chosen = near[np.unique(np.linspace(0, len(near) - 1, min(len(near), _MOST_PHOTOS)).astype(np.int64))]
    where = _Where(photo_s[chosen], photo_m[chosen], track_s, track_m)
    # At least three photos within the log: the others may be of another flight.
    offsets = np.arange(track_s[0] - where.photo_s[-3], track_s[-1] - where.photo_s[2] + _STEP_S, _STEP_S)
    if not len(offsets):
        return None
    cost = np.array([where.cost_m2(offset) for offset in offsets])
    best, *others = sorted((_finest(where, offset) for offset in _lowest(offsets, cost)), key=lambda found: found[1])
    distance_m = where.distance_m(best[0])
    inside = distance_m < _FARTHEST_M
    residual_m = float(np.median(distance_m[inside])) if inside.any() else _FARTHEST_M
    sigma_m = max(residual_m / np.sqrt(2.0 * np.log(2.0)), _LEAST_SIGMA_M)
    sigma_s = float(np.hypot(_width_s(where, best, sigma_m), _LAG_SIGMA_S))
    rivals = [cost_m2 for offset_s, cost_m2 in others if abs(offset_s - best[0]) > _APART_S]
    problem = ""
    if np.count_nonzero(inside) < max(3, np.count_nonzero(np.isfinite(distance_m)) / 2):
        told_m = float(np.median(distance_m[np.isfinite(distance_m)]))
        problem = f"the photos' positions are {told_m:.0f} m from the track at best"
    elif _speed(track_s, track_m) < _LEAST_SPEED_M_S:
        problem = "the vehicle hardly moved, so positions do not tell times"
    elif sigma_s > _APART_S / 2.0 or any(rival - best[1] < 2.0 * _MARGIN * sigma_m**2 for rival in rivals):
        problem = "several offsets put the photos on the track equally well"
    return PlaceFit(best[0], sigma_s, residual_m, int(np.count_nonzero(inside)), problem)


@dataclass(frozen=True, slots=True)
class _Where:
    """Photos with their places, and the track."""

    photo_s: Floats
    photo_m: Floats
    track_s: Floats
    track_m: Floats

    def distance_m(self, offset_s: float) -> Floats:
        """From each photo to where the track is at its time; infinite beyond the log's ends."""
        at = self.photo_s + offset_s
        there = np.column_stack([np.interp(at, self.track_s, self.track_m[:, k]) for k in range(2)])
        outside = (at < self.track_s[0]) | (at > self.track_s[-1])
        out: Floats = np.where(outside, np.inf, np.linalg.norm(there - self.photo_m, axis=1))
        return out

    def cost_m2(self, offset_s: float) -> float:
        """Sum of squared distances, a photo that is elsewhere counted as at the farthest."""
        return float(np.sum(np.minimum(self.distance_m(offset_s), _FARTHEST_M) ** 2))


def _nearest_m(photo_m: Floats, track_m: Floats) -> Floats:
    """How near to each photo the track ever comes."""
    out = np.full(len(photo_m), np.inf)
    for begin in range(0, len(track_m), _CHUNK):
        part = track_m[begin : begin + _CHUNK]
        for k, place_m in enumerate(photo_m):
            out[k] = min(out[k], float(np.min(np.hypot(*(part - place_m).T))))
    return out


def _lowest(offsets: Floats, cost_m2: Floats) -> list[float]:
    """The offsets of the lowest costs, one of each valley."""
    out: list[float] = []
    for index in np.argsort(cost_m2, kind="stable").tolist():
        if all(abs(offsets[index] - other) > _APART_S / 2.0 for other in out):
            out.append(float(offsets[index]))
        if len(out) == _RIVALS:
            break
    return out


def _finest(where: _Where, offset_s: float) -> tuple[float, float]:
    """The best offset near one, and its cost."""
    fine = np.arange(offset_s - _STEP_S, offset_s + _STEP_S, _FINE_S)
    cost = [where.cost_m2(offset) for offset in fine.tolist()]
    return float(fine[int(np.argmin(cost))]), float(np.min(cost))


def _width_s(where: _Where, best: tuple[float, float], sigma_m: float) -> float:
    """One sigma of the offset: how far it moves until the places are half a unit of log-odds less likely."""
    steps = np.geomspace(_FINE_S, _APART_S, 40)
    for step_s in steps.tolist():
        sides = [where.cost_m2(best[0] + side * step_s) for side in (-1.0, 1.0)]
        if min(sides) - best[1] > sigma_m**2:
            return float(step_s)
    return _APART_S


def _speed(track_s: Floats, track_m: Floats) -> float:
    """Median speed while moving at all, m/s."""
    step_s = np.diff(track_s)
    speed = np.linalg.norm(np.diff(track_m, axis=0), axis=1)[step_s > 0] / step_s[step_s > 0]
    moving = speed[speed > _LEAST_SPEED_M_S]
    return float(np.median(moving)) if len(moving) else 0.0
