"""The returns of all tiles about a flight, decoded once and kept on disk by ground cell, in the local frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pipeline.engine.errors import NothingLeftError
from pipeline.geodesy.local_fit import LocalFit
from pipeline.geodesy.transform import FrameTransform
from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints
from pipeline.lidar.nearby import MOST_RETURNS, LocalTiles
from pipeline.lidar.pieces import Piece, Seen, pieces_of, read_piece
from pipeline.lidar.reach import Mask, Reach
from pipeline.lidar.thinning import FirstOfVoxel, Thinning
from pipeline.lidar.tiles import NOISE_CLASSES, Tile

# Ground cells on disk: some tens of thousand returns each.
_CELL_M = 32.0
# Offsets from a cell's corner in single precision are good to some micrometres; heights to a few more.
_RECORD = np.dtype("<f4")
_INDEX = np.dtype([("column", "<i4"), ("row", "<i4"), ("piece", "<i4"), ("start", "<i8"), ("count", "<i8"),
                   ("per_m2", "<f4")])  # fmt: skip
_BLOCK = 65_536
_MARGIN = 0.1


class Map(Protocol):
    """`Context.map`: applies a function to shards of items, in parallel, results in order."""

    def __call__(
        self, function: Callable[[Sequence[Any]], Any], items: Any, *, shard: int, label: str
    ) -> Iterator[Any]:
        """As `pipeline.engine.stage.Context.map`."""


@dataclass(frozen=True, slots=True)
class Store:
    """Returns on disk, by ground cell.

    Args:
        folder: Where they lie.
        thinning: How they were thinned; None for not at all.
    """

    folder: Path
    thinning: Thinning | None

    def near(self, centres_in_enu_m: Floats, max_range_m: float, most: int = MOST_RETURNS) -> Floats:
        """The returns within a ground distance of any of some cameras.

        Args:
            centres_in_enu_m: (n, 3) camera centres, ENU m; n >= 1.
            max_range_m: Largest ground distance from the nearest camera, m; no more than what was gathered.
            most: Returns kept in memory; where there are more, every other one is dropped, evenly, or more of them.

        Returns:
            (m, 3) ENU, m; by ground cell, and in the tiles' order within it.
        """
        index = np.load(self.folder / "index.npy")
        near = _cells_near(index, centres_in_enu_m[:, :2], max_range_m)
        index = index[near]
        index = index[np.lexsort((index["start"], index["piece"], index["row"], index["column"]))]
        stride = max(1, -(-int(index["count"].sum()) // most)) if len(index) else 1
        reach = Reach.load(self.folder / "reach.npz") if self.thinning else None
        parts = []
        for rows in _by_cell(index):
            points = np.concatenate([self._read(entry) for entry in index[rows]], axis=1)
            if self.thinning and reach and len(rows) > 1:
                # Each part has been thinned by itself.
                density = float(index["per_m2"][rows].max())
                points = points[:, FirstOfVoxel().take(self.thinning.voxels(points, reach, density))]
            parts.append(points[:, _within(points, centres_in_enu_m[:, :2], max_range_m)][:, ::stride])
        return np.ascontiguousarray(np.concatenate(parts, axis=1).T) if parts else np.zeros((0, 3))

    def _read(self, entry: AnyArray) -> Floats:
        count = int(entry["count"])
        with _file(self.folder, int(entry["piece"])).open("rb") as file:
            file.seek(int(entry["start"]) * 3 * _RECORD.itemsize)
            stored = np.fromfile(file, _RECORD, 3 * count).reshape(3, count).astype(np.float64)
        stored[0] += float(entry["column"]) * _CELL_M
        stored[1] += float(entry["row"]) * _CELL_M
        return stored


@dataclass(frozen=True, slots=True)
class _Way:
    """From the CRS of some tiles to the local frame."""

    mask: Mask
    fit: LocalFit | None


@dataclass(frozen=True, slots=True)
class _Job:
    """What is the same for every piece."""

    local: LocalTiles
    ways: dict[str, _Way]
    thinning: Thinning | None
    folder: Path


def gather(
    context_map: Map, local: LocalTiles, centres_in_enu_m: Floats, max_range_m: float, folder: Path, focal_px: float
) -> Store:
    """Decodes every tile that meets the flight once, and keeps what the cameras may see.

    Args:
        context_map: Spreads the work over processes; the result does not depend on them.
        local: The tiles.
        centres_in_enu_m: (n, 3) every camera centre, ENU m; n >= 1.
        max_range_m: Largest ground distance from the nearest camera that will be asked for, m.
        folder: An empty folder, read by the store for as long as it is used.
        focal_px: The longest focal length among the cameras, px: returns finer than these can use are thinned.

    Returns:
        The store.

    Raises:
        InputError: A tile is damaged.
        UndeterminedError: A height datum or the geoid between two is not known.
        NothingLeftError: All returns about the flight are classed as noise or withheld.
    """
    reach = Reach.of(centres_in_enu_m, max_range_m)
    folder.mkdir(parents=True, exist_ok=True)
    reach.save(folder / "reach.npz")
    ways = _ways(local, reach, float(np.median(centres_in_enu_m[:, 2])))
    items = [
        (number, piece)
        for number, piece in enumerate(
            piece
            for tile in local.tiles
            if tile.point_count
            for piece in pieces_of(tile, ways[tile.crs_wkt].mask.meets)
        )
    ]
    # Sweeps were thinned when they were put together, and surfaces indoors are small.
    thinning = Thinning(focal_px) if local.from_above else None
    job = _Job(local, ways, thinning, folder)
    seen, entries = Seen(), [np.zeros(0, _INDEX)]
    for part, came_by in context_map(partial(spill, job), items, shard=1, label="tiles"):
        entries.append(part)
        seen.add(came_by)
    index = np.concatenate(entries)
    np.save(folder / "index.npy", index)
    if not len(index) and seen.by_class.sum():
        raise _all_dropped(local, seen)
    return Store(folder, thinning)


def spill(job: _Job, items: Sequence[tuple[int, Piece]]) -> tuple[AnyArray, Seen]:
    """Writes the returns of some pieces by ground cell.

    Args:
        job: What is the same for every piece.
        items: Pieces with their numbers.

    Returns:
        Rows of the index, and what came by.
    """
    reach, seen, entries = Reach.load(job.folder / "reach.npz"), Seen(), [np.zeros(0, _INDEX)]
    for number, piece in items:
        way = job.ways[piece.tile.crs_wkt]
        transform = job.local.transform(piece.tile)
        density = _density(piece.tile, transform)
        written, first = 0, FirstOfVoxel()
        with _file(job.folder, number).open("wb") as file:
            for chunk in read_piece(piece, way.mask.holds, seen):
                blocks = []
                for start in range(0, chunk.shape[1], _BLOCK):
                    points = chunk[:, start : start + _BLOCK]
                    points = way.fit.enu_from(points, transform) if way.fit else transform.enu_from(points.T).T
                    points = points[:, np.isfinite(points).all(axis=0)]
                    if job.thinning is not None:
                        points = points[:, first.take(job.thinning.voxels(points, reach, density))]
                    blocks.append(points)
                rows, stored = _by_ground(np.concatenate(blocks, axis=1), number, written)
                rows["per_m2"] = density
                stored.tofile(file)
                written += int(rows["count"].sum())
                entries.append(rows)
    return np.concatenate(entries), seen


def _by_ground(points: Floats, number: int, written: int) -> tuple[AnyArray, AnyArray]:
    """Returns sorted into ground cells: rows of the index and what is written."""
    if not points.shape[1]:
        return np.zeros(0, _INDEX), np.zeros(0, _RECORD)
    cell = np.floor(points[:2] / _CELL_M).astype(np.int32)
    low = cell.min(axis=1, keepdims=True)
    wide = int(cell[1].max() - low[1, 0]) + 1
    flat = (cell[0] - low[0]) * wide + (cell[1] - low[1])
    # Sixteen bits are sorted by radix.
    order = np.argsort(flat.astype(np.uint16) if flat.max() < 1 << 16 else flat, kind="stable")
    flat = flat[order]
    starts = np.flatnonzero(np.concatenate([[True], flat[1:] != flat[:-1]]))
    counts = np.diff(np.append(starts, len(flat)))
    rows = np.zeros(len(starts), _INDEX)
    rows["column"], rows["row"] = low[0] + flat[starts] // wide, low[1] + flat[starts] % wide
    rows["piece"], rows["start"], rows["count"] = number, written + starts, counts
    sorted_points = points[:, order]
    sorted_points[:2] -= cell[:, order] * _CELL_M
    stored = sorted_points.astype(_RECORD)
    return rows, np.concatenate([stored[:, s : s + n].ravel() for s, n in zip(starts, counts, strict=True)])


def _ways(local: LocalTiles, reach: Reach, up_m: float) -> dict[str, _Way]:
    """The way from each CRS among the tiles."""
    ways: dict[str, _Way] = {}
    for wkt in dict.fromkeys(tile.crs_wkt for tile in local.tiles):
        tiles = [tile for tile in local.tiles if tile.crs_wkt == wkt and tile.point_count]
        if tiles:
            transform = local.transform(tiles[0])
            mask = Mask.of(reach, transform, up_m)
            ways[wkt] = _Way(mask, _fit(transform, mask, tiles) if local.frame is not None else None)
    return ways


def _fit(transform: FrameTransform, mask: Mask, tiles: Sequence[Tile]) -> LocalFit | None:
    """The fit over what tiles and cameras have in common; None where that is nothing."""
    lower, upper = np.min([tile.minimum for tile in tiles], axis=0), np.max([tile.maximum for tile in tiles], axis=0)
    lower[:2] = np.maximum(lower[:2], mask.origin)
    upper[:2] = np.minimum(upper[:2], mask.origin + np.array(mask.within.shape) * mask.cell)
    if not np.all(lower <= upper):
        return None
    margin = _MARGIN * (upper - lower) + mask.cell
    return LocalFit.of(transform, lower - margin, upper + margin)


def _density(tile: Tile, transform: FrameTransform) -> float:
    """Returns per square metre of the tile's box."""
    corners = np.array([tile.minimum, tile.maximum])
    level = (corners[0, 2] + corners[1, 2]) / 2.0
    x, y = corners[:, 0], corners[:, 1]
    box = transform.enu_from(np.array([[x[0], y[0], level], [x[1], y[0], level], [x[0], y[1], level]]))
    sides = np.linalg.norm(box[1:, :2] - box[0, :2], axis=1)
    return float(tile.point_count / max(float(np.prod(sides)), 1.0))


def _cells_near(index: AnyArray, places: Floats, reach_m: float) -> Bools:
    lower = np.column_stack([index["column"], index["row"]]) * _CELL_M
    near = np.zeros(len(index), np.bool_)
    for place in places:
        beside = np.maximum(np.maximum(lower - place, place - lower - _CELL_M), 0.0)
        near |= np.einsum("ij,ij->i", beside, beside) <= reach_m**2
    return near


def _by_cell(index: AnyArray) -> list[Ints]:
    """Rows of the sorted index that are of one cell."""
    if not len(index):
        return []
    ends = np.flatnonzero((np.diff(index["column"]) != 0) | (np.diff(index["row"]) != 0)) + 1
    return list(np.split(np.arange(len(index)), ends))


def _within(points: Floats, places: Floats, reach_m: float) -> Bools:
    within = np.zeros(points.shape[1], np.bool_)
    for place in places:
        east, north = points[0] - place[0], points[1] - place[1]
        within |= east * east + north * north <= reach_m**2
        if within.all():
            break
    return within


def _file(folder: Path, number: int) -> Path:
    return folder / f"{number:06d}.f4"


def _all_dropped(local: LocalTiles, seen: Seen) -> NothingLeftError:
    classes = ", ".join(f"{count:,} of class {number}" for number, count in enumerate(seen.by_class) if count)
    return NothingLeftError(
        "E-LIDAR-12", "every LiDAR return about the flight is classed as noise or withheld",
        where=str(local.tiles[0].path), found=f"{classes}; {seen.withheld:,} withheld",
        expected=f"returns of classes other than {' and '.join(map(str, NOISE_CLASSES))} (noise), not withheld",
        hint="classify the tiles anew; where the classes are wrong, make them 1 (unclassified): "
        "pdal translate IN OUT assign --filters.assign.value='Classification = 1'",
    )  # fmt: skip
