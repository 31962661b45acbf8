"""The STAC item beside the points: where and when, in which CRS, how many, and the files.

Sources: STAC 1.1.0 item-spec; extensions projection v2.0.0, pointcloud v2.0.0, table v1.2.0.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pyarrow as pa
from pyproj import CRS, Transformer

from pipeline.geodesy.local_world import is_engineering
from pipeline.points.geoparquet import TileFile
from schemas import POINTS
from schemas.points import GEOMETRY

STAC_VERSION = "1.1.0"
EXTENSIONS = (
    "https://stac-extensions.github.io/projection/v2.0.0/schema.json",
    "https://stac-extensions.github.io/pointcloud/v2.0.0/schema.json",
    "https://stac-extensions.github.io/table/v1.2.0/schema.json",
)
PARQUET_MEDIA_TYPE = "application/vnd.apache.parquet"

# STAC wants an interval; where no image has a time, this one is true.
_ANY_TIME = ("0001-01-01T00:00:00Z", "9999-12-31T23:59:59Z")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
# The footprint's edges are straight in the CRS, so each gets some corners in longitude and latitude.
_EDGE_POINTS = 8


def item(files: Sequence[TileFile], crs: CRS, item_id: str, description: str) -> dict[str, Any]:
    """The STAC item of a points dataset; the same dataset gives the same item.

    Args:
        files: What `geoparquet.write_dataset` wrote; not empty.
        crs: The dataset's CRS, with its vertical part.
        item_id: Identifier of the item.
        description: One sentence for people.

    Returns:
        A GeoJSON feature.
    """
    boxes = np.array([file.bounds for file in files])
    bounds = [*boxes[:, :3].min(axis=0).tolist(), *boxes[:, 3:].max(axis=0).tolist()]
    rows = sum(file.rows for file in files)
    authority = crs.to_authority()
    return {
        "type": "Feature",
        "stac_version": STAC_VERSION,
        "stac_extensions": list(EXTENSIONS),
        "id": item_id,
        **_where(crs, bounds),
        "properties": {
            "title": item_id,
            "description": description,
            **_when(files),
            "proj:code": ":".join(authority) if authority else None,
            "proj:projjson": crs.to_json_dict(),
            "proj:bbox": bounds,
            "pc:count": rows,
            "pc:type": "eopc",
            "pc:schemas": [_dimension(field) for field in POINTS.arrow() if _is_number(field.type)],
            "table:row_count": rows,
            "table:primary_geometry": GEOMETRY,
            "table:columns": [
                {"name": column.name, "description": column.meaning, "type": str(column.type)}
                for column in POINTS.columns
            ],
        },
        "links": [],
        "assets": {
            file.name: {
                "href": f"./{file.name}.parquet",
                "type": PARQUET_MEDIA_TYPE,
                "title": f"{file.rows} points of tile {file.name}",
                "roles": ["data"],
                "proj:bbox": list(file.bounds),
                "table:row_count": file.rows,
            }
            for file in files
        },
    }


def _where(crs: CRS, bounds: Sequence[float]) -> dict[str, Any]:
    """Footprint and box in longitude and latitude; an engineering CRS has none, and then STAC forbids the box."""
    if is_engineering(crs):
        return {"geometry": None}
    ring = _footprint(crs, bounds)
    corners = np.array(ring)
    return {
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "bbox": [*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist()],
    }


def _footprint(crs: CRS, bounds: Sequence[float]) -> list[list[float]]:
    """The bounds as a closed ring, counterclockwise, longitude and latitude in degrees (WGS 84)."""
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs.to_2d()
    transformer = Transformer.from_crs(horizontal, "EPSG:4326", always_xy=True, allow_ballpark=False)
    west, south, _, east, north, _ = bounds
    along = np.linspace(0.0, 1.0, _EDGE_POINTS, endpoint=False)
    x = np.concatenate(
        [
            west + (east - west) * along,
            np.full_like(along, east),
            east - (east - west) * along,
            np.full_like(along, west),
        ]
    )
    y = np.concatenate(
        [
            np.full_like(along, south),
            south + (north - south) * along,
            np.full_like(along, north),
            north - (north - south) * along,
        ]
    )
    longitude, latitude = transformer.transform(x, y)
    # Nine decimals are a tenth of a millimetre, and hide the last bits, which differ between builds of PROJ.
    ring: list[list[float]] = np.round(np.stack([longitude, latitude], axis=-1), 9).tolist()
    return [*ring, ring[0]]


def _when(files: Sequence[TileFile]) -> dict[str, Any]:
    spans = [file.times_ns for file in files if file.times_ns is not None]
    if not spans:
        return {"datetime": None, "start_datetime": _ANY_TIME[0], "end_datetime": _ANY_TIME[1]}
    first, last = min(span[0] for span in spans), max(span[1] for span in spans)
    return {"datetime": None, "start_datetime": _rfc3339(first), "end_datetime": _rfc3339(last)}


def _rfc3339(time_ns: int) -> str:
    return (_EPOCH + timedelta(microseconds=time_ns // 1000)).isoformat().replace("+00:00", "Z")


def _is_number(kind: pa.DataType) -> bool:
    return bool(pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_timestamp(kind))


def _dimension(field: pa.Field) -> dict[str, Any]:
    """A dimension as the pointcloud extension names it."""
    kind = (
        "floating"
        if pa.types.is_floating(field.type)
        else "unsigned"
        if pa.types.is_unsigned_integer(field.type)
        else "signed"
    )
    return {"name": field.name, "size": field.type.bit_width // 8, "type": kind}
