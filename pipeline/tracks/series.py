"""Values of a stream at instants between its samples: linear for positions, along the great circle for attitudes.

Interpolation never crosses a gap or a reset of the estimator; an instant outside the stream has no value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.rotations import rotation_from_quaternion, vector_from_rotation

Nanoseconds = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Bracket:
    """Between which samples instants lie.

    Args:
        left: (k,) index of the sample before.
        right: (k,) index of the sample after.
        weight: (k,) share of the right sample.
        step_s: (k,) time between the two, s.
        known: (k,) whether there is a value at all.
    """

    left: Ints
    right: Ints
    weight: Floats
    step_s: Floats
    known: Bools


def bracket(time_ns: Nanoseconds, segment: Ints, at_ns: Nanoseconds, longest_gap_s: float) -> Bracket:
    """Finds the samples about instants.

    Args:
        time_ns: (n,) of the stream, never decreasing.
        segment: (n,) interpolation does not cross a change.
        at_ns: (k,) instants.
        longest_gap_s: Samples further apart than this are not interpolated between.

    Returns:
        The bracket of each instant.
    """
    at_ns = np.asarray(at_ns, np.int64)
    if not len(time_ns):
        none = np.zeros(len(at_ns), np.int64)
        return Bracket(none, none, np.zeros(len(at_ns)), np.zeros(len(at_ns)), np.zeros(len(at_ns), np.bool_))
    right = np.clip(np.searchsorted(time_ns, at_ns, side="right"), min(1, len(time_ns) - 1), len(time_ns) - 1)
    left = np.maximum(right - 1, 0)
    step_ns = time_ns[right] - time_ns[left]
    weight = np.where(step_ns > 0, (at_ns - time_ns[left]) / np.maximum(step_ns, 1), 0.0)
    inside = (at_ns >= time_ns[0]) & (at_ns <= time_ns[-1])
    step_s = step_ns.astype(np.float64) / 1e9
    on_sample = (weight == 0.0) | (weight == 1.0)
    known: Bools = inside & (on_sample | ((segment[left] == segment[right]) & (step_s <= longest_gap_s)))
    return Bracket(left, right, weight, step_s, known)


def between(values: Floats, where: Bracket) -> Floats:
    """Linear interpolation.

    Args:
        values: (n,) or (n, d) of the stream.
        where: Brackets of k instants.

    Returns:
        (k,) or (k, d); NaN where there is no value.
    """
    weight = where.weight if values.ndim == 1 else where.weight[:, None]
    known = where.known if values.ndim == 1 else where.known[:, None]
    low, high = values[where.left], values[where.right]
    # A sample that is not logged spoils only what needs it.
    mixed = np.where(weight == 0.0, low, np.where(weight == 1.0, high, low + weight * (high - low)))
    out: Floats = np.where(known, mixed, np.nan)
    return out


def slerp(q_wxyz: Floats, where: Bracket) -> Floats:
    """Spherical interpolation of unit quaternions, the short way round.

    Args:
        q_wxyz: (n, 4) of the stream.
        where: Brackets of k instants.

    Returns:
        (k, 4) unit quaternions; NaN where there is no value.

    Source: Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985.
    """
    low, high = q_wxyz[where.left], q_wxyz[where.right]
    cosine = np.sum(low * high, axis=-1, keepdims=True)
    high = np.where(cosine < 0.0, -high, high)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    weight = where.weight[:, None]
    near = angle < 1e-6
    sine = np.where(near, 1.0, np.sin(angle))
    share_low = np.where(near, 1.0 - weight, np.sin((1.0 - weight) * angle) / sine)
    share_high = np.where(near, weight, np.sin(weight * angle) / sine)
    mixed = share_low * low + share_high * high
    mixed = mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)
    out: Floats = np.where(where.known[:, None], mixed, np.nan)
    return out


def speed(values: Floats, where: Bracket) -> Floats:
    """Change per second of a stream between the samples about instants; 0 on a lone sample.

    Args:
        values: (n, d).
        where: Brackets of k instants.

    Returns:
        (k, d) per second; NaN where there is no value.
    """
    step_s = np.where(where.step_s > 0.0, where.step_s, np.inf)
    change = values[where.right] - values[where.left]
    out: Floats = np.where(where.known[:, None], change / step_s[:, None], np.nan)
    return out


def bend(values: Floats, time_ns: Nanoseconds, segment: Ints, where: Bracket, longest_gap_s: float) -> Floats:
    """What a straight line between samples may miss of a curve: what its slope changes by, and for how long.

    Args:
        values: (n, d) of the stream.
        time_ns: (n,) of the stream.
        segment: (n,) a change of slope is not taken across a change of it.
        where: Brackets of k instants.
        longest_gap_s: Nor across samples further apart than this.

    Returns:
        (k, d), not negative; 0 where the stream is too short to tell.
    """
    if len(values) < 3:
        return np.zeros((len(where.left), values.shape[1]))
    return _missed(lambda first, last: values[last] - values[first], time_ns, segment, where, longest_gap_s)


def turn_bend(q_wxyz: Floats, time_ns: Nanoseconds, segment: Ints, where: Bracket, longest_gap_s: float) -> Floats:
    """What interpolation along the great circle may miss of a turn, rad; arguments as of `bend`.

    Returns:
        (k,) rad, not negative.
    """
    if len(q_wxyz) < 3:
        return np.zeros(len(where.left))

    def turned(first: Ints, last: Ints) -> Floats:
        before, after = (rotation_from_quaternion(q_wxyz[index]) for index in (first, last))
        return vector_from_rotation(np.swapaxes(before, -1, -2) @ after)

    out: Floats = np.linalg.norm(_missed(turned, time_ns, segment, where, longest_gap_s), axis=1)
    return out


def _missed(
    way: Callable[[Ints, Ints], Floats], time_ns: Nanoseconds, segment: Ints, where: Bracket, longest_gap_s: float
) -> Floats:
    """What even motion between samples misses, (k, d), by how the speeds before and after differ from that between."""
    before, after = np.maximum(where.left - 1, 0), np.minimum(where.right + 1, len(time_ns) - 1)

    def speeds(first: Ints, last: Ints) -> tuple[Floats, Floats, Bools]:
        step_s = (time_ns[last] - time_ns[first]).astype(np.float64) / 1e9
        known: Bools = (step_s > 0.0) & (step_s <= longest_gap_s) & (segment[first] == segment[last])
        return way(first, last) / np.where(step_s > 0.0, step_s, 1.0)[:, None], step_s, known

    middle, step_s, _ = speeds(where.left, where.right)
    out = np.zeros_like(middle)
    for first, last in ((before, where.left), (where.right, after)):
        beside, apart_s, known = speeds(first, last)
        # A constant acceleration a misses a w (1 - w) h^2 / 2 of a step h.
        turned = np.abs(middle - beside) / np.maximum((step_s + apart_s) / 2.0, 1e-9)[:, None]
        missed = (0.5 * where.weight * (1.0 - where.weight) * step_s**2)[:, None] * turned
        out = np.fmax(out, np.where(known[:, None], missed, 0.0))
    return np.where(where.known[:, None], out, 0.0)
