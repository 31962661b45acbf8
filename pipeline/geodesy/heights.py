"""Vertical datums, and the geoid that ties orthometric heights to ellipsoidal ones: h = H + N.

PROJ is always asked with `allow_ballpark=False`: without its grid it otherwise returns the height unchanged and says
nothing.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

from pipeline.engine.errors import InputError, UndeterminedError, UsageError
from pipeline.geometry.arrays import Floats

ELLIPSOIDAL, TAKEOFF, LOCAL, UNKNOWN = "ellipsoidal", "takeoff", "local", "unknown"
# Heights that are known against each other only: above the take-off point, or from a zero that the user knows.
RELATIVE = (TAKEOFF, LOCAL)
# Orthometric datums with a name of their own, and the EPSG code of their vertical CRS in metres.
VERTICAL_EPSG: dict[str, int] = {"egm96": 5773, "egm2008": 3855, "navd88": 5703}
DATUMS = (ELLIPSOIDAL, *VERTICAL_EPSG, *RELATIVE, UNKNOWN)
_ALIASES = {"ellipsoid": ELLIPSOIDAL, "wgs84": ELLIPSOIDAL, "egm08": "egm2008", "take-off": TAKEOFF}
# As PROJ's vertical datums are named, in lower case without punctuation; WKT 1 of LiDAR tiles often has no code.
_DATUM_OF_NAME = {
    "egm96geoid": "egm96",
    "egm2008geoid": "egm2008",
    "northamericanverticaldatum1988": "navd88",
    "navd88": "navd88",
    "takeoffpoint": TAKEOFF,
    "localzero": LOCAL,
}
_REMEDY = (
    "--set ingest.geoid=METRES (the undulation here, h - H) or --set ingest.geoid=GRID (a PROJ grid file: GTX, GeoTIFF)"
)


def height_datum(text: str) -> str:
    """The canonical name of a height datum as a user writes it.

    Args:
        text: One of `DATUMS` or an alias ("ellipsoid").

    Returns:
        One of `DATUMS`.

    Raises:
        UsageError: No such datum.
    """
    name = text.strip().lower()
    name = _ALIASES.get(name, name)
    if name not in DATUMS:
        near = get_close_matches(name, DATUMS, 1)
        raise UsageError(
            "E-HEIGHT-01",
            "no such height datum",
            where="ingest.height_datum",
            found=text,
            expected=", ".join(DATUMS),
            hint=f"did you mean {near[0]}?" if near else "name what the source's heights are measured from",
        )
    return name


def is_orthometric(datum: str) -> bool:
    """Whether heights of this datum need a geoid to become ellipsoidal ones."""
    return datum not in (ELLIPSOIDAL, *RELATIVE, UNKNOWN)


def datum_of_vertical(vertical: CRS) -> str:
    """The height datum of a vertical CRS.

    Args:
        vertical: The vertical part of a compound CRS.

    Returns:
        One of `DATUMS`, or the CRS's own text ("EPSG:7837", or its name) where it has no short name here.
    """
    code = vertical.to_epsg()
    for name, epsg in VERTICAL_EPSG.items():
        if code == epsg:
            return name
    name = vertical.datum.name if vertical.datum is not None else vertical.name
    plain = "".join(letter for letter in name.lower() if letter.isalnum())
    return _DATUM_OF_NAME.get(plain, f"EPSG:{code}" if code is not None else vertical.name)


@dataclass(frozen=True, slots=True)
class Geoid:
    """The surface that the heights of an orthometric datum are measured from.

    Args:
        datum: Name of the datum, for messages; with no source, one of `VERTICAL_EPSG` or "EPSG:code".
        source: A constant undulation in metres, a PROJ grid file, or None for PROJ's own grid of the datum.
    """

    datum: str
    source: float | Path | None = None

    @classmethod
    def of(cls, source: float | str | Path | None, datum: str) -> Geoid:
        """A geoid from a configuration value: metres (also as text), a path, or None."""
        value = _number(source)
        if value is None:
            return cls(datum, None if source is None else Path(str(source)))
        if not np.isfinite(value):
            raise UsageError("E-HEIGHT-02", "an undulation must be finite", where="ingest.geoid", found=str(source))
        return cls(datum, value)

    def undulation(self, lat_deg: Floats | float, lon_deg: Floats | float) -> Floats:
        """The geoid's height above the ellipsoid.

        Args:
            lat_deg: (...) latitude, deg.
            lon_deg: (...) longitude, deg.

        Returns:
            (...) N with h = H + N, m.

        Raises:
            UndeterminedError: No grid for the datum is installed, or a point lies outside it.
            InputError: The grid file cannot be read.
        """
        latitude, longitude = np.broadcast_arrays(np.asarray(lat_deg, np.float64), np.asarray(lon_deg, np.float64))
        if isinstance(self.source, float):
            return np.full(latitude.shape, self.source)
        transformer, sign = (_of_file(self.source), 1.0) if self.source is not None else (self._of_proj(), -1.0)
        shift = np.asarray(transformer.transform(longitude, latitude, np.zeros(latitude.shape))[2], np.float64) * sign
        if not np.all(np.isfinite(shift)):
            row = int(np.flatnonzero(~np.isfinite(np.atleast_1d(shift).ravel()))[0])
            raise UndeterminedError(
                "E-HEIGHT-04",
                "a point lies outside the geoid grid",
                where=str(self.source or f"PROJ's grid for {self.datum}"),
                found=f"latitude {np.ravel(latitude)[row]:.6f}, longitude {np.ravel(longitude)[row]:.6f}",
                expected="a grid that covers the whole flight",
                hint=_REMEDY,
            )
        return shift

    def _of_proj(self) -> Transformer:
        vertical = f"EPSG:{VERTICAL_EPSG[self.datum]}" if self.datum in VERTICAL_EPSG else self.datum
        if not vertical.startswith("EPSG:"):
            raise self._unavailable("PROJ knows no geoid for this datum")
        # Only the height is wanted: the base is WGS 84, whatever the projected CRS is made on.
        target = f"EPSG:4326+{vertical.removeprefix('EPSG:')}"
        try:
            return Transformer.from_crs("EPSG:4979", target, always_xy=True, allow_ballpark=False)
        except ProjError as error:
            raise self._unavailable(_wanted_grids(target)) from error

    def _unavailable(self, found: str) -> UndeterminedError:
        return UndeterminedError(
            "E-HEIGHT-03",
            f"{self.datum} heights meet ellipsoidal ones and the geoid between them is not known",
            found=found,
            expected="a geoid model that covers the flight",
            hint=_REMEDY,
        )


def _number(source: float | str | Path | None) -> float | None:
    """The metres a configuration value means, None where it is no number."""
    if source is None or isinstance(source, Path):
        return None
    try:
        return float(source)
    except ValueError:
        return None


def _of_file(grid: Path) -> Transformer:
    """A transformer that adds a grid file's undulation to the height."""
    path = str(grid.expanduser().absolute()).replace('"', '""')
    step = f'+step +proj=vgridshift +grids="{path}" +multiplier=1'
    degrees = "+step +proj=unitconvert +xy_in=deg +xy_out=rad", "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    try:
        return Transformer.from_pipeline(f"+proj=pipeline {degrees[0]} {step} {degrees[1]}")
    except ProjError as error:
        readable = grid.is_file()
        comma = "," in path
        raise InputError(
            "E-HEIGHT-05",
            "the geoid grid cannot be read",
            where=f"ingest.geoid = {grid}",
            found="a comma in the path, which PROJ takes for a list"
            if comma
            else "not a grid"
            if readable
            else "no such file",
            expected="a vertical grid that PROJ reads: GTX or GeoTIFF (GTG)",
            hint="move it to a path without a comma"
            if comma
            else "name the file as it is on this machine, or a constant in metres",
        ) from error


def _wanted_grids(target: str) -> str:
    """Which grid file PROJ would use if it were installed, for the message."""
    with warnings.catch_warnings():
        # The group warns that its best operation is not available; that is what is being asked.
        warnings.simplefilter("ignore", UserWarning)
        group = TransformerGroup("EPSG:4979", target, always_xy=True, allow_ballpark=False)
    # The plainest operation first: others reach the same geoid by way of horizontal grids.
    operations = sorted(group.unavailable_operations, key=lambda operation: len(tuple(operation.grids)))
    names = [grid.short_name for operation in operations[:3] for grid in operation.grids]
    several = list(dict.fromkeys(names))[:3]
    return f"no grid installed (PROJ would use {', '.join(several)})" if several else "no grid installed"
