"""Predicted sigma against truth on the example's own matches, over redraws of the flight's pose error.

usage: python benchmarks/calibration.py EXAMPLE RUN [REDRAWS]

A redraw gives every frame a new error of its own and the flight a new common one, with the sigmas of the run's `frames`
table, about the true poses. The depths of real matches under such poses are then compared with the ray-cast truth. The
matches stay the same, with the errors that they have, wrong ones too.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from flight_truth import BETWEEN, LEGS, FlightTruth, TruePose, configured, reprojection_errors

from pipeline.depthing import Limits, MatchedRays, depths_by
from pipeline.engine.tables import read_table
from pipeline.flight import (
    PairRow,
    camera_by_frame,
    cameras_of,
    column,
    columns,
    poses_of,
    selected_pairs,
)
from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.poses import Pose, relative_pose
from pipeline.geometry.rotations import rotation_from_vector
from pipeline.geometry.transfer import VirtualView

METHODS = {"adaptive": "epitransfer", "DLT": "dlt"}
REDRAWS, MATCHES_PER_PAIR, SEED = 200, 100, 11
# A match farther from the truth is wrong, not noisy.
WRONG_PX = 3.0
# Of a chi-square distribution with two degrees of freedom.
MEDIAN_SQUARE = 1.386


def limits_of(run: Path) -> Limits:
    """What a published depth of a run has to keep, from its manifest."""
    depth = configured(run, "depth")
    return Limits(depth["max_relative_sigma"], depth["max_range_m"])


@dataclass(frozen=True, slots=True)
class PairTruth:
    """Some matches of a pair with their true depths.

    Args:
        pair: The pair.
        leg: Where it was flown.
        neighbours: Whether its photos follow one another.
        rays: The matches, each with its own covariance.
        depth_m: (n,) true depths in ref, m.
        error_px: (n, 2) src pixel less the true one.
        covariance: (n, 3) px^2, stated for it: uu, uv, vv.
    """

    pair: PairRow
    leg: str
    neighbours: bool
    rays: MatchedRays
    depth_m: Floats
    error_px: Floats
    covariance: Floats

    @property
    def squares(self) -> Floats:
        """(n,) the error's square in units of the covariance; of Gaussian errors half are below MEDIAN_SQUARE."""
        uu, uv, vv = self.covariance.T
        u, v = self.error_px.T
        out: Floats = (vv * u * u - 2.0 * uv * u * v + uu * v * v) / (uu * vv - uv * uv)
        return out


def pairs_with_truth(run: Path, truth: FlightTruth, per_pair: int = MATCHES_PER_PAIR) -> list[PairTruth]:
    """A random choice of every selected pair's inliers that have a truth."""
    frames = read_table(run / "frames.parquet", "frames")
    cameras = camera_by_frame(frames, cameras_of(read_table(run / "cameras.parquet", "cameras")))
    matches = read_table(run / "matches", "matches")
    matches = matches.filter(matches.column("inlier"))
    ids = column(matches, "pair_id")
    rng = np.random.default_rng([SEED, 0])
    out = []
    for pair in selected_pairs(read_table(run / "pairs.parquet", "pairs")):
        some = matches.filter(ids == pair.pair_id)
        ref_px, src_px = columns(some, ("ref_u", "ref_v")), columns(some, ("src_u", "src_v"))
        depth = truth.depths(pair.ref, ref_px)
        has = np.flatnonzero(np.isfinite(depth))
        rows = np.sort(rng.permutation(has)[:per_pair])
        ref_px, src_px, depth = ref_px[rows], src_px[rows], depth[rows]
        covariance = columns(some, ("cov_uu", "cov_uv", "cov_vv"))[rows]
        camera = cameras[pair.ref]
        error = reprojection_errors(ref_px, src_px, depth, camera, ref=truth.poses[pair.ref], src=truth.poses[pair.src])
        out.append(
            PairTruth(
                pair,
                truth.leg(pair.ref, pair.src),
                truth.neighbours(pair.ref, pair.src),
                MatchedRays.of(ref_px, src_px, camera, cameras[pair.src], covariance),
                depth,
                error,
                covariance,
            )
        )
    return out


def redrawn_poses(
    truth: Mapping[str, TruePose], logged: Mapping[str, Pose], rng: np.random.Generator
) -> dict[str, Pose]:
    """Poses as another log of the same flight would give them, with the errors that the table's sigmas say."""
    common_m, common_rad = rng.normal(size=3), rng.normal(size=3)
    out = {}
    for name, pose in logged.items():
        own_m, own_rad = rng.normal(size=3), rng.normal(size=3)
        shift = own_m * pose.own.position_m + common_m * pose.common.position_m
        turn = own_rad * pose.own.gimbal_rad + common_rad * pose.common.gimbal_rad
        true = truth[name]
        out[name] = Pose(turned(true.rotation, turn), true.centre + shift, pose.own, pose.common)
    return out


def turned(rotation: Floats, turn_rad: Floats) -> Floats:
    """An attitude (enu_from_cam) off by yaw, pitch and roll as `frames` defines them, written without the closed form.

    Yaw is about the vertical, pitch about the camera's right axis, roll about the level forward axis.
    """
    yaw, pitch, roll = turn_rad
    level_forward = np.cross([0.0, 0.0, 1.0], rotation[:, 0])
    level_forward /= np.linalg.norm(level_forward)
    out: Floats = (
        rotation_from_vector(np.array([0.0, 0.0, -yaw]))
        @ rotation_from_vector(roll * level_forward)
        @ rotation
        @ rotation_from_vector(np.array([pitch, 0.0, 0.0]))
    )
    return out


@dataclass(frozen=True, slots=True)
class Outcome:
    """One method's depths over all redraws.

    Args:
        error: (redraws, n) estimated less true depth, m.
        sigma: (redraws, n) predicted, m.
        truth: (n,) m.
        kept: (redraws, n).
        pair: (n,) index of the pair.
        wrong: (n,) whether the match is a wrong one.
    """

    error: Floats
    sigma: Floats
    truth: Floats
    kept: Bools
    pair: Ints
    wrong: Bools

    def within(self, sigmas: float, rows: Bools) -> tuple[float, float]:
        """Share of the kept depths within some sigmas, and its standard error from the spread between redraws."""
        kept = self.kept[:, rows]
        hit = (np.abs(self.error[:, rows]) <= sigmas * self.sigma[:, rows]) & kept
        total = int(kept.sum())
        if not total:
            return float("nan"), float("nan")
        share = float(hit.sum() / total)
        residual = hit.sum(axis=1) - share * kept.sum(axis=1)
        return share, float(np.sqrt(np.sum(residual.astype(np.float64) ** 2)) / total)

    def abs_rel(self, rows: Bools, common: Bools) -> float:
        """Mean relative error over the depths of `common` (redraws, n)."""
        relative = np.abs(self.error[:, rows]) / self.truth[rows]
        return float(np.mean(relative[common[:, rows]])) if np.any(common[:, rows]) else float("nan")


def outcomes(
    pairs: Sequence[PairTruth], truth: FlightTruth, logged: Mapping[str, Pose], limits: Limits, redraws: int
) -> dict[str, Outcome]:
    """Every method over the same redraws."""
    rng = np.random.default_rng([SEED, 1])
    n = sum(len(pair.depth_m) for pair in pairs)
    stacks = {name: (np.empty((redraws, n)), np.empty((redraws, n)), np.zeros((redraws, n), bool)) for name in METHODS}
    true_depth = np.concatenate([pair.depth_m for pair in pairs])
    for k in range(redraws):
        poses = redrawn_poses(truth.poses, logged, rng)
        start = 0
        for pair in pairs:
            part = slice(start, start + len(pair.depth_m))
            start = part.stop
            pose = relative_pose(poses[pair.pair.ref], poses[pair.pair.src])
            for name, method in METHODS.items():
                found = depths_by(method, VirtualView.ADAPTIVE, 1.0, pair.rays, pose, limits)
                error, sigma, kept = stacks[name]
                error[k, part] = found.depths.depth_m - pair.depth_m
                sigma[k, part] = np.sqrt(found.depths.variance_m2)
                kept[k, part] = found.kept
    of_pair = np.repeat(np.arange(len(pairs)), [len(pair.depth_m) for pair in pairs])
    wrong = np.linalg.norm(np.concatenate([pair.error_px for pair in pairs]), axis=1) > WRONG_PX
    return {
        name: Outcome(error, sigma, true_depth, kept, of_pair, wrong) for name, (error, sigma, kept) in stacks.items()
    }


def groups(pairs: Sequence[PairTruth]) -> dict[str, Bools]:
    """Which pairs are reported together."""
    leg = np.array([pair.leg for pair in pairs])
    near = np.array([pair.neighbours for pair in pairs])
    named = {f"{name} leg, neighbours": (leg == name) & near for name in LEGS}
    named |= {f"{name} leg, all pairs": leg == name for name in LEGS}
    return named | {"between the legs": leg == BETWEEN}


def lines(found: Mapping[str, Outcome], pairs: Sequence[PairTruth]) -> Iterator[str]:
    """The rows of the table."""
    common = np.logical_and.reduce([outcome.kept for outcome in found.values()])
    for title, chosen in groups(pairs).items():
        for name, outcome in found.items():
            rows = chosen[outcome.pair]
            one, two = outcome.within(1.0, rows), outcome.within(2.0, rows)
            shares = f"{one[0]:8.1%} +-{one[1]:5.1%}{two[0]:8.1%} +-{two[1]:5.1%}{np.mean(outcome.kept[:, rows]):9.1%}"
            rest = f"{outcome.abs_rel(rows, common):9.4f}{np.mean(outcome.wrong[rows]):8.2%}"
            yield f"{title:26}{name:10}{shares}{rest}"


def main(example: Path, run: Path, redraws: int) -> None:
    """Prints the table."""
    truth = FlightTruth.of(example)
    logged = poses_of(read_table(run / "frames.parquet", "frames"))
    pairs = pairs_with_truth(run, truth)
    found = outcomes(pairs, truth, logged, limits_of(run), redraws)
    print(f"Kept depths within the predicted sigma, over {redraws} redraws of the pose error that `frames` states,")
    print(f"on {len(pairs)} pairs x {MATCHES_PER_PAIR} of the run's matches; a Gaussian error has 68.3 % and 95.4 %\n")
    print(f"{'':36}{'1 sigma':>16}{'2 sigma':>16}{'kept':>9}{'AbsRel':>9}{'wrong':>8}")
    for line in lines(found, pairs):
        print(line)
    middle = np.median(np.concatenate([pair.squares for pair in pairs]))
    print(
        f"Matched positions: the median square in units of their covariance is {middle:.2f}; Gaussian {MEDIAN_SQUARE}"
    )
    print("AbsRel is over what both keep. Wrong are matches more than")
    print(f"{WRONG_PX:g} px from the truth; they are in the figures.")


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit("usage: python benchmarks/calibration.py EXAMPLE RUN [REDRAWS]")
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) == 4 else REDRAWS)
