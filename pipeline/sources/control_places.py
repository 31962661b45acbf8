"""Control points in a flight: their places in the local frame, and which frames see them at which pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
from pyproj import CRS
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError

from pipeline.engine.errors import InputError, NothingLeftError, UndeterminedError, UsageError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import DATUMS, ELLIPSOIDAL, UNKNOWN, height_datum, is_orthometric
from pipeline.geodesy.transform import CrsTransform
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.sources.control_points import ControlList, Sighting

# Farther from the flight's origin no camera of it sees anything; swapped axes or the next UTM zone are farther.
_FARTHEST_M = 50_000.0


@dataclass(frozen=True, slots=True)
class Mark:
    """A control point of a flight.

    Args:
        name: The point's.
        surveyed_m: (3,) ENU, m.
        frames: m frame_ids that see it.
        pixels: (m, 2) where; pixel (0, 0) is the centre of the top-left pixel.
    """

    name: str
    surveyed_m: Floats
    frames: tuple[str, ...]
    pixels: Floats


def surveyed(
    listed: ControlList, frame: LocalFrame, source_datum: str, geoid: float | str | None, stated: str | None, key: str
) -> tuple[Floats, str]:
    """Where the points lie in the local frame.

    Args:
        listed: The list.
        frame: The local frame.
        source_datum: What the source's heights were measured from before ingest made orthometric ones ellipsoidal.
        geoid: Undulation in metres, a grid file, or None, as the configuration has it.
        stated: What the points' heights are measured from where their CRS does not say: one of `heights.DATUMS`, or
            the code of a vertical CRS, which carries its unit.
        key: The configuration key of `stated`, for messages.

    Returns:
        (n, 3) ENU, m; and what was done with the heights, in a line.

    Raises:
        UndeterminedError: What the heights are measured from, or the geoid between two datums, is not known.
        UsageError: `stated` is no height datum.
        InputError: A point lies where the flight is not.
    """
    crs, datum = _with_heights(listed, stated, key)
    flight_datum = ELLIPSOIDAL if is_orthometric(source_datum) else source_datum
    transform = CrsTransform(crs, frame, flight_datum, geoid, datum)
    with np.errstate(invalid="ignore"):
        places = transform.enu_from(np.array([point.xyz for point in listed.points], np.float64))
        away = np.linalg.norm(places[:, :2], axis=1)
    lost = np.flatnonzero(~(away < _FARTHEST_M))
    if len(lost):
        raise _far_away(listed, int(lost[0]), float(away[lost[0]]), crs)
    return places, transform.height_note


def marks_of(
    listed: ControlList, places: Floats, images: Mapping[str, str], cameras: Mapping[str, Camera]
) -> tuple[list[Mark], dict[str, str]]:
    """The points that frames see.

    Args:
        listed: The list.
        places: (n, 3) of its points, ENU, m.
        images: Path of every image of the flight by frame_id, a frame_id being the image's stem.
        cameras: By frame_id, of the frames that can be used.

    Returns:
        Marks in the list's order, and why some rows were left out, by the photo's name and the row's line.

    Raises:
        InputError: A pixel lies outside its photo.
        NothingLeftError: No row is of a photo of the flight.
    """
    frame_of = _Names(images)
    left_out: dict[str, str] = {}
    seen: list[list[tuple[str, Sighting]]] = [[] for _ in listed.points]
    for sighting in listed.sightings:
        frame = frame_of(sighting.image)
        row = f"{sighting.image}, line {sighting.line}"
        if frame is None or frame not in cameras:
            left_out[row] = "no such photo in the flight" if frame is None else "the frame is not usable"
        elif any(frame == other for other, _ in seen[sighting.point]):
            left_out[row] = "an earlier row is of the same point and photo"
        elif _checked(sighting, cameras[frame], listed.where):
            seen[sighting.point].append((frame, sighting))
        else:
            left_out[row] = "the lens has no ray at this pixel"
    marks = [_mark(point.name, place, of) for point, place, of in zip(listed.points, places, seen, strict=True) if of]
    if not marks:
        raise NothingLeftError(
            "E-CONTROL-10", "no control point is seen by a photo of the flight", where=listed.where,
            found=", ".join(list(left_out)[:3]),
            expected=f"photos of the flight, such as {next(iter(cameras), 'none')}",
            hint="see that the list and the photos are of one flight; a photo is known by its file name",
        )  # fmt: skip
    return marks, left_out


def _mark(name: str, place: Floats, seen: Sequence[tuple[str, Sighting]]) -> Mark:
    pixels = np.array([(sighting.u_px, sighting.v_px) for _, sighting in seen])
    return Mark(name, place, tuple(frame for frame, _ in seen), pixels)


def _checked(sighting: Sighting, camera: Camera, where: str) -> bool:
    """Whether a pixel that lies in its photo has a ray."""
    pixel = np.array([sighting.u_px, sighting.v_px])
    if not camera.holds(pixel):
        across = not -0.5 <= sighting.u_px <= camera.width - 0.5
        said = f"column {sighting.u_px:g}" if across else f"row {sighting.v_px:g}"
        raise InputError(
            "E-CONTROL-09", "a control point lies outside its photo", where=f"{where}:{sighting.line}",
            found=f"{said} lies outside the photo of {camera.width} x {camera.height}; does the list belong to photos "
            "of another size?",
            expected=f"pixels of {sighting.image} as it is here, (0, 0) the centre of the top-left one",
            hint="give the photos that were measured in, or bring the list's pixels to the size of these",
        )  # fmt: skip
    return bool(np.all(np.isfinite(camera.rays(pixel))))


class _Names:
    """Finds frames by the names that people give photos: with or without folder and suffix, in any case."""

    def __init__(self, images: Mapping[str, str]) -> None:
        exact = {_stem(image): frame for frame, image in images.items()} | {frame: frame for frame in images}
        self._frame = {name.lower(): frame for name, frame in exact.items()} | exact

    def __call__(self, image: str) -> str | None:
        plain = image.replace("\\", "/")
        names = (plain, _stem(plain), plain.lower(), _stem(plain).lower())
        return next((self._frame[name] for name in names if name in self._frame), None)


def _stem(image: str) -> str:
    return PurePosixPath(image).stem


def _with_heights(listed: ControlList, stated: str | None, key: str) -> tuple[CRS, str]:
    """The CRS, and what its heights are measured from where it does not say so itself."""
    crs = listed.crs
    if crs.is_compound or crs.is_geocentric or len(crs.axis_info) == 3:
        return crs, ""
    if stated is None:
        raise UndeterminedError(
            "E-CONTROL-06", "the control points do not say what their heights are measured from", where=listed.where,
            found=f"{crs.name}, two-dimensional", expected="a compound CRS, such as EPSG:32617+5703",
            hint=f"state it: --set {key}=... (ellipsoidal, egm96, egm2008, navd88, or the EPSG code of a vertical "
            "CRS), or put a compound CRS into the list's first line",
        )  # fmt: skip
    try:
        datum = height_datum(stated)
    except UsageError:
        # Not one of the names, so the code of a vertical CRS, or nothing that PROJ knows.
        return _compound(crs, stated, key), ""
    if datum == UNKNOWN:
        raise _not_a_datum(stated, key)
    if not crs.is_geographic and any(abs(axis.unit_conversion_factor - 1.0) > 1e-9 for axis in crs.axis_info):
        raise UndeterminedError(
            "E-CONTROL-07", "the control points are in feet, and whether their heights are too is not stated",
            where=listed.where, found=f"{crs.name} in {crs.axis_info[0].unit_name}, heights from {datum}",
            expected="the code of a vertical CRS, which carries its unit",
            hint=f"--set {key}=EPSG:6360 (NAVD88 in US survey feet), EPSG:8228 (in feet) or EPSG:5703 (in metres)",
        )  # fmt: skip
    return crs, datum


def _compound(crs: CRS, vertical: str, key: str) -> CRS:
    try:
        up = CRS.from_user_input(vertical)
        if not up.is_vertical or up.is_compound:
            raise _not_a_datum(vertical, key)
        return CompoundCRS(f"{crs.name} + {up.name}", [crs, up])
    except CRSError as error:
        raise _not_a_datum(vertical, key) from error


def _not_a_datum(found: str, key: str) -> UsageError:
    known = ", ".join(datum for datum in DATUMS if datum != UNKNOWN)
    return UsageError(
        "E-CONTROL-08", "not a height datum", where=key, found=found,
        expected=f"{known}, or the code of a vertical CRS, such as EPSG:6360",
    )  # fmt: skip


def _far_away(listed: ControlList, point: int, away_m: float, crs: CRS) -> InputError:
    line = next(sighting.line for sighting in listed.sightings if sighting.point == point)
    x, y, _ = listed.points[point].xyz
    return InputError(
        "E-CONTROL-11", "a control point lies where the flight is not", where=f"{listed.where}:{line}",
        found=f"x = {x:g}, y = {y:g} in {crs.name}, "
        + (f"{away_m / 1000.0:.0f} km from the flight" if np.isfinite(away_m) else "which is no place on earth"),
        expected="x east (or longitude) and y north (or latitude), in the CRS of the first line",
        hint="see the CRS, its zone, and the order of x and y",
    )  # fmt: skip
