"""Runs that are tied to no place on earth: everything stays in the metres of the run's own frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pyproj import CRS

from pipeline.geometry.arrays import Floats

# What ingest says of a run's world. Poses of motion capture, SLAM or a reconstruction know no latitude and longitude.
EARTH, LOCAL_WORLD = "earth", "local"

# An engineering CRS (ISO 19162:2019, 11), the kind for what is placed by itself alone, with heights that are so, too.
LOCAL_WKT = (
    'COMPOUNDCRS["local frame",'
    'ENGCRS["local frame, level",EDATUM["local"],CS[Cartesian,2],AXIS["easting (X)",east],AXIS["northing (Y)",north],'
    'LENGTHUNIT["metre",1]],'
    'VERTCRS["local height",VDATUM["local zero"],CS[vertical,1],AXIS["gravity-related height (H)",up],'
    'LENGTHUNIT["metre",1]]]'
)


def is_engineering(crs: CRS) -> bool:
    """Whether a CRS, or the horizontal part of a compound one, is an engineering CRS: tied to nothing else."""
    return bool((crs.sub_crs_list[0] if crs.is_compound else crs).is_engineering)


@dataclass(frozen=True)
class LocalTransform:
    """Leaves points where they are: the CRS of a run in a local frame is that frame."""

    @cached_property
    def crs(self) -> CRS:
        """The engineering CRS of the frame: x, y, z in metres, z up."""
        return CRS.from_wkt(LOCAL_WKT)

    @property
    def height_note(self) -> str:
        """What is done with heights, in one line for the manifest and the report."""
        return "local frame"

    def from_enu(self, p_in_enu_m: Floats) -> Floats:
        """Points of the frame, (..., 3) m, unchanged."""
        return np.array(p_in_enu_m, np.float64)

    def enu_from(self, p_in_crs: Floats) -> Floats:
        """Points of the frame, (..., 3) m, unchanged."""
        return np.array(p_in_crs, np.float64)

    def jacobian(self, p_in_enu_m: Floats) -> Floats:
        """Derivative of the coordinates by those of the frame.

        Args:
            p_in_enu_m: (..., 3) m.

        Returns:
            (..., 3, 3) identities.
        """
        return np.broadcast_to(np.eye(3), (*np.shape(p_in_enu_m)[:-1], 3, 3)).copy()
