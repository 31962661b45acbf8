"""The depths of a run of the example beside the ray-cast truth, per leg and method, on the same pixels.

usage: python benchmarks/example_truth.py EXAMPLE RUN

EXAMPLE is a folder that `epitransfer example` made, RUN a run of its workflow with all four methods.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
from flight_truth import LEGS, FlightTruth, configured

from pipeline.engine.tables import read_table
from pipeline.flight import PairRow, camera_by_frame, cameras_of, column, columns, selected_pairs
from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.scoring.metrics import DELTA_BASE

# Nothing farther is scored, and an unmasked depth is clipped to this.
MAX_RANGE_M, LEAST_M = 100.0, 0.1
NAMES = {
    "epitransfer-lateral": "lateral",
    "epitransfer-vertical": "vertical",
    "epitransfer": "adaptive",
    "dlt": "DLT",
}
# Methods whose kept pixels are the ones that all are compared on.
COMMON = ("epitransfer", "dlt")


@dataclass(frozen=True, slots=True)
class Scored:
    """Matches of some pairs that have a truth.

    Args:
        truth: (n,) m.
        depth: (n,) m by method; not finite where there is none.
        kept: (n,) by method.
        group: (n,) index of the match's pair.
    """

    truth: Floats
    depth: dict[str, Floats]
    kept: dict[str, Bools]
    group: Ints

    def where(self, rows: Bools) -> Scored:
        """Some of the matches."""
        return Scored(
            self.truth[rows],
            {name: values[rows] for name, values in self.depth.items()},
            {name: values[rows] for name, values in self.kept.items()},
            self.group[rows],
        )


def scored(run: Path, truth: FlightTruth, pairs: list[PairRow]) -> Scored:
    """Every match of the run whose pixel has a true depth within range.

    Raises:
        ValueError: The run lacks one of the methods.
    """
    cameras = camera_by_frame(
        read_table(run / "frames.parquet", "frames"), cameras_of(read_table(run / "cameras.parquet", "cameras"))
    )
    wanted = ["pair_id", "frame_id", "u", "v", "method", "depth_m", "kept"]
    table = ds.dataset(run / "depths", format="parquet").to_table(columns=wanted)
    parts = {name: table.filter(pc.equal(table.column("method"), name)) for name in NAMES}
    if missing := [name for name, part in parts.items() if not part.num_rows]:
        raise ValueError(f"{run} has no depths by {', '.join(missing)}: run it with depth.methods = {list(NAMES)}")
    # Each method has a row for every match, in the same order.
    first = parts["epitransfer"]
    pixels, (frames, frame_of) = columns(first, ("u", "v")), coded(first, "frame_id")
    depth = np.full(len(pixels), np.nan)
    for i, frame in enumerate(frames):
        rows = np.flatnonzero(frame_of == i)
        found = truth.depths(frame, pixels[rows])
        in_range = found * np.linalg.norm(cameras[frame].rays(pixels[rows]), axis=1) <= MAX_RANGE_M
        depth[rows] = np.where(in_range, found, np.nan)
    names, pair_of = coded(first, "pair_id")
    order = {pair.pair_id: i for i, pair in enumerate(pairs)}
    whole = Scored(
        depth,
        {name: np.asarray(column(part, "depth_m"), np.float64) for name, part in parts.items()},
        {name: column(part, "kept").astype(bool) for name, part in parts.items()},
        np.array([order[name] for name in names], np.int64)[pair_of],
    )
    return whole.where(np.isfinite(depth))


def coded(table: pa.Table, name: str) -> tuple[list[str], Ints]:
    """The different texts of a column, and which of them each row has."""
    encoded = table.column(name).combine_chunks().dictionary_encode()
    return encoded.dictionary.to_pylist(), encoded.indices.to_numpy().astype(np.int64)


def clipped(depth_m: Floats) -> Floats:
    """Depths as one would take them without a mask: what is negative or no number lies beyond infinity."""
    return np.where(np.isfinite(depth_m) & (depth_m > 0.0), np.clip(depth_m, LEAST_M, MAX_RANGE_M), MAX_RANGE_M)


def lines(title: str, pairs: int, some: Scored) -> Iterator[str]:
    """The rows of the table for some pairs."""
    common = np.logical_and.reduce([some.kept[name] for name in COMMON])
    yield f"{title}: {pairs} pairs, {len(some.truth):,} matches with a truth, {common.sum():,} kept by adaptive and DLT"
    for name, shown in NAMES.items():
        own = some.kept[name]
        bare = clipped(some.depth[name])
        cells = (
            _cells(bare[common], some.truth[common]),
            f"{np.mean(own) if len(own) else 0.0:7.1%}" + _cells(some.depth[name][own], some.truth[own]),
            _cells(bare, some.truth),
        )
        yield f"  {shown:22}" + "  |".join(cells)


def _cells(depth_m: Floats, truth_m: Floats) -> str:
    if not len(truth_m):
        return f"{'-':>9}{'-':>8}"
    ratio = depth_m / truth_m
    return f"{np.mean(np.abs(ratio - 1.0)):9.4f}{np.mean((ratio < DELTA_BASE) & (ratio > 1.0 / DELTA_BASE)):8.1%}"


def main(example: Path, run: Path) -> None:
    """Prints the table."""
    truth = FlightTruth.of(example)
    pairs = selected_pairs(read_table(run / "pairs.parquet", "pairs"))
    found = scored(run, truth, pairs)
    of_leg = {leg: np.array([truth.leg(pair.ref, pair.src) == leg for pair in pairs]) for leg in LEGS}
    near = np.array([truth.neighbours(pair.ref, pair.src) for pair in pairs])
    mode = configured(run, "refine")["mode"]
    print(f"Depths against the ray-cast truth, refine.mode = {mode}; truth within {MAX_RANGE_M:g} m, outlines left out")
    print(f"{'':24}{'on the same pixels':>17}  |{'on its own kept pixels':>24}  |{'all, unmasked':>17}")
    print(f"{'':24}{'AbsRel':>9}{'d1':>8}  |{'kept':>7}{'AbsRel':>9}{'d1':>8}  |{'AbsRel':>9}{'d1':>8}")
    groups = {
        **{f"{leg} leg, neighbours": chosen & near for leg, chosen in of_leg.items()},
        **{f"{leg} leg, all pairs": chosen for leg, chosen in of_leg.items()},
        "the whole flight": np.ones(len(pairs), bool),
    }
    for title, chosen in groups.items():
        for line in lines(title, int(chosen.sum()), found.where(chosen[found.group])):
            print(line)
    print(f"Unmasked depths, and those on the same pixels, are clipped to {MAX_RANGE_M:g} m.")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python benchmarks/example_truth.py EXAMPLE RUN")
    main(Path(sys.argv[1]), Path(sys.argv[2]))
