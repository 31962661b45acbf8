"""Between the local frame and a CRS: heights from datum to datum, and the grid's rotation and scale."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from pipeline.engine.errors import InputError, UndeterminedError, UsageError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import ELLIPSOIDAL, RELATIVE, UNKNOWN, Geoid, datum_of_vertical, is_orthometric
from pipeline.geometry.arrays import Floats

# Half the step of the central differences: the grid's curvature is far below rounding over this length.
_STEP_M = 10.0
_ROUND_TRIP_M = 1e-3


class FrameTransform(Protocol):
    """Between the local frame and the CRS of a product or of data; points are (..., 3) x east, y north, z up."""

    @property
    def crs(self) -> CRS:
        """The CRS."""

    @property
    def height_note(self) -> str:
        """What is done with heights, in one line for the manifest and the report."""

    def from_enu(self, p_in_enu_m: Floats) -> Floats:
        """Points of the local frame (m) in the CRS."""

    def enu_from(self, p_in_crs: Floats) -> Floats:
        """Points of the CRS in the local frame (m)."""

    def jacobian(self, p_in_enu_m: Floats) -> Floats:
        """(..., 3, 3) derivative of the CRS's coordinates by ENU, at points of the local frame."""


@dataclass(frozen=True)
class CrsTransform:
    """Takes points from the local frame to a CRS and back; x is east and y north whatever the CRS says.

    Heights meet in three ways. Where the frame's heights and the CRS's are of one datum they pass through. Where one is
    ellipsoidal and the other orthometric, the geoid stands between them. Between two orthometric datums both geoids do;
    a geoid stated by the user then stands for both. Heights above take-off meet only their own kind.

    Args:
        crs: Any CRS, projected as a rule; without a vertical part only if `crs_datum` says what its heights are.
        frame: The local frame.
        frame_datum: What the frame's heights are measured from, one of `heights.DATUMS`.
        geoid: Undulation in metres, a PROJ grid file, or None for PROJ's own grid.
        crs_datum: What z is measured from where the CRS itself does not say; "" leaves it to the CRS.

    Raises:
        UndeterminedError: A height datum or the geoid between two is not known.
        InputError: The geoid file cannot be read.
        UsageError: The CRS cannot hold the frame's origin.
    """

    crs: CRS
    frame: LocalFrame
    frame_datum: str = ELLIPSOIDAL
    geoid: float | str | Path | None = None
    crs_datum: str = ""
    _metres_per_z: float = field(init=False, repr=False)
    _from_geodetic: Transformer = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        datum, metres_per_z = _vertical_part(self.crs, self.crs_datum)
        _refuse_unrelated(self.frame_datum, datum, self.crs)
        horizontal = self.crs.sub_crs_list[0] if self.crs.is_compound else self.crs
        try:
            transformer = Transformer.from_crs("EPSG:4979", horizontal.to_3d(), always_xy=True, allow_ballpark=False)
        except ProjError as error:
            raise UndeterminedError(
                "E-CRS-05",
                "PROJ has no exact way from WGS 84 to the CRS",
                found=self.crs.name,
                expected="a CRS whose datum is tied to WGS 84, and its grids installed",
                hint="name another CRS, or install the grid: projsync, or PROJ_NETWORK=ON",
            ) from error
        object.__setattr__(self, "crs_datum", datum)
        object.__setattr__(self, "_metres_per_z", metres_per_z)
        object.__setattr__(self, "_from_geodetic", transformer)
        self._check_at_origin()

    @cached_property
    def projjson(self) -> dict[str, Any]:
        """The CRS as a PROJJSON object."""
        return dict(self.crs.to_json_dict())

    @cached_property
    def wkt(self) -> str:
        """The CRS as WKT 2 (ISO 19162:2019)."""
        return str(self.crs.to_wkt("WKT2_2019"))

    @property
    def height_note(self) -> str:
        """What is done with heights, in one line for the manifest and the report."""
        if self.frame_datum == self.crs_datum:
            return f"heights pass through as {self.crs_datum}"
        stated = f"undulation {self.geoid}" if self.geoid is not None else "PROJ's own geoid grid"
        return f"heights go from {self.frame_datum} to {self.crs_datum} by {stated}"

    def from_enu(self, p_in_enu_m: Floats) -> Floats:
        """Points of the local frame in the CRS.

        Args:
            p_in_enu_m: (..., 3) ENU, m.

        Returns:
            (..., 3) x (east), y (north), z (up), in the CRS's units.

        Raises:
            UndeterminedError: A point lies outside the geoid grid.
        """
        latitude, longitude, height = self.frame.geodetic_from_enu(p_in_enu_m)
        above_ellipsoid = height + self._lift(self.frame_datum, latitude, longitude)
        x, y, z = self._from_geodetic.transform(longitude, latitude, above_ellipsoid)
        z = height if self._same_datum else z - self._lift(self.crs_datum, latitude, longitude)
        return np.stack(np.broadcast_arrays(x, y, z / self._metres_per_z), axis=-1)

    def enu_from(self, p_in_crs: Floats) -> Floats:
        """Points of the CRS in the local frame, LiDAR tiles for instance.

        Args:
            p_in_crs: (..., 3) x (east), y (north), z (up), in the CRS's units.

        Returns:
            (..., 3) ENU, m.

        Raises:
            UndeterminedError: A point lies outside the geoid grid.
        """
        p = np.asarray(p_in_crs, np.float64)
        x, y, z = p[..., 0], p[..., 1], p[..., 2] * self._metres_per_z
        if self._same_datum and self.crs_datum != ELLIPSOIDAL:
            longitude, latitude, _ = self._inverse(x, y, np.zeros_like(z))
            return self.frame.enu_from_geodetic(latitude, longitude, z)
        if is_orthometric(self.crs_datum):
            longitude, latitude, _ = self._inverse(x, y, z)
            z = z + self._lift(self.crs_datum, latitude, longitude)
        longitude, latitude, height = self._inverse(x, y, z)
        return self.frame.enu_from_geodetic(
            latitude, longitude, height - self._lift(self.frame_datum, latitude, longitude)
        )

    def jacobian(self, p_in_enu_m: Floats) -> Floats:
        """Derivative of the CRS's coordinates by ENU: grid convergence, scale factor, curvature and geoid slope.

        Args:
            p_in_enu_m: (..., 3) ENU, m; the origin's is good to 1e-4 over a flight of a kilometre.

        Returns:
            (..., 3, 3) CRS unit per m; covariance_crs = J covariance_enu J^T.
        """
        p = np.asarray(p_in_enu_m, np.float64)
        steps = _STEP_M * np.eye(3)
        ahead, behind = (self.from_enu(p[..., None, :] + sign * steps) for sign in (1.0, -1.0))
        out: Floats = np.swapaxes((ahead - behind) / (2.0 * _STEP_M), -1, -2)
        return out

    @property
    def _same_datum(self) -> bool:
        """Whether heights pass through; ellipsoidal ones do not: ellipsoids of other datums lie up to metres away."""
        return self.frame_datum == self.crs_datum != ELLIPSOIDAL

    def _lift(self, datum: str, latitude: Floats, longitude: Floats) -> Floats | float:
        """What takes heights of a datum to ellipsoidal ones, m."""
        if self._same_datum or not is_orthometric(datum):
            return 0.0
        return Geoid.of(self.geoid, datum).undulation(latitude, longitude)

    def _inverse(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
        longitude, latitude, height = self._from_geodetic.transform(x, y, z, direction="INVERSE")
        return np.asarray(longitude), np.asarray(latitude), np.asarray(height)

    def _check_at_origin(self) -> None:
        with np.errstate(invalid="ignore"):
            back = self.enu_from(self.from_enu(np.zeros(3)))
        if not float(np.linalg.norm(back)) < _ROUND_TRIP_M:
            site = f"latitude {self.frame.latitude_deg:.6f}, longitude {self.frame.longitude_deg:.6f}"
            raise UsageError(
                "E-CRS-06",
                "the site lies where the CRS cannot be used",
                found=f"{site} in {self.crs.name}",
                expected=str(self.crs.area_of_use or "a CRS whose area of use holds the site"),
                hint="--set ingest.crs=auto takes the UTM zone of the site",
            )


def _vertical_part(crs: CRS, stated: str) -> tuple[str, float]:
    """What z is measured from, and metres per unit of z."""
    if crs.is_compound:
        vertical = crs.sub_crs_list[1]
        return stated or datum_of_vertical(vertical), float(vertical.axis_info[0].unit_conversion_factor)
    if len(crs.axis_info) == 3:
        # PROJ itself takes care of the unit of an ellipsoidal height.
        return stated or ELLIPSOIDAL, 1.0
    metric = all(axis.unit_name in ("metre", "degree") for axis in crs.axis_info)
    if not stated or not metric:
        raise UndeterminedError(
            "E-HEIGHT-07",
            "the CRS does not say what its heights are measured from"
            if metric
            else "the CRS does not say the unit of its heights",
            found=crs.name,
            expected="a CRS with a vertical part, such as EPSG:32617+5703",
            hint="give the data their compound CRS, or state the heights' datum",
        )
    return stated, 1.0


def _refuse_unrelated(frame_datum: str, crs_datum: str, crs: CRS) -> None:
    """Heights above take-off, from a local zero or of an unknown datum cannot be turned into any other."""
    if frame_datum == crs_datum != UNKNOWN or not {frame_datum, crs_datum} & {*RELATIVE, UNKNOWN}:
        return
    raise UndeterminedError(
        "E-HEIGHT-06",
        "the height datum of the flight cannot be brought to that of the CRS",
        found=f"the flight's heights: {frame_datum}; {crs.name}: {crs_datum}",
        expected="heights of one datum, or of two that a geoid ties",
        hint="say what the source's heights are: --set ingest.height_datum=ellipsoidal (or egm96, egm2008, navd88)",
    )


def to_enu(crs: CRS, frame: LocalFrame, geoid: float | str | Path | None, height_datum: str) -> CrsTransform:
    """The transform that brings data in a CRS, LiDAR tiles for instance, into the frame: `.enu_from(xyz)`.

    Args:
        crs: The data's CRS, with its vertical part.
        frame: The local frame.
        geoid: As for `CrsTransform`.
        height_datum: What the frame's heights are measured from.

    Returns:
        The transform.

    Raises:
        UndeterminedError: A height datum, or the geoid between two, is not known.
    """
    return CrsTransform(crs, frame, height_datum, geoid)


def read_crs(text: str, where: str) -> CRS:
    """A CRS from a user's or a file's text: authority code, compound code, PROJJSON or WKT.

    Args:
        text: The CRS.
        where: Configuration key or file, for the message.

    Returns:
        The CRS.

    Raises:
        InputError: PROJ does not know it.
    """
    try:
        return CRS.from_user_input(text)
    except ProjError as error:
        raise InputError(
            "E-CRS-01",
            "PROJ does not know this CRS",
            where=where,
            found=text[:120],
            expected="auto, an EPSG code (EPSG:32617), a compound one (EPSG:32617+5703), or WKT",
        ) from error
