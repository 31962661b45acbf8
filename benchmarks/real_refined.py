"""What refinement does on real photo sets, in every mode, and COLMAP beside it.

usage: python benchmarks/real_refined.py WORK [SEEDS]

WORK is an empty or absent folder. The sets lie in $EPITRANSFER_SHARED or ../shared. Two of them have exact poses, one
of these measured depth maps; these two are also matched anew under trajectories with planted errors, SEEDS times (3).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from flight_truth import facts
from match_sets import EXACT, PhotoSet, real_sets, shared_folder
from measured import Cost
from real_runs import (
    LEAST_POSITIONS,
    MODES,
    Model,
    Planted,
    exact_poses,
    in_modes,
    logged,
    matched,
    model_poses,
    pairs_of,
    planted,
    reconstructed,
    relative_poses,
    variant,
)
from real_sets_told import brighton, mirafiori, sheffield
from real_truth import Depths, agreement, cameras, measured_depths, pose_errors, squares, unexplained
from whole_path import colmap_observations

from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.poses import RelativePose
from pipeline.geometry.transfer import VirtualView, transfer

PLANTED = {"hololens": Planted(0.02, 0.5), "fountain_p11": Planted(0.05, 0.5)}
# Beside the modes: the flight with its lens refined too, with longer pairs that tie strips together, and with both.
CALIBRATED = "refine.calibrate=true"
SHEFFIELD, MIRAFIORI = (
    ("pair.baseline_m=[2, 45]", "pair.min_overlap=0.3"),
    ("pair.baseline_m=[2, 30]", "pair.min_overlap=0.25"),
)
VARIANTS = {
    "sheffield_cross": {"lens": (CALIBRATED,), "wide": SHEFFIELD, "wide+lens": (*SHEFFIELD, CALIBRATED)},
    "mirafiori_p4m_rtk": {"lens": (CALIBRATED,), "wide": MIRAFIORI, "wide+lens": (*MIRAFIORI, CALIBRATED)},
    "brighton_beach": {"lens": (CALIBRATED,)},
}
TOLD_OF = {"sheffield_cross": sheffield, "mirafiori_p4m_rtk": mirafiori, "brighton_beach": brighton}
COLMAP = "COLMAP"
NOTES = """
Turn, direction, length: medians over pairs of the relative pose's errors. NEES: median of their squares in units of
the covariance; 5.3 is to be expected of exact truth. Depths: kept ones with a truth, per draw; median and AbsRel over
these, common over those that every mode keeps; bias is the median of signed errors. 68 %, 95 %: shares within 1 and
1.96 predicted sigmas. Left: the error of the truth that would bring the first to 68 %.
No truth here is exact. Hololens: the poses are a headset's own tracking and the depths its own maps, coarse and
smoothed; both are in every figure. Fountain: poses by registration to a laser scan, good to some millimetres (0.1 deg
of a baseline of 1.7 m); the depths are the same matches under these poses, so that only the poses differ.
COLMAP gets the photos alone and our camera, held; its model is brought to metres by the similarity that fits its
cameras best to the same logged positions. Its depths are those of its points in every photo that shows them. Three
cameras on a line allow no similarity: turns and directions alone then."""


@dataclass(frozen=True, slots=True)
class Told:
    """A set in every mode.

    Args:
        photos: The set, matched.
        cost: Of everything up to its matches.
        runs: By mode, with what refinement and depths took.
        model: COLMAP's, or why there is none.
    """

    photos: PhotoSet
    cost: Cost
    runs: dict[str, tuple[Path, Cost]]
    model: Model | str


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of one mode under one log.

    Args:
        poses: (p, 3) of relative poses: deg, deg, share.
        squares: (p,) in units of their covariances; empty where none are stated.
        relative: (n,) signed relative errors of kept depths.
        sigma: (n,) predicted, over the true depth.
        common: (k,) as relative, of the depths that every mode keeps.
    """

    poses: Floats
    squares: Floats
    relative: Floats
    sigma: Floats
    common: Floats

    @classmethod
    def together(cls, some: list[Errors]) -> Errors:
        """Those of several logs."""
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(one, name) for one in some]) for name in names))


def told(shared: Path, work: Path) -> Iterator[Told | str]:
    """Every set as logged, in every mode, and by COLMAP."""
    for some in real_sets(shared, work):
        if isinstance(some, str):
            yield some
            continue
        cost = matched(some)
        runs = in_modes(some, "score" if some.name == "brighton_beach" else "depth")
        photos = Path(facts(some.run, "ingest")["photo_root"])
        yield Told(some, cost, runs, reconstructed(photos, some.run))


def residuals(found: list[Told]) -> Iterator[str]:
    """Every set and mode: residuals, pairs refined, kept depths, how pairs agree."""
    heads = f"{'px before':>10}{'after':>8}{'pairs':>7}{'refined':>8}{'kept':>14}{'seen twice':>12}{'spread':>9}"
    yield f"{'':26}{heads}"
    for one in found:
        runs = {mode: (facts(run, "refine"), Depths.of(run)) for mode, (run, _) in one.runs.items()}
        everywhere = np.logical_and.reduce([depths.kept for _, depths in runs.values()])
        for mode, (known, depths) in runs.items():
            before, after = known["median_epipolar_residual_px"], known["median_epipolar_residual_after_px"]
            several, spread, _ = agreement(depths, everywhere)
            said = f"{spread:.3%}" if several else "-"
            yield (
                f"{one.photos.name if mode == MODES[0] else '':19}{mode:7}{before:10.3f}{after:8.3f}"
                f"{len(pairs_of(one.photos.run)):7}{known['share_of_pairs_refined']:8.0%}"
                f"{depths.kept.sum():7,}/{len(depths.kept):6,}{several:12,}{said:>9}"
            )
    yield "Spread: of the depths that several pairs give one pixel, median, on the pixels kept in all modes."


def corrections(found: list[Told]) -> Iterator[str]:
    """What the mode flight finds wrong in all frames alike, and which frames it leaves off their log."""
    for one in found:
        known = facts(one.runs["flight"][0], "refine")
        told_of = {
            name: figures
            for name, figures in known["shared_errors"].items()
            if figures["sigma"] < 0.9 * figures["prior_sigma"] or name == "clock"
        }
        said = ", ".join(
            f"{name} {f['correction']:+.3f} +- {f['sigma']:.3f} {f['unit']} (log: {f['prior_sigma']:.2g})"
            for name, f in told_of.items()
        )
        yield f"{one.photos.name:18} {said or 'nothing'}; matches' information / {known['information_divided_by']:.1f}"
        for name, problem in known["frames_off_the_log"].items():
            yield f"{'':18} {name}: {problem}"
        for mode in ("pair", "flight"):
            for problem, count in facts(one.runs[mode][0], "refine")["pairs_not_refined"].items():
                yield f"{'':18} {mode}: {count} pair(s) not refined: {problem}"


def under(exact: Mapping[str, RelativePose], run: Path, depths: Depths, truth: Floats, common: Bools) -> Errors:
    """Errors of one run.

    Args:
        exact: By pair.
        run: With refined poses.
        depths: Of the run.
        truth: (n,) m; NaN where there is none.
        common: (n,) kept in every mode.
    """
    poses = relative_poses(run)
    names = [name for name in poses if name in exact]
    relative, sigma = depths.depth / truth - 1.0, depths.sigma / truth
    known = np.isfinite(truth)
    rows: Bools = depths.kept & known
    of = [poses[name] for name in names], [exact[name] for name in names]
    return Errors(pose_errors(*of), squares(*of), relative[rows], sigma[rows], relative[common & known])


def colmap_under(model: Model | str, run: Path, exact: Mapping[str, RelativePose], maps: Path | None) -> Errors | str:
    """Errors of COLMAP's model brought to the positions of a log, or why there are none."""
    if isinstance(model, str):
        return f"no model: {model}"
    none = np.empty(0)
    try:
        metric, placed = model.in_metres(run), True
    except ValueError:
        # Turns and directions are the same in any unit.
        metric, placed = model(), False
    found = exact_poses(model_poses(metric, run), pairs_of(run))
    names = [name for name in exact if name in found]
    relative = none
    if maps is not None and placed:
        observed, _ = colmap_observations(metric, run)
        relative = observed.depth_m / measured_depths(maps, observed.frame_id, observed.pixels) - 1.0
        relative = relative[np.isfinite(relative)]
    errors = pose_errors([found[name] for name in names], [exact[name] for name in names])
    errors[:, 2] = errors[:, 2] if placed else np.nan
    return Errors(errors, none, relative, none, none)


def truth_of(run: Path, depths: Depths, exact: Mapping[str, RelativePose], maps: Path | None) -> Floats:
    """(n,) true depths: measured, or what the same matches give under the exact poses."""
    if maps is not None:
        return measured_depths(maps, depths.frame_id, depths.ref_px)
    out, lenses = np.full(len(depths.depth), np.nan), cameras(run)
    for pair in pairs_of(run):
        rows = np.flatnonzero(depths.pair_id == pair.pair_id)
        ref, src = lenses[pair.ref].rays(depths.ref_px[rows]), lenses[pair.src].rays(depths.src_px[rows])
        out[rows] = transfer(ref[:, :2].T, src[:, :2].T, exact[pair.pair_id], VirtualView.ADAPTIVE)
    return out


def against_truth(one: Told, shared: Path, work: Path, seeds: int) -> Iterator[str]:
    """The rows of a set with exact poses: as given, then under planted errors."""
    name = one.photos.name
    maps = shared / "data" / "truth" / name / "depth" if name == "hololens" else None
    given = {mode: run for mode, (run, _) in one.runs.items()}
    exact = logged(one.photos.run)
    logs = {"poses as given": [given]}
    drawn = [planted(one.photos, work / f"{name}.in", PLANTED[name], seed) for seed in range(seeds)]
    error = PLANTED[name]
    what = f"{error.position_m * 100:g} cm, {error.gimbal_deg:g} deg planted, {seeds} draws"
    logs[what] = [{mode: run for mode, (run, _) in in_modes(some).items()} for some in drawn]
    for log, draws in logs.items():
        yield f"{name}, {log}"
        table: dict[str, list[Errors]] = {}
        for runs in draws:
            pairs = exact_poses(exact, pairs_of(runs[MODES[0]]))
            depths = {mode: Depths.of(run) for mode, run in runs.items()}
            common = np.logical_and.reduce([some.kept for some in depths.values()])
            for mode, run in runs.items():
                truth = truth_of(run, depths[mode], pairs, maps)
                table.setdefault(mode, []).append(under(pairs, run, depths[mode], truth, common))
            theirs = colmap_under(one.model, runs[MODES[0]], pairs, maps)
            if isinstance(theirs, str):
                yield f"  {COLMAP:8}{theirs}"
            else:
                table.setdefault(COLMAP, []).append(theirs)
        for mode, some in table.items():
            yield f"  {mode:8}" + _cells(Errors.together(some), len(some))


HEAD = (
    f"{'':10}{'turn deg':>9}{'dir. deg':>9}{'length':>8}{'NEES':>8}{'depths':>8}{'median':>8}{'AbsRel':>8}"
    f"{'common':>8}{'bias':>8}{'68 %':>6}{'95 %':>6}{'left':>7}"
)


def _cells(errors: Errors, draws: int) -> str:
    turn, direction, length = np.median(errors.poses, axis=0) if len(errors.poses) else (np.nan,) * 3
    nees = f"{np.median(errors.squares):8.1f}" if errors.squares.size else f"{'-':>8}"
    size, sigma = np.abs(errors.relative), errors.sigma
    out = f"{turn:9.3f}{direction:9.2f}" + (f"{length:8.2%}" if np.isfinite(length) else f"{'-':>8}") + nees
    if not size.size:
        return f"{out}{'-':>8}"
    out += f"{size.size / draws:8,.0f}{np.median(size):8.2%}{np.mean(size):8.2%}"
    out += f"{np.mean(np.abs(errors.common)):8.2%}" if errors.common.size else f"{'-':>8}"
    out += f"{np.median(errors.relative):+8.2%}"
    if sigma.size:
        within = [f"{np.mean(size <= factor * sigma):6.0%}" for factor in (1.0, 1.96)]
        out += "".join(within) + f"{unexplained(errors.relative, sigma):7.2%}"
    return out


def drone(one: Told, shared: Path) -> Iterator[str]:
    """The rows of a drone's flight of which something is known beside its log."""
    name = one.photos.name
    runs = {mode: run for mode, (run, _) in one.runs.items()}
    for variation, changed in VARIANTS[name].items():
        first = "refine" if changed == (CALIBRATED,) else "pair"
        runs[variation] = variant(one.photos, variation, first, *changed)
    model = None
    if isinstance(one.model, Model) and len(logged(one.photos.run)) >= LEAST_POSITIONS:
        model = one.model.in_metres(one.photos.run)
    return TOLD_OF[name](shared / "data" / "photos" / name, runs, model)


def costs(found: list[Told]) -> Iterator[str]:
    """What COLMAP registered, and what it took of processor time and wall time in multiples of ours."""
    yield f"{'':19}{'photos':>7}{'registered':>11}{'points':>8}{'px':>6}{'wall':>7}{'CPU':>7}"
    for one in found:
        name = f"{one.photos.name:19}{len(logged(one.photos.run)):7}"
        if isinstance(one.model, str):
            yield f"{name}  no model: {one.model}"
            continue
        model, theirs, after = one.model(), one.model.cost, one.runs["flight"][1]
        wall, cpu = theirs.wall_s / (one.cost.wall_s + after.wall_s), theirs.cpu_s / (one.cost.cpu_s + after.cpu_s)
        yield (
            f"{name}{model.num_reg_images():11}{model.num_points3D():8,}{model.compute_mean_reprojection_error():6.2f}"
            f"{wall:7.2f}{cpu:7.2f}"
        )
    yield "Ours: everything from reading the photos to depths, flight refined. Registered counts all photos."


def main(work: Path, seeds: int) -> None:
    """Runs the sets and prints the tables."""
    shared = shared_folder()
    if shared is None:
        sys.exit("no real photo sets: set EPITRANSFER_SHARED")
    work.mkdir(parents=True, exist_ok=True)
    found = []
    for one in told(shared, work):
        if isinstance(one, str):
            print(one)
        else:
            found.append(one)
    _print("Real photo sets in every mode of refinement", residuals(found))
    _print("What refine.mode = flight finds, and what it leaves", corrections(found))
    print("\nAgainst exact poses; depths against measured maps (hololens), or the same matches under exact poses")
    print(HEAD)
    for one in found:
        if one.photos.poses == EXACT:
            for line in against_truth(one, shared, work, seeds):
                print(line, flush=True)
    print(NOTES)
    for one in found:
        if one.photos.name in TOLD_OF:
            _print(one.photos.name, drone(one, shared))
    _print("COLMAP beside ours", costs(found))


def _print(title: str, rows: Iterator[str]) -> None:
    print(f"\n{title}" if title else "")
    for line in rows:
        print(line, flush=True)


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit("usage: python benchmarks/real_refined.py WORK [SEEDS]")
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) == 3 else 3)
