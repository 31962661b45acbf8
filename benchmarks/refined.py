"""Depths, points and shared errors after refinement, on the example's photos matched anew under logs with known errors.

usage: python benchmarks/refined.py EXAMPLE WORK [CASES]

EXAMPLE is a folder that `epitransfer example` made, WORK an empty or absent folder, CASES some of the letters abcdefg.
Every case is one seeded draw about the true poses; its `frames` state exactly the sigmas that it was drawn with. Pairs
are chosen and photos matched under that log, then refined in every mode.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.dataset as ds
from example_truth import MAX_RANGE_M, clipped, coded
from flight_truth import LEGS, FlightTruth, configured, facts
from planted import CASES, CLOCK, YAW, Case, planted_errors, planted_poses, planted_run
from redraws import squares_of, times_of

from pipeline.engine.executors import usable_cores
from pipeline.engine.tables import read_table
from pipeline.flight import (
    PairRow,
    camera_by_frame,
    cameras_of,
    column,
    columns,
    placements_of,
    relative_poses_of,
    selected_pairs,
)
from pipeline.geodesy.crs import output_crs
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import ELLIPSOIDAL
from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.transfer import VirtualView, transfer
from stages.app import run as epitransfer

MODES = ("none", "pair", "flight")
SEED = 23
ADAPTIVE, EQUAL, DLT = "adaptive", "n*", "DLT"
GROUPS = (*(f"{leg} leg, neighbours" for leg in LEGS), "all pairs")


@dataclass(frozen=True, slots=True)
class Found:
    """The depths of a run that have a truth in range.

    Args:
        truth: (n,) m.
        depth: (n,) m by method; n* is the adaptive view with equal noise in all directions.
        kept: (n,) by method, ADAPTIVE and DLT.
        group: (n,) by name.
    """

    truth: Floats
    depth: dict[str, Floats]
    kept: dict[str, Bools]
    group: dict[str, Bools]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one mode made of one case.

    Args:
        case: The case.
        mode: The mode.
        depths: Of the run.
        points: (n,) relative errors of the fused points, in the photo that shows them best.
        off_m: (n,) m from the true place of what that photo shows.
        nees: (p,) squares of the pairs' relative pose errors in units of their covariances; 6 is to be expected.
        facts: Of the stage `refine`.
        planted: What all frames get wrong alike, by name.
    """

    case: Case
    mode: str
    depths: Found
    points: Floats
    off_m: Floats
    nees: Floats
    facts: dict[str, Any]
    planted: dict[str, float]


def command(*arguments: str | Path) -> None:
    """Runs the command line in this process.

    Raises:
        RuntimeError: It ended with an error, which it has told.
    """
    code = epitransfer([*map(str, arguments), "--jobs", str(usable_cores())])
    if code:
        raise RuntimeError(f"epitransfer {' '.join(map(str, arguments))} ended with {code}")


def depths_of(run: Path, truth: FlightTruth) -> Found:
    """Depths by all methods beside their truth."""
    frames = read_table(run / "frames.parquet", "frames")
    cameras = camera_by_frame(frames, cameras_of(read_table(run / "cameras.parquet", "cameras")))
    wanted = ["pair_id", "u", "v", "src_u", "src_v", "method", "depth_m", "kept"]
    table = ds.dataset(run / "depths", format="parquet").to_table(columns=wanted)
    first, other = (table.filter(pc.equal(table.column("method"), name)) for name in ("epitransfer", "dlt"))
    pairs = {pair.pair_id: pair for pair in selected_pairs(read_table(run / "pairs.parquet", "pairs"))}
    poses = relative_poses_of(read_table(run / "relative_poses.parquet", "relative_poses"))
    ref_px, src_px = columns(first, ("u", "v")), columns(first, ("src_u", "src_v"))
    names, pair_of = coded(first, "pair_id")
    true_depth, equal = np.full(len(ref_px), np.nan), np.empty(len(ref_px))
    for i, name in enumerate(names):
        rows = np.flatnonzero(pair_of == i)
        ref, src = cameras[pairs[name].ref].rays(ref_px[rows]), cameras[pairs[name].src].rays(src_px[rows])
        equal[rows] = transfer(ref[:, :2].T, src[:, :2].T, poses[name], VirtualView.ADAPTIVE)
        depth = truth.depths(pairs[name].ref, ref_px[rows])
        true_depth[rows] = np.where(depth * np.linalg.norm(ref, axis=1) <= MAX_RANGE_M, depth, np.nan)
    has = np.isfinite(true_depth)
    depth = {ADAPTIVE: column(first, "depth_m"), EQUAL: equal, DLT: column(other, "depth_m")}
    return Found(
        true_depth[has],
        {name: np.asarray(values, np.float64)[has] for name, values in depth.items()},
        {name: column(part, "kept").astype(bool)[has] for name, part in ((ADAPTIVE, first), (DLT, other))},
        {name: chosen[pair_of[has]] for name, chosen in _groups(truth, [pairs[name] for name in names]).items()},
    )


def _groups(truth: FlightTruth, pairs: Sequence[PairRow]) -> dict[str, Bools]:
    leg = np.array([truth.leg(pair.ref, pair.src) for pair in pairs])
    near = np.array([truth.neighbours(pair.ref, pair.src) for pair in pairs])
    chosen = [*((leg == name) & near for name in LEGS), np.ones(len(pairs), bool)]
    return dict(zip(GROUPS, chosen, strict=True))


def points_of(run: Path, truth: FlightTruth) -> tuple[Floats, Floats]:
    """Errors of the fused points, each in its best photo.

    Returns:
        (n,) relative error of the depth under the photo's refined pose, and (n,) m from the true place.
    """
    wanted = ["x", "y", "z", "frame_id", "u", "v"]
    table = ds.dataset(sorted((run / "points").glob("*.parquet")), format="parquet").to_table(columns=wanted)
    known, settings = facts(run, "ingest"), configured(run, "ingest")
    crs = output_crs(
        settings["crs"],
        LocalFrame(**known["origin"]),
        ELLIPSOIDAL,
        settings["geoid"],
        source_datum=known["height_datum"],
    )
    p_in_enu_m = crs.enu_from(columns(table, ("x", "y", "z")))
    frames = read_table(run / "frames.parquet", "frames")
    cameras = camera_by_frame(frames, cameras_of(read_table(run / "cameras.parquet", "cameras")))
    placed = placements_of(read_table(run / "poses.parquet", "poses"))
    pixels, (names, of) = columns(table, ("u", "v")), coded(table, "frame_id")
    relative, off = np.full(len(of), np.nan), np.full(len(of), np.nan)
    for i, name in enumerate(names):
        rows = np.flatnonzero(of == i)
        rays, true = cameras[name].rays(pixels[rows]), truth.poses[name]
        depth = truth.depths(name, pixels[rows])
        depth = np.where(depth * np.linalg.norm(rays, axis=1) <= MAX_RANGE_M, depth, np.nan)
        found = (p_in_enu_m[rows] - placed[name].centre) @ placed[name].rotation[:, 2]
        relative[rows] = np.abs(found / depth - 1.0)
        off[rows] = np.linalg.norm(p_in_enu_m[rows] - true.centre - (depth[:, None] * rays) @ true.rotation.T, axis=1)
    has = np.isfinite(relative)
    return relative[has], off[has]


def pose_nees(run: Path, truth: FlightTruth) -> Floats:
    """(p,) squares of the errors of all pairs' relative poses in units of their covariances."""
    poses = relative_poses_of(read_table(run / "relative_poses.parquet", "relative_poses"))
    pairs = selected_pairs(read_table(run / "pairs.parquet", "pairs"))
    return np.array([squares_of(poses[pair.pair_id], truth, pair)[0] for pair in pairs])


def outcomes(base: Path, case: Case, truth: FlightTruth, run: Path) -> Iterator[Outcome]:
    """Plants a case, and runs it in every mode."""
    rng = np.random.default_rng([SEED, ord(case.name)])
    shared = planted_errors(case, rng)
    planted_run(base, planted_poses(truth.poses, times_of(base), case, shared, rng), run)
    for mode in MODES:
        first = "pair" if mode == MODES[0] else "refine"
        changed = ("--set", f'refine.mode="{mode}"', "--set", 'depth.methods=["epitransfer", "dlt"]')
        command("run", run / "workflow.toml", "--out", run, "--from", first, "--to", "fuse", *changed)
        yield Outcome(
            case,
            mode,
            depths_of(run, truth),
            *points_of(run, truth),
            pose_nees(run, truth),
            facts(run, "refine"),
            shared,
        )


def _error(depth_m: Floats, truth_m: Floats) -> str:
    if not len(truth_m):
        return f"{'-':>9}"
    return f"{np.mean(np.abs(depth_m / truth_m - 1.0)):9.4f}"


def accuracy(found: Sequence[Outcome]) -> Iterator[str]:
    """Every case, group and mode: what is kept of all matches with a truth, and its mean relative error."""
    yield f"{'':34}" + "".join(f"{mode:>34}" for mode in MODES)
    yield f"{'':34}" + f"{'kept':>9}{'AbsRel':>9}{'DLT kept':>9}{'DLT':>7}" * len(MODES)
    for of_case in by_case(found):
        yield f"{of_case[0].case.name}: {of_case[0].case.title}"
        for group in GROUPS:
            line = f"  {group:26}{int(of_case[0].depths.group[group].sum()):6,}"
            for outcome in of_case:
                some = outcome.depths
                for name in (ADAPTIVE, DLT):
                    chosen = some.group[group]
                    kept = chosen & some.kept[name]
                    share = kept.sum() / max(chosen.sum(), 1)
                    line += (
                        f"{share:9.1%}" + _error(some.depth[name][kept], some.truth[kept])[1 if name == DLT else 0 :]
                    )
            yield line
        yield f"  {'fused points':32}" + "".join(_of_points(outcome) for outcome in of_case)


def _of_points(outcome: Outcome) -> str:
    points = outcome.points
    return f"{len(points):9,}{np.mean(points):9.4f}{'':3}off{np.median(outcome.off_m):8.2f} m"


def by_case(found: Sequence[Outcome]) -> Iterator[list[Outcome]]:
    """The outcomes of each case."""
    for name in dict.fromkeys(outcome.case.name for outcome in found):
        yield [outcome for outcome in found if outcome.case.name == name]


def gains(found: Sequence[Outcome]) -> Iterator[str]:
    """What the plane chosen by covariance gains where no refinement helps, on the same pixels."""
    yield f"{'':29}{'kept by adaptive and DLT':>27}{'':3}{'all, unmasked':>27}"
    yield f"{'':29}" + 2 * ("".join(f"{name:>9}" for name in (ADAPTIVE, EQUAL, DLT)) + "   ")
    for outcome in found:
        some = outcome.depths
        for group in GROUPS if outcome.mode == "none" else ():
            chosen = some.group[group]
            line = f"{outcome.case.name}  {group:26}"
            for rows in (chosen & some.kept[ADAPTIVE] & some.kept[DLT], chosen):
                line += (
                    "".join(_error(clipped(some.depth[name][rows]), some.truth[rows]) for name in some.depth) + "   "
                )
            yield line


def poses(found: Sequence[Outcome]) -> Iterator[str]:
    """Residuals before and after, pairs refined, and the pose errors in units of their covariances."""
    heads = ("px before", "px after", "refined", "NEES mean", "median")
    yield f"{'':10}" + "".join(f"{head:>11}" for head in heads)
    for outcome in found:
        known = outcome.facts
        px = (known["median_epipolar_residual_px"], known["median_epipolar_residual_after_px"])
        cells = "".join(f"{value:11.3f}" for value in px) + f"{known['share_of_pairs_refined']:11.0%}"
        yield f"{outcome.case.name} {outcome.mode:8}{cells}{np.mean(outcome.nees):11.2f}{np.median(outcome.nees):11.2f}"
    yield "NEES is of the relative pose of all pairs; 6 is to be expected, a median of 5.3."


def shared(found: Sequence[Outcome]) -> Iterator[str]:
    """The shared errors that the mode flight tells, beside what was planted."""
    yield f"{'':4}{'':18}{'planted':>10}{'found':>22}{'allowed':>10}{'off':>12}"
    for outcome in found:
        if outcome.mode != "flight":
            continue
        for name, figures in outcome.facts["shared_errors"].items():
            known = outcome.planted
            planted = {"boresight yaw": np.degrees(known[YAW]), "clock": known[CLOCK]}.get(
                name, known.get(f"{name.replace('lever arm ', 'lever_')}_m", 0.0)
            )
            # A correction undoes what was planted.
            value, sigma = -figures["correction"], figures["sigma"]
            said = f"{value:+10.4f} +- {sigma:.4f} {figures['unit']}"
            off = f"{(value - planted) / sigma:+6.2f} sigma"
            yield f"{outcome.case.name:4}{name:18}{planted:10.2f}{said:>22}{figures['prior_sigma']:10.3f}{off:>12}"


def main(example: Path, work: Path, wanted: str) -> None:
    """Runs the cases and prints the tables."""
    truth = FlightTruth.of(example)
    base = work / "base"
    command("run", example / "workflow.toml", "--out", base, "--to", "match")
    found = [
        outcome
        for case in CASES
        if case.name in wanted
        for outcome in outcomes(base, case, truth, work / f"case_{case.name}")
    ]
    print(f"Kept depths with a truth within {MAX_RANGE_M:g} m, adaptive view and DLT, after refine.mode\n")
    for title, rows in (
        ("", accuracy(found)),
        ("Without refinement, on the same pixels", gains(found)),
        ("Relative poses", poses(found)),
        ("Shared errors that refine.mode = flight tells", shared(found)),
    ):
        print(f"\n{title}" if title else "")
        for line in rows:
            print(line)


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit("usage: python benchmarks/refined.py EXAMPLE WORK [CASES]")
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] if len(sys.argv) == 4 else "abcdef")
