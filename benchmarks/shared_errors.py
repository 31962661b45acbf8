"""Boresight and clock as refine.mode = flight finds them, over many draws of a log in which they are planted.

usage: python benchmarks/shared_errors.py EXAMPLE RUN [SEEDS] [CASES]

RUN is a run of the example that got as far as `match`; its matches, which are not pulled towards its log, are refined
anew under every draw. What is found less what was planted, in units of the sigma that is told for it, should have mean
0, and mean square 1 where all that a log may get wrong is drawn (case g); less where less is wrong than it allows.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from flight_truth import FlightTruth
from planted import SHARED, Case, planted_errors, planted_poses
from refitted import Matches

from pipeline.engine.executors import executor_for, usable_cores
from pipeline.refinement.flight.flight import Found

SEEDS, SEED = 40, 31
_SHARD = 4


Draw = tuple[dict[str, float], tuple[Found, ...]]


def draws(matches: Matches, truth: FlightTruth, case: Case, seeds: Sequence[int]) -> list[Draw]:
    """What was planted and what is found for every seed."""
    out = []
    for seed in seeds:
        rng = np.random.default_rng([SEED, ord(case.name), seed])
        shared = planted_errors(case, rng)
        poses = planted_poses(truth.poses, matches.log.time_s, case, shared, rng)
        out.append((shared, matches.refitted(poses, "flight").found))
    return out


def lines(case: Case, done: Sequence[Draw]) -> Iterator[str]:
    """The rows of a case."""
    for several in zip(*(found for _, found in done), strict=True):
        name = several[0].name
        planted = np.array([shared.get(name, 0.0) for shared, _ in done])
        # A correction undoes what was planted.
        off = np.array([-one.value for one in several]) - planted
        sigma = np.array([one.sigma for one in several])
        unit = np.degrees(1.0) if name.endswith("_rad") else 1.0
        shown = name.replace("_rad", "_deg")
        z = off / sigma
        said = f"{planted[0] * unit:9.3f}" if np.ptp(planted) == 0.0 else f"{'drawn':>9}"
        cells = f"{said}{np.mean(off) * unit:+11.4f}{np.std(off) * unit:9.4f}"
        told = f"{np.median(sigma) * unit:9.4f}{several[0].prior_sigma * unit:9.3f}"
        yield f"{case.name}  {shown:22}{cells}{told}{np.mean(z):+9.2f}{np.mean(z**2):9.2f}{np.max(np.abs(z)):9.2f}"


def main(example: Path, run: Path, seeds: int, wanted: str) -> None:
    """Prints the table."""
    cases = [case for case in SHARED if case.name in wanted]
    truth, matches = FlightTruth.of(example), Matches.of(run)
    print(f"Shared errors over {seeds} draws of a log, each refined as a whole on the matches of one run\n")
    heads = ("planted", "off: mean", "spread", "sigma", "allowed", "mean", "square", "largest")
    widths = (9, 11, 9, 9, 9, 9, 9, 9)
    print(f"{'':25}" + "".join(f"{head:>{width}}" for head, width in zip(heads, widths, strict=True)))
    with executor_for(usable_cores(), None) as executor:
        for case in cases:
            shards = [range(start, min(start + _SHARD, seeds)) for start in range(0, seeds, _SHARD)]
            parts = executor.map(partial(draws, matches, truth, case), shards)
            for line in lines(case, [one for part in parts for one in part]):
                print(line)
    for case in cases:
        print(f"{case.name}: {case.title}")
    print(f"The last three columns are in sigmas; a mean should be 0 +- {seeds**-0.5:.2f},", end=" ")
    print(f"a square 1 +- {(2.0 / seeds) ** 0.5:.2f}.")


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 5:
        sys.exit("usage: python benchmarks/shared_errors.py EXAMPLE RUN [SEEDS] [CASES]")
    count = int(sys.argv[3]) if len(sys.argv) > 3 else SEEDS
    main(Path(sys.argv[1]), Path(sys.argv[2]), count, sys.argv[4] if len(sys.argv) > 4 else "efg")
