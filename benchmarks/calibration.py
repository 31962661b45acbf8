"""Predicted sigma against truth on the example's own matches, over redraws of the flight's pose error.

usage: python benchmarks/calibration.py EXAMPLE RUN [REDRAWS] [MODE...]

A redraw gives every frame a new error of its own and the flight a new common one, with the sigmas of the run's `frames`
table, about the true poses. These are refined as refine.mode says, by default every mode in turn, and the depths of
real matches under the refined poses are compared with the ray-cast truth. The matches stay the same, with the errors
that they have, wrong ones too.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from flight_truth import BETWEEN, LEGS, FlightTruth, configured, reprojection_errors
from redraws import PARTS, redrawn_poses, squares_of, turned
from refitted import Matches, Refit

from pipeline.depthing import Limits, MatchedRays, depths_by
from pipeline.engine.executors import executor_for, usable_cores
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
from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints
from pipeline.geometry.poses import Pose, relative_pose
from pipeline.geometry.transfer import VirtualView

__all__ = ["MEDIAN_SQUARE", "Outcome", "PairTruth", "groups", "limits_of", "outcomes", "pairs_with_truth", "turned"]

METHODS = {"adaptive": "epitransfer", "DLT": "dlt"}
MODES = ("none", "pair", "flight")
REDRAWS, MATCHES_PER_PAIR, SEED = 200, 100, 11
# A match farther from the truth is wrong, not noisy.
WRONG_PX = 3.0
# Of a chi-square distribution with two degrees of freedom.
MEDIAN_SQUARE = 1.386
# Redraws that a process takes at a time.
_SHARD = 5


def limits_of(run: Path) -> Limits:
    """What a published depth of a run has to keep, from its manifest."""
    depth = configured(run, "depth")
    return Limits(depth["max_relative_sigma"], depth["max_range_m"], depth.get("max_miss_sigmas", np.inf))


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
        focal_px: Of src.
    """

    pair: PairRow
    leg: str
    neighbours: bool
    rays: MatchedRays
    depth_m: Floats
    error_px: Floats
    covariance: Floats
    focal_px: float = 1.0

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
                cameras[pair.src].focal_px,
            )
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

    def nees(self, rows: Bools) -> tuple[float, float]:
        """Mean square of the kept depths' errors in units of their sigmas, wrong matches left out; 1 is Gaussian.

        With its standard error from the spread between redraws or between pairs, whichever is larger: the errors of
        the matched positions are the same in every redraw.
        """
        kept = self.kept & rows & ~self.wrong
        square = np.where(kept, (self.error / np.where(kept, self.sigma, 1.0)) ** 2, 0.0)
        total = int(kept.sum())
        if not total:
            return float("nan"), float("nan")
        mean = float(square.sum() / total)
        off = square - mean * kept
        by_pair = np.bincount(self.pair, off.sum(axis=0))
        return mean, float(max(np.linalg.norm(off.sum(axis=1)), np.linalg.norm(by_pair)) / total)

    def abs_rel(self, rows: Bools, common: Bools) -> float:
        """Mean relative error over the depths of `common` (redraws, n)."""
        relative = np.abs(self.error[:, rows]) / self.truth[rows]
        return float(np.mean(relative[common[:, rows]])) if np.any(common[:, rows]) else float("nan")


@dataclass(frozen=True, slots=True)
class _Setting:
    """What a redraw is judged with.

    Args:
        pairs: Whose matches.
        limits: What a published depth has to keep.
        mode: One of MODES.
        matches: All of the run, to refine on; None where nothing is refined.
    """

    pairs: Sequence[PairTruth]
    limits: Limits
    mode: str
    matches: Matches | None

    def refit(self, poses: Mapping[str, Pose]) -> Refit:
        if self.matches is not None:
            return self.matches.refitted(poses, self.mode)
        relative = {pair.pair.pair_id: relative_pose(poses[pair.pair.ref], poses[pair.pair.src]) for pair in self.pairs}
        return Refit(relative, dict.fromkeys(relative, 0.0), ())

    def redraw(self, poses: Mapping[str, Pose]) -> tuple[dict[str, list[AnyArray]], Refit]:
        """Depth, sigma and kept of every match, by method."""
        refit = self.refit(poses)
        stacks: dict[str, list[tuple[Floats, Floats, Bools]]] = {name: [] for name in METHODS}
        for pair in self.pairs:
            name = pair.pair.pair_id
            limits = replace(self.limits, usual_miss_rad=refit.median_px[name] / pair.focal_px)
            for method, stack in stacks.items():
                rays, pose = pair.rays, refit.relative[name]
                found = depths_by(METHODS[method], VirtualView.ADAPTIVE, 1.0, rays, pose, limits)
                stack.append((found.depths.depth_m, np.sqrt(found.depths.variance_m2), found.kept))
        return {name: [np.concatenate(part) for part in zip(*of, strict=True)] for name, of in stacks.items()}, refit


def _redraws(setting: _Setting, drawn: Sequence[Mapping[str, Pose]]) -> list[tuple[dict[str, list[AnyArray]], Refit]]:
    return [setting.redraw(poses) for poses in drawn]


def outcomes(
    pairs: Sequence[PairTruth],
    truth: FlightTruth,
    logged: Mapping[str, Pose],
    limits: Limits,
    redraws: int,
    *,
    mode: str = "none",
    matches: Matches | None = None,
    jobs: int = 1,
    squares: list[Floats] | None = None,
) -> dict[str, Outcome]:
    """Every method over the same redraws.

    Args:
        pairs: Matches with a truth.
        truth: Of the flight.
        logged: Poses whose sigmas are redrawn.
        limits: What a published depth has to keep.
        redraws: How many.
        mode: One of MODES.
        matches: All of the run, to refine on.
        jobs: Processes.
        squares: Is filled with the squares of every pair's relative pose error, (pairs, parts) per redraw.
    """
    rng = np.random.default_rng([SEED, 1])
    drawn = [redrawn_poses(truth.poses, logged, rng) for _ in range(redraws)]
    setting = _Setting(pairs, limits, mode, matches)
    with executor_for(jobs, None) as executor:
        shards = (drawn[start : start + _SHARD] for start in range(0, redraws, _SHARD))
        done = [one for some in executor.map(partial(_redraws, setting), shards) for one in some]
    if squares is not None:
        squares += [
            np.array([squares_of(refit.relative[pair.pair.pair_id], truth, pair.pair) for pair in pairs])
            for _, refit in done
        ]
    true_depth = np.concatenate([pair.depth_m for pair in pairs])
    of_pair = np.repeat(np.arange(len(pairs)), [len(pair.depth_m) for pair in pairs])
    wrong = np.linalg.norm(np.concatenate([pair.error_px for pair in pairs]), axis=1) > WRONG_PX
    out = {}
    for name in METHODS:
        depth, sigma, kept = (np.stack(part) for part in zip(*(found[name] for found, _ in done), strict=True))
        out[name] = Outcome(depth - true_depth, sigma, true_depth, kept, of_pair, wrong)
    return out


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
            one, two, nees = outcome.within(1.0, rows), outcome.within(2.0, rows), outcome.nees(rows)
            shares = f"{one[0]:8.1%} +-{one[1]:5.1%}{two[0]:8.1%} +-{two[1]:5.1%}{nees[0]:8.2f} +-{nees[1]:5.2f}"
            rest = f"{np.mean(outcome.kept[:, rows]):9.1%}{outcome.abs_rel(rows, common):9.4f}"
            yield f"{title:26}{name:10}{shares}{rest}{np.mean(outcome.wrong[rows]):8.2%}"


def pose_lines(squares: Sequence[Floats]) -> Iterator[str]:
    """The relative poses' errors in units of their covariances: means over the pairs, errors between the redraws."""
    per_redraw = np.mean(squares, axis=1)
    mean, error = np.mean(per_redraw, axis=0), np.std(per_redraw, axis=0) / np.sqrt(len(per_redraw))
    cells = (
        f"{name} {value:.2f} +- {off:.2f} of {size}"
        for (name, size), value, off in zip(PARTS.items(), mean, error, strict=True)
    )
    yield "relative poses, mean squares: " + ", ".join(cells)


def main(example: Path, run: Path, redraws: int, modes: Sequence[str]) -> None:
    """Prints the tables."""
    truth = FlightTruth.of(example)
    logged = poses_of(read_table(run / "frames.parquet", "frames"))
    matches = Matches.of(run)
    having = {pair.pair_id for pair in matches.pairs}
    pairs = [pair for pair in pairs_with_truth(run, truth) if pair.pair.pair_id in having]
    print(f"Kept depths within the predicted sigma, over {redraws} redraws of the pose error that `frames` states,")
    print(f"on {len(pairs)} pairs x {MATCHES_PER_PAIR} of the run's matches; a Gaussian error has 68.3 % and 95.4 %")
    for mode in modes:
        squares: list[Floats] = []
        found = outcomes(
            pairs,
            truth,
            logged,
            limits_of(run),
            redraws,
            mode=mode,
            matches=matches,
            jobs=usable_cores(),
            squares=squares,
        )
        print(f"\nrefine.mode = {mode}")
        heads = f"{'1 sigma':>16}{'2 sigma':>16}{'squares':>16}{'kept':>9}{'AbsRel':>9}{'wrong':>8}"
        print(f"{'':36}{heads}")
        for line in lines(found, pairs):
            print(line)
        for line in pose_lines(squares):
            print(line)
    middle = np.median(np.concatenate([pair.squares for pair in pairs]))
    print(
        f"\nMatched positions: the median square in units of their covariance is {middle:.2f}; Gaussian {MEDIAN_SQUARE}"
    )
    print("Squares are of the errors in units of their sigmas, without wrong matches; their mean should be 1.")
    print("AbsRel is over what both keep. Wrong are matches more than")
    print(f"{WRONG_PX:g} px from the truth; they are in the figures but the squares.")


if __name__ == "__main__":
    if len(sys.argv) < 3 or not set(sys.argv[4:]) <= set(MODES):
        sys.exit(f"usage: python benchmarks/calibration.py EXAMPLE RUN [REDRAWS] [{' '.join(MODES)}]")
    main(
        Path(sys.argv[1]),
        Path(sys.argv[2]),
        int(sys.argv[3]) if len(sys.argv) > 3 else REDRAWS,
        sys.argv[4:] or MODES,
    )
