"""The points dataset: tiled Parquet files that are GeoParquet 1.1.0 and native Parquet GEOMETRY at once.

Sources: GeoParquet 1.1.0, format-specs/geoparquet.md; Parquet format, Geospatial.md and LogicalTypes.md (GEOMETRY).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pyproj import CRS
from pyproj.exceptions import CRSError

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import AnyArray, Floats
from pipeline.points.wkb import point_z_column
from schemas import POINTS, SchemaError
from schemas.points import BBOX, GEOMETRY

GEO_VERSION = "1.1.0"
"""Version of the `geo` key. Readers of 1.1 find all they need; native GEOMETRY comes on top of it."""

ROW_GROUP = 50_000
"""Rows of a row group: the grain of a bbox query."""

DERIVED = (GEOMETRY, "tile", "bbox")
"""Columns that `tile_table` makes."""

_AXES = ("x", "y", "z")
_IDENTIFIERS = ("frame_id", "tile")


class _GeoArrowWkb(pa.ExtensionType):  # type: ignore[misc]  # pyarrow has no types
    """WKB with a CRS: the Arrow type that pyarrow writes as Parquet's GEOMETRY."""

    def __init__(self, crs: Mapping[str, Any]) -> None:
        self._crs = dict(crs)
        super().__init__(pa.binary(), "geoarrow.wkb")

    def __arrow_ext_serialize__(self) -> bytes:
        return json.dumps({"crs": self._crs}).encode()

    @classmethod
    def __arrow_ext_deserialize__(cls, storage: pa.DataType, serialized: bytes) -> _GeoArrowWkb:
        del storage
        return cls(json.loads(serialized)["crs"])


@dataclass(frozen=True, slots=True)
class TileFile:
    """One file of the dataset.

    Args:
        name: The tile's name, the file's stem.
        rows: Number of points.
        bounds: xmin, ymin, zmin, xmax, ymax, zmax in the dataset's CRS.
        times_ns: First and last exposure, ns since 1970 UTC; None where no point has a time.
    """

    name: str
    rows: int
    bounds: tuple[float, ...]
    times_ns: tuple[int, int] | None


def tile_table(columns: Mapping[str, object], tile: str) -> pa.Table:
    """A tile's table from its columns, with geometry, bbox and tile made from them.

    Args:
        columns: All columns of POINTS but `DERIVED`, rows in the order they are to have.
        tile: The tile's name.

    Returns:
        A table as `schemas.POINTS`.

    Raises:
        SchemaError: A column is missing, unknown or of the wrong type.
    """
    xyz = np.stack([np.asarray(columns[axis], np.float64) for axis in _AXES], axis=-1)
    corners = [pa.array(xyz[:, axis]) for axis in range(3)]
    return POINTS.from_columns(
        {
            **columns,
            GEOMETRY: point_z_column(xyz),
            "tile": pa.array([tile] * len(xyz), pa.string()),
            "bbox": pa.StructArray.from_arrays([*corners, *corners], fields=list(BBOX)),
        }
    )


def write_dataset(folder: Path, tiles: Iterable[pa.Table], crs: CRS) -> list[TileFile]:
    """Writes tiles as they come, one file each; only one tile is in memory.

    Args:
        folder: An existing folder.
        tiles: Tables as `tile_table` makes them, each of one tile, not empty.
        crs: The dataset's CRS, with its vertical part.

    Returns:
        What was written, in the order of the tiles.
    """
    written = []
    for table in tiles:
        name = table.column("tile")[0].as_py()
        with PointsWriter(folder / f"{name}.parquet", crs, bounds_of(table)) as writer:
            writer.write(table)
        written.append(TileFile(name, table.num_rows, bounds_of(table), _times(table)))
    return written


class PointsWriter:
    """Writes one file, a table at a time; equal tables give equal bytes.

    Args:
        path: The file.
        crs: The CRS of its points.
        bounds: xmin, ymin, zmin, xmax, ymax, zmax of all of them.
    """

    def __init__(self, path: Path, crs: CRS, bounds: tuple[float, ...]) -> None:
        projjson = crs.to_json_dict()
        plain = POINTS.arrow()
        geometry = plain.field(GEOMETRY).with_type(_GeoArrowWkb(projjson))
        metadata = {**(plain.metadata or {}), b"geo": json.dumps(_geo(projjson, bounds)).encode()}
        self._schema = plain.set(plain.get_field_index(GEOMETRY), geometry).with_metadata(metadata)
        floats = [field.name for field in plain if pa.types.is_floating(field.type)]
        self._writer = pq.ParquetWriter(
            path,
            self._schema,
            compression="zstd",
            compression_level=3,
            use_dictionary=list(_IDENTIFIERS),
            use_byte_stream_split=[*floats, *(f"bbox.{field.name}" for field in BBOX)],
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def write(self, table: pa.Table) -> None:
        """Writes a table of POINTS in row groups of at most `ROW_GROUP`, equal in size."""
        groups = max(-(-table.num_rows // ROW_GROUP), 1)
        self._writer.write_table(table.cast(self._schema), row_group_size=-(-table.num_rows // groups))


class PointDataset:
    """A points dataset to read, row group by row group.

    Args:
        folder: The folder `points` of a run.

    Raises:
        InputError: No dataset, an unreadable file, or one of another schema.
    """

    def __init__(self, folder: Path) -> None:
        self.files = sorted(folder.glob("*.parquet"))
        if not self.files:
            raise InputError(
                "E-POINTS-01",
                "the run has no points",
                where=str(folder),
                expected="a GeoParquet dataset",
                hint="run: epitransfer fuse RUN",
            )
        self.rows = 0
        boxes: list[list[float]] = []
        latest: list[int] = []
        for path in self.files:
            metadata, geo = _metadata(path)
            self.rows += metadata.num_rows
            boxes.append(geo["bbox"])
            latest += _latest_times(metadata)
            if path == self.files[0]:
                self.crs = _crs(path, geo)
        self.last_time_ns = max(latest, default=None)
        corners = np.array(boxes, np.float64)
        self.bounds = (*corners[:, :3].min(axis=0).tolist(), *corners[:, 3:].max(axis=0).tolist())

    def tables(self) -> Iterator[pa.Table]:
        """The row groups, in the order of the files.

        Yields:
            Tables as `schemas.POINTS`, the geometry as plain WKB.

        Raises:
            InputError: A file is damaged.
        """
        for path in self.files:
            try:
                with pq.ParquetFile(path, arrow_extensions_enabled=False) as file:
                    for group in range(file.num_row_groups):
                        yield plain(file.read_row_group(group))
            except (pa.ArrowException, OSError) as error:
                raise _unreadable(path, str(error)) from error


def plain(table: pa.Table) -> pa.Table:
    """The table with its geometry as plain binary, whichever Arrow extensions this process has loaded."""
    index = table.schema.get_field_index(GEOMETRY)
    if isinstance(table.schema.field(index).type, pa.ExtensionType):
        column = pa.chunked_array([chunk.storage for chunk in table.column(index).chunks], pa.binary())
        return table.set_column(index, table.schema.field(index).with_type(pa.binary()), column)
    return table


def bounds_of(table: pa.Table) -> tuple[float, ...]:
    """xmin, ymin, zmin, xmax, ymax, zmax of a table of POINTS; NaN where it is empty."""
    if not table.num_rows:
        return (float("nan"),) * 6
    xyz = coordinates(table)
    return (*xyz.min(axis=0).tolist(), *xyz.max(axis=0).tolist())


def coordinates(table: pa.Table) -> Floats:
    """x, y, z of a table of POINTS, (n, 3) in the dataset's CRS."""
    columns: list[AnyArray] = [table.column(axis).to_numpy() for axis in _AXES]
    return np.stack(columns, axis=-1)


def _times(table: pa.Table) -> tuple[int, int] | None:
    times = table.column("time").drop_null().cast(pa.int64()).to_numpy()
    return (int(times.min()), int(times.max())) if len(times) else None


def _geo(projjson: Mapping[str, Any], bounds: tuple[float, ...]) -> dict[str, Any]:
    """The `geo` key of GeoParquet 1.1.0."""
    column = {
        "encoding": "WKB",
        "geometry_types": ["Point Z"],
        "crs": dict(projjson),
        "bbox": list(bounds),
        "covering": {"bbox": {field.name: ["bbox", field.name] for field in BBOX}},
    }
    return {"version": GEO_VERSION, "primary_column": GEOMETRY, "columns": {GEOMETRY: column}}


def _metadata(path: Path) -> tuple[pq.FileMetaData, dict[str, Any]]:
    """A file's metadata and the `geo` entry of its geometry, after the check of its schema."""
    try:
        with pq.ParquetFile(path, arrow_extensions_enabled=False) as file:
            metadata, schema = file.metadata, file.schema_arrow
        index = schema.get_field_index(GEOMETRY)
        POINTS.check_schema(plain(schema.empty_table()).schema if index >= 0 else schema)
        geo: dict[str, Any] = json.loads(metadata.metadata[b"geo"])["columns"][GEOMETRY]
    except (pa.ArrowException, OSError) as error:
        raise _unreadable(path, str(error)) from error
    except (KeyError, ValueError, SchemaError) as error:
        raise InputError(
            "E-POINTS-03",
            "not a points file of this version",
            where=str(path),
            found=str(error),
            hint="run: epitransfer fuse RUN",
        ) from error
    return metadata, geo


def _latest_times(metadata: pq.FileMetaData) -> list[int]:
    """The last exposure of each row group that has one, ns since 1970 UTC, from the file's statistics."""
    found = []
    for group in (metadata.row_group(index) for index in range(metadata.num_row_groups)):
        column = next(c for c in map(group.column, range(group.num_columns)) if c.path_in_schema == "time")
        if column.statistics is not None and column.statistics.has_min_max:
            found.append(int(column.statistics.max_raw))
    return found


def _crs(path: Path, geo: Mapping[str, Any]) -> CRS:
    try:
        return CRS.from_json_dict(geo["crs"])
    except (KeyError, TypeError, CRSError) as error:
        raise InputError("E-POINTS-04", "the points file has no CRS", where=str(path), found=str(error)) from error


def _unreadable(path: Path, found: str) -> InputError:
    return InputError(
        "E-POINTS-02",
        "a points file cannot be read",
        where=str(path),
        found=found,
        hint="run again: epitransfer fuse RUN",
    )
