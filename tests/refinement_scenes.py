"""Flights over known points, and what a matcher would make of them: true poses, a log that is off, noisy matches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pixel_noise import drawn, slanted

from pipeline.flight import PairRow
from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement, Pose, PoseSigmas
from pipeline.geometry.rotations import enu_from_cam, gimbal_error_axes, rotation_from_vector, vector_from_rotation
from pipeline.refinement.flight.flight import RefinedFlight, refine_flight, trusted_stars
from pipeline.refinement.logged import Log
from pipeline.refinement.matched import Matched
from pipeline.refinement.near import together
from schemas import MATCHES

DEG = np.pi / 180.0
CAMERA = Camera("brown", 1600, 1200, 1120.0, 1122.0, 803.0, 596.0, (-0.06, 0.01, 0.0005, -0.0003, 0.0))
NONE = PoseSigmas(np.zeros(3), np.zeros(3))
# What the example flight's log is off by, and half as much again in roll and pitch: a consumer drone's.
OWN = PoseSigmas(np.array([0.053, 0.053, 0.053]), np.array([0.25, 0.08, 0.08]) * DEG)
COMMON = PoseSigmas(np.array([0.25, 0.25, 0.4]), np.array([0.4, 0.12, 0.12]) * DEG)
# A matcher's sigmas of 0.5 to 0.9 px along and a third of that across, times this.
NOISE = 0.3
NEAREST_M, FARTHEST_M = 15.0, 90.0
EVERY_S = 2.0
WAYS = {"forward": 0.0, "sideways": 90.0}

Depths = Callable[[Floats, np.random.Generator], Floats]
Spoiling = Callable[[Floats, np.random.Generator], Floats]


def placement(angles_deg: Sequence[float], centre: Sequence[float]) -> Placement:
    """A camera by its gimbal's yaw, pitch and roll."""
    return Placement(enu_from_cam(*np.radians(angles_deg)), np.array(centre, np.float64))


def straight(frames: int, way: str = "forward", spacing_m: float = 5.0, seed: int = 0) -> dict[str, Placement]:
    """A leg at 31 m, 20 degrees down, flown a little unsteadily so that no two poses are alike."""
    rng = np.random.default_rng([seed, 5])
    heading = 23.0 + WAYS[way]
    step = spacing_m * np.array([np.sin(heading * DEG), np.cos(heading * DEG), 0.0])
    return {
        f"f{i:02d}": placement(
            np.array([23.0, -20.0, 0.0]) + rng.normal(0.0, (1.5, 1.0, 0.7)),
            step * i + (0.0, 0.0, 31.0) + rng.normal(0.0, (0.2, 0.2, 0.4)),
        )
        for i in range(frames)
    }


def looked_at(rays: Floats, rng: np.random.Generator, above_ground_m: float = 31.0) -> Floats:
    """(n,) ranges along unit rays (n, 3) in ENU: half on the ground, half on things that stand on it; NaN for sky."""
    standing = rng.uniform(NEAREST_M, FARTHEST_M, len(rays))
    ground = np.where(rays[:, 2] < -1e-3, above_ground_m / np.maximum(-rays[:, 2], 1e-3), np.inf)
    reach = np.where(rng.random(len(rays)) < 0.5, np.minimum(ground, standing), ground)
    return np.where(reach < FARTHEST_M, reach, np.nan)


def flat(rays: Floats, rng: np.random.Generator) -> Floats:
    """(n,) ranges to level ground."""
    ground = 31.0 / np.maximum(-rays[:, 2], 1e-3)
    return np.where(ground < FARTHEST_M, ground, np.nan)


def seen_points(
    at: Placement, rng: np.random.Generator, count: int, camera: Camera = CAMERA, depths: Depths = looked_at
) -> tuple[Floats, Floats]:
    """Pixels (n, 2) of a frame and the points (n, 3) in ENU that they show; n is `count`, or less with much sky."""
    pixels = rng.uniform((20.0, 20.0), (camera.width - 20.0, camera.height - 20.0), (4 * count, 2))
    rays = camera.rays(pixels) @ at.rotation.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    reach = depths(rays, rng)
    good = np.flatnonzero(np.isfinite(reach))[:count]
    return pixels[good], at.centre + reach[good, None] * rays[good]


def seen_in(at: Placement, points: Floats, camera: Camera = CAMERA) -> tuple[Floats, Bools]:
    """Pixels (n, 2) of points (n, 3) in ENU, and which of them lie in the image."""
    pixels = camera.project((points - at.centre) @ at.rotation)
    return pixels, camera.holds(pixels)


def matched(
    pair: PairRow, ref_px: Floats, src_px: Floats, covariance: Floats, cameras: Mapping[str, Camera] | None = None
) -> Matched:
    """A pair's matches, all of them inliers, by way of the table."""
    n = len(ref_px)
    table = MATCHES.from_columns(
        {
            "pair_id": [pair.pair_id] * n,
            **{name: column for name, column in zip(("ref_u", "ref_v"), ref_px.T, strict=True)},  # noqa: C416
            **{name: column for name, column in zip(("src_u", "src_v"), src_px.T, strict=True)},  # noqa: C416
            "score": np.ones(n, np.float32),
            **{
                name: column.astype(np.float32)
                for name, column in zip(("cov_uu", "cov_uv", "cov_vv"), covariance.T, strict=True)
            },
            "inlier": np.ones(n, np.bool_),
        }
    )
    return Matched.of(pair, table, cameras or {pair.ref: CAMERA, pair.src: CAMERA})


def named(ref: str, src: str) -> PairRow:
    """A pair by its frames."""
    return PairRow(f"{ref}~{src}", ref, src)


def matches_of(
    truth: Mapping[str, Placement],
    pair: PairRow,
    rng: np.random.Generator,
    points: tuple[Floats, Floats],
    noise: float = NOISE,
    spoilt: Spoiling | None = None,
) -> Matched:
    """Matches of a pair: ref pixels as they are, src pixels off by what their covariances say, then spoilt."""
    ref_px, world = points
    src_px, seen = seen_in(truth[pair.src], world)
    covariance = slanted(len(world), noise, int(rng.integers(1 << 30)))[seen]
    ref_px, src_px = ref_px[seen], src_px[seen] + drawn(rng, covariance)
    return matched(pair, ref_px, src_px if spoilt is None else spoilt(src_px, rng), covariance)


@dataclass(frozen=True)
class Errors:
    """What a log gets wrong: per frame, and for all frames alike.

    Args:
        own: (n, 6) gimbal yaw, pitch, roll (rad), then east, north, up (m).
        common: (6,) likewise.
    """

    own: Floats
    common: Floats

    @classmethod
    def drawn(cls, rng: np.random.Generator, n: int, own: PoseSigmas = OWN, common: PoseSigmas = COMMON) -> Errors:
        """As the sigmas say."""
        of = [np.concatenate([sigmas.gimbal_rad, sigmas.position_m]) for sigmas in (own, common)]
        return cls(rng.normal(size=(n, 6)) * of[0], rng.normal(size=6) * of[1])

    @classmethod
    def none(cls, n: int) -> Errors:
        """A log that is right."""
        return cls(np.zeros((n, 6)), np.zeros(6))


def logged(
    truth: Mapping[str, Placement], errors: Errors, own: PoseSigmas = OWN, common: PoseSigmas = COMMON
) -> dict[str, Pose]:
    """The log of a flight: every pose off by its errors, which are turns of the gimbal and shifts."""
    out = {}
    for (name, at), error in zip(truth.items(), errors.own + errors.common, strict=True):
        turn = rotation_from_vector(gimbal_error_axes(at.rotation) @ error[:3])
        out[name] = Pose(turn @ at.rotation, at.centre + error[3:], own, common)
    return out


def log_of(poses: Mapping[str, Pose], pairs: Sequence[PairRow], time_s: Mapping[str, float] | None = None) -> Log:
    """A flight as logged, a frame every two seconds unless told otherwise."""
    times = time_s or {name: 1.7e9 + 0.34 + EVERY_S * i for i, name in enumerate(poses)}
    return Log(poses, dict.fromkeys(poses, CAMERA), {pair.pair_id: pair for pair in pairs}, times)


def chained(names: Sequence[str], reach: int = 2) -> list[PairRow]:
    """Every frame with the ones before it."""
    return [named(names[i], names[j]) for i in range(len(names)) for j in range(max(0, i - reach), i)]


def matches_by_pair(
    truth: Mapping[str, Placement], pairs: Sequence[PairRow], rng: np.random.Generator, count: int, noise: float = NOISE
) -> list[Matched]:
    """Matches of all pairs, the pixels of a ref frame the same in all of its pairs: stars."""
    points = {ref: seen_points(truth[ref], rng, count) for ref in dict.fromkeys(pair.ref for pair in pairs)}
    return [matches_of(truth, pair, rng, points[pair.ref], noise) for pair in pairs]


def robust_cost(found: Floats, scale: float) -> float:
    """The flight's cost of whitened residuals (m, 2)."""
    return float(0.5 * scale**2 * np.sum(np.log1p(np.sum(found**2, axis=1) / scale**2)))


def refined_flight(log: Log, found: Sequence[Matched]) -> RefinedFlight:
    """As the stage refines it."""
    return refine_flight(log, trusted_stars(log, found)[0], together(tuple(log.poses), list(log.pairs.values())))


def off(found: Placement | Pose, truth: Placement) -> Floats:
    """(6,) the turn and shift, ENU, that are left from a pose to the true one."""
    return np.concatenate([vector_from_rotation(truth.rotation @ found.rotation.T), truth.centre - found.centre])


def nees(error: Floats, covariance: Floats) -> float:
    """e C^-1 e, whose mean is the number of unknowns where the covariance is right; units are brought near 1 first."""
    scale = np.sqrt(np.diag(covariance))
    white = error / scale
    return float(white @ np.linalg.solve(covariance / np.outer(scale, scale), white))


def seen_from_ref(ref: Placement, src: Placement) -> tuple[Floats, Floats]:
    """ref_from_src and the centre of src in ref."""
    return ref.rotation.T @ src.rotation, ref.rotation.T @ (src.centre - ref.centre)


def relative_off(found: tuple[Placement, Placement], truth: tuple[Placement, Placement]) -> Floats:
    """(6,) the turn and shift of src on ref's axes that are left from a relative pose to the true one."""
    (r, c), (r_true, c_true) = seen_from_ref(*found), seen_from_ref(*truth)
    return np.concatenate([vector_from_rotation(r_true @ r.T), c_true - c])
