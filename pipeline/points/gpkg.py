"""Points as a GeoPackage, made with sqlite alone.

Sources: OGC GeoPackage 1.3.1 (12-128r18) and its extension "WKT for Coordinate Reference Systems" (annex F.10).
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyproj import CRS

from pipeline.points.geoparquet import PointDataset
from pipeline.points.las import wkt1
from schemas import POINTS
from schemas.points import GEOMETRY

_TABLE = "points"
_APPLICATION_ID, _VERSION = 0x47504B47, 10301
# Of no register: a compound CRS has no code of its own.
_SRS_ID = 100_000
_LEFT_OUT = (GEOMETRY, "bbox")
_UNDATED = "1970-01-01T00:00:00.000Z"
# Magic, version 0, flags: little endian, no envelope (12-128r18, 2.1.3.1.1).
_BLOB_HEADER = b"GP\x00\x01" + _SRS_ID.to_bytes(4, "little")

_SETUP = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT,
  definition_12_063 TEXT NOT NULL DEFAULT 'undefined');
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name), CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_extensions (table_name TEXT, column_name TEXT, extension_name TEXT NOT NULL, definition TEXT NOT NULL,
  scope TEXT NOT NULL, CONSTRAINT ge_tce UNIQUE (table_name, column_name, extension_name));
INSERT INTO gpkg_extensions VALUES ('gpkg_spatial_ref_sys', 'definition_12_063', 'gpkg_crs_wkt',
  'http://www.geopackage.org/spec/#extension_crs_wkt', 'read-write');
"""


def write_gpkg(points: PointDataset, path: Path) -> None:
    """Writes a dataset as a GeoPackage with one layer, a row group at a time.

    Args:
        points: The dataset.
        path: A file that does not exist.
    """
    fields = [field for field in POINTS.arrow() if field.name not in _LEFT_OUT]
    declared = ", ".join(f'"{field.name}" {_sql_type(field.type)}' for field in fields)
    marks = ", ".join("?" * (len(fields) + 1))
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        # The file is renamed into place when it is complete, so a journal would guard nothing.
        database.execute("PRAGMA journal_mode = OFF")
        database.execute("PRAGMA synchronous = OFF")
        database.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
        database.execute(f"PRAGMA user_version = {_VERSION}")
        database.executescript(_SETUP)
        database.execute(
            f'CREATE TABLE {_TABLE} (fid INTEGER PRIMARY KEY AUTOINCREMENT, "{GEOMETRY}" POINT, {declared})'
        )
        _describe(database, points)
        columns = ", ".join(f'"{name}"' for name in (GEOMETRY, *(field.name for field in fields)))
        insert = f"INSERT INTO {_TABLE} ({columns}) VALUES ({marks})"  # noqa: S608  # the names are the schema's own
        database.execute("BEGIN")
        for table in points.tables():
            database.executemany(insert, _rows(table, fields))
        database.execute("COMMIT")


def _describe(database: sqlite3.Connection, points: PointDataset) -> None:
    """Fills the GeoPackage's own tables."""
    text = "INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?, ?)"
    wgs84 = CRS.from_epsg(4326)
    database.executemany(
        text,
        (
            ("Undefined Cartesian SRS", -1, "NONE", -1, "undefined", "undefined Cartesian", "undefined"),
            ("Undefined geographic SRS", 0, "NONE", 0, "undefined", "undefined geographic", "undefined"),
            (
                wgs84.name,
                4326,
                "EPSG",
                4326,
                wgs84.to_wkt("WKT1_GDAL"),
                "longitude and latitude",
                wgs84.to_wkt("WKT2_2019"),
            ),
            (
                points.crs.name,
                _SRS_ID,
                "NONE",
                _SRS_ID,
                wkt1(points.crs),
                "the points' CRS with its vertical part",
                points.crs.to_wkt("WKT2_2019"),
            ),
        ),
    )
    last = points.last_time_ns
    changed = _UNDATED if last is None else str(np.datetime_as_string(np.datetime64(last, "ns"), unit="ms")) + "Z"
    xmin, ymin, _, xmax, ymax, _ = points.bounds
    database.execute(
        "INSERT INTO gpkg_contents VALUES (?, 'features', ?, ?, ?, ?, ?, ?, ?, ?)",
        (_TABLE, _TABLE, POINTS.meaning, changed, xmin, ymin, xmax, ymax, _SRS_ID),
    )
    database.execute("INSERT INTO gpkg_geometry_columns VALUES (?, ?, 'POINT', ?, 1, 0)", (_TABLE, GEOMETRY, _SRS_ID))


def _rows(table: pa.Table, fields: list[pa.Field]) -> Iterator[tuple[object, ...]]:
    """Rows as sqlite takes them: the geometry's blob, then the columns."""
    values = [
        pc.strftime(column.cast(pa.timestamp("ms", "UTC"), safe=False), "%Y-%m-%dT%H:%M:%SZ")
        if pa.types.is_timestamp(field.type)
        else column
        for field, column in ((field, table.column(field.name)) for field in fields)
    ]
    blobs = (_BLOB_HEADER + wkb for wkb in table.column(GEOMETRY).to_pylist())
    return zip(blobs, *(column.to_pylist() for column in values), strict=True)


def _sql_type(kind: pa.DataType) -> str:
    if pa.types.is_timestamp(kind):
        return "DATETIME"
    if pa.types.is_string(kind):
        return "TEXT"
    return "INTEGER" if pa.types.is_integer(kind) else "FLOAT" if pa.types.is_float32(kind) else "DOUBLE"
