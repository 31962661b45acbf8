"""The frame the report's maps are drawn in: the CRS of the run's points, or its local frame where there are none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import ELLIPSOIDAL, is_orthometric
from pipeline.geodesy.transform import CrsTransform
from pipeline.geometry.arrays import Floats
from pipeline.points.geoparquet import PointDataset
from pipeline.reporting.gathered import RunData

_LOCAL_AXES = ("east of the origin (m)", "north of the origin (m)", "height above the origin (m)")


@dataclass(frozen=True, slots=True)
class Ground:
    """The frame of the maps.

    Args:
        transform: From the run's local frame; None where the maps are drawn in that frame.
        axes: Titles of the axes: east, north, up.
    """

    transform: CrsTransform | None
    axes: tuple[str, str, str]

    def place(self, p_in_enu_m: Floats) -> Floats:
        """Points of the local frame, (..., 3) m, in that of the maps."""
        p = np.asarray(p_in_enu_m, np.float64)
        return p if self.transform is None else self.transform.from_enu(p)

    @property
    def corner(self) -> Floats:
        """(3,) m near the local origin, in hundreds and level: what is left after it fits single precision."""
        east, north, _ = np.round(self.place(np.zeros(3)), -2)
        return np.array([east, north, 0.0])


def points_of(run: RunData) -> PointDataset | None:
    """The run's points, if it was fused."""
    folder = run.paths.get("points")
    return PointDataset(folder) if folder is not None and any(folder.glob("*.parquet")) else None


def ground_of(run: RunData) -> Ground:
    """The frame of a run's maps.

    Args:
        run: The run.

    Returns:
        The CRS of its points; the local frame, if it has none or its world is local.

    Raises:
        InputError: The points cannot be read.
        UndeterminedError: The geoid the points were made with is not there.
    """
    points = None if run.is_local else points_of(run)
    if points is None:
        return Ground(None, _LOCAL_AXES)
    facts, crs = run.facts("ingest"), points.crs
    source = facts["height_datum"]
    transform = CrsTransform(
        crs,
        LocalFrame(**facts["origin"]),
        # Ingest makes orthometric heights ellipsoidal.
        ELLIPSOIDAL if is_orthometric(source) else source,
        run.setting("ingest", "geoid"),
    )
    horizontal, vertical = (part.name for part in crs.sub_crs_list) if crs.is_compound else (crs.name, "ellipsoidal")
    return Ground(transform, (f"easting (m), {horizontal}", f"northing (m), {horizontal}", f"height (m), {vertical}"))
