"""A list of control points brought into the frame of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.engine.errors import NothingLeftError, UndeterminedError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.local_world import EARTH, LOCAL_WORLD
from pipeline.geometry.arrays import Floats
from pipeline.sources.control_places import surveyed
from pipeline.sources.control_points import ControlList, load_control_points


@dataclass(frozen=True, slots=True)
class ControlSurvey:
    """A list of control points and where they lie.

    Args:
        listed: The list.
        places_m: (n, 3) of its points, ENU.
        height_note: What was done with their heights.
    """

    listed: ControlList
    places_m: Floats
    height_note: str


def survey(
    location: str, stated: str | None, facts: Mapping[str, Any], geoid: float | str | None, section: str
) -> ControlSurvey:
    """The control points of a flight.

    Args:
        location: Path or URL of the list.
        stated: What their heights are measured from, where their CRS does not say.
        facts: Of ingest.
        geoid: As configured.
        section: Of the configuration that names the list, for messages.

    Raises:
        InputError: The list cannot be read, or its points lie elsewhere.
        UndeterminedError: The flight lies nowhere on earth, or a height datum is not known.
        UsageError: `stated` is no height datum.
        NothingLeftError: No frame of the flight is usable.
    """
    key = f"{section}.control_points"
    if facts.get("world", EARTH) == LOCAL_WORLD:
        raise UndeterminedError(
            "E-CONTROL-12", "control points are on earth, and nothing says where on earth the run's frame lies",
            where=key, found=location, expected="a flight whose poses have latitude and longitude",
            hint=f"leave {key} out",
        )  # fmt: skip
    listed = load_control_points(location)
    if facts["origin"] is None:
        raise NothingLeftError(
            "E-CONTROL-13", "no photo of the flight is usable, and control points are of no help", where=location,
            hint=f"the table frames says why; leave {key} out to go on",
        )  # fmt: skip
    frame, datum = LocalFrame(**facts["origin"]), str(facts["height_datum"])
    places, note = surveyed(listed, frame, datum, geoid, stated, f"{section}.control_height_datum")
    return ControlSurvey(listed, places, note)
