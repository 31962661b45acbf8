"""Observations of points: kept depths as points in the output CRS, spilled by tile, then merged tile by tile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import feather

from pipeline.flight import PairRow, column, columns
from pipeline.geodesy.transform import FrameTransform
from pipeline.geometry.arrays import AnyArray, Bytes, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Pose
from pipeline.matching.images import read_colour
from pipeline.points.geoparquet import tile_table
from pipeline.points.merge import merge_voxels
from pipeline.points.tiles import split, tile_corners, tile_order
from pipeline.points.world import Shot, world_points

_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, slots=True)
class Scene:
    """What observations are made with.

    Args:
        images: Path or URL of each frame's image.
        times: Exposure of each frame, ns since 1970 UTC, or None.
        cameras: Camera of each frame.
        poses: Pose of each frame.
        pairs: The pairs by name.
        transform: From ENU to the output CRS.
        method: The method whose points are published.
    """

    images: Mapping[str, str]
    times: Mapping[str, int | None]
    cameras: Mapping[str, Camera]
    poses: Mapping[str, Pose]
    pairs: Mapping[str, PairRow]
    transform: FrameTransform
    method: str


def observations(scene: Scene, depths: pa.Table) -> pa.Table:
    """The kept depths of the published method as points in the output CRS.

    Args:
        scene: What they are made with.
        depths: Rows of `depths`; those of one ref frame side by side, so that its image is decoded once.

    Returns:
        pair_id, frame_id, u, v, depth_m, parallax_deg, xyz (3), own (6), common (6), rgb (3).

    Raises:
        InputError: An image cannot be read.
    """
    kept = depths.filter(pc.and_(depths.column("kept"), pc.equal(depths.column("method"), scene.method)))
    ids = column(kept, "pair_id")
    tables = []
    shown, picture = "", np.empty((0, 0, 3), np.uint8)
    for pair_id in dict.fromkeys(ids):
        rows = kept.filter(ids == pair_id)
        pair = scene.pairs[pair_id]
        if pair.ref != shown:
            shown, picture = pair.ref, read_colour(scene.images[pair.ref])
        tables.append(_of_pair(scene, pair, rows, picture))
    return pa.concat_tables(tables) if tables else pa.table({})


def _of_pair(scene: Scene, pair: PairRow, rows: pa.Table, picture: Bytes) -> pa.Table:
    pixels, depth = columns(rows, ("u", "v")), np.asarray(column(rows, "depth_m"), np.float64)
    normal = columns(rows, ("normal_x", "normal_y", "normal_z"))
    pixel_sigma = np.asarray(column(rows, "sigma_pixel_m"), np.float64)
    ref, src = (Shot(scene.cameras[frame], scene.poses[frame]) for frame in (pair.ref, pair.src))
    points = world_points(pixels, depth, normal, pixel_sigma, ref, src)
    # Convergence and scale hardly change over one frame's view: the Jacobian at its camera serves all its points.
    jacobian = scene.transform.jacobian(ref.pose.centre)
    own, common = (jacobian @ part @ jacobian.T for part in (points.own, points.common))
    height, width = picture.shape[:2]
    at = np.clip(np.round(pixels).astype(np.int64), 0, (width - 1, height - 1))
    table = rows.select(["pair_id", "frame_id", "u", "v", "depth_m", "parallax_deg"])
    for name, values in (
        ("xyz", scene.transform.from_enu(points.p_in_enu_m)),
        ("own", _packed(own)),
        ("common", _packed(common)),
        ("rgb", picture[at[:, 1], at[:, 0]]),
    ):
        width = values.shape[1]
        flat = pa.array(np.ascontiguousarray(values).reshape(-1))
        table = table.append_column(name, pa.FixedSizeListArray.from_arrays(flat, width))
    return table.replace_schema_metadata(None)


def spill(table: pa.Table, folder: Path, name: str, tile_m: int) -> None:
    """Writes observations to one file per tile: FOLDER/TILE/NAME."""
    if not table.num_rows:
        return
    for tile, rows in split(_matrix(table, "xyz"), tile_m):
        place = folder / tile / name
        place.parent.mkdir(parents=True, exist_ok=True)
        temporary = place.with_suffix(".tmp")
        feather.write_feather(table.take(rows), temporary, compression="uncompressed")
        temporary.replace(place)


def fused_tile(scene: Scene, folder: Path, voxel_m: float, min_observations: int, tile_m: int) -> pa.Table:
    """Merges the spilled observations of one tile.

    Args:
        scene: What they were made with.
        folder: The tile's spilled files; its name is the tile's.
        voxel_m: Edge of a voxel.
        min_observations: Least number of pairs that saw a point.
        tile_m: Edge of a tile.

    Returns:
        Rows of `points` along the tile's Hilbert curve.
    """
    table = pa.concat_tables([feather.read_table(file) for file in sorted(folder.glob("*.arrow"))])
    xyz = _matrix(table, "xyz")
    ids, pair = np.unique(column(table, "pair_id"), return_inverse=True)
    of_id = [(scene.pairs[name].ref, scene.pairs[name].src) for name in ids]
    frames = np.unique(np.array(of_id), return_inverse=True)[1].reshape(-1, 2)[pair]
    merged = merge_voxels(
        xyz, _unpacked(_matrix(table, "own")), _unpacked(_matrix(table, "common")), pair, frames, voxel_m
    )
    rows = np.flatnonzero(merged.n_pairs >= min_observations)
    corner = tile_corners(xyz[:1], tile_m)[0]
    rows = rows[tile_order(merged.xyz[rows], corner, tile_m)]
    best = table.take(merged.best[rows])
    covariance = merged.covariance[rows]
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).astype(np.float32)
    rgb = _matrix(best, "rgb")
    cov = covariance.astype(np.float32)
    times = [scene.times[frame] for frame in best.column("frame_id").to_pylist()]
    return tile_table(
        {
            **{axis: merged.xyz[rows, i] for i, axis in enumerate("xyz")},
            **{f"sigma_{axis}_m": sigma[:, i] for i, axis in enumerate("xyz")},
            "cov_xy": cov[:, 0, 1],
            "cov_xz": cov[:, 0, 2],
            "cov_yz": cov[:, 1, 2],
            "n_pairs": merged.n_pairs[rows],
            "frame_id": best.column("frame_id"),
            **{name: column(best, name).astype(np.float32) for name in ("u", "v", "depth_m", "parallax_deg")},
            **{name: rgb[:, i] for i, name in enumerate(("red", "green", "blue"))},
            "time": pa.array(times, pa.timestamp("ns", tz="UTC")),
        },
        folder.name,
    )


def _matrix(table: pa.Table, name: str) -> AnyArray:
    chunk = table.column(name).combine_chunks()
    values: AnyArray = chunk.flatten().to_numpy(zero_copy_only=False)
    return values.reshape(table.num_rows, -1)


def _packed(covariance: Floats) -> Floats:
    return np.stack([covariance[:, i, j] for i, j in _UPPER], axis=1)


def _unpacked(values: Floats) -> Floats:
    out = np.empty((len(values), 3, 3))
    for k, (i, j) in enumerate(_UPPER):
        out[:, i, j] = out[:, j, i] = values[:, k]
    return out
