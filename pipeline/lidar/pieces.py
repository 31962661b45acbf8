"""Tiles in pieces that several processes decode: ranges of returns, or the nodes of a COPC tile that are of use."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import groupby

import laspy
import numpy as np
from laspy.copc import Bounds, CopcReader, Entry, HierarchyPage, OctreeNode, VoxelKey, load_octree_for_query

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints
from pipeline.lidar.tiles import NOISE_CLASSES, UNREADABLE, Tile, unreadable

# Returns of a piece and of what is decoded at once: whole chunks of LAZ, which hold 50,000, or some are decoded twice.
PIECE_RETURNS, CHUNK_RETURNS = 3_000_000, 500_000
# Nothing else of a return is needed, and from point format 6 on the rest stays compressed.
_FIELDS = (
    laspy.DecompressionSelection.XY_RETURNS_CHANNEL
    | laspy.DecompressionSelection.Z
    | laspy.DecompressionSelection.CLASSIFICATION
    | laspy.DecompressionSelection.FLAGS
)
_CLASSES = 256

MeetsBox = Callable[[Floats, Floats], bool]
"""Whether a box of the tile's CRS, given by its lower and upper corner (2+,), holds something of use."""


@dataclass(frozen=True, slots=True)
class Piece:
    """Part of a tile.

    Args:
        tile: The tile.
        first: Number of its first return.
        count: How many returns.
        nodes: Of a COPC tile: level, x, y, z, offset, bytes and returns of each node, all of one level.
    """

    tile: Tile
    first: int
    count: int
    nodes: tuple[tuple[int, ...], ...] = ()


@dataclass(slots=True)
class Seen:
    """What came by while pieces were read.

    Args:
        by_class: (256,) returns within reach by their class.
        withheld: Those that are marked as not to be used.
    """

    by_class: Ints = field(default_factory=lambda: np.zeros(_CLASSES, np.int64))
    withheld: int = 0

    def add(self, other: Seen) -> None:
        """Adds what was seen elsewhere."""
        self.by_class += other.by_class
        self.withheld += other.withheld


def pieces_of(tile: Tile, meets: MeetsBox) -> Iterator[Piece]:
    """The pieces of a tile that have to be read.

    Args:
        tile: The tile.
        meets: Which boxes are of use.

    Raises:
        InputError: The tile's hierarchy of nodes is damaged.
    """
    if is_copc(tile):
        yield from _node_pieces(tile, meets)
        return
    for first in range(0, tile.point_count, PIECE_RETURNS):
        yield Piece(tile, first, min(PIECE_RETURNS, tile.point_count - first))


def is_copc(tile: Tile) -> bool:
    """Whether a tile is a COPC file, which keeps its returns by place."""
    try:
        with laspy.open(tile.path, read_evlrs=False) as reader:
            vlrs = reader.header.vlrs
            return bool(len(vlrs) and vlrs[0].user_id == CopcInfo.USER and vlrs[0].record_id == CopcInfo.RECORD)
    except UNREADABLE as error:
        raise unreadable(tile.path, error) from error


class CopcInfo:
    """The record that a COPC file begins with (COPC 1.0, "info VLR")."""

    USER, RECORD = "copc", 1


def read_piece(
    piece: Piece, holds: Callable[[Floats, Floats], Bools], seen: Seen, chunk_returns: int = CHUNK_RETURNS
) -> Iterator[Floats]:
    """The returns of a piece at places of use, by chunk; noise and withheld ones left out.

    Args:
        piece: From `pieces_of`.
        holds: Which places x, y (n,) of the tile's CRS are of use.
        seen: Counts what came by.
        chunk_returns: Returns decoded at once.

    Yields:
        (3, n) x, y, z in the tile's CRS and units, all finite; never empty.

    Raises:
        InputError: The file is damaged or cut short.
    """
    try:
        for chunk in _by_nodes(piece) if piece.nodes else _by_range(piece, chunk_returns):
            points = _wanted(chunk, holds, seen)
            if points.shape[1]:
                yield points
    except UNREADABLE as error:
        raise unreadable(piece.tile.path, error) from error


def read_returns(tile: Tile, lower: Floats, upper: Floats, chunk_returns: int = CHUNK_RETURNS) -> Iterator[Floats]:
    """The returns of a tile in a horizontal box, by chunk; noise and withheld ones left out.

    Args:
        tile: From `read_tile`.
        lower: (2+,) lower corner of the box, tile CRS.
        upper: (2+,) upper corner.
        chunk_returns: Returns decoded at once.

    Yields:
        (n, 3) x, y, z in the tile's CRS and units, all finite; never empty.

    Raises:
        InputError: The file is damaged or cut short.
    """

    def meets(low: Floats, high: Floats) -> bool:
        return bool(np.all(low[:2] <= upper[:2]) and np.all(high[:2] >= lower[:2]))

    def holds(x: Floats, y: Floats) -> Bools:
        out: Bools = (x >= lower[0]) & (x <= upper[0]) & (y >= lower[1]) & (y <= upper[1])
        return out

    for piece in pieces_of(tile, meets):
        for points in read_piece(piece, holds, Seen(), chunk_returns):
            yield points.T


def _by_range(piece: Piece, chunk_returns: int) -> Iterator[laspy.ScaleAwarePointRecord]:
    # One thread for each process: the processes are the parallelism.
    with laspy.open(
        piece.tile.path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False, decompression_selection=_FIELDS
    ) as reader:
        if piece.first:
            reader.seek(piece.first)
        left = piece.count
        while left:
            chunk = reader.read_points(min(chunk_returns, left))
            if not len(chunk):
                raise InputError(
                    "E-LIDAR-02", "the tile is cut short", where=str(piece.tile.path),
                    found=f"{piece.first + piece.count - left:,} returns",
                    expected=f"{piece.tile.point_count:,} as its header says", hint="copy the file again",
                )  # fmt: skip
            left -= len(chunk)
            yield chunk


def _by_nodes(piece: Piece) -> Iterator[laspy.ScaleAwarePointRecord]:
    """The returns of the nodes of a piece: the reader is shown a hierarchy that has no others."""
    with CopcReader.open(piece.tile.path, decompression_selection=_FIELDS) as reader:
        page = HierarchyPage()
        for level, x, y, z, offset, size, count in piece.nodes:
            for up in range(level, -1, -1):
                entry = Entry()
                entry.key = _key(up, x >> (level - up), y >> (level - up), z >> (level - up))
                if up == level:
                    entry.offset, entry.byte_size, entry.point_count = offset, size, count
                page.entries[entry.key] = entry
        reader.root_page = page
        yield reader.query(level=piece.nodes[0][0])


def _node_pieces(tile: Tile, meets: MeetsBox) -> Iterator[Piece]:
    try:
        with CopcReader.open(tile.path) as reader:
            nodes = load_octree_for_query(reader.source, reader.copc_info, reader.root_page, _whole(reader))
    except UNREADABLE as error:
        raise unreadable(tile.path, error) from error
    kept = [node for node in nodes if node.point_count and meets(node.bounds.mins, node.bounds.maxs)]
    kept.sort(key=lambda node: (node.key.level, node.offset))
    for _, of_level in groupby(kept, key=lambda node: node.key.level):
        waiting: list[OctreeNode] = []
        for node in of_level:
            waiting.append(node)
            if sum(one.point_count for one in waiting) >= CHUNK_RETURNS:
                yield _piece_of(tile, waiting)
                waiting = []
        if waiting:
            yield _piece_of(tile, waiting)


def _whole(reader: CopcReader) -> Bounds:
    info = reader.copc_info
    return Bounds(info.center - info.halfsize, info.center + info.halfsize)


def _piece_of(tile: Tile, nodes: list[OctreeNode]) -> Piece:
    rows = tuple(
        (node.key.level, node.key.x, node.key.y, node.key.z, node.offset, node.byte_size, node.point_count)
        for node in nodes
    )
    return Piece(tile, 0, sum(row[-1] for row in rows), rows)


def _key(level: int, x: int, y: int, z: int) -> VoxelKey:
    key = VoxelKey()
    key.level, key.x, key.y, key.z = level, x, y, z
    return key


def _wanted(chunk: laspy.ScaleAwarePointRecord, holds: Callable[[Floats, Floats], Bools], seen: Seen) -> Floats:
    x, y = np.asarray(chunk.x, np.float64), np.asarray(chunk.y, np.float64)
    rows = np.flatnonzero(holds(x, y))
    points = np.stack([x[rows], y[rows], np.asarray(chunk.z, np.float64)[rows]])
    classes, withheld = np.asarray(chunk.classification)[rows], np.asarray(chunk.withheld, np.bool_)[rows]
    seen.by_class += np.bincount(classes, minlength=_CLASSES)
    seen.withheld += int(np.count_nonzero(withheld))
    use: AnyArray = np.ones(_CLASSES, np.bool_)
    use[list(NOISE_CLASSES)] = False
    kept = use[classes] & ~withheld & np.isfinite(points[2])
    return points if kept.all() else points[:, kept]
