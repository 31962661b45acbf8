"""Which of a photo's heights is used, and what it is measured from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geodesy.heights import ELLIPSOIDAL, LOCAL, TAKEOFF, UNKNOWN, Geoid, height_datum, is_orthometric
from pipeline.sources.dji import RTK_SINGLE
from pipeline.sources.photos import PhotoRecord

AUTO = "auto"


@dataclass(frozen=True, slots=True)
class Heights:
    """Heights of all photos in one datum.

    Args:
        values_m: One per photo, None where it has no height of this datum.
        datum: What `values_m` are measured from: ellipsoidal, takeoff, local or unknown.
        stated: What the source's heights were measured from, before a geoid was added.
        why: How that was found, for the manifest.
    """

    values_m: tuple[float | None, ...]
    datum: str
    stated: str
    why: str


def own_datum(record: PhotoRecord) -> str:
    """What the best height of a photo is measured from; empty where it has none.

    A log may say the ellipsoidal height itself, and a receiver with RTK logs it. Without either DJI's AbsoluteAltitude
    is of no certain datum (sea level by barometer or by the receiver's geoid, metres to tens of metres apart), but the
    height above take-off is known.
    """
    if record.ellipsoidal_m is not None:
        return ELLIPSOIDAL
    if record.absolute_m is not None and (record.fix.rtk_flag or 0) >= RTK_SINGLE:
        return ELLIPSOIDAL
    if record.relative_m is not None:
        return TAKEOFF
    return UNKNOWN if record.absolute_m is not None else ""


def resolve(records: Sequence[PhotoRecord], stated: str, geoid: float | str | None) -> Heights:
    """The heights of a run's photos in one datum.

    Args:
        records: The photos, exposure marks applied.
        stated: ingest.height_datum: "auto", or what the user says.
        geoid: ingest.geoid: undulation in metres, a grid file, or None for PROJ's own grid.

    Returns:
        Heights, in one datum for all.

    Raises:
        UsageError: No such datum.
        UndeterminedError: An orthometric datum whose geoid is not known.
    """
    if stated.strip().lower() == AUTO:
        votes = Counter(own for record in records if not record.problem and (own := own_datum(record)))
        order = (ELLIPSOIDAL, TAKEOFF, UNKNOWN)
        # Of equally many the better known datum wins.
        datum = max(order, key=lambda name: (votes[name], -order.index(name))) if votes else UNKNOWN
        why = {
            ELLIPSOIDAL: "the receiver's heights above the ellipsoid are known",
            TAKEOFF: "no RTK: heights above the take-off point",
            UNKNOWN: "no RTK and no height above take-off: the altitude's datum is not known",
        }[datum]
        values = tuple(_height(record, datum, automatic=True) for record in records)
        return Heights(values, datum, datum, why)
    datum = height_datum(stated)
    values = tuple(_height(record, datum, automatic=False) for record in records)
    if not is_orthometric(datum):
        return Heights(values, datum, datum, "stated by the user")
    return Heights(_ellipsoidal(records, values, Geoid.of(geoid, datum)), ELLIPSOIDAL, datum, "stated by the user")


def _height(record: PhotoRecord, datum: str, *, automatic: bool) -> float | None:
    if datum == TAKEOFF:
        return record.relative_m
    if datum == LOCAL and record.absolute_m is None:
        return record.relative_m
    if datum == ELLIPSOIDAL and record.ellipsoidal_m is not None:
        return record.ellipsoidal_m
    if automatic and datum == ELLIPSOIDAL and own_datum(record) != ELLIPSOIDAL:
        return None
    if is_orthometric(datum) and record.absolute_m is None:
        return record.ellipsoidal_m
    return record.absolute_m


def _ellipsoidal(
    records: Sequence[PhotoRecord], values: Sequence[float | None], geoid: Geoid
) -> tuple[float | None, ...]:
    """Orthometric heights plus the geoid's; what a mark or a log says of the ellipsoid is ellipsoidal already."""
    rows = [
        row
        for row, (record, value) in enumerate(zip(records, values, strict=True))
        if value is not None
        and record.absolute_m is not None
        and record.position is not None
        and record.position.source != "mrk position"
    ]
    out = list(values)
    if rows:
        positions = [position for row in rows if (position := records[row].position) is not None]
        undulations_m = geoid.undulation(
            np.array([p.latitude_deg for p in positions]), np.array([p.longitude_deg for p in positions])
        )
        for row, undulation_m in zip(rows, undulations_m, strict=True):
            out[row] = float(values[row] or 0.0) + float(undulation_m)
    return tuple(out)
