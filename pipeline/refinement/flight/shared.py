"""What all frames of a flight get wrong alike, as unknowns with priors: boresight, clock, lever arm, GNSS bias.

A frame's logged pose is off by an error of its own plus, to first order,

    turn  = axes_f boresight                                  axes_f: those of yaw, pitch and roll
    shift = velocity_f clock + heading_f lever + bias(t_f)    heading_f: the camera's level forward, right, down

The bias is a Gauss-Markov process that is nearly constant over a flight. How far each may be off follows from the log's
own sigmas: what it states for a whole position is taken at its word, so a log that knows positions to two centimetres
at ten metres a second has no room for a clock that is off by more than two milliseconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.poses import Pose

BORESIGHT = ("boresight_yaw_rad", "boresight_pitch_rad", "boresight_roll_rad")
CLOCK = "clock_s"
LEVER = ("lever_forward_m", "lever_right_m", "lever_down_m")
_CLOCK_SIGMA_S = 0.2
_LEVER_SIGMA_M = 0.1
# Of the log's level sigma: how much of it a clock or a lever arm may be, and of its square what the bias is at least.
_CLOCK_SHARE, _LEVER_SHARE, _BIAS_SHARE = 0.7, 0.3, 0.3
# A receiver's error changes over an hour; within a minute it moves by a fifth of its sigma.
_BIAS_HOLDS_S = 3600.0
_KNOT_EVERY_S, _BETWEEN_FLIGHTS_S = 60.0, 600.0
# Speeds come from neighbouring positions; over a longer gap a drone may have done anything.
_LONGEST_GAP_S = 15.0
_NEIGHBOURS = 2
_NONE = 1e-9


@dataclass(frozen=True, slots=True)
class Shared:
    """The shared unknowns of a flight of n frames.

    Args:
        names: c names of the constant ones, with units.
        sigma: (c,) of their priors; their means are zero.
        effect: (n, 6, c) of each on the frames' turn (rad) and shift (m), ENU.
        knot_s: (k,) instants of the bias.
        bias_sigma_m: (3,) east, north, up.
        before: (n,) the knot before each frame; the one after it follows.
        share: (n,) share of the knot after it.
        loose_m: (n, 3) one sigma of a frame's own shift by what the clock does with velocities that are not known.
    """

    names: tuple[str, ...]
    sigma: Floats
    effect: Floats
    knot_s: Floats
    bias_sigma_m: Floats
    before: Ints
    share: Floats
    loose_m: Floats

    @property
    def holds(self) -> Floats:
        """(k - 1,) how much of the bias is left from one knot to the next."""
        out: Floats = np.exp(-np.diff(self.knot_s) / _BIAS_HOLDS_S)
        return out


def shared_unknowns(poses: Sequence[Pose], time_s: Floats) -> Shared:
    """The shared unknowns of a flight and what the log lets them be.

    Args:
        poses: As logged.
        time_s: (n,) exposures; NaN where not known.
    """
    velocity, rest = velocities(np.stack([pose.centre for pose in poses]), time_s)
    common_m = np.median([pose.common.position_m for pose in poses], axis=0)
    common_rad = np.median([pose.common.gimbal_rad for pose in poses], axis=0)
    whole_m = np.hypot(common_m, np.median([pose.own.position_m for pose in poses], axis=0))
    level_m = float(np.sqrt(np.mean(whole_m[:2] ** 2)))
    speed = float(np.sqrt(np.mean(np.sum(velocity**2, axis=1))))
    clock_s = min(_CLOCK_SIGMA_S, _CLOCK_SHARE * level_m / speed) if speed > 0.0 else 0.0
    sigma = np.array([*common_rad, clock_s, *[min(_LEVER_SIGMA_M, _LEVER_SHARE * level_m)] * 3])
    effect = np.zeros((len(poses), 6, len(sigma)))
    for i, pose in enumerate(poses):
        effect[i, :3, :3] = pose.error_axes
        effect[i, 3:, 3] = velocity[i]
        effect[i, 3:, 4:] = level_axes(pose.rotation)
    names = np.array([*BORESIGHT, CLOCK, *LEVER])
    used = sigma > _NONE
    knot_s = _knots(time_s)
    before, share = _between(time_s, knot_s)
    # Together they are to be what the log says of a whole position, not more.
    told = np.mean(np.sum((effect[:, 3:] * sigma) ** 2, axis=2), axis=0)
    bias_m = np.sqrt(np.maximum(common_m**2 - told, _BIAS_SHARE * common_m**2))
    return Shared(
        tuple(names[used].tolist()), sigma[used], effect[:, :, used], knot_s, bias_m, before, share, clock_s * rest
    )


def level_axes(rotation: Floats) -> Floats:
    """(3, 3) columns: level forward, level right and down of a camera, ENU."""
    right = rotation[:, 0] * (1.0, 1.0, 0.0)
    length = float(np.linalg.norm(right))
    right = right / length if length > _NONE else np.array([1.0, 0.0, 0.0])
    return np.stack([np.cross([0.0, 0.0, 1.0], right), right, [0.0, 0.0, -1.0]], axis=1)


def velocities(centre_m: Floats, time_s: Floats) -> tuple[Floats, Floats]:
    """Velocities from lines through a few neighbouring positions, and how far single steps are from these lines.

    A drone is shaken between two exposures by more than its positions show. A clock that is off moves every frame by
    its velocity at that instant; taking that from two positions alone would make the shaking look like knowledge.

    Args:
        centre_m: (n, 3).
        time_s: (n,); NaN where not known.

    Returns:
        (n, 3) m/s, zero where the neighbours are too far in time; (n, 3) m/s one sigma of what the lines leave.
    """
    velocity, rest = np.zeros_like(centre_m), np.full_like(centre_m, np.nan)
    known = np.flatnonzero(np.isfinite(time_s))
    order = known[np.argsort(time_s[known], kind="stable")]
    t, x = time_s[order], centre_m[order]
    # Cameras that keep whole seconds give several frames one time: no reason to think that a leg ends.
    leg = np.concatenate([[0], np.cumsum(np.diff(t) > _LONGEST_GAP_S)]) if len(order) else np.empty(0)
    for i, row in enumerate(order):
        rows = np.arange(max(i - _NEIGHBOURS, 0), min(i + _NEIGHBOURS + 1, len(order)))
        rows = rows[leg[rows] == leg[i]]
        since = t[rows] - t[rows].mean()
        if not since @ since > 0.0:
            continue
        velocity[row] = since @ x[rows] / (since @ since)
        step_s = np.diff(t[rows])
        steps = np.diff(x[rows], axis=0)[step_s > 0.0] / step_s[step_s > 0.0, None]
        rest[row] = np.sqrt(np.mean((steps - velocity[row]) ** 2, axis=0))
    # Where nothing is known, a frame may have been as fast as the others.
    usual = np.sqrt(np.mean(velocity[np.isfinite(rest[:, 0])] ** 2, axis=0)) if np.isfinite(rest).any() else 0.0
    return velocity, np.where(np.isfinite(rest), rest, usual)


def _knots(time_s: Floats) -> Floats:
    """Instants of the bias: about every minute of flight, none in between flights."""
    known = np.unique(time_s[np.isfinite(time_s)])
    if not len(known):
        return np.array([0.0, _KNOT_EVERY_S])
    out = []
    for flown in np.split(known, np.flatnonzero(np.diff(known) > _BETWEEN_FLIGHTS_S) + 1):
        first, last = float(flown[0]), float(flown[-1])
        count = max(2, int(np.ceil((last - first) / _KNOT_EVERY_S)) + 1)
        out.append(np.linspace(first, max(last, first + 1.0), count))
    return np.concatenate(out)


def _between(time_s: Floats, knots: Floats) -> tuple[Ints, Floats]:
    at = np.where(np.isfinite(time_s), time_s, knots[0])
    before = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    return before, np.clip((at - knots[before]) / (knots[before + 1] - knots[before]), 0.0, 1.0)
