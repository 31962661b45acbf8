"""The example flight from bare photos and every kind of log: exposures against the truth, points against DJI's stills.

    python benchmarks/logs_truth.py EXAMPLE RUN RUNS

EXAMPLE is the folder of `epitransfer example`, RUN a finished run of its workflow.toml (DJI stills), RUNS a folder for
the runs from logs, which are made here where they are not there yet.
"""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.engine.tables import read_table
from pipeline.flight import camera_by_frame, cameras_of, columns, placements_of
from pipeline.geodesy.enu import LocalFrame
from pipeline.geometry.arrays import Floats
from pipeline.simulation.bare import FORMS

METHOD = "epitransfer"


def main() -> None:
    """Prints a line per kind of log."""
    example, stills, runs = (Path(argument) for argument in sys.argv[1:4])
    truth = true_times(example)
    reference = observed(stills)
    print("log          placed   exposure error   observations   points from those of the stills (median, 95 %)")
    for form in FORMS:
        run = runs / form.key
        made(example / form.workflow, run)
        frames = read_table(run / "frames.parquet", "frames")
        late_s = time_errors(frames, truth)
        apart = distances(reference, observed(run))
        usable = sum(frames.column("usable").to_pylist())
        print(
            f"{form.key:<10} {usable:3d} of {frames.num_rows:<3d} {1e3 * late_s.max():9.3f} ms max {len(apart):12d}"
            f"   {100 * np.median(apart):9.2f} cm {100 * np.quantile(apart, 0.95):9.2f} cm"
        )


def made(workflow: Path, run: Path) -> None:
    """Runs a workflow; what is up to date is skipped."""
    command = [sys.executable, "-c", "from stages.app import main; main()", "run", str(workflow), "--out", str(run)]
    subprocess.run([*command, "--to", "fuse"], check=True, capture_output=True)


def true_times(example: Path) -> dict[str, datetime]:
    """The true exposure of every frame."""
    with (example / "truth" / "poses.csv").open(newline="") as stream:
        return {row["frame_id"]: datetime.fromisoformat(row["time"]) for row in csv.DictReader(stream)}


def time_errors(frames: pa.Table, truth: dict[str, datetime]) -> Floats:
    """|exposure as placed - truth| of the usable frames, s."""
    rows = frames.filter(frames.column("usable")).select(["frame_id", "time"]).to_pylist()
    return np.array([abs((row["time"].to_pydatetime() - truth[row["frame_id"]]).total_seconds()) for row in rows])


def observed(run: Path) -> dict[tuple[str, float, float], Floats]:
    """The kept observations of a run as earth-centred points, by pair and pixel."""
    frames = read_table(run / "frames.parquet", "frames")
    record = json.loads((run / ".stages" / "ingest.json").read_text())
    origin = LocalFrame(**record["facts"]["origin"])
    poses = placements_of(read_table(run / "poses.parquet", "poses"))
    cameras = camera_by_frame(frames, cameras_of(read_table(run / "cameras.parquet", "cameras")))
    depths = read_table(run / "depths", "depths")
    kept = np.array(depths.column("kept").to_pylist()) & (np.array(depths.column("method").to_pylist()) == METHOD)
    depths = depths.filter(pa.array(kept))
    pairs, ids = depths.column("pair_id").to_pylist(), np.array(depths.column("frame_id").to_pylist())
    pixels, depth_m = columns(depths, ("u", "v")), columns(depths, ("depth_m",))
    points = np.empty((len(ids), 3))
    for frame_id in np.unique(ids):
        rows = ids == frame_id
        in_cam = cameras[frame_id].rays(pixels[rows]) * depth_m[rows]
        points[rows] = origin.ecef_from_enu(poses[frame_id].centre + in_cam @ poses[frame_id].rotation.T)
    return {
        (pair, round(u, 3), round(v, 3)): point
        for pair, (u, v), point in zip(pairs, pixels.tolist(), points, strict=True)
    }


def distances(one: dict[tuple[str, float, float], Floats], other: dict[tuple[str, float, float], Floats]) -> Floats:
    """Between the points of observations that both runs have, m."""
    return np.array([np.linalg.norm(one[key] - other[key]) for key in one.keys() & other.keys()])


if __name__ == "__main__":
    main()
