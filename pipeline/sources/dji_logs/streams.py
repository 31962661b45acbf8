"""Position and attitude streams of DJI's texts: fixes told from non-fixes, repeats told from measurements."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.sources.dji_logs.held import new_values, sloped, sloped_longitude
from pipeline.sources.records import Attitudes, Nanoseconds, Positions, nothing
from pipeline.sources.streams import ned_quaternions

# An angle of more turns is a damaged number.
_LARGEST_DEG = 720.0


def positions(
    stream: str,
    time_ns: Nanoseconds,
    latitude_deg: Floats,
    longitude_deg: Floats,
    heights: Mapping[str, Floats],
    segment: Ints,
    losses: list[str],
    *,
    item: str,
    fused: bool,
    held: bool,
) -> tuple[Positions, int] | None:
    """A position stream of the samples that have a fix.

    Args:
        stream: Its name.
        time_ns: (n,) in order.
        latitude_deg: (n,) NaN where not known.
        longitude_deg: (n,) NaN where not known.
        heights: "amsl_m", "above_home_m", "barometric_m": (n,) each, NaN where not known.
        segment: (n,) pieces that interpolation must not join; a lost fix makes another one.
        losses: Gets a sentence for each kind of sample left out.
        item: What a sample is, plural, for the sentences.
        fused: As in `Positions`.
        held: Whether values are repeated until the next measurement; repeats are then left out.

    Returns:
        The stream and how many samples were repeats; None where there is no fix at all.
    """
    good = _fixed(latitude_deg, longitude_deg, losses, item)
    if not good.any():
        return None
    at = np.flatnonzero(good)
    segment = segment[at] + runs(at)
    time_ns = time_ns[at]
    pair = np.stack([longitude_deg[at], latitude_deg[at]], axis=1)
    columns = {name: np.where(np.isfinite(height), height, np.nan)[at] for name, height in heights.items()}
    new = np.ones(len(at), np.bool_)
    if held:
        new = new_values(pair, segment)
        for height in columns.values():
            new |= new_values(height[:, None], segment)
        pair = sloped_longitude(time_ns, pair[:, 0], pair[:, 1], segment)
        columns = {name: sloped(time_ns, height[:, None], segment)[:, 0] for name, height in columns.items()}
    n = int(np.count_nonzero(new))
    made = Positions(
        stream=stream, time_ns=time_ns[new], latitude_deg=pair[new, 1], longitude_deg=pair[new, 0],
        ellipsoidal_m=nothing(n), sigma_horizontal_m=nothing(n), sigma_vertical_m=nothing(n),
        amsl_m=columns["amsl_m"][new], above_home_m=columns["above_home_m"][new],
        barometric_m=columns["barometric_m"][new], segment=segment[new], fused=fused,
    )  # fmt: skip
    return made, len(at) - n


def attitudes(
    stream: str,
    of: Literal["vehicle", "gimbal"],
    time_ns: Nanoseconds,
    yaw_pitch_roll_deg: Floats,
    segment: Ints,
    *,
    held: bool,
) -> Attitudes | None:
    """An attitude stream against north-east-down, of the samples that have all three angles.

    Args:
        stream: Its name.
        of: Whose attitude.
        time_ns: (n,) in order.
        yaw_pitch_roll_deg: (n, 3) yaw from north, pitch up, roll right side down; NaN where not known.
        segment: (n,) pieces that interpolation must not join.
        held: Whether values are repeated until the next measurement; repeats are then left out.

    Returns:
        The stream; None where nothing is known.
    """
    at = np.flatnonzero(np.all(np.abs(yaw_pitch_roll_deg) <= _LARGEST_DEG, axis=1))
    if not len(at):
        return None
    angles_deg, segment = yaw_pitch_roll_deg[at], segment[at] + runs(at)
    if held:
        new = new_values(angles_deg, segment)
        at, angles_deg, segment = at[new], angles_deg[new], segment[new]
    return Attitudes(stream, time_ns[at], ned_quaternions(*np.radians(angles_deg).T), of, "ned", segment)


def runs(at: Ints) -> Ints:
    """(k,) numbers of the unbroken runs in rising indices."""
    return np.cumsum(np.diff(at, prepend=at[:1]) > 1).astype(np.int64)


def _fixed(latitude: Floats, longitude: Floats, losses: list[str], item: str) -> Bools:
    n = len(latitude)
    known: Bools = np.isfinite(latitude) & np.isfinite(longitude)
    nowhere: Bools = known & (latitude == 0.0) & (longitude == 0.0)
    impossible: Bools = known & ((np.abs(latitude) > 90.0) | (np.abs(longitude) > 180.0))
    good: Bools = known & ~nowhere & ~impossible
    for found, text in (
        (~known, "hold no position"),
        (nowhere, "are at latitude 0, longitude 0: no fix"),
        (impossible, "hold coordinates that do not exist"),
    ):
        if known.any() and found.any():
            losses.append(f"{np.count_nonzero(found)} of {n} {item} {text}")
    return good
