"""Control points for the refinement of a flight: from the list to its factors, and what became of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Floats
from pipeline.refinement.flight.control import Control, ControlFit
from pipeline.refinement.flight.flight import RefinedFlight
from pipeline.refinement.logged import Log
from pipeline.sources.control_places import marks_of
from pipeline.sources.control_survey import ControlSurvey

# A mark that is clicked in its own photo is off by a few pixels at most.
_WRONG_PX = 20.0
# Coordinates that are worse than this may look wrong in a photo and be right.
_SURVEYED_M = 0.2
_FAR_SIGMAS = 5.0


def controls(
    found: ControlSurvey, images: Mapping[str, str], log: Log, sigma_m: float
) -> tuple[list[Control], dict[str, str]]:
    """The points that the flight's frames see, and why some rows are left out, by photo and line.

    Args:
        found: The list.
        images: Path of every image by frame_id.
        log: The flight, whose order numbers the frames.
        sigma_m: One sigma of the survey.

    Raises:
        InputError: A pixel lies outside its photo.
        NothingLeftError: No row is of a photo of the flight.
    """
    marks, left_out = marks_of(found.listed, found.places_m, images, log.cameras)
    number = {name: i for i, name in enumerate(log.poses)}
    points = [
        Control(mark.name, mark.surveyed_m, sigma_m, np.array([number[name] for name in mark.frames]), mark.pixels)
        for mark in marks
    ]
    return points, left_out


def control_facts(fits: Sequence[ControlFit]) -> dict[str, Any]:
    """Figures of control points for the manifest; those out of sight have no pixels, and are counted.

    Args:
        fits: At least one.
    """
    before, after = (np.concatenate(parts) for parts in zip(*((f.before_px, f.after_px) for f in fits), strict=True))
    return {
        "points": len(fits),
        "observations": len(after),
        "observations_out_of_sight": int(np.sum(~np.isfinite(after))),
        "rms_before_px": _rms(before),
        "rms_after_px": _rms(after),
        "by_point": {
            fit.name: {
                "observations": len(fit.after_px),
                "rms_before_px": _rms(fit.before_px),
                "rms_after_px": _rms(fit.after_px),
            }
            for fit in fits
        },
    }


def doubts(flight: RefinedFlight | None, log: Log, sigma_m: float, where: str) -> list[str]:
    """What a careful user wants to hear of the control points before believing the result.

    Args:
        flight: The refined flight.
        log: As logged.
        sigma_m: Of the surveyed coordinates.
        where: The list, named in errors.

    Raises:
        InputError: The points do not fit the photos, and would have bent the flight.
    """
    told: list[str] = []
    if flight is None or not flight.control:
        return told
    after = np.concatenate([fit.after_px for fit in flight.control])
    if np.median(after) > _WRONG_PX * max(1.0, sigma_m / _SURVEYED_M):
        worst = max(flight.control, key=lambda fit: float(np.median(fit.after_px)))
        off = float(np.median(worst.after_px))
        said = f"{off:.0f} px" if np.isfinite(off) else "out of sight"
        usual = float(np.median(after))
        half = f"more than {usual:.0f} px off" if np.isfinite(usual) else "out of sight of their photos"
        raise InputError(
            "E-CONTROL-14", "the control points do not fit the photos", where=where,
            found=f"half of them are {half}, {worst.name} most ({said})",
            expected=f"less than {_WRONG_PX:g} px once the flight is fitted to them",
            hint="see that images, column and row, CRS and height datum are right; for points of a map, whose "
            "coordinates are not good to centimetres, state --set refine.control_sigma_m=1",
        )  # fmt: skip
    shift = np.mean([flight.frames[name].placed.centre - pose.centre for name, pose in log.poses.items()], axis=0)
    allowed = np.median([np.hypot(p.common.position_m, p.own.position_m) for p in log.poses.values()], axis=0)
    if np.any(np.abs(shift) > _FAR_SIGMAS * allowed):
        east, north, up = shift
        told.append(
            f"the control points move the flight by {east:+.2f} m east, {north:+.2f} m north, {up:+.2f} m up, more "
            f"than {_FAR_SIGMAS:g} sigmas of its log; see that both are of one CRS and height datum"
        )
    return told


def _rms(values: Floats) -> float | None:
    seen = values[np.isfinite(values)]
    return round(float(np.sqrt(np.mean(seen**2))), 3) if len(seen) else None
