"""The fused points near a few cameras, in the local frame, with their covariances; only the tiles near are read."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pyproj import CRS
from scipy.spatial import cKDTree

from pipeline.engine.tables import dataset, explained
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import LOCAL
from pipeline.geodesy.local_world import LocalTransform
from pipeline.geodesy.transform import FrameTransform, to_enu
from pipeline.geometry.arrays import AnyArray, Bools, Floats
from pipeline.lidar.nearby import box_in_crs
from pipeline.lidar.tile_covariance import covariance_of
from pipeline.points.geoparquet import PointDataset, coordinates
from schemas.points import GEOMETRY

_AXES = ("x", "y", "z")
_COVARIANCE = ("sigma_x_m", "sigma_y_m", "sigma_z_m", "cov_xy", "cov_xz", "cov_yz")


@dataclass(frozen=True, slots=True)
class NearPoints:
    """Fused points.

    Args:
        p_in_enu_m: (n, 3) m.
        covariance: (n, 3, 3) m^2, ENU.
        frame_id: (n,) the frame of each one's best view.
    """

    p_in_enu_m: Floats
    covariance: Floats
    frame_id: AnyArray

    def of_frames(self, frame_ids: Sequence[str], centres_in_enu_m: Floats, max_range_m: float) -> Bools:
        """(n,) which points belong to some frames: their best view is one of these, no further off than a range.

        Args:
            frame_ids: (f,) names.
            centres_in_enu_m: (f, 3) their cameras, ENU m.
            max_range_m: Largest distance from the camera, m.
        """
        out = np.zeros(len(self.p_in_enu_m), np.bool_)
        for frame_id, centre in zip(frame_ids, centres_in_enu_m, strict=True):
            rows = np.flatnonzero(self.frame_id == frame_id)
            out[rows] = np.linalg.norm(self.p_in_enu_m[rows] - centre, axis=1) <= max_range_m
        return out


@dataclass(frozen=True, slots=True)
class PointsNear:
    """A points dataset and the way from its CRS; it is sent to other processes.

    Args:
        files: Its files.
        bounds: (f, 6) xmin, ymin, zmin, xmax, ymax, zmax of each, in the dataset's CRS.
        crs_wkt: That CRS.
        frame: The local frame; None for a run that is tied to no place on earth.
        geoid: Undulation in metres, a grid file, or None, as the configuration has it.
        height_datum: What the frame's heights are measured from.
    """

    files: tuple[Path, ...]
    bounds: Floats
    crs_wkt: str
    frame: LocalFrame | None
    geoid: float | str | None
    height_datum: str

    @staticmethod
    def of(
        folder: Path, frame: LocalFrame | None = None, geoid: float | str | None = None, height_datum: str = LOCAL
    ) -> PointsNear:
        """The points of a run.

        Args:
            folder: Its folder `points`.
            frame: As the class.
            geoid: As the class.
            height_datum: As the class.

        Raises:
            InputError: No dataset, an unreadable file, or one of another schema.
        """
        points = PointDataset(folder)
        bounds = np.array([_bounds(path) for path in points.files], np.float64)
        return PointsNear(tuple(points.files), bounds, points.crs.to_wkt(), frame, geoid, height_datum)

    @property
    def transform(self) -> FrameTransform:
        """The way from the dataset's CRS to the local frame.

        Raises:
            UndeterminedError: A height datum or the geoid between two is not known.
        """
        if self.frame is None:
            return LocalTransform()
        return to_enu(CRS.from_wkt(self.crs_wkt), self.frame, self.geoid, self.height_datum)

    def near(self, centres_in_enu_m: Floats, reach_m: float) -> NearPoints:
        """The points within a ground distance of any of some cameras.

        Args:
            centres_in_enu_m: (c, 3) ENU m; c >= 1.
            reach_m: Largest ground distance from the nearest camera, m.

        Raises:
            InputError: A file is damaged.
            UndeterminedError: A height datum or the geoid between two is not known.
        """
        transform = self.transform
        lower, upper = box_in_crs(transform, centres_in_enu_m, reach_m)
        meets = np.all((self.bounds[:, :2] <= upper[:2]) & (self.bounds[:, 3:5] >= lower[:2]), axis=1)
        tables = [_rows(self.files[i], lower, upper) for i in np.flatnonzero(meets)]
        points = [_points(table, transform) for table in tables if table.num_rows]
        if not points:
            return NearPoints(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, object))
        p, covariance, names = (np.concatenate(part) for part in zip(*points, strict=True))
        close = cKDTree(centres_in_enu_m[:, :2]).query(p[:, :2])[0] <= reach_m
        return NearPoints(p[close], covariance[close], names[close])


def _rows(path: Path, lower: Floats, upper: Floats) -> pa.Table:
    """The rows of a file in a horizontal box; row groups that do not meet it are not read."""
    x, y = pc.field("x"), pc.field("y")
    inside = (x >= lower[0]) & (x <= upper[0]) & (y >= lower[1]) & (y <= upper[1])
    with explained(path, "points"):
        return dataset(path).to_table(columns=[*_AXES, *_COVARIANCE, "frame_id"], filter=inside)


def _points(table: pa.Table, transform: FrameTransform) -> tuple[Floats, Floats, AnyArray]:
    p = transform.enu_from(coordinates(table))
    covariance = covariance_of([table.column(name).to_numpy() for name in _COVARIANCE])
    return p, covariance_in_enu(covariance, p, transform), _names(table)


def covariance_in_enu(covariance: Floats, p_in_enu_m: Floats, transform: FrameTransform) -> Floats:
    """Covariances on the axes of a CRS, as points and tiles have them, on those of the local frame.

    Args:
        covariance: (n, 3, 3) on the CRS's axes.
        p_in_enu_m: (n, 3) where the points are, ENU m; n >= 1.
        transform: The way to the CRS.

    Returns:
        (n, 3, 3) m^2, ENU.
    """
    # One for all of them: it changes by 1e-4 over a kilometre.
    enu_from_crs = np.linalg.inv(transform.jacobian(p_in_enu_m.mean(axis=0)))
    out: Floats = enu_from_crs @ covariance @ enu_from_crs.T
    return out


def _names(table: pa.Table) -> AnyArray:
    return np.asarray(table.column("frame_id").to_numpy(zero_copy_only=False), object)


def _bounds(path: Path) -> list[float]:
    """What GeoParquet says of a file's extent; the dataset was checked before."""
    geo = json.loads(pq.read_metadata(path).metadata[b"geo"])
    return [float(x) for x in geo["columns"][GEOMETRY]["bbox"]]
