"""Boresight and clock as refine.mode = flight finds them, over many draws of a log in which they are planted.

usage: python benchmarks/shared_errors.py EXAMPLE RUN [SEEDS]

RUN is a run of the example that got as far as `match`; its matches, which are not pulled towards its log, are refined
anew under every draw. What is found less what was planted, in units of the sigma that is told for it, should have mean
0 and mean square 1.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from flight_truth import FlightTruth
from planted import SHARED, Case, planted_poses
from refitted import Matches

from pipeline.engine.executors import executor_for, usable_cores
from pipeline.refinement.flight.flight import Found

SEEDS, SEED = 40, 31
_SHARD = 4


def shared_found(matches: Matches, truth: FlightTruth, case: Case, seeds: Sequence[int]) -> list[tuple[Found, ...]]:
    """What is found for every seed."""
    out = []
    for seed in seeds:
        rng = np.random.default_rng([SEED, ord(case.name), seed])
        out.append(matches.refitted(planted_poses(truth.poses, matches.log.time_s, case, rng), "flight").found)
    return out


def lines(case: Case, found: Sequence[tuple[Found, ...]]) -> Iterator[str]:
    """The rows of a case."""
    planted = {"boresight_yaw_rad": np.radians(case.boresight_yaw_deg), "clock_s": case.clock_s}
    for several in zip(*found, strict=True):
        name = several[0].name
        # A correction undoes what was planted.
        off = np.array([-one.value - planted.get(name, 0.0) for one in several])
        sigma = np.array([one.sigma for one in several])
        unit = np.degrees(1.0) if name.endswith("_rad") else 1.0
        shown = name.replace("_rad", "_deg")
        z = off / sigma
        cells = f"{planted.get(name, 0.0) * unit:9.3f}{np.mean(off) * unit:+11.4f}{np.std(off) * unit:9.4f}"
        told = f"{np.median(sigma) * unit:9.4f}{several[0].prior_sigma * unit:9.3f}"
        yield f"{case.name}  {shown:22}{cells}{told}{np.mean(z):+9.2f}{np.mean(z**2):9.2f}{np.max(np.abs(z)):9.2f}"


def main(example: Path, run: Path, seeds: int) -> None:
    """Prints the table."""
    truth, matches = FlightTruth.of(example), Matches.of(run)
    print(f"Shared errors over {seeds} draws of a log, each refined as a whole on the matches of one run\n")
    heads = ("planted", "off: mean", "spread", "sigma", "allowed", "mean", "square", "largest")
    widths = (9, 11, 9, 9, 9, 9, 9, 9)
    print(f"{'':25}" + "".join(f"{head:>{width}}" for head, width in zip(heads, widths, strict=True)))
    with executor_for(usable_cores(), None) as executor:
        for case in SHARED:
            shards = [range(start, min(start + _SHARD, seeds)) for start in range(0, seeds, _SHARD)]
            parts = executor.map(partial(shared_found, matches, truth, case), shards)
            for line in lines(case, [one for part in parts for one in part]):
                print(line)
    for case in SHARED:
        print(f"{case.name}: {case.title}")
    print(f"The last three columns are in sigmas; a mean should be 0 +- {seeds**-0.5:.2f},", end=" ")
    print(f"a square 1 +- {(2.0 / seeds) ** 0.5:.2f}.")


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit("usage: python benchmarks/shared_errors.py EXAMPLE RUN [SEEDS]")
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) == 4 else SEEDS)
