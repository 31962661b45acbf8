"""The returns of all tiles that lie within range of a few cameras, in the local frame; memory is bounded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import LOCAL
from pipeline.geodesy.local_world import LocalTransform
from pipeline.geodesy.transform import FrameTransform, to_enu
from pipeline.geometry.arrays import Bools, Floats
from pipeline.lidar.pieces import read_returns
from pipeline.lidar.tiles import Tile

# 24 bytes each: some 190 MiB at most, whatever the tiles' density.
MOST_RETURNS = 8_000_000
# A tile's box is found from the corners of the cameras' box; this covers the curvature of its sides.
_MARGIN_M = 2.0


@dataclass(frozen=True, slots=True)
class LocalTiles:
    """Tiles and the way from their CRS to the local frame.

    Args:
        tiles: What to read.
        frame: The local frame; None for tiles that are in it already, whether it is tied to a place on earth or not.
        geoid: Undulation in metres, a grid file, or None, as the configuration has it.
        height_datum: What the frame's heights are measured from.
    """

    tiles: tuple[Tile, ...]
    frame: LocalFrame | None = None
    geoid: float | str | None = None
    height_datum: str = LOCAL

    @property
    def from_above(self) -> bool:
        """Whether the tiles are surveys from the air; those in the run's own frame show ceilings and walls too."""
        return self.frame is not None

    def transform(self, tile: Tile) -> FrameTransform:
        """The way from a tile's CRS to the frame.

        Raises:
            UndeterminedError: A height datum or the geoid between two is not known.
        """
        if self.frame is None:
            return LocalTransform()
        return to_enu(tile.crs, self.frame, self.geoid, self.height_datum)

    def transforms(self) -> dict[str, FrameTransform]:
        """The way from each CRS among the tiles, by its WKT: PROJ takes its time to find one, and tiles are many.

        Raises:
            UndeterminedError: A height datum or the geoid between two is not known.
        """
        one_of_each = {tile.crs_wkt: tile for tile in self.tiles}
        return {wkt: self.transform(tile) for wkt, tile in one_of_each.items()}

    def meeting(self, centres_in_enu_m: Floats, max_range_m: float) -> tuple[Tile, ...]:
        """The tiles that meet the box of the cameras and their range.

        Args:
            centres_in_enu_m: (n, 3) camera centres, ENU m; n >= 1.
            max_range_m: Largest distance of a return from its camera, m.
        """
        boxes = {
            wkt: box_in_crs(transform, centres_in_enu_m, max_range_m) for wkt, transform in self.transforms().items()
        }
        return tuple(tile for tile in self.tiles if tile.meets(*boxes[tile.crs_wkt]))


def returns_near(local: LocalTiles, centres_in_enu_m: Floats, max_range_m: float, most: int = MOST_RETURNS) -> Floats:
    """The returns within a ground distance of any of some cameras.

    Args:
        local: The tiles.
        centres_in_enu_m: (n, 3) camera centres, ENU m; n >= 1.
        max_range_m: Largest ground distance from the nearest camera, m.
        most: Returns kept in memory; beyond it every other one is dropped, again and again, evenly over the tiles.

    Returns:
        (m, 3) ENU, m; in the tiles' order.

    Raises:
        InputError: A tile is damaged.
        UndeterminedError: A height datum or the geoid between two is not known.
    """
    parts: list[Floats] = []
    stride, held = 1, 0
    transforms = local.transforms()
    for tile in local.tiles:
        transform = transforms[tile.crs_wkt]
        lower, upper = box_in_crs(transform, centres_in_enu_m, max_range_m)
        if not tile.meets(lower, upper):
            continue
        for chunk in read_returns(tile, lower, upper):
            points = transform.enu_from(chunk[::stride])
            points = points[_near(points, centres_in_enu_m, max_range_m)]
            parts.append(points)
            held += len(points)
            while held > most:
                parts, stride = [part[::2].copy() for part in parts], 2 * stride
                held = sum(len(part) for part in parts)
    return np.concatenate(parts) if parts else np.zeros((0, 3))


def _near(points: Floats, centres: Floats, reach_m: float) -> Bools:
    near = np.zeros(len(points), np.bool_)
    for centre in centres:
        near |= np.hypot(points[:, 0] - centre[0], points[:, 1] - centre[1]) <= reach_m
    near &= np.isfinite(points).all(axis=1)
    return near


def box_in_crs(transform: FrameTransform, centres: Floats, reach_m: float) -> tuple[Floats, Floats]:
    """Lower and upper corner, (3,) each in a CRS, of the box about cameras.

    Args:
        transform: The way from the CRS.
        centres: (n, 3) camera centres, ENU m.
        reach_m: How far the box reaches beyond them, m.
    """
    lower = centres.min(axis=0) - reach_m - _MARGIN_M
    upper = centres.max(axis=0) + reach_m + _MARGIN_M
    grid = np.meshgrid(*(np.linspace(low, high, 3) for low, high in zip(lower, upper, strict=True)))
    corners = transform.from_enu(np.stack([axis.ravel() for axis in grid], axis=-1))
    return corners.min(axis=0), corners.max(axis=0)
