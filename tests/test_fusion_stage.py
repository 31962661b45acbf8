"""fuse on a small flight: one row per physical point, whatever the tiles, and an account of what was left out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pytest
from flight_truth import FlightTruth
from flights import SMALL, copied, epitransfer, outputs
from scipy.spatial import cKDTree

from pipeline.engine.tables import read_table
from pipeline.geometry.arrays import Floats
from pipeline.points.geoparquet import PointDataset, coordinates

# An edge that cuts the flight's ground into dozens of tiles.
SMALL_TILE_M = 20


def points_of(run: Path) -> pa.Table:
    return pa.concat_tables(PointDataset(run / "points").tables())


def counts_of(run: Path) -> dict[str, int]:
    facts: dict[str, int] = json.loads((run / "manifest.json").read_text())["stages"]["fuse"]["facts"]
    return facts


def sights(table: pa.Table) -> list[tuple[str, float, float]]:
    return list(zip(*(table.column(name).to_pylist() for name in ("frame_id", "u", "v")), strict=True))


def fused_again(run: Path, *settings: str, jobs: int = 1) -> pa.Table:
    done = epitransfer("fuse", run, "--jobs", jobs, *(part for item in settings for part in ("--set", item)))
    assert done.returncode == 0, done.stderr
    return points_of(run)


@pytest.fixture(scope="module")
def in_tiles(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pa.Table]:
    run = copied(small_run, tmp_path_factory.mktemp("tiles") / "run")
    return run, fused_again(run, f"fuse.tile_m={SMALL_TILE_M}")


def true_points(flight: Path, frame_id: pa.Array, pixels: Floats) -> Floats:
    """(n, 3) ENU of the site: what the pixels of the photos show; NaN where the truth is not certain."""
    truth = FlightTruth.of(flight)
    out = np.full((len(pixels), 3), np.nan)
    names = np.array(frame_id.to_pylist())
    for name in set(names):
        rows, pose = np.flatnonzero(names == name), truth.poses[name]
        depth = truth.depths(name, pixels[rows])
        out[rows] = (SMALL.rays(pixels[rows]) * depth[:, None]) @ pose.rotation.T + pose.centre
    return out


def doubles(shown: Floats, radius_m: Floats) -> float:
    """Share of points that have another within a radius of their own."""
    known = np.isfinite(shown).all(axis=1)
    distance = cKDTree(shown[known]).query(shown[known], k=2)[0][:, 1]
    return float(np.mean(distance < radius_m[known]))


def test_one_row_per_physical_point(small_flight: Path, small_run: Path) -> None:
    """By what the photos truly show: of the observations most have a twin, of the points hardly any.

    Of one leg, whose frames are paired with one another; no pair ties the legs of so short a flight.
    """
    table = points_of(small_run)
    depths = ds.dataset(small_run / "depths").to_table()
    kept = depths.filter(pc.and_(depths.column("kept"), pc.equal(depths.column("method"), "epitransfer")))
    shares, rows = [], []
    for found in (kept, table):
        of_leg = found.filter(pc.is_in(found.column("frame_id"), pa.array(["DJI_0002", "DJI_0003", "DJI_0004"])))
        rows.append(of_leg.num_rows)
        pixels = np.stack([of_leg.column(name).to_numpy().astype(float) for name in ("u", "v")], axis=1)
        half_a_pixel = 0.5 * of_leg.column("depth_m").to_numpy() / SMALL.focal_px
        shares.append(doubles(true_points(small_flight, of_leg.column("frame_id"), pixels), half_a_pixel))
    assert shares[0] > 0.6
    assert shares[1] < 0.02
    assert len(set(sights(table))) == table.num_rows
    assert 0.15 < rows[1] / rows[0] < 0.6


def test_the_account_is_whole(small_run: Path) -> None:
    table, counts = points_of(small_run), counts_of(small_run)
    depths = ds.dataset(small_run / "depths").to_table()
    kept = pc.sum(pc.and_(depths.column("kept"), pc.equal(depths.column("method"), "epitransfer"))).as_py()
    assert counts["observations"] == kept
    assert {"disagreeing", "contradictory", "isolated", "looked_through", "seen_too_seldom", "thinned"} <= counts.keys()
    pairs, frames = (table.column(name).to_numpy() for name in ("n_pairs", "n_frames"))
    assert pairs.min() == 1
    assert pairs.max() > 2
    assert np.all((frames >= 2) & (frames <= 2 * pairs) & (2 * pairs <= frames * (frames - 1)))
    assert np.sum(pairs) <= kept


def test_the_common_error_is_in_every_sigma(small_run: Path) -> None:
    """No point is surer than the position that all frames share an error of."""
    table = points_of(small_run)
    frames = read_table(small_run / "frames.parquet", "frames")
    for axis, name in zip("xyz", ("east", "north", "up"), strict=True):
        whole, own = (frames.column(f"{kind}sigma_{name}_m").to_numpy() for kind in ("", "own_"))
        assert table.column(f"sigma_{axis}_m").to_numpy().min() > np.sqrt(whole**2 - own**2).min()


def test_tiles_do_not_show_in_the_points(small_run: Path, in_tiles: tuple[Path, pa.Table]) -> None:
    run, table = in_tiles
    whole = points_of(small_run)
    assert len(list((run / "points").glob("*.parquet"))) > 10 * len(list((small_run / "points").glob("*.parquet")))
    one, other = set(sights(whole)), set(sights(table))
    # Seen from either side of a border a point of two stars may look different when its sigma exceeds the margin.
    assert table.num_rows - len(other) <= 0.001 * table.num_rows
    assert len(one ^ other) < 0.01 * len(one)
    order = {sight: i for i, sight in enumerate(sights(table))}
    both = [(i, order[sight]) for i, sight in enumerate(sights(whole)) if sight in order]
    here, there = np.array(both).T
    moved = np.linalg.norm(coordinates(whole)[here] - coordinates(table)[there], axis=1)
    assert np.mean(moved > 1e-6) < 0.01


def test_two_processes_give_the_same_tiles(small_run: Path, in_tiles: tuple[Path, pa.Table], tmp_path: Path) -> None:
    run = copied(small_run, tmp_path / "run")
    fused_again(run, f"fuse.tile_m={SMALL_TILE_M}", jobs=2)
    assert outputs(run) == outputs(in_tiles[0])


def test_points_of_too_few_pairs_are_left_out_and_cubes_keep_their_surest(small_run: Path, tmp_path: Path) -> None:
    whole = points_of(small_run)
    run = copied(small_run, tmp_path / "run")
    often = fused_again(run, "fuse.min_observations=2")
    assert sorted(sights(often)) == sorted(sights(whole.filter(pc.greater_equal(whole.column("n_pairs"), 2))))
    assert counts_of(run)["seen_too_seldom"] == whole.num_rows - often.num_rows > 0
    thin = fused_again(run, "fuse.voxel_m=2.5", "fuse.min_observations=1")
    cubes = np.floor(coordinates(thin) / 2.5)
    assert len(np.unique(cubes, axis=0)) == thin.num_rows
    assert len(np.unique(np.floor(coordinates(whole) / 2.5), axis=0)) == thin.num_rows
    assert counts_of(run)["thinned"] == whole.num_rows - thin.num_rows > 0
    assert set(sights(thin)) < set(sights(whole))


def test_tiles_that_no_cube_fits_are_refused(small_run: Path) -> None:
    done = epitransfer("fuse", small_run, "--set", "fuse.voxel_m=0.7")
    assert done.returncode == 2
    assert "multiple" in done.stderr
