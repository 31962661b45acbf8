"""Points in another format: the same CRS, the uncertainties kept, memory bounded by a row group.

A file appears under its name only when it is complete.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import lazrs  # type: ignore[import-untyped]
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from pipeline.engine.errors import ResourceError, UsageError
from pipeline.points.colmap_export import SUFFIX
from pipeline.points.geoparquet import ROW_GROUP, PointDataset, PointsWriter
from pipeline.points.gpkg import write_gpkg
from pipeline.points.las import write_las
from schemas import POINTS
from schemas.points import GEOMETRY

# A tenth of a millimetre: below any point's sigma, and what a double holds at UTM's northings with room to spare.
_COORDINATE_DECIMALS = 4
_COORDINATES = ("x", "y", "z")
# As Arrow calls them, and as PLY does; text and times have no place in a PLY file.
_PLY_TYPES = {"double": "double", "float": "float", "uint8": "uchar", "int64": "int"}
_PLY_DTYPES = {"double": "<f8", "float": "<f4", "uchar": "u1", "int": "<i4"}


def export_points(points_folder: Path, target: Path) -> int:
    """Writes a run's points to one file of the format its suffix names.

    Args:
        points_folder: The folder `points` of a run.
        target: The file; replaced when it exists.

    Returns:
        Number of points.

    Raises:
        UsageError: The suffix names no known format.
        InputError: The run has no points, or they cannot be read.
        ResourceError: The file cannot be written.
    """
    write = WRITERS.get(target.suffix.lower())
    if write is None:
        raise UsageError(
            "E-EXPORT-01",
            "no such format to export to",
            where=str(target),
            found=target.suffix or "no suffix",
            expected=", ".join((*WRITERS, SUFFIX)),
            hint=f"--to {target.with_suffix('.laz')}",
        )
    points = PointDataset(points_folder)
    with _in_place(target) as temporary:
        write(points, temporary)
        if target.suffix.lower() in _WITH_SIDECAR:
            target.with_suffix(".prj").write_text(points.crs.to_wkt("WKT2_2019") + "\n", encoding="utf-8")
    return points.rows


def write_csv(points: PointDataset, path: Path) -> None:
    """Writes a dataset as CSV with a header: coordinates to 0.1 mm, times in ISO 8601, no geometry.

    Args:
        points: The dataset.
        path: The file.
    """
    names = [name for name in POINTS.arrow().names if name not in (GEOMETRY, "bbox")]
    schema = pa.schema([pa.field(name, _csv_type(POINTS.arrow().field(name).type)) for name in names])
    with csv.CSVWriter(path, schema, write_options=csv.WriteOptions(quoting_style="needed")) as writer:
        for table in points.tables():
            columns = [_csv_column(name, table.column(name)) for name in names]
            writer.write_table(pa.Table.from_arrays(columns, schema=schema))


def write_parquet(points: PointDataset, path: Path) -> None:
    """Writes a dataset as one GeoParquet file, its small row groups joined.

    Args:
        points: The dataset.
        path: The file.
    """
    with PointsWriter(path, points.crs, points.bounds) as writer:
        waiting: list[pa.Table] = []
        rows = 0
        for table in points.tables():
            if waiting and rows + table.num_rows > ROW_GROUP:
                writer.write(pa.concat_tables(waiting))
                waiting, rows = [], 0
            waiting.append(table)
            rows += table.num_rows
        writer.write(pa.concat_tables(waiting))


def write_ply(points: PointDataset, path: Path) -> None:
    """Writes a dataset as binary little-endian PLY: double coordinates, sigmas, covariances and colours per vertex.

    Args:
        points: The dataset.
        path: The file.

    Source: Turk, "The PLY Polygon File Format" (1994).
    """
    fields = [(field.name, _PLY_TYPES[str(field.type)]) for field in POINTS.arrow() if str(field.type) in _PLY_TYPES]
    layout = np.dtype([(name, _PLY_DTYPES[kind]) for name, kind in fields])
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment EpiTransfer points; sigmas in metres, covariances in square metres",
        # A comment is one line of ASCII; WKT escapes what is not by its own rules, PROJ writes names as they are.
        "comment crs " + points.crs.to_wkt("WKT2_2019").encode("ascii", "replace").decode(),
        f"element vertex {points.rows}",
        *(f"property {kind} {name}" for name, kind in fields),
        "end_header",
    ]
    with path.open("wb") as stream:
        stream.write(("\n".join(header) + "\n").encode())
        for table in points.tables():
            vertices = np.empty(table.num_rows, layout)
            for name, _ in fields:
                vertices[name] = table.column(name).to_numpy()
            stream.write(vertices.tobytes())


WRITERS: dict[str, Callable[[PointDataset, Path], None]] = {
    ".laz": partial(write_las, compressed=True),
    ".las": partial(write_las, compressed=False),
    ".ply": write_ply,
    ".gpkg": write_gpkg,
    ".csv": write_csv,
    ".parquet": write_parquet,
}
"""What writes which suffix."""

# Formats that cannot hold a CRS: it goes into FILE.prj, where GDAL looks for it.
_WITH_SIDECAR = (".csv",)


@contextmanager
def _in_place(target: Path) -> Iterator[Path]:
    """A file to write to that takes its name when the block ends without an error."""
    temporary = target.with_name(f".{target.name}.tmp")
    try:
        temporary.unlink(missing_ok=True)
        yield temporary
        temporary.replace(target)
    except (OSError, sqlite3.Error, lazrs.LazrsError) as error:
        raise ResourceError(
            "E-EXPORT-02",
            "the file cannot be written",
            where=str(target),
            found=str(error),
            hint="check that its folder exists, is writable and has room",
        ) from error
    finally:
        # A folder that cannot be written to or looked into has no leftover of ours either.
        if temporary.parent.is_dir():
            temporary.unlink(missing_ok=True)


def _csv_type(kind: pa.DataType) -> pa.DataType:
    return pa.string() if pa.types.is_timestamp(kind) else kind


def _csv_column(name: str, column: pa.ChunkedArray) -> pa.ChunkedArray:
    if name in _COORDINATES:
        return pc.round(column, _COORDINATE_DECIMALS)
    if pa.types.is_timestamp(column.type):
        return pc.strftime(column, "%Y-%m-%dT%H:%M:%SZ")
    return column
