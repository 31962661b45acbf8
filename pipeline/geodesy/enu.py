"""The local topocentric frame (east, north, up) and geodetic coordinates on WGS 84, in closed form.

All geometry of the pipeline is done in this frame. Heights here are ellipsoidal, always.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats

# WGS 84 (NGA.STND.0036_1.0.0, table 3.1): semi-major axis and inverse flattening.
SEMI_MAJOR_M = 6378137.0
INVERSE_FLATTENING = 298.257223563
FLATTENING = 1.0 / INVERSE_FLATTENING
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
SEMI_MINOR_M = SEMI_MAJOR_M * (1.0 - FLATTENING)
_SECOND_ECCENTRICITY_SQUARED = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED)
# Each step of Bowring's iteration gains some five digits near the surface; the start is good to four.
_BOWRING_STEPS = 4


def ecef_from_geodetic(lat_deg: Floats | float, lon_deg: Floats | float, h_m: Floats | float) -> Floats:
    """Earth-centred coordinates of geodetic ones, WGS 84.

    Args:
        lat_deg: (...) geodetic latitude, deg.
        lon_deg: (...) longitude, deg.
        h_m: (...) ellipsoidal height, m.

    Returns:
        (..., 3) ECEF (EPSG:4978), m.

    Source: EPSG Guidance Note 7-2, method 9602.
    """
    latitude, longitude = np.radians(np.asarray(lat_deg, np.float64)), np.radians(np.asarray(lon_deg, np.float64))
    height = np.asarray(h_m, np.float64)
    sine, cosine = np.sin(latitude), np.cos(latitude)
    normal_m = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_SQUARED * sine**2)
    across = (normal_m + height) * cosine
    along = ((1.0 - ECCENTRICITY_SQUARED) * normal_m + height) * sine
    return np.stack(np.broadcast_arrays(across * np.cos(longitude), across * np.sin(longitude), along), axis=-1)


def geodetic_from_ecef(p_in_ecef_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Geodetic coordinates of earth-centred ones, WGS 84, to better than 1e-8 m from the deep sea to low orbit.

    Args:
        p_in_ecef_m: (..., 3) ECEF (EPSG:4978), m; not within some 50 km of the earth's centre.

    Returns:
        Latitude (deg), longitude (deg) and ellipsoidal height (m), each (...).

    Source: Bowring, "Transformation from spatial to geographical coordinates", Survey Review 23 (1976); the height by
    the form that is well conditioned at the poles and the equator alike.
    """
    p = np.asarray(p_in_ecef_m, np.float64)
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    across = np.hypot(x, y)
    sine_b, cosine_b = _unit(z, (1.0 - FLATTENING) * across)
    sine, cosine = sine_b, cosine_b
    for _ in range(_BOWRING_STEPS):
        sine, cosine = _unit(
            z + _SECOND_ECCENTRICITY_SQUARED * SEMI_MINOR_M * sine_b**3,
            across - ECCENTRICITY_SQUARED * SEMI_MAJOR_M * cosine_b**3,
        )
        sine_b, cosine_b = _unit((1.0 - FLATTENING) * sine, cosine)
    height = across * cosine + z * sine - SEMI_MAJOR_M * np.sqrt(1.0 - ECCENTRICITY_SQUARED * sine**2)
    return np.degrees(np.arctan2(sine, cosine)), np.degrees(np.arctan2(y, x)), height


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """East-north-up metres about an origin on (or above) the WGS 84 ellipsoid.

    Args:
        latitude_deg: Geodetic latitude of the origin, deg.
        longitude_deg: Longitude of the origin, deg.
        height_m: Ellipsoidal height of the origin, m.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float

    @property
    def origin_in_ecef_m(self) -> Floats:
        """The origin, (3,) ECEF m."""
        return ecef_from_geodetic(self.latitude_deg, self.longitude_deg, self.height_m)

    @property
    def rotation_ecef_from_enu(self) -> Floats:
        """The (3, 3) rotation whose columns are east, north and up in ECEF."""
        latitude, longitude = np.radians(self.latitude_deg), np.radians(self.longitude_deg)
        s_lat, c_lat, s_lon, c_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
        return np.array(
            [
                [-s_lon, -s_lat * c_lon, c_lat * c_lon],
                [c_lon, -s_lat * s_lon, c_lat * s_lon],
                [0.0, c_lat, s_lat],
            ]
        )

    def ecef_from_enu(self, p_in_enu_m: Floats) -> Floats:
        """Earth-centred coordinates of local ones.

        Args:
            p_in_enu_m: (..., 3) ENU, m.

        Returns:
            (..., 3) ECEF, m.
        """
        out: Floats = np.asarray(p_in_enu_m, np.float64) @ self.rotation_ecef_from_enu.T + self.origin_in_ecef_m
        return out

    def enu_from_ecef(self, p_in_ecef_m: Floats) -> Floats:
        """Local coordinates of earth-centred ones.

        Args:
            p_in_ecef_m: (..., 3) ECEF, m.

        Returns:
            (..., 3) ENU, m.
        """
        out: Floats = (np.asarray(p_in_ecef_m, np.float64) - self.origin_in_ecef_m) @ self.rotation_ecef_from_enu
        return out

    def enu_from_geodetic(self, lat_deg: Floats | float, lon_deg: Floats | float, h_m: Floats | float) -> Floats:
        """Local coordinates of geodetic ones.

        Args:
            lat_deg: (...) geodetic latitude, deg.
            lon_deg: (...) longitude, deg.
            h_m: (...) ellipsoidal height, m.

        Returns:
            (..., 3) ENU, m.
        """
        return self.enu_from_ecef(ecef_from_geodetic(lat_deg, lon_deg, h_m))

    def geodetic_from_enu(self, p_in_enu_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Geodetic coordinates of local ones.

        Args:
            p_in_enu_m: (..., 3) ENU, m.

        Returns:
            Latitude (deg), longitude (deg) and ellipsoidal height (m), each (...).
        """
        return geodetic_from_ecef(self.ecef_from_enu(p_in_enu_m))


def _unit(opposite: Floats, adjacent: Floats) -> tuple[Floats, Floats]:
    """Sine and cosine of atan2(opposite, adjacent), without the angle."""
    length = np.hypot(opposite, adjacent)
    return opposite / length, adjacent / length
