"""Points as LAS 1.4, point format 7: 16-bit colour, GPS time, sigmas as extra bytes, CRS as WKT.

Source: ASPRS, LAS Specification 1.4 - R15 (2019).
"""

from __future__ import annotations

from datetime import UTC, date, datetime
from pathlib import Path

import laspy
import numpy as np
import pyarrow as pa
from laspy.header import GpsTimeType
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS

from pipeline.geometry.arrays import Floats, Ints
from pipeline.points.geoparquet import PointDataset, coordinates

SCALE_M = 0.001

# Column of the table, name of the extra bytes, type, description (at most 31 bytes).
_EXTRA = (
    ("sigma_x_m", "sigma_x", "f4", "one sigma along x, m"),
    ("sigma_y_m", "sigma_y", "f4", "one sigma along y, m"),
    ("sigma_z_m", "sigma_z", "f4", "one sigma along z, m"),
    ("cov_xy", "cov_xy", "f4", "covariance of x and y, m2"),
    ("cov_xz", "cov_xz", "f4", "covariance of x and z, m2"),
    ("cov_yz", "cov_yz", "f4", "covariance of y and z, m2"),
    ("n_pairs", "n_pairs", "u2", "pairs that saw the point"),
    ("n_frames", "n_frames", "u2", "frames with a part in it"),
)
_COLOURS = ("red", "green", "blue")
_UNIX_DAY, _GPS_DAY = date(1970, 1, 1), date(1980, 1, 6)
_ADJUSTED_GPS_S = 1_000_000_000
# Days from which UTC was one second further behind GPS time (IERS Bulletin C).
_LEAP_DAYS = tuple(
    date(year, month, 1)
    for year, month in (
        *((1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7)),
        *((1994, 7), (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1)),
    )
)
# PROJ reads a vertical part of this datum type (2002) as the third axis of an ellipsoidal CRS.
_ELLIPSOID_WKT1 = (
    'VERT_CS["Ellipsoid (metre)",VERT_DATUM["Ellipsoid",2002],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Up",UP]]'
)


def write_las(points: PointDataset, path: Path, *, compressed: bool) -> None:
    """Writes a dataset as LAS or LAZ, a row group at a time.

    Args:
        points: The dataset.
        path: The file.
        compressed: LAZ instead of LAS.
    """
    header = _header(points)
    with laspy.open(path, mode="w", header=header, do_compress=compressed) as writer:
        for table in points.tables():
            writer.write_points(_record(table, header))


def gps_time(times_ns: Ints) -> Floats:
    """Adjusted standard GPS time: GPS seconds less 1e9 (LAS 1.4, GPS time type 1).

    Args:
        times_ns: (n,) ns since 1970 UTC.

    Returns:
        (n,) s.
    """
    leap_ns = np.array([(day - _UNIX_DAY).days * 86_400 * 10**9 for day in _LEAP_DAYS])
    leap_s = np.searchsorted(leap_ns, times_ns, side="right")
    whole: Floats = (times_ns - (_GPS_DAY - _UNIX_DAY).days * 86_400 * 10**9 - _ADJUSTED_GPS_S * 10**9) / 1e9 + leap_s
    return whole


def wkt1(crs: CRS) -> str:
    """The CRS as LAS wants it: WKT 1 (OGC 01-009), its vertical part kept.

    Args:
        crs: A compound or a three-dimensional projected CRS.

    Returns:
        A COMPD_CS; WKT 1 has no three-dimensional projected CRS, so ellipsoidal height becomes its vertical part. The
        horizontal part of a local frame is a LOCAL_CS.
    """
    if crs.is_compound:
        return str(crs.to_wkt("WKT1_GDAL"))
    horizontal = crs.to_2d()
    return f'COMPD_CS["{crs.name} + ellipsoidal height",{horizontal.to_wkt("WKT1_GDAL")},{_ELLIPSOID_WKT1}]'


def _header(points: PointDataset) -> laspy.LasHeader:
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, SCALE_M)
    header.offsets = np.floor(points.bounds[:3])
    header.generating_software = "EpiTransfer"
    header.system_identifier = "EXTRACTION"
    # The spec wants the day the file was made; a day of the data's own keeps the bytes reproducible.
    header.creation_date = _day(points)
    header.global_encoding.gps_time_type = GpsTimeType.STANDARD
    header.global_encoding.wkt = True
    header.vlrs.append(WktCoordinateSystemVlr(wkt1(points.crs)))
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind, text) for _, name, kind, text in _EXTRA])
    return header


def _day(points: PointDataset) -> date:
    last = points.last_time_ns
    return datetime.fromtimestamp(last // 10**9, UTC).date() if last is not None else _UNIX_DAY


def _record(table: pa.Table, header: laspy.LasHeader) -> laspy.ScaleAwarePointRecord:
    record = laspy.ScaleAwarePointRecord.zeros(table.num_rows, header=header)
    record.x, record.y, record.z = coordinates(table).T
    record.return_number[:] = 1
    record.number_of_returns[:] = 1
    for colour in _COLOURS:
        # 8 bits to the full range of 16, as the specification asks.
        record[colour] = table.column(colour).to_numpy().astype(np.uint16) * 257
    for column, name, kind, _ in _EXTRA:
        values = table.column(column).to_numpy()
        record[name] = np.minimum(values, np.iinfo(np.uint16).max).astype(kind) if kind == "u2" else values
    times = table.column("time")
    known = times.is_valid().to_numpy()
    seconds = gps_time(times.cast(pa.int64()).fill_null(0).to_numpy())
    # Zero is the format's own "no time".
    record.gps_time = np.where(known, seconds, 0.0)
    return record
