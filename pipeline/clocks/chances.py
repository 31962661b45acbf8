"""How likely photos and events belong together, given an offset: the sum over all assignments that keep the order.

A photo is an event's with odds: how much likelier its time is as that event's than as a photo whose event was not
logged. The latter keeps the rhythm too, so nearness alone proves nothing. The sum over all one-to-one assignments that
keep the order tells how well an offset explains the flight, and the share of those that give a photo another event
tells how sure the best assignment is: in a quick rhythm on a coarse clock one lost photo leaves the choice of all its
neighbours open, not just its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from pipeline.geometry.arrays import Floats, Ints

# Odds that a photo's exposure is in the log: a hot shoe misses one in some hundred.
_LOGGED_ODDS = 150.0
# One photo in two hundred is written late or early by more than the others.
_STRAY_SHARE, _STRAY_S = 0.005, 0.1
_REACH_SIGMAS = 3.5
_LARGEST = 1e100


@dataclass(frozen=True, slots=True)
class Windows:
    """For each photo the events near enough to be its own.

    Args:
        low: (n,) index of the first; never decreasing.
        high: (n,) index past the last; never decreasing.
        odds: Per photo, (high - low,) odds of each.
        events: How many events there are.
    """

    low: Ints
    high: Ints
    odds: tuple[Floats, ...]
    events: int


def windows(
    predicted_s: Floats, event_s: Floats, tick_s: float, sigma_s: float, unit_s: float, kept_odds: float
) -> Windows:
    """Odds of photos and events.

    Args:
        predicted_s: (n,) photo times on the event clock, the middle of their tick, in order.
        event_s: (m,) events, in order.
        tick_s: Tick of the camera's clock: within it all residuals are alike.
        sigma_s: One sigma of a photo's time beside the tick.
        unit_s: What the density of residuals is multiplied with, alike for all offsets: see `unit`.
        kept_odds: Odds that an event has its photo on the card: test shots and lost files leave events without.

    Returns:
        The windows.
    """
    reach_s = tick_s / 2.0 + max(_REACH_SIGMAS * sigma_s, 2.5 * _STRAY_S)
    low = np.searchsorted(event_s, predicted_s - reach_s)
    high = np.searchsorted(event_s, predicted_s + reach_s, side="right")
    sizes = high - low
    first = np.repeat(low - np.concatenate([[0], np.cumsum(sizes)[:-1]]), sizes)
    residual_s = event_s[first + np.arange(int(sizes.sum()))] - np.repeat(predicted_s, sizes)
    density = (1.0 - _STRAY_SHARE) * _density(residual_s, tick_s, sigma_s)
    density += _STRAY_SHARE * _density(residual_s, tick_s, float(np.hypot(sigma_s, _STRAY_S)))
    odds = _LOGGED_ODDS * kept_odds * unit_s * density
    return Windows(low, high, tuple(np.split(odds, np.cumsum(sizes)[:-1])), len(event_s))


def unit(tick_s: float, sigma_s: float) -> float:
    """The time within which photos are of one event, s: one whose event was not logged is as near to where it belongs.

    Args:
        tick_s: Tick of the camera's clock.
        sigma_s: One sigma of a photo's time beside the tick, by the best offset.

    Returns:
        The inverse of the greatest density of residuals.
    """
    return 1.0 / float(_density(np.zeros(1), tick_s, sigma_s)[0])


def log_odds(near: Windows) -> float:
    """Log-odds of an offset against photos and events having nothing to do with each other."""
    # Photos that share no event with their neighbours count each for itself.
    lone = np.ones(len(near.low), np.bool_)
    lone[1:] = near.high[:-1] <= near.low[1:]
    lone[:-1] &= lone[1:]
    if len(lone) > 1:
        lone[-1] = near.high[-2] <= near.low[-1]
    total = 0.0
    sizes = near.high - near.low
    if lone.any():
        photo = np.repeat(np.arange(len(sizes)), sizes)
        own = np.bincount(photo, np.concatenate(near.odds), len(sizes))
        total = float(np.sum(np.log1p(own[lone])))
    rest = np.flatnonzero(~lone)
    if not len(rest):
        return total
    some = Windows(near.low[rest], near.high[rest], tuple(near.odds[k] for k in rest.tolist()), near.events)
    return total + _sums(some)[1]


def shares(near: Windows) -> list[Floats]:
    """Per photo, (high - low,) the share of all assignments, by their odds, that give it each of its events."""
    before, total = _sums(near)
    turned = Windows(
        near.events - near.high[::-1],
        near.events - near.low[::-1],
        tuple(odds[::-1] for odds in near.odds[::-1]),
        near.events,
    )
    after, _ = _sums(turned)
    out = []
    for photo, odds in enumerate(near.odds):
        (head, head_log), (tail, tail_log) = before[photo], after[len(before) - 1 - photo]
        out.append(head * tail[::-1] * odds * np.exp(head_log + tail_log - total))
    return out


def _sums(near: Windows) -> tuple[list[tuple[Floats, float]], float]:
    """Sums over assignments of the photos before each one to events before each of its own, and of all.

    A sum is a number times e to the power of the logarithm beside it.
    """
    sums = np.ones(near.events + 1)
    filled, scale = 0, 0.0
    out: list[tuple[Floats, float]] = []
    for low, high, odds in zip(near.low.tolist(), near.high.tolist(), near.odds, strict=True):
        # Beyond the events seen so far nothing is added, so the last sum holds.
        if high > filled:
            sums[filled + 1 : high + 1] = sums[filled]
            filled = high
        head = sums[low:high].copy()
        out.append((head, scale))
        if high > low:
            sums[low + 1 : high + 1] += np.cumsum(head * odds)
            if filled > high:
                sums[high + 1 : filled + 1] += float(head @ odds)
            top = float(sums[filled])
            if top > _LARGEST:
                sums[low : filled + 1] /= top
                scale += float(np.log(top))
    return out, float(np.log(sums[filled])) + scale


def likeliest(near: Windows) -> Ints:
    """The assignment of the greatest odds, (n,) event of each photo, -1 for none.

    Order is kept, so a burst within one tick goes to its events one by one.
    """
    # best[j]: greatest gain of the photos so far with events before j only; links lead back along the choice.
    best = np.zeros(near.events + 1)
    head = np.full(near.events + 1, -1, np.int64)
    filled = 0
    links: list[tuple[int, int, int]] = []
    for photo, (low, high) in enumerate(zip(near.low.tolist(), near.high.tolist(), strict=True)):
        if high > filled:
            best[filled + 1 : high + 1], head[filled + 1 : high + 1] = best[filled], head[filled]
            filled = high
        if low >= high:
            continue
        with np.errstate(divide="ignore"):
            gains = (best[low:high] + np.log(near.odds[photo])).tolist()
        heads = head[low:high].tolist()
        for place, gain in enumerate(gains, low):
            if gain > best[place + 1] + 1e-12:
                links.append((photo, place, heads[place - low]))
                upto = place + 1
                while upto <= filled and best[upto] < gain:
                    best[upto], head[upto] = gain, len(links) - 1
                    upto += 1
    out = np.full(len(near.low), -1, np.int64)
    at = int(head[filled])
    while at >= 0:
        photo, event, at = links[at]
        out[photo] = event
    return out


def _density(residual_s: Floats, tick_s: float, sigma_s: float) -> Floats:
    """Density of a residual that is even over the tick, its edges softened by a Gaussian; per second."""
    if tick_s < sigma_s:
        both_s = float(np.hypot(sigma_s, tick_s / np.sqrt(12.0)))
        out: Floats = np.exp(-0.5 * (residual_s / both_s) ** 2) / (both_s * np.sqrt(2.0 * np.pi))
        return out
    edge = tick_s / 2.0
    even: Floats = (ndtr((residual_s + edge) / sigma_s) - ndtr((residual_s - edge) / sigma_s)) / tick_s
    return even
