"""One tile's points: its observations joined to tracks, merged, and what cannot be true left out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import feather

from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints
from pipeline.points.covariances import whole
from pipeline.points.geoparquet import tile_table
from pipeline.points.merge import Merged, agreed, merge, surest_of_pairs
from pipeline.points.observations import Scene
from pipeline.points.observed import Observed
from pipeline.points.tiles import tile_corner, tile_corners, tile_order
from pipeline.points.tracks import tracks


@dataclass(frozen=True, slots=True)
class Limits:
    """What is fused to what.

    Args:
        min_observations: Least number of pairs that saw a point.
        voxel_m: Edge of the cubes of which only the surest point is kept, m; 0 keeps all.
        tile_m: Edge of a tile, m.
    """

    min_observations: int
    voxel_m: float
    tile_m: int


@dataclass(frozen=True, slots=True)
class Counts:
    """What became of the observations, each thing counted in the tile that it lies in.

    Args:
        observations: Kept depths.
        disagreeing: Observations that their track's surest one contradicts.
        contradictory: Tracks without a majority that agrees.
        seen_too_seldom: Points of fewer pairs than asked for.
        thinned: Points that are not the surest of their cube.
    """

    observations: int = 0
    disagreeing: int = 0
    contradictory: int = 0
    seen_too_seldom: int = 0
    thinned: int = 0

    @classmethod
    def sum(cls, parts: Iterable[Counts]) -> Counts:
        """The counts of several tiles together."""
        return cls(*(sum(numbers) for numbers in zip(astuple(cls()), *map(astuple, parts), strict=True)))


def fused_tile(scene: Scene, folder: Path, limits: Limits) -> tuple[pa.Table, Counts]:
    """Fuses the spilled observations of one tile and its surroundings.

    Args:
        scene: What they were made with.
        folder: The tile's spilled files; its name is the tile's.
        limits: What is asked for.

    Returns:
        Rows of `points` in the tile, along its Hilbert curve, and what was left out.
    """
    corner = tile_corner(folder.name)
    table = pa.concat_tables([feather.read_table(file) for file in sorted(folder.glob("*.arrow"))])
    observed = Observed.of(table)

    def here(xyz: Floats) -> Bools:
        inside: Bools = (tile_corners(xyz, limits.tile_m) == corner).all(axis=1)
        return inside

    own = whole(observed, scene.errors)
    track = tracks(observed, own, scene.errors)
    observed, own, track = _some(observed, own, track, surest_of_pairs(observed, track))
    agree, sound = agreed(observed, track, own, scene.errors)
    inside = here(observed.xyz)
    best_of_unsound = np.flatnonzero(~sound[track] & inside)
    counts = {
        "observations": int(inside.sum()),
        "disagreeing": int((~agree & sound[track] & inside).sum()),
        "contradictory": len(np.unique(track[best_of_unsound])),
    }
    observed, own, track = _some(observed, own, track, agree & sound[track])
    merged = merge(observed, track, own, scene.errors)
    kept = here(merged.xyz)
    often = merged.n_pairs >= limits.min_observations
    counts["seen_too_seldom"] = int((kept & ~often).sum())
    rows = np.flatnonzero(kept & often)
    if limits.voxel_m > 0.0:
        surest = surest_of_cubes(merged.xyz[rows], merged.covariance[rows], limits.voxel_m)
        counts["thinned"] = len(rows) - len(surest)
        rows = rows[surest]
    rows = rows[tile_order(merged.xyz[rows], corner, limits.tile_m)]
    return _table(scene, observed, merged, rows, folder.name), Counts(**counts)


def surest_of_cubes(xyz: Floats, covariance: Floats, voxel_m: float) -> Ints:
    """The point with the least variance of each occupied cube.

    Args:
        xyz: (n, 3) in the dataset's CRS, m.
        covariance: (n, 3, 3) m^2.
        voxel_m: Edge of a cube, m.

    Returns:
        Rows, in no order.
    """
    cubes = np.floor(xyz / voxel_m)
    order = np.lexsort((*xyz.T, np.trace(covariance, axis1=1, axis2=2), *cubes.T))
    new = np.any(cubes[order][1:] != cubes[order][:-1], axis=1)
    out: Ints = order[np.concatenate([[True], new])[: len(order)]]
    return out


def _some(observed: Observed, own: Floats, track: Ints, keep: Bools) -> tuple[Observed, Floats, Ints]:
    """Some observations, their tracks numbered anew."""
    renumbered = np.unique(track[keep], return_inverse=True)[1].reshape(-1)
    return observed.take(keep), own[keep], renumbered


def _table(scene: Scene, observed: Observed, merged: Merged, rows: AnyArray, tile: str) -> pa.Table:
    best = merged.best[rows]
    covariance = merged.covariance[rows]
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).astype(np.float32)
    cov = covariance.astype(np.float32)
    names = np.array(list(scene.errors.index), object)[observed.frames[best, 0]]
    return tile_table(
        {
            **{axis: merged.xyz[rows, i] for i, axis in enumerate("xyz")},
            **{f"sigma_{axis}_m": sigma[:, i] for i, axis in enumerate("xyz")},
            "cov_xy": cov[:, 0, 1],
            "cov_xz": cov[:, 0, 2],
            "cov_yz": cov[:, 1, 2],
            "n_pairs": merged.n_pairs[rows],
            "n_frames": merged.n_frames[rows],
            "frame_id": names,
            **{name: observed.ref_px[best, i].astype(np.float32) for i, name in enumerate("uv")},
            "depth_m": observed.depth_m[best].astype(np.float32),
            "parallax_deg": observed.parallax_deg[best].astype(np.float32),
            **{name: observed.rgb[best, i] for i, name in enumerate(("red", "green", "blue"))},
            "time": pa.array([scene.times[name] for name in names], pa.timestamp("ns", tz="UTC")),
        },
        tile,
    )
