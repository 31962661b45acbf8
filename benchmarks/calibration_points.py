"""Covariances of the fused points against truth, over redraws of the flight's pose error.

usage: python benchmarks/calibration_points.py EXAMPLE RUN [REDRAWS] [MODE...]

RUN is a run of the example that got as far as `match`. Every redraw writes another log of the flight, with the errors
of its own and in common that the run's `frames` state, and runs the stages from `refine` to `fuse` on the matches in a
quarter of the squares of the ground. A point's true place is where the true camera of its best photo sees what that
photo shows at its pixel.
"""

from __future__ import annotations

import io
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.dataset as ds
from calibration import MODES
from example_truth import coded
from flight_truth import FlightTruth, configured, facts
from planted import planted_run
from redraws import redrawn_poses

from pipeline.engine.config import parse_overrides, resolve
from pipeline.engine.executors import executor_for, usable_cores
from pipeline.engine.runfolder import RunFolder
from pipeline.engine.tables import parquet_files, read_table, write_table
from pipeline.flight import camera_by_frame, cameras_of, column, columns, poses_of, selected_pairs
from pipeline.geodesy.crs import output_crs
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import ELLIPSOIDAL
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.points.covariances import squares
from stages.registry import MODELS
from stages.workflow import execute, kept_sections

REDRAWS, SEED = 200, 17
_SQUARE_M = 10.0
# Of a chi-square distribution with three degrees of freedom.
MEDIAN_SQUARE, BEYOND = 2.366, 25.0
_COV = ("cov_xy", "cov_xz", "cov_yz")


@dataclass(frozen=True, slots=True)
class Errors:
    """Points of one redraw beside the truth.

    Args:
        error: (n, 3) m along x, y and z.
        covariance: (n, 3, 3) m^2.
        pairs: (n,) how many pairs saw each.
    """

    error: Floats
    covariance: Floats
    pairs: Floats

    @property
    def squares(self) -> Floats:
        """(n,) in units of the covariances."""
        return squares(self.error, self.covariance)


def thinned(base: Path, truth: FlightTruth, run: Path) -> None:
    """A copy of a run with the matches of every other square of the ground, both ways."""
    shutil.copytree(base, run)
    cameras = _cameras(run)
    pairs = {pair.pair_id: pair for pair in selected_pairs(read_table(run / "pairs.parquet", "pairs"))}
    for file in parquet_files(run / "matches"):
        table = read_table(file, "matches")
        pixels, (names, of) = columns(table, ("ref_u", "ref_v")), coded(table, "pair_id")
        kept = np.zeros(len(pixels), bool)
        for i, name in enumerate(names):
            rows, ref = np.flatnonzero(of == i), pairs[name].ref
            rays = cameras[ref].rays(pixels[rows]) @ truth.poses[ref].rotation.T
            place = truth.poses[ref].centre + truth.depths(ref, pixels[rows])[:, None] * rays
            square = np.floor(np.nan_to_num(place[:, :2]) / _SQUARE_M)
            kept[rows] = np.isfinite(place[:, 0]) & np.all(square % 2.0 == 0.0, axis=1)
        write_table(file, table.filter(kept))


def _cameras(run: Path) -> dict[str, Camera]:
    frames = read_table(run / "frames.parquet", "frames")
    return camera_by_frame(frames, cameras_of(read_table(run / "cameras.parquet", "cameras")))


def errors_of(run: Path, truth: FlightTruth) -> Errors:
    """The points of a run whose best photo has a truth at their pixel."""
    names = ["x", "y", "z", "sigma_x_m", "sigma_y_m", "sigma_z_m", *_COV, "n_pairs", "frame_id", "u", "v"]
    table = ds.dataset(sorted((run / "points").glob("*.parquet")), format="parquet").to_table(columns=names)
    known, settings = facts(run, "ingest"), configured(run, "ingest")
    frame, source = LocalFrame(**known["origin"]), known["height_datum"]
    crs = output_crs(settings["crs"], frame, ELLIPSOIDAL, settings["geoid"], source_datum=source)
    cameras, pixels, (frames, of) = _cameras(run), columns(table, ("u", "v")), coded(table, "frame_id")
    true = np.full((len(of), 3), np.nan)
    for i, name in enumerate(frames):
        rows, pose = np.flatnonzero(of == i), truth.poses[name]
        rays = cameras[name].rays(pixels[rows]) @ pose.rotation.T
        true[rows] = pose.centre + truth.depths(name, pixels[rows])[:, None] * rays
    has = np.isfinite(true).all(axis=1)
    sigma = columns(table, ("sigma_x_m", "sigma_y_m", "sigma_z_m"))
    covariance = sigma[:, :, None] ** 2 * np.eye(3)
    for (i, j), values in zip(((0, 1), (0, 2), (1, 2)), columns(table, _COV).T, strict=True):
        covariance[:, i, j] = covariance[:, j, i] = values
    error = columns(table, ("x", "y", "z"))[has] - crs.from_enu(true[has])
    return Errors(error, covariance[has], np.asarray(column(table, "n_pairs"), np.float64)[has])


def redraws(base: Path, truth: FlightTruth, mode: str, seeds: Sequence[int]) -> list[Errors]:
    """The points of some redraws."""
    logged = poses_of(read_table(base / "frames.parquet", "frames"))
    sections = kept_sections(RunFolder(base))
    changed = parse_overrides([f'refine.mode="{mode}"', 'depth.methods=["epitransfer"]'], MODELS)
    configuration = resolve([("run folder", sections), ("benchmark", changed)], MODELS)
    out = []
    for seed in seeds:
        poses = redrawn_poses(truth.poses, logged, np.random.default_rng([SEED, seed]))
        with tempfile.TemporaryDirectory(prefix="redraw.") as folder:
            run = Path(folder) / "run"
            planted_run(base, poses, run)
            with redirect_stderr(io.StringIO()):
                execute(RunFolder(run), configuration, ["refine", "depth", "fuse"], jobs=1)
            out.append(errors_of(run, truth))
    return out


def lines(found: Sequence[Errors]) -> Iterator[str]:
    """The rows of a mode: all points, and those of one and of several pairs."""
    for title, least, most in (("all points", 1, np.inf), ("of one pair", 1, 1), ("of several pairs", 2, np.inf)):
        some = [np.flatnonzero((one.pairs >= least) & (one.pairs <= most)) for one in found]
        error = np.concatenate([one.error[rows] for one, rows in zip(found, some, strict=True)])
        covariance = np.concatenate([one.covariance[rows] for one, rows in zip(found, some, strict=True)])
        square = squares(error, covariance)
        within = np.abs(error) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        # Points of one redraw are wrong together: what is known of a share is what redraws differ by.
        of = np.repeat(np.arange(len(found)), [len(rows) for rows in some])
        off = np.bincount(of, np.mean(within <= 1.0, axis=1) - np.mean(within <= 1.0), len(found))
        inside = square <= BEYOND
        cells = "".join(f"{np.mean(within[:, i] <= k):8.1%}" for k in (1.0, 2.0) for i in range(3))
        rest = f"{np.mean(square[inside]):9.2f}{np.median(square):8.2f}{np.mean(~inside):9.2%}"
        size = f"{len(square) / len(found):9,.0f}{np.median(np.linalg.norm(error, axis=1)):9.3f}"
        yield f"{title:18}{size}{cells} +-{np.linalg.norm(off) / len(square):6.1%}{rest}"


def main(example: Path, run: Path, count: int, modes: Sequence[str]) -> None:
    """Prints the tables."""
    truth = FlightTruth.of(example)
    with tempfile.TemporaryDirectory(prefix="calibration_points.") as folder:
        base = Path(folder) / "base"
        thinned(run, truth, base)
        print(f"Fused points over {count} redraws of the pose error that `frames` states; of Gaussian errors 68.3 and")
        print(f"95.4 % are within one and two sigmas, and the squares' mean is 3, their median {MEDIAN_SQUARE}")
        for mode in modes:
            with executor_for(usable_cores(), None) as executor:
                parts = executor.map(partial(redraws, base, truth, mode), [[seed] for seed in range(count)])
                found = [one for part in parts for one in part]
            print(f"\nrefine.mode = {mode}")
            print(f"{'':36}{'1 sigma: x, y, z':>24}{'2 sigma':>24}{'':9}{'squares':>9}{'median':>8}{'> 5 s.':>9}")
            for line in lines(found):
                print(line)
    print("Columns: points, median distance from the truth (m), shares, and squares of errors; beyond five sigmas left")
    print("out of their mean.")


if __name__ == "__main__":
    if len(sys.argv) < 3 or not set(sys.argv[4:]) <= set(MODES):
        sys.exit(f"usage: python benchmarks/calibration_points.py EXAMPLE RUN [REDRAWS] [{' '.join(MODES)}]")
    count_of = int(sys.argv[3]) if len(sys.argv) > 3 else REDRAWS
    main(Path(sys.argv[1]), Path(sys.argv[2]), count_of, sys.argv[4:] or MODES)
