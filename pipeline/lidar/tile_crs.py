"""The coordinate reference system of a LiDAR tile, its vertical part included: WKT record first, then GeoTIFF keys."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import laspy
import pyproj
from laspy.vlrs.known import GeoKeyDirectoryVlr, WktCoordinateSystemVlr
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError

from pipeline.engine.errors import UndeterminedError, UsageError
from pipeline.geodesy.heights import ELLIPSOIDAL, VERTICAL_EPSG, height_datum
from pipeline.geodesy.local_world import LocalTransform, is_engineering

# GeoTIFF keys (OGC 19-008r4, annex B; GeoTIFF 1.0 revision 1.8.2, 6.3.3 and 6.3.4).
_GEODETIC, _PROJECTED, _VERTICAL, _VERTICAL_UNITS = 2048, 3072, 4096, 4099
_FIRST_CODE, _LAST_CODE = 1024, 32766
# GeoTIFF 1.0 had vertical codes of its own: ellipsoids from 5001 to 5033, and 5103 for NAVD88.
_GEOTIFF1_ELLIPSOIDS = range(5001, 5034)
_GEOTIFF1_VERTICAL = {5103: 5703}
_IN_UNITS = {(5703, 9001): 5703, (5703, 9002): 8228, (5703, 9003): 6360}
_RECORDS = "LASF_Projection"


def tile_crs(header: laspy.LasHeader, path: Path, height_datum: str | None = None) -> pyproj.CRS:
    """The three-dimensional CRS of a tile.

    Args:
        header: The tile's header, extended records included.
        path: Named in errors.
        height_datum: What the heights are measured from where the tile does not say: "ellipsoidal", "egm96", "egm2008",
            "navd88" (metres) or the code of a vertical CRS ("EPSG:6360"), which carries its unit.

    Returns:
        A compound, geocentric or otherwise three-dimensional CRS.

    Raises:
        UndeterminedError: The tile names no CRS, or one without a vertical part and no datum is stated.
        UsageError: `height_datum` is none of the above.
    """
    crs = _from_records(_projection_records(header), path)
    if crs is None:
        raise UndeterminedError(
            "E-LIDAR-03", "the tile does not name its CRS", where=str(path),
            found="no WKT record and no GeoTIFF keys with a known code",
            expected="a compound CRS, such as EPSG:32617+5703",
            hint=_tag_hint(path),
        )  # fmt: skip
    if is_engineering(crs):
        raise UndeterminedError(
            "E-LIDAR-09", "the tile is in a frame of its own, and nothing says where on earth that lies",
            where=str(path), found=f"{crs.name}, an engineering CRS", expected="a CRS on earth: the flight has one",
            hint=_tag_hint(path),
        )  # fmt: skip
    if has_heights(crs):
        return crs
    if height_datum is None:
        raise UndeterminedError(
            "E-LIDAR-04", "the tile's CRS does not say what its heights are measured from", where=str(path),
            found=f"{crs.name}, two-dimensional", expected="a compound CRS, such as EPSG:32617+5703",
            hint="state it for such tiles: --set score.lidar_height_datum=... (ellipsoidal, egm96, egm2008, navd88, or "
            f"the EPSG code of their vertical CRS), or {_tag_hint(path, crs)}",
        )  # fmt: skip
    return _with_stated_heights(crs, height_datum, path)


def local_tile_crs(header: laspy.LasHeader, path: Path) -> pyproj.CRS:
    """The CRS of a tile that has to be in the run's own frame: no CRS at all, or an engineering CRS in metres.

    Args:
        header: The tile's header, extended records included.
        path: Named in errors.

    Returns:
        The engineering CRS of local frames.

    Raises:
        UndeterminedError: The tile is somewhere on earth, or not in metres.
    """
    crs = _from_records(_projection_records(header), path)
    if crs is not None and not is_engineering(crs):
        raise UndeterminedError(
            "E-LIDAR-10", "the tile is on earth, and nothing says where on earth the run's frame lies", where=str(path),
            found=crs.name, expected="a tile in the frame of the poses, with no CRS or an engineering CRS",
            hint="bring the tile into the frame of the poses, or leave score.lidar out to use the run's own sweeps",
        )  # fmt: skip
    if crs is not None and any(axis.unit_conversion_factor != 1.0 for axis in crs.axis_info):
        raise UndeterminedError(
            "E-LIDAR-11", "the tile is not in metres", where=str(path),
            found=f"{crs.name}, {crs.axis_info[0].unit_name}", expected="metres, as the poses are",
            hint="rewrite it in metres",
        )  # fmt: skip
    return LocalTransform().crs


def _tag_hint(path: Path, crs: pyproj.CRS | None = None) -> str:
    """How to tag a tile; its own horizontal CRS is named where it is known, the rest only its owner knows."""
    code = crs.to_epsg() if crs is not None else None
    horizontal = f"EPSG:{code}" if code is not None else "EPSG:HORIZONTAL"
    return f"tag it: pdal translate {path.name} tagged.laz --writers.las.a_srs={horizontal}+VERTICAL (its EPSG codes)"


def has_heights(crs: pyproj.CRS) -> bool:
    """Whether a CRS has a third axis with a datum."""
    return bool(crs.is_compound or crs.is_geocentric or len(crs.axis_info) == 3)


def _projection_records(header: laspy.LasHeader) -> list[object]:
    records: list[object] = list(header.vlrs.get_by_id(_RECORDS))
    if header.evlrs is not None:
        records += header.evlrs.get_by_id(_RECORDS)
    return records


def _from_records(records: Iterable[object], path: Path) -> pyproj.CRS | None:
    listed = list(records)
    for record in listed:
        if isinstance(record, WktCoordinateSystemVlr) and (wkt := str(record.string).strip("\0 \n")):
            return _parsed(wkt, path)
    for record in listed:
        if isinstance(record, GeoKeyDirectoryVlr):
            return _from_geokeys({int(key.id): int(key.value_offset) for key in record.geo_keys}, path)
    return None


def _from_geokeys(keys: dict[int, int], path: Path) -> pyproj.CRS | None:
    codes = [keys[key] for key in (_PROJECTED, _GEODETIC) if _FIRST_CODE <= keys.get(key, 0) <= _LAST_CODE]
    if not codes:
        return None
    horizontal = _parsed(f"EPSG:{codes[0]}", path)
    vertical = keys.get(_VERTICAL, 0)
    if vertical in _GEOTIFF1_ELLIPSOIDS:
        return horizontal.to_3d()
    vertical = _GEOTIFF1_VERTICAL.get(vertical, vertical)
    if has_heights(horizontal) or not _FIRST_CODE <= vertical <= _LAST_CODE:
        return horizontal
    vertical = _IN_UNITS.get((vertical, keys.get(_VERTICAL_UNITS, 0)), vertical)
    return _compound(horizontal, _parsed(f"EPSG:{vertical}", path), path)


def _with_stated_heights(crs: pyproj.CRS, stated: str, path: Path) -> pyproj.CRS:
    try:
        datum = height_datum(stated)
    except UsageError:
        # Not one of the names, so the code of a vertical CRS, or nothing that PROJ knows.
        datum = stated
    metric = all(abs(axis.unit_conversion_factor - 1.0) < 1e-9 for axis in crs.axis_info) or crs.is_geographic
    if datum in (ELLIPSOIDAL, *VERTICAL_EPSG) and not metric:
        raise UndeterminedError(
            "E-LIDAR-05", "the tile is in feet, and whether its heights are too is not stated", where=str(path),
            found=f"{crs.name} in {crs.axis_info[0].unit_name}, heights from {datum}",
            expected="the code of a vertical CRS, which carries its unit",
            hint="--set score.lidar_height_datum=EPSG:6360 (NAVD88 in US survey feet), EPSG:8228 (in feet) or "
            "EPSG:5703 (in metres)",
        )  # fmt: skip
    if datum == ELLIPSOIDAL:
        return crs.to_3d()
    try:
        vertical = pyproj.CRS.from_user_input(VERTICAL_EPSG.get(datum, datum))
    except CRSError as error:
        raise _not_vertical(datum) from error
    if not vertical.is_vertical:
        raise _not_vertical(datum)
    return _compound(crs, vertical, path)


def _compound(horizontal: pyproj.CRS, vertical: pyproj.CRS, path: Path) -> pyproj.CRS:
    try:
        return CompoundCRS(f"{horizontal.name} + {vertical.name}", [horizontal, vertical])
    except CRSError as error:
        raise _not_understood(path, f"{horizontal.name} + {vertical.name}", error) from error


def _parsed(text: str, path: Path) -> pyproj.CRS:
    try:
        return pyproj.CRS.from_user_input(text)
    except CRSError as error:
        raise _not_understood(path, text, error) from error


def _not_understood(path: Path, text: str, error: CRSError) -> UndeterminedError:
    return UndeterminedError(
        "E-LIDAR-06", "the tile's CRS is not understood", where=str(path), found=f"{text[:120]} ({str(error)[:200]})",
        hint=_tag_hint(path),
    )  # fmt: skip


def _not_vertical(datum: str) -> UsageError:
    return UsageError(
        "E-LIDAR-07", "score.lidar_height_datum is not a height datum", found=datum,
        expected=", ".join((ELLIPSOIDAL, *VERTICAL_EPSG)) + " or the code of a vertical CRS, such as EPSG:6360",
    )  # fmt: skip
