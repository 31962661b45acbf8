"""From the site's ENU frame to the CRS that its tiles and control points are given in: UTM zone 17N and NAVD 88."""

from __future__ import annotations

import numpy as np
from pyproj import Transformer

from pipeline.geodesy.enu import LocalFrame
from pipeline.geometry.arrays import Floats
from pipeline.simulation.site import UNDULATION_M

HORIZONTAL_CRS = "EPSG:32617"
COMPOUND_CRS = "EPSG:32617+5703"


def navd88_height(ellipsoidal_m: Floats) -> Floats:
    """Heights above NAVD 88 of ellipsoidal ones, by the site's constant undulation."""
    return ellipsoidal_m - UNDULATION_M


def grid_from_enu(frame: LocalFrame, p_in_enu_m: Floats) -> Floats:
    """Easting, northing and NAVD 88 height of points.

    Args:
        frame: The site's frame.
        p_in_enu_m: (n, 3) ENU, m.

    Returns:
        (n, 3) `COMPOUND_CRS`, m.
    """
    latitude, longitude, height = frame.geodetic_from_enu(p_in_enu_m)
    project = Transformer.from_crs("EPSG:4326", HORIZONTAL_CRS, always_xy=True, allow_ballpark=False)
    easting, northing = project.transform(longitude, latitude)
    return np.column_stack([easting, northing, navd88_height(height)])
