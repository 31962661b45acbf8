"""The whole path on the example's photos beside COLMAP's extract, match and triangulate with the same poses.

usage: python benchmarks/whole_path.py EXAMPLE

Both sides get two cores, the same pairs, poses, image size and number of features, and an empty folder; each is a
process of its own. COLMAP is given the poses and pairs that our side found on its way, and keeps its default
thresholds; only tracks of two views, which it would drop, are allowed.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.dataset as ds
import pycolmap
from flight_truth import FlightTruth, configured, facts
from measured import Cost, measured

from pipeline.engine.tables import read_table
from pipeline.flight import camera_by_frame, cameras_of, column, columns, poses_of
from pipeline.geodesy.crs import output_crs
from pipeline.geodesy.enu import LocalFrame
from pipeline.geometry.arrays import AnyArray, Bools, Floats
from pipeline.scoring.metrics import DELTA_BASE

THREADS = 2
MAX_RANGE_M = 100.0


@dataclass(frozen=True, slots=True)
class Observed:
    """Depths of points in photos that show them.

    Args:
        frame_id: (n,) names.
        pixels: (n, 2).
        depth_m: (n,) in that photo's camera, at the pose as logged.
        relative_sigma: (n,) predicted sigma over depth; NaN where nothing is predicted.
    """

    frame_id: AnyArray
    pixels: Floats
    depth_m: Floats
    relative_sigma: Floats

    def where(self, rows: Bools) -> Observed:
        """Some of them."""
        return Observed(self.frame_id[rows], self.pixels[rows], self.depth_m[rows], self.relative_sigma[rows])

    def surest(self, count: int) -> Observed:
        """As many, those of the smallest relative sigma."""
        last = np.sort(self.relative_sigma)[min(count, len(self.relative_sigma)) - 1]
        return self.where(self.relative_sigma <= last)


def our_points(run: Path) -> Observed:
    """The published points, each in its best view."""
    table = ds.dataset(sorted((run / "points").glob("*.parquet")), format="parquet").to_table(
        columns=["x", "y", "z", "frame_id", "u", "v"]
    )
    frames = read_table(run / "frames.parquet", "frames")
    known = facts(run, "ingest")
    datum = frames.filter(frames.column("usable")).column("height_datum")[0].as_py()
    settings = configured(run, "ingest")
    crs = output_crs(
        settings["crs"], LocalFrame(**known["origin"]), datum, settings["geoid"], source_datum=known["height_datum"]
    )
    p_in_enu_m = crs.enu_from(columns(table, ("x", "y", "z")))
    names = column(table, "frame_id")
    depth = np.empty(len(names))
    for name, pose in poses_of(frames).items():
        rows = names == name
        depth[rows] = (p_in_enu_m[rows] - pose.centre) @ pose.rotation[:, 2]
    return Observed(names, columns(table, ("u", "v")), depth, np.full(len(depth), np.nan))


def our_observations(run: Path) -> Observed:
    """The kept depths."""
    wanted = ["frame_id", "u", "v", "depth_m", "sigma_depth_m", "kept"]
    table = ds.dataset(run / "depths", format="parquet").to_table(columns=wanted)
    table = table.filter(table.column("kept"))
    depth, sigma = columns(table, ("depth_m", "sigma_depth_m")).T
    return Observed(column(table, "frame_id"), columns(table, ("u", "v")), depth, sigma / depth)


def colmap_observations(model: pycolmap.Reconstruction, run: Path) -> tuple[Observed, Bools]:
    """COLMAP's points in every photo of their tracks, and which of these is the point's nearest view."""
    frames = read_table(run / "frames.parquet", "frames")
    names = dict(zip(frames.column("image").to_pylist(), frames.column("frame_id").to_pylist(), strict=True))
    ids, pixels, depths, points = [], [], [], []
    for image in model.images.values():
        pose = image.cam_from_world().matrix()
        seen = [point for point in image.points2D if point.has_point3D()]
        xyz = np.array([model.points3D[point.point3D_id].xyz for point in seen]).reshape(-1, 3)
        ids += [names[image.name]] * len(seen)
        # Its first pixel's centre is (0.5, 0.5).
        pixels.append(np.array([point.xy for point in seen]).reshape(-1, 2) - 0.5)
        depths.append(xyz @ pose[2, :3] + pose[2, 3])
        points += [point.point3D_id for point in seen]
    depth, point = np.concatenate(depths), np.array(points)
    order = np.lexsort([depth, point])
    nearest = np.zeros(len(depth), bool)
    nearest[order[np.append(True, np.diff(point[order]) != 0)]] = True
    return Observed(np.array(ids, object), np.concatenate(pixels), depth, np.full(len(depth), np.nan)), nearest


def accuracy(found: Observed, truth: FlightTruth, run: Path) -> str:
    """Cells of the table: number, number with a truth in range, median and mean relative error, delta 1."""
    frames = read_table(run / "frames.parquet", "frames")
    cameras = camera_by_frame(frames, cameras_of(read_table(run / "cameras.parquet", "cameras")))
    true_depth = np.full(len(found.depth_m), np.nan)
    for name, camera in cameras.items():
        rows = np.flatnonzero(found.frame_id == name)
        depth = truth.depths(name, found.pixels[rows])
        in_range = depth * np.linalg.norm(camera.rays(found.pixels[rows]), axis=1) <= MAX_RANGE_M
        true_depth[rows] = np.where(in_range, depth, np.nan)
    has = np.isfinite(true_depth)
    ratio = found.depth_m[has] / true_depth[has]
    error = np.abs(ratio - 1.0)
    delta = np.mean((ratio < DELTA_BASE) & (ratio > 1.0 / DELTA_BASE))
    return f"{len(has):10,}{has.sum():12,}{np.median(error):9.4f}{np.mean(error):9.4f}{delta:8.1%}"


def costs(ours: Cost, theirs: Cost) -> Iterator[str]:
    """The rows of the first table."""
    yield f"{'':14}{'wall':>8}{'CPU':>8}{'memory':>8}"
    ratios = (theirs.wall_s / ours.wall_s, theirs.cpu_s / ours.cpu_s, theirs.memory_mib / ours.memory_mib)
    yield f"{'epitransfer':14}" + "".join(f"{1.0:8.2f}" for _ in ratios)
    yield f"{'COLMAP':14}" + "".join(f"{ratio:8.2f}" for ratio in ratios)


def main(example: Path) -> None:
    """Runs both sides and prints the tables."""
    truth = FlightTruth.of(example)
    photos = example / "photos"
    # Read once, so that neither side pays for the disk.
    size = sum(len(path.read_bytes()) for path in photos.iterdir())
    with tempfile.TemporaryDirectory(prefix="whole_path.") as folder:
        work = Path(folder)
        run, peer = work / "run", work / "colmap"
        peer.mkdir()
        command = Path(sys.executable).with_name("epitransfer")
        # COLMAP is given the poses as logged, so ours stay as logged, too; sfm.py has both sides find theirs.
        logged = ("--set", 'depth.methods=["epitransfer"]', "--set", 'refine.mode="none"')
        arguments = ("--out", run, "--to", "fuse", "--jobs", str(THREADS), *logged)
        ours = measured([command, "run", example / "workflow.toml", *arguments], work / "ours.log")
        script = Path(__file__).with_name("colmap_side.py")
        theirs = measured([sys.executable, script, run, photos, peer, str(THREADS)], work / "theirs.log")
        print(f"{len(truth.poses)} photos ({size / 2**20:.0f} MiB) to points on {THREADS} cores, one run of each side;")
        spent = f"{ours.wall_s:.0f} s, CPU {ours.cpu_s:.0f} s, {ours.memory_mib:.0f} MiB"
        print(f"COLMAP {pycolmap.__version__}; as multiples of ours ({spent})\n")
        for line in costs(ours, theirs):
            print(line)
        model = pycolmap.Reconstruction(peer / "model")
        observed, nearest = colmap_observations(model, run)
        print(
            f"\nagainst the ray-cast truth within {MAX_RANGE_M:g} m, outlines left out; poses as logged on both sides\n"
        )
        print(f"{'':28}{'number':>10}{'with truth':>12}{'median':>9}{'AbsRel':>9}{'d1':>8}")
        kept = our_observations(run)
        for name, found in (
            ("epitransfer points", our_points(run)),
            ("COLMAP points", observed.where(nearest)),
            ("epitransfer observations", kept),
            ("  as many as COLMAP's", kept.surest(len(nearest))),
            ("COLMAP observations", observed),
        ):
            print(f"{name:28}{accuracy(found, truth, run)}")
        print("As many: those with the smallest predicted sigma over depth, which COLMAP does not tell.")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python benchmarks/whole_path.py EXAMPLE")
    main(Path(sys.argv[1]))
