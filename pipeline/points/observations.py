"""Observations of points: kept depths as points in the output CRS, spilled by tile."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import feather

from pipeline.flight import PairRow, column, columns
from pipeline.geodesy.transform import FrameTransform
from pipeline.geometry.arrays import Bytes, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.geometry.poses import PlacedPair, Placement
from pipeline.matching.images import read_colour
from pipeline.points.observed import Observed
from pipeline.points.tiles import split
from pipeline.points.tracks import stars
from pipeline.points.world import world_points

# How far around a tile observations are its business too, so that a track which lies on both sides of a border is whole
# in either tile: three sigmas, at least this and at most that, m.
_NEAREST_M, _FARTHEST_M = 1.0, 10.0


@dataclass(frozen=True, slots=True)
class Scene:
    """What observations are made with.

    Args:
        images: Path or URL of each frame's image.
        times: Exposure of each frame, ns since 1970 UTC, or None.
        cameras: Camera of each frame.
        placements: Where each frame stands.
        errors: Covariances between the frames' errors; its numbers of the frames are those of the observations.
        pairs: The pairs by name; their order numbers them.
        placed: How the pairs' cameras are placed, by name.
        transform: From ENU to the output CRS.
        method: The method whose points are published.
    """

    images: Mapping[str, str]
    times: Mapping[str, int | None]
    cameras: Mapping[str, Camera]
    placements: Mapping[str, Placement]
    errors: PoseErrors
    pairs: Mapping[str, PairRow]
    placed: Mapping[str, PlacedPair]
    transform: FrameTransform
    method: str


def observations(scene: Scene, depths: pa.Table) -> list[Observed]:
    """The kept depths of the published method as points in the output CRS.

    Args:
        scene: What they are made with.
        depths: Rows of `depths`; those of one ref frame side by side, so that its image is decoded once.

    Returns:
        One record per pair.

    Raises:
        InputError: An image cannot be read.
    """
    kept = depths.filter(pc.and_(depths.column("kept"), pc.equal(depths.column("method"), scene.method)))
    ids = column(kept, "pair_id")
    number = {name: i for i, name in enumerate(scene.pairs)}
    found = []
    shown, picture = "", np.empty((0, 0, 3), np.uint8)
    for pair_id in dict.fromkeys(ids):
        pair = scene.pairs[pair_id]
        if pair.ref != shown:
            shown, picture = pair.ref, read_colour(scene.images[pair.ref])
        found.append(_of_pair(scene, pair, number[pair_id], kept.filter(ids == pair_id), picture))
    return found


def _of_pair(scene: Scene, pair: PairRow, number: int, rows: pa.Table, picture: Bytes) -> Observed:
    ref_px, depth = columns(rows, ("u", "v")), np.asarray(column(rows, "depth_m"), np.float64)
    normal = columns(rows, ("normal_x", "normal_y", "normal_z"))
    pixel_sigma = np.asarray(column(rows, "sigma_pixel_m"), np.float64)
    camera, placed = scene.cameras[pair.ref], scene.placed[pair.pair_id]
    points = world_points(ref_px, depth, normal, pixel_sigma, camera, placed)
    # Convergence and scale hardly change over one frame's view: the Jacobian at its camera serves all its points.
    to_crs = scene.transform.jacobian(placed.ref.centre)
    height, width = picture.shape[:2]
    at = np.clip(np.round(ref_px).astype(np.int64), 0, (width - 1, height - 1))
    of_frame = scene.errors.index
    return Observed(
        scene.transform.from_enu(points.p_in_enu_m),
        to_crs @ points.jacobian,
        to_crs @ points.independent @ to_crs.T,
        np.full(len(depth), number),
        np.tile([of_frame[pair.ref], of_frame[pair.src]], (len(depth), 1)),
        ref_px,
        columns(rows, ("src_u", "src_v")),
        np.asarray(column(rows, "sigma_depth_m"), np.float64),
        depth,
        (camera.rays(ref_px) @ placed.ref.rotation.T) @ to_crs.T,
        depth / camera.focal_px,
        np.asarray(column(rows, "parallax_deg"), np.float64),
        picture[at[:, 1], at[:, 0]],
    )


def spill(parts: Sequence[Observed], folder: Path, name: str, tile_m: int) -> None:
    """Writes observations to one file per tile that they may belong to: FOLDER/TILE/NAME."""
    if not parts:
        return
    observed = Observed.joined(parts)
    for tile, rows in split(observed.xyz, tile_m, _boxes(observed)):
        place = folder / tile / name
        place.parent.mkdir(parents=True, exist_ok=True)
        temporary = place.with_suffix(".tmp")
        feather.write_feather(observed.take(rows).table(), temporary, compression="uncompressed")
        temporary.replace(place)


def _boxes(observed: Observed) -> tuple[Floats, Floats]:
    """Around each observation, and around all others of its star: they stay together."""
    margin = np.clip(3.0 * observed.sigma_m, _NEAREST_M, _FARTHEST_M)[:, None]
    star = stars(observed)
    order = np.argsort(star, kind="stable")
    first = np.flatnonzero(np.diff(star[order], prepend=-1))
    low = np.minimum.reduceat((observed.xyz[:, :2] - margin)[order], first)
    high = np.maximum.reduceat((observed.xyz[:, :2] + margin)[order], first)
    return low[star], high[star]
