"""A run's LiDAR sweeps as tiles in the run's own frame: every return placed by the pose of its own instant."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, date, datetime
from pathlib import Path

import laspy
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr

from pipeline.geodesy.local_world import LocalTransform
from pipeline.geometry.arrays import Floats
from pipeline.lidar.voxels import append, by_tile, merged
from pipeline.sources.records import NS_PER_S, Nanoseconds, Sweep

PoseAt = Callable[[Nanoseconds], tuple[Floats, Floats]]
"""From (n,) instants, ns, to rotations world_from_sensor (n, 3, 3) and positions of the sensor (n, 3) m; NaN where no
pose is known."""

TILE_M = 32.0
# What is in memory at once: returns of a batch at some 150 bytes each, voxels of a tile at some 100.
_BATCH_RETURNS, _MOST_VOXELS = 1_200_000, 1_500_000
# A place further off than this is a damaged pose, not a place.
_FARTHEST_M = 1e6
_SCALE_M = 0.001
_SPILL = ".spill"


def write_sweeps(
    sweeps: Iterable[Sweep],
    pose_at: PoseAt,
    folder: Path,
    voxel_m: float = 0.05,
    max_range_m: float = 100.0,
    min_range_m: float = 0.5,
) -> int:
    """Accumulates sweeps into LAZ tiles, thinned to the mean return of each voxel; memory stays below 1 GiB.

    Args:
        sweeps: The sweeps, one at a time.
        pose_at: Where the sensor was; returns at instants without a pose are left out.
        folder: Where the tiles go; made when missing, tiles left in it by an interrupted run are replaced.
        voxel_m: Edge of a voxel, m; at least 0.5 mm, the smallest a tile can number.
        max_range_m: Returns further from the sensor are left out, m.
        min_range_m: Returns nearer to the sensor, on what carries it, are left out, m.

    Returns:
        Points written, one per voxel.

    Raises:
        ValueError: `voxel_m` is too small.
    """
    per_tile = round(TILE_M / voxel_m)
    if not 0 < per_tile <= 1 << 16:
        raise ValueError(f"voxels of {voxel_m} m cannot be numbered in tiles of {TILE_M} m")
    edge_m = per_tile * voxel_m
    spill = folder / _SPILL
    shutil.rmtree(spill, ignore_errors=True)
    spill.mkdir(parents=True)
    for old in folder.glob("*.laz"):
        old.unlink()
    first_ns: int | None = None
    tiles: set[tuple[int, int]] = set()
    for time_ns, points in _batches(sweeps, pose_at, min_range_m, max_range_m):
        first_ns = time_ns if first_ns is None else first_ns
        for tile, voxels in by_tile(points, voxel_m, per_tile):
            append(spill / _name(tile, edge_m), voxels)
            tiles.add(tile)
    day = datetime.fromtimestamp(max(first_ns or 0, 0) // NS_PER_S, UTC).date()
    written = 0
    for tile in sorted(tiles):
        corner = tile[0] * per_tile, tile[1] * per_tile
        for part, voxels in enumerate(merged(spill / _name(tile, edge_m), _MOST_VOXELS)):
            _write(folder / f"{_name(tile, edge_m, part)}.laz", voxels.means(corner, voxel_m), day)
            written += len(voxels)
    shutil.rmtree(spill)
    return written


def on_clock(pose_at: PoseAt, offset_s: float) -> PoseAt:
    """Poses at the instants of a LiDAR whose clock is another one.

    Args:
        pose_at: Where the sensor was, by the poses' clock.
        offset_s: What makes the LiDAR's times the poses', s.
    """
    offset_ns = round(offset_s * NS_PER_S)
    return lambda time_ns: pose_at(time_ns + offset_ns)


def placed(sweep: Sweep, pose_at: PoseAt, min_range_m: float, max_range_m: float) -> Floats:
    """The returns of a sweep in the run's frame, the sensor's motion during the sweep taken out.

    Args:
        sweep: The sweep.
        pose_at: Where the sensor was.
        min_range_m: Nearest return that is kept, m.
        max_range_m: Furthest return that is kept, m.

    Returns:
        (m, 3) m, all finite.
    """
    distance = np.linalg.norm(sweep.p_in_sensor_m, axis=1)
    # A comparison with NaN is false, so a return that is no number is left out.
    kept = np.flatnonzero((distance >= min_range_m) & (distance <= max_range_m) & np.isfinite(sweep.delay_s))
    instants = sweep.time_ns + np.rint(sweep.delay_s[kept] * NS_PER_S).astype(np.int64)
    rotation, position = pose_at(instants)
    points = np.einsum("nij,nj->ni", rotation, sweep.p_in_sensor_m[kept]) + position
    sound: Floats = points[np.all(np.abs(points) < _FARTHEST_M, axis=1)]
    return sound


def _batches(
    sweeps: Iterable[Sweep], pose_at: PoseAt, min_range_m: float, max_range_m: float
) -> Iterator[tuple[int, Floats]]:
    """Placed returns of many sweeps together, with the stamp of the first."""
    waiting: list[Floats] = []
    held, first_ns = 0, 0
    for sweep in sweeps:
        points = placed(sweep, pose_at, min_range_m, max_range_m)
        if not len(points):
            continue
        first_ns = first_ns if held else sweep.time_ns
        waiting.append(points)
        held += len(points)
        if held >= _BATCH_RETURNS:
            yield first_ns, np.concatenate(waiting)
            waiting, held = [], 0
    if held:
        yield first_ns, np.concatenate(waiting)


def _name(tile: tuple[int, int], edge_m: float, part: int = 0) -> str:
    """s_EAST_NORTH of the tile's lower-left corner in metres; parts after the first are numbered."""
    name = f"s_{round(tile[0] * edge_m)}_{round(tile[1] * edge_m)}"
    return f"{name}_{part}" if part else name


def _write(path: Path, points_m: Floats, day: date) -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    # The spec wants the day the file was made; a day of the data's own keeps the bytes reproducible.
    header.creation_date = day
    header.system_identifier = "MERGE"
    header.generating_software = "EpiTransfer"
    header.vlrs.append(WktCoordinateSystemVlr(LocalTransform().crs.to_wkt("WKT1_GDAL")))
    header.global_encoding.wkt = True
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.floor(points_m.min(axis=0))
    las = laspy.LasData(header)
    las.x, las.y, las.z = points_m.T
    las.return_number = np.ones(len(points_m), np.uint8)
    las.number_of_returns = np.ones(len(points_m), np.uint8)
    # One thread: the order of work must not reach the bytes.
    with path.open("wb") as file:
        las.write(file, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
