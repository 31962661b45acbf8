"""The airborne laser survey of the site: two crossing scan lines, classified, as LAZ tiles."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from pathlib import Path

import laspy
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS

from pipeline.geometry.arrays import Floats, Ints
from pipeline.simulation.grid import COMPOUND_CRS, grid_from_enu
from pipeline.simulation.site import GROUND, Site, place
from pipeline.simulation.solids import Building, Crown, Solid

CLASS_GROUND, CLASS_VEGETATION, CLASS_BUILDING, CLASS_NOISE, CLASS_POLE = 2, 5, 6, 7, 64
NOISE_M = 0.02
ABOVE_ORIGIN_M = 380.0
WIDEST_DEG = 20.0
# Surveyed area along and across the flight, m from its start.
_FORWARD_M, _RIGHT_M = (-15.0, 185.0), (-95.0, 95.0)
# Each line leaves one pulse per cell of this size: 4 per m2, 8 for both.
_CELL_M = 0.5
# The first line follows the photo flight; the second crosses it where it sees the walls that face the flight.
_LINES = ((0, 0.0), (1, 50.0))
_STRAY_RETURNS = 40
_SCALE_M = 0.001
# The LAS unit of a scan angle (LAS 1.4 R15, table 14).
_SCAN_ANGLE_DEG = 0.006
_LINE_SPEED_M_S = 60.0
_WRITTEN = date(2024, 6, 1)


@dataclass(frozen=True, slots=True)
class Returns:
    """Laser returns.

    Args:
        p_in_enu_m: (n, 3) ENU.
        classification: (n,) LAS class.
        scan_angle_deg: (n,) positive to the right of the line.
        line: (n,) number of the scan line, from 1.
        time_s: (n,) since the survey's start.
    """

    p_in_enu_m: Floats
    classification: Ints
    scan_angle_deg: Floats
    line: Ints
    time_s: Floats


def survey(site: Site) -> Returns:
    """Scans the site.

    Args:
        site: The site; its seed is the survey's.

    Returns:
        All returns, in order of time, then the stray ones.
    """
    rng = np.random.default_rng([site.seed, 5])
    parts = [_scan(site, rng, number, axis, offset) for number, (axis, offset) in enumerate(_LINES)]
    parts.append(_stray(rng))
    return Returns(
        np.concatenate([part.p_in_enu_m for part in parts]),
        np.concatenate([part.classification for part in parts]),
        np.concatenate([part.scan_angle_deg for part in parts]),
        np.concatenate([part.line for part in parts]),
        np.concatenate([part.time_s for part in parts]),
    )


def write_tiles(site: Site, returns: Returns, folder: Path) -> tuple[Path, ...]:
    """Writes the returns as two tiles, west and east.

    Args:
        site: The site, for its frame.
        returns: What to write.
        folder: Where; it exists.

    Returns:
        The tiles.
    """
    xyz = grid_from_enu(site.frame, returns.p_in_enu_m)
    middle = round(float(np.median(xyz[:, 0])) / 10.0) * 10.0
    paths = []
    for name, inside in (("tile_west.laz", xyz[:, 0] < middle), ("tile_east.laz", xyz[:, 0] >= middle)):
        paths.append(folder / name)
        _write(paths[-1], xyz[inside], returns, np.flatnonzero(inside))
    return tuple(paths)


def _scan(site: Site, rng: np.random.Generator, number: int, axis: int, offset_m: float) -> Returns:
    """One line: it runs along `axis` (0 forward, 1 right) at an offset on the other one."""
    forward, right = (np.arange(a, b, _CELL_M) for a, b in (_FORWARD_M, _RIGHT_M))
    cells = np.stack(np.meshgrid(forward, right, indexing="ij" if axis == 0 else "xy"), axis=-1).reshape(-1, 2)
    aim = cells + rng.uniform(0.0, _CELL_M, cells.shape)
    across = aim[:, 1 - axis] - offset_m
    above = ABOVE_ORIGIN_M
    aim, across = (a[np.abs(across) < above * np.tan(np.radians(WIDEST_DEG))] for a in (aim, across))
    scanner = aim.copy()
    scanner[:, 1 - axis] = offset_m
    origins = np.column_stack([place(scanner), np.full(len(aim), above)])
    directions = np.column_stack([place(aim), np.zeros(len(aim))]) - origins
    hits = site.cast(origins, directions)
    met = np.flatnonzero(np.isfinite(hits.distance))
    p = origins[met] + hits.distance[met, None] * directions[met]
    classes = np.array([_class_of(solid) for solid in site.solids])
    thing = hits.thing[met]
    # Right of a line along `forward` is `right`; right of one along `right` is backward.
    to_right = across if axis == 0 else -across
    return Returns(
        p + rng.normal(0.0, NOISE_M, p.shape),
        np.where(thing == GROUND, CLASS_GROUND, classes[np.maximum(thing, 0)]),
        np.degrees(np.arctan2(to_right[met], above)),
        np.full(len(met), number + 1),
        300.0 * number + (aim[met, axis] - (_FORWARD_M, _RIGHT_M)[axis][0]) / _LINE_SPEED_M_S,
    )


def _class_of(solid: Solid) -> int:
    """The LAS class of a solid's returns."""
    if isinstance(solid, Building):
        return CLASS_BUILDING
    return CLASS_VEGETATION if isinstance(solid, Crown) else CLASS_POLE


def _stray(rng: np.random.Generator) -> Returns:
    """Isolated returns in the air, as birds and moisture leave them."""
    level = place(np.column_stack([rng.uniform(*a, _STRAY_RETURNS) for a in (_FORWARD_M, _RIGHT_M)]))
    return Returns(
        np.column_stack([level, rng.uniform(16.0, 60.0, _STRAY_RETURNS)]),
        np.full(_STRAY_RETURNS, CLASS_NOISE),
        np.zeros(_STRAY_RETURNS),
        np.full(_STRAY_RETURNS, len(_LINES)),
        300.0 * len(_LINES) + np.arange(_STRAY_RETURNS, dtype=np.float64),
    )


def _write(path: Path, xyz: Floats, returns: Returns, at: Ints) -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.creation_date = _WRITTEN
    header.system_identifier = "simulated"
    header.generating_software = "epitransfer example"
    # LAS 1.4 asks for WKT 1, and compound systems for COMPD_CS.
    header.vlrs.append(WktCoordinateSystemVlr(CRS(COMPOUND_CRS).to_wkt("WKT1_GDAL")))
    header.global_encoding.wkt = True
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.floor(xyz.min(axis=0) / 100.0) * 100.0
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz[:, 0], xyz[:, 1], xyz[:, 2]
    las.classification = returns.classification[at].astype(np.uint8)
    las.scan_angle = np.rint(returns.scan_angle_deg[at] / _SCAN_ANGLE_DEG).astype(np.int16)
    las.point_source_id = returns.line[at].astype(np.uint16)
    las.gps_time = returns.time_s[at]
    las.return_number = np.ones(len(at), np.uint8)
    las.number_of_returns = np.ones(len(at), np.uint8)
    # One thread: the order of work must not reach the bytes.
    with path.open("wb") as file:
        las.write(file, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
