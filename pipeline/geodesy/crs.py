"""Which CRS the points are delivered in, with its vertical part."""

from __future__ import annotations

from pathlib import Path

from pyproj import CRS
from pyproj.crs import CompoundCRS

from pipeline.engine.errors import InputError, UndeterminedError, UsageError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import ELLIPSOIDAL, LOCAL, TAKEOFF, VERTICAL_EPSG
from pipeline.geodesy.local_world import LocalTransform
from pipeline.geodesy.transform import CrsTransform, read_crs

# Vertical CRSs of no register, as WKT 2 (ISO 19162:2019, 10): zero is where the drone took off, or where the user says.
_RELATIVE = {TAKEOFF: ("height above take-off", "take-off point"), LOCAL: ("local height", "local zero")}
_VERTICAL_WKT = 'VERTCRS["{}",VDATUM["{}"],CS[vertical,1],AXIS["gravity-related height (H)",up],LENGTHUNIT["metre",1]]'
_KEY = "ingest.crs"
# A zone of UTM: projects that cross a zone's edge keep to one.
_AREA_MARGIN_DEG = 6.0


def output_crs(
    crs: str, frame: LocalFrame, height_datum: str, geoid: float | str | Path | None = None, *, source_datum: str = ""
) -> CrsTransform:
    """The CRS of the product, from the configuration and what ingest found.

    A CRS without a vertical part ("auto" is the UTM zone of the origin) gets the one of the source's heights:
    ellipsoidal, an orthometric datum's, or "height above take-off".

    Args:
        crs: "auto", or a CRS as PROJ reads it.
        frame: The local frame.
        height_datum: What the frame's heights are measured from, one of `heights.DATUMS`.
        geoid: Undulation in metres, a PROJ grid file, or None for PROJ's own grid.
        source_datum: What the source's heights were measured from before ingest made them ellipsoidal; "" for the same.

    Returns:
        The CRS with the transform into it.

    Raises:
        UndeterminedError: The height datum is unknown, or the geoid between two is.
        UsageError: The CRS is not projected, not in metres, or not of east and north axes.
        InputError: The geoid file cannot be read.
    """
    chosen = utm_zone(frame) if crs.strip().lower() == "auto" else _read(crs)
    _check_axes(chosen)
    _check_area(chosen, frame)
    if len(chosen.axis_info) == 2:
        chosen = with_vertical(chosen, source_datum or height_datum)
    return CrsTransform(chosen, frame, height_datum, geoid)


def local_output(crs: str) -> LocalTransform:
    """The CRS of the product of a run in a local frame: that frame.

    Args:
        crs: "auto" or "local", from the configuration.

    Returns:
        The engineering CRS with the transform into it, which changes nothing.

    Raises:
        UsageError: Another CRS is asked for.
    """
    if crs.strip().lower() not in ("auto", "local"):
        raise UsageError(
            "E-CRS-07",
            "the poses are in a local frame, and no CRS on earth can be reached from it",
            where=_KEY,
            found=crs,
            expected="auto or local",
            hint="--set ingest.crs=local; points on earth need poses with latitude and longitude",
        )
    return LocalTransform()


def utm_zone(frame: LocalFrame) -> CRS:
    """The UTM zone (WGS 84) of the frame's origin.

    Raises:
        UsageError: The site lies beyond 84 degrees of latitude.
    """
    if abs(frame.latitude_deg) > 84.0:
        raise UsageError(
            "E-CRS-02",
            "UTM does not reach the site",
            where=_KEY,
            found=f"latitude {frame.latitude_deg:.4f}",
            expected="between -84 and 84 degrees",
            hint="name a projected CRS in metres with east and north axes",
        )
    # A longitude of 180 is zone 60's eastern limit, or zone 1's western; floor and modulo take the second.
    zone = int((frame.longitude_deg + 180.0) // 6.0) % 60 + 1
    return CRS.from_epsg((32600 if frame.latitude_deg >= 0.0 else 32700) + zone)


def with_vertical(horizontal: CRS, datum: str) -> CRS:
    """A projected CRS with the vertical part of a height datum.

    Args:
        horizontal: A projected CRS of two axes.
        datum: One of `heights.DATUMS`.

    Returns:
        The CRS in 3D where heights are ellipsoidal, else a compound CRS.

    Raises:
        UndeterminedError: The datum is unknown.
    """
    if datum == ELLIPSOIDAL:
        return horizontal.to_3d()
    if datum not in (*_RELATIVE, *VERTICAL_EPSG):
        raise UndeterminedError(
            "E-HEIGHT-08",
            "nothing says what the flight's heights are measured from, and the points need a vertical datum",
            where="ingest.height_datum",
            found=datum,
            expected=", ".join((ELLIPSOIDAL, *VERTICAL_EPSG, *_RELATIVE)),
            hint="state it: --set ingest.height_datum=egm96 (or ellipsoidal, ...); local leaves the heights as "
            "logged, with no tie to any other data",
        )
    relative = _RELATIVE.get(datum)
    vertical = CRS.from_wkt(_VERTICAL_WKT.format(*relative)) if relative else CRS.from_epsg(VERTICAL_EPSG[datum])
    return CompoundCRS(f"{horizontal.name} + {vertical.name}", [horizontal, vertical])


def _read(text: str) -> CRS:
    try:
        return read_crs(text, _KEY)
    except InputError as error:
        # In the configuration it is the user's text that is wrong, not a file.
        raise UsageError(error.code, error.message, where=_KEY, found=error.found, expected=error.expected) from error


def _check_axes(crs: CRS) -> None:
    """Only projected CRSs in metres, east and north: sigmas and covariances of the tables are in metres."""
    directions = [axis.direction for axis in crs.axis_info[:2]]
    units = [axis.unit_name for axis in crs.axis_info]
    problem = (
        "is not projected"
        if not crs.is_projected
        else f"has axes {', '.join(directions)}"
        if sorted(directions) != ["east", "north"]
        else f"is in {', '.join(dict.fromkeys(units))}"
        if any(axis.unit_conversion_factor != 1.0 for axis in crs.axis_info)
        else ""
    )
    if problem:
        raise UsageError(
            "E-CRS-03",
            "the points cannot be delivered in this CRS",
            where=_KEY,
            found=f"{crs.name} {problem}",
            expected="a projected CRS in metres, east and north, with or without a vertical part",
            hint="--set ingest.crs=auto takes the UTM zone of the site",
        )


def _check_area(crs: CRS, frame: LocalFrame) -> None:
    """A site far outside the CRS's area of use is a slip of the code; a neighbouring zone may be meant."""
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
    area = horizontal.area_of_use
    if area is None:
        return
    # Eastward from the western edge, so that an area across the 180th meridian is one interval.
    width = (area.east - area.west) % 360.0 or 360.0
    beyond = (frame.longitude_deg - area.west + _AREA_MARGIN_DEG) % 360.0 > width + 2.0 * _AREA_MARGIN_DEG
    aside = not area.south - _AREA_MARGIN_DEG <= frame.latitude_deg <= area.north + _AREA_MARGIN_DEG
    if (beyond and width + 2.0 * _AREA_MARGIN_DEG < 360.0) or aside:
        raise UsageError(
            "E-CRS-04",
            "the site lies outside the CRS's area of use",
            where=_KEY,
            found=f"latitude {frame.latitude_deg:.4f}, longitude {frame.longitude_deg:.4f}",
            expected=f"{horizontal.name}: {area.south} .. {area.north} north, {area.west} .. {area.east} east",
            hint="--set ingest.crs=auto takes the UTM zone of the site",
        )
