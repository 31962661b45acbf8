"""A survey of thousands of frames refined as a whole: time, peak memory, and how well it ends up.

usage: python benchmarks/big_flight.py [FRAMES]

Strips of a hundred frames in steps of 8 m, 60 m above uneven ground, looking down; each frame is paired with the three
before it and two of the strip beside it. Matches are made up, with a twentieth of a pixel of noise and 2 % of wrong
ones; the log is a consumer drone's, with a planted boresight, and positions of a fifth of a second before the exposure.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from pipeline.flight import PairRow
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement, Pose, PoseSigmas
from pipeline.geometry.rotations import enu_from_cam
from pipeline.refinement.flight.flight import RefinedFlight, refine_flight, trusted_stars
from pipeline.refinement.flight.stars import Stars
from pipeline.refinement.logged import Log
from pipeline.refinement.matched import Matched, Rays
from pipeline.refinement.near import together

FRAMES, PER_STRIP, STEP_M, BESIDE_M, ABOVE_M, SPEED_M_S = 2000, 100, 8.0, 25.0, 60.0, 4.0
NOISE_PX, WRONG, POINTS_PER_PAIR = 0.05, 0.02, 400
BORESIGHT_DEG, CLOCK_S = 1.0, 0.2
CAMERA = Camera("pinhole", 1600, 1200, 1120.0, 1120.0, 799.5, 599.5)
OWN = PoseSigmas(np.array([0.06, 0.06, 0.06]), np.radians([0.2, 0.1, 0.1]))
COMMON = PoseSigmas(np.array([1.5, 1.5, 3.0]), np.radians([1.5, 0.5, 0.5]))


def flown(frames: int) -> tuple[list[Placement], Floats, Floats]:
    """True cameras, times (s), and where the drone was CLOCK_S before each (m); strip by strip, there and back."""
    strip, along = np.divmod(np.arange(frames), PER_STRIP)
    back = strip % 2 == 1
    x = np.where(back, PER_STRIP - 1 - along, along) * STEP_M
    rng = np.random.default_rng(1)
    time_s = np.arange(frames) * (STEP_M / SPEED_M_S) + strip * 30.0
    # A drone sways by some decimetres, slowly.
    sway = sum(
        0.2 * np.sin(2.0 * np.pi * time_s[:, None] / period + rng.uniform(0.0, 6.3, 3)) for period in (17.0, 43.0)
    )
    centre = np.column_stack([x, strip * BESIDE_M, np.full(frames, ABOVE_M)]) + sway
    yaw = np.where(back, 1.5, 0.5) * np.pi
    angles = np.column_stack([yaw, np.full(frames, np.radians(-85.0)), np.zeros(frames)])
    angles += rng.normal(0.0, 0.01, (frames, 3))
    rotation = enu_from_cam(*angles.T)
    before = np.empty_like(centre)
    for one in range(int(strip[-1]) + 1):
        rows = strip == one
        before[rows] = CubicSpline(time_s[rows], centre[rows])(time_s[rows] - CLOCK_S)
    return [Placement(r, c) for r, c in zip(rotation, centre, strict=True)], time_s, before


def logged(true: list[Placement], before: Floats) -> list[Pose]:
    """The log: own errors, a common shift, and what is planted."""
    rng = np.random.default_rng(2)
    shift = rng.normal(size=3) * COMMON.position_m
    out = []
    for placed, then in zip(true, before, strict=True):
        pose = Pose(placed.rotation, placed.centre, OWN, COMMON)
        gimbal = rng.normal(size=3) * OWN.gimbal_rad - (np.radians(BORESIGHT_DEG), 0.0, 0.0)
        position = rng.normal(size=3) * OWN.position_m + shift + then - placed.centre
        moved = placed.moved(np.concatenate([pose.error_axes @ gimbal, position]))
        out.append(Pose(moved.rotation, moved.centre, OWN, COMMON))
    return out


def partners(i: int, frames: int) -> list[int]:
    """The frames that frame i is paired with."""
    strip, along = divmod(i, PER_STRIP)
    beside = (strip - 1) * PER_STRIP + (PER_STRIP - 1 - along)
    near = [i - k for k in (1, 2, 3) if (i - k) // PER_STRIP == strip and i - k >= 0]
    return [j for j in (*near, beside, beside + 1) if 0 <= j < frames and (j < i)]


def height(x: Floats, y: Floats) -> Floats:
    """The ground."""
    out: Floats = 6.0 * np.sin(x / 23.0) * np.cos(y / 31.0)
    return out


def matched_pairs(true: list[Placement]) -> Iterator[list[Matched]]:
    """The pairs of every ref frame in turn."""
    for i, ref in enumerate(true):
        rng = np.random.default_rng([3, i])
        px = rng.uniform((20, 20), (CAMERA.width - 20, CAMERA.height - 20), (POINTS_PER_PAIR, 2))
        rays = CAMERA.rays(px)
        world = rays @ ref.rotation.T
        points = ref.centre + world * (ABOVE_M / -world[:, 2:])
        for _ in range(6):
            points = ref.centre + world * (
                (ref.centre[2] - height(points[:, 0], points[:, 1]))[:, None] / -world[:, 2:]
            )
        of_ref = []
        for j in partners(i, len(true)):
            src = true[j]
            at = CAMERA.project((points - src.centre) @ src.rotation) + rng.normal(0.0, NOISE_PX, px.shape)
            at += (rng.random(len(px)) < WRONG)[:, None] * rng.normal(0.0, 5.0, px.shape)
            seen = np.all((at > 0) & (at < (CAMERA.width - 1, CAMERA.height - 1)), axis=1)
            if seen.sum() < 10:
                continue
            noise = np.tile([1.0, 0.0, 1.0], (int(seen.sum()), 1)) * (NOISE_PX / CAMERA.fx) ** 2
            pair = PairRow(f"{i:05d}~{j:05d}", f"{i:05d}", f"{j:05d}")
            found = Rays(rays[seen], CAMERA.rays(at[seen]), noise)
            of_ref.append(Matched(pair, int(seen.sum()), px[seen], at[seen], found, CAMERA.focal_px))
        yield of_ref


def refined(frames: int) -> tuple[RefinedFlight, list[Placement], Log, dict[str, float]]:
    """Everything, with the seconds it took."""
    true, time_s, before = flown(frames)
    names = [f"{i:05d}" for i in range(frames)]
    known = dict(zip(names, logged(true, before), strict=True))
    log = Log(known, dict.fromkeys(names, CAMERA), {}, dict(zip(names, time_s.tolist(), strict=True)))
    stars: list[Stars] = []
    pairs = []
    began = time.perf_counter()
    for of_ref in matched_pairs(true):
        pairs += [matched.pair for matched in of_ref]
        stars += trusted_stars(log, of_ref)[0]
    made = time.perf_counter()
    log = replace(log, pairs={pair.pair_id: pair for pair in pairs})
    flight = refine_flight(log, stars, together(names, pairs))
    seconds = {"pairs checked": made - began, "refined": time.perf_counter() - made}
    return flight, true, log, seconds


def main(frames: int) -> None:
    """Prints the figures."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    flight, true, log, seconds = refined(frames)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    names = list(log.poses)
    off = np.stack([flight.frames[name].placed.centre - t.centre for name, t in zip(names, true, strict=True)])
    logged_off = np.stack([log.poses[name].centre - t.centre for name, t in zip(names, true, strict=True)])
    print(f"{frames} frames, {len(log.pairs)} pairs: " + ", ".join(f"{k} in {v:.1f} s" for k, v in seconds.items()))
    print(f"peak memory {peak:.0f} MiB, of which {before:.0f} MiB before anything")
    for title, values in (("as logged", logged_off), ("refined", off)):
        rms = np.sqrt(np.mean((values - values.mean(axis=0)) ** 2, axis=0))
        print(f"{title:12} camera centres about their common shift: {rms.round(4)} m (east, north, up)")
    for found in flight.found:
        print(f"{found.name:22}{found.value:10.5f} +- {found.sigma:.5f}  (log allows {found.prior_sigma:.5f})")
    print(f"planted: boresight yaw {np.radians(BORESIGHT_DEG):.5f} rad, clock {CLOCK_S} s")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else FRAMES)
