"""One tile's points: its observations joined to tracks, merged, and what cannot be true left out."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import feather

from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints
from pipeline.points.covariances import whole
from pipeline.points.freespace import Views, looked_through
from pipeline.points.geoparquet import tile_table
from pipeline.points.merge import Merged, agreed, merge, surest_of_pairs
from pipeline.points.observations import Scene
from pipeline.points.observed import Observed
from pipeline.points.outliers import isolated
from pipeline.points.tiles import tile_corner, tile_corners, tile_order
from pipeline.points.tracks import least, tracks


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
        isolated: Points that stand alone, seen by one pair.
        looked_through: Points where more frames saw something behind than had a part in them.
        seen_too_seldom: Points of fewer pairs than asked for.
        thinned: Points that are not the surest of their cube.
    """

    observations: int = 0
    disagreeing: int = 0
    contradictory: int = 0
    isolated: int = 0
    looked_through: int = 0
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

    def here(xyz: Floats) -> Bools:
        inside: Bools = (tile_corners(xyz, limits.tile_m) == corner).all(axis=1)
        return inside

    joined, counts = _joined(Observed.of(table), scene, here)
    merged = merge(joined.observed, joined.track, joined.own, scene.errors)
    left = here(merged.xyz)
    for name, wrong in (
        ("isolated", isolated(merged.xyz, _worst(merged.covariance), merged.n_frames)),
        ("looked_through", looked_through(joined.observed, joined.track, merged, _views(scene))),
        ("seen_too_seldom", merged.n_pairs < limits.min_observations),
    ):
        counts[name] = int((left & wrong).sum())
        left &= ~wrong
    rows = np.flatnonzero(left)
    if limits.voxel_m > 0.0:
        surest = surest_of_cubes(merged.xyz[rows], merged.covariance[rows], limits.voxel_m)
        counts["thinned"] = len(rows) - len(surest)
        rows = rows[surest]
    rows = rows[tile_order(merged.xyz[rows], corner, limits.tile_m)]
    return _table(scene, joined.observed, merged, rows, folder.name), Counts(**counts)


@dataclass(frozen=True, slots=True)
class _Joined:
    """Observations that agree, their whole covariances and their tracks, numbered without gaps."""

    observed: Observed
    own: Floats
    track: Ints

    def some(self, keep: Bools) -> _Joined:
        track = np.unique(self.track[keep], return_inverse=True)[1].reshape(-1)
        return _Joined(self.observed.take(keep), self.own[keep], track)


def _joined(observed: Observed, scene: Scene, here: Callable[[Floats], Bools]) -> tuple[_Joined, dict[str, int]]:
    own = whole(observed, scene.errors)
    found = _Joined(observed, own, tracks(observed, own, scene.errors))
    found = found.some(surest_of_pairs(observed, found.track))
    agree, sound = agreed(found.observed, found.track, found.own, scene.errors)
    inside, kept = here(found.observed.xyz), sound[found.track]
    # A track lies where its surest observation does.
    home = least(found.observed.sigma_m, found.track)
    counts = {
        "observations": int(here(observed.xyz).sum()),
        "disagreeing": int((~agree & kept & inside).sum()),
        "contradictory": int((~sound & inside[home]).sum()),
    }
    return found.some(agree & kept), counts


def _views(scene: Scene) -> Views:
    return Views(list(scene.errors.index), scene.cameras, scene.placements, scene.errors, scene.transform)


def _worst(covariance: Floats) -> Floats:
    """(n,) m: one sigma along the longest axis."""
    out: Floats = np.sqrt(np.linalg.eigvalsh(covariance)[:, 2])
    return out


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
