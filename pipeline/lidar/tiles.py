"""LAS, LAZ and COPC tiles: which files, and what their headers say."""

from __future__ import annotations

import glob
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
import pyproj

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Floats
from pipeline.lidar.public_header import check_public_header
from pipeline.lidar.tile_crs import local_tile_crs, tile_crs

SUFFIXES = (".las", ".laz")
# ASPRS LAS 1.4 R15, table 17: low point (noise), high noise.
NOISE_CLASSES = (7, 18)
# What laspy and its decoder (RuntimeError) raise on bytes that are not a tile.
UNREADABLE = (laspy.errors.LaspyException, RuntimeError, OSError, ValueError, TypeError, struct.error, EOFError,
               KeyError, IndexError, OverflowError, MemoryError)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Tile:
    """What a tile's header says.

    Args:
        path: The file.
        crs_wkt: Its CRS as WKT 2, three-dimensional.
        point_count: Returns in the file.
        minimum: Lower corner x, y, z in the tile's CRS and units (x east, whatever the CRS's axis order).
        maximum: Upper corner.
    """

    path: Path
    crs_wkt: str
    point_count: int
    minimum: tuple[float, float, float]
    maximum: tuple[float, float, float]

    @property
    def crs(self) -> pyproj.CRS:
        """The tile's CRS."""
        return pyproj.CRS.from_wkt(self.crs_wkt)

    def meets(self, lower: Floats, upper: Floats) -> bool:
        """Whether the tile's horizontal box meets another in the same CRS.

        Args:
            lower: (2+,) lower corner.
            upper: (2+,) upper corner.
        """
        if self.point_count == 0:
            return False
        return all(self.minimum[i] <= upper[i] and self.maximum[i] >= lower[i] for i in range(2))


def expand(tiles: str | Sequence[str]) -> tuple[Path, ...]:
    """The files a path, a folder, a glob or a list of these names, in order and without repeats.

    Args:
        tiles: Paths or globs; a folder stands for the tiles in it.

    Returns:
        Absolute paths.

    Raises:
        InputError: One of them names no file.
    """
    found: dict[Path, None] = {}
    for text in [tiles] if isinstance(tiles, str) else tiles:
        path = Path(text).expanduser()
        if path.is_dir():
            matches = sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES)
        elif path.is_file():
            matches = [path]
        else:
            matches = sorted(Path(p) for p in glob.glob(str(path), recursive=True) if Path(p).is_file())  # noqa: PTH207
        if not matches:
            raise InputError(
                "E-LIDAR-01", "no LiDAR tile there", where=text, expected="a .las or .laz file, a folder or a glob",
                hint="check score.lidar; relative paths are relative to the workflow file",
            )  # fmt: skip
        found.update(dict.fromkeys(match.absolute() for match in matches))
    return tuple(found)


def read_tile(path: Path, height_datum: str | None = None) -> Tile:
    """Reads a tile's header.

    Args:
        path: LAS, LAZ or COPC file.
        height_datum: As in `tile_crs`, for a tile whose CRS has no vertical part.

    Raises:
        InputError: Not a tile, or cut short.
        UndeterminedError: The CRS or its vertical part is not known.
    """
    header = read_header(path)
    return _tile(path, header, tile_crs(header, path, height_datum))


def read_local_tile(path: Path) -> Tile:
    """Reads the header of a tile in the run's own frame.

    Args:
        path: LAS, LAZ or COPC file with no CRS, or with an engineering CRS.

    Raises:
        InputError: Not a tile, or cut short.
        UndeterminedError: The tile is on earth, or not in metres.
    """
    header = read_header(path)
    return _tile(path, header, local_tile_crs(header, path))


def _tile(path: Path, header: laspy.LasHeader, crs: pyproj.CRS) -> Tile:
    lower, upper = (tuple(float(x) for x in corner) for corner in (header.mins, header.maxs))
    return Tile(
        path,
        crs.to_wkt(),
        int(header.point_count),
        (lower[0], lower[1], lower[2]),
        (upper[0], upper[1], upper[2]),
    )


def read_header(path: Path) -> laspy.LasHeader:
    """A tile's header with its records.

    Raises:
        InputError: Not a tile, cut short, or without finite bounds.
    """
    check_public_header(path)
    try:
        with laspy.open(path, read_evlrs=True) as reader:
            header = reader.header
            bounds = [float(x) for corner in (header.mins, header.maxs) for x in corner]
            count = int(header.point_count)
    except UNREADABLE as error:
        raise unreadable(path, error) from error
    if count and not np.all(np.isfinite(bounds)):
        raise InputError(
            "E-LIDAR-08", "the tile's header has no finite bounds", where=str(path), found=str(bounds),
            hint="rewrite it: pdal translate",
        )  # fmt: skip
    return header


def unreadable(path: Path, error: BaseException) -> InputError:
    """A tile that laspy or its decoder cannot read."""
    return InputError(
        "E-LIDAR-02", "the LiDAR tile cannot be read", where=str(path), found=str(error) or type(error).__name__,
        expected="a LAS, LAZ or COPC file, whole", hint="copy the file again, or take it out of score.lidar",
    )  # fmt: skip
