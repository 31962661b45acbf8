"""Control points beside a run: the translation they ask for, what may not be scored on them, and the checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.engine.stage import Context
from pipeline.flight import camera_by_frame, cameras_of, column, placements_of, pose_errors_of
from pipeline.geometry.arrays import Floats
from pipeline.scoring.around_control import AroundControl
from pipeline.scoring.checkpoints import checkpoint_metrics, checkpoints, left_one_out
from pipeline.scoring.frame_scores import Correction
from pipeline.scoring.inputs import datum_of, is_local
from pipeline.scoring.translation import solve_translation
from pipeline.sources.control_places import marks_of
from pipeline.sources.control_points import load_control_points
from pipeline.sources.control_survey import ControlSurvey, survey

_SECTION = "score"


@dataclass(frozen=True, slots=True)
class ControlNamed:
    """Control points as the configuration names them.

    Args:
        location: OpenDroneMap's gcp_list.txt: path or URL.
        height_datum: What their heights are measured from where their CRS does not say.
        sigma_m: One sigma of their coordinates along each axis.
    """

    location: str
    height_datum: str | None
    sigma_m: float

    def placed(self, facts: Mapping[str, Any], geoid: float | str | None) -> ControlSurvey:
        """The points in the run's frame; raises what `survey` does."""
        return survey(self.location, self.height_datum, facts, geoid, _SECTION)


@dataclass(frozen=True, slots=True)
class Control:
    """What control points say of a run.

    Args:
        correction: The translation, and what it must not be scored on.
        metrics: The object `control_points` of metrics.json.
        checkpoints: The object `checkpoints` with the translation; None where nothing can be checked.
        checkpoints_without: The same without it.
    """

    correction: Correction
    metrics: dict[str, Any]
    checkpoints: dict[str, Any] | None
    checkpoints_without: dict[str, Any] | None

    @property
    def margin_m(self) -> float:
        """How far the truth is shifted, m."""
        return float(np.linalg.norm(self.correction.translation_m))


def control_of(context: Context, named: ControlNamed) -> Control:
    """The translation from three control points or more, and the points as checkpoints.

    A point that the run was refined with is no checkpoint of it.

    Args:
        context: Of the stage; what is left out is told through it.
        named: The points.

    Raises:
        InputError: The list cannot be read, or its points do not fit the photos.
        UndeterminedError: Fewer than three are seen, or their CRS or heights are not known.
        NothingLeftError: No row is of a photo of the flight.
        UsageError: The height datum is none.
    """
    facts = context.facts("ingest")
    if not is_local(facts):
        datum_of(context.read("frames"))
    found = named.placed(facts, context.setting("ingest.geoid"))
    frames, poses = context.read("frames"), context.read("poses")
    cameras = camera_by_frame(frames, cameras_of(context.read("refined_cameras")))
    images = dict(zip(column(frames, "frame_id"), column(frames, "image"), strict=True))
    marks, left_out = marks_of(found.listed, found.places_m, images, cameras)
    placed, errors = placements_of(poses), pose_errors_of(context.read("pose_covariances"))
    solved = solve_translation(marks, placed, cameras, errors, named.sigma_m, named.location)
    for told in solved.told:
        context.warn(told)
    context.record("control_heights", found.height_note)
    known = _known_to_the_run(context)
    resting = [mark for mark in solved.rests_on(marks) if mark.name not in known]
    plain = checkpoints(resting, placed, cameras, errors, named.sigma_m)
    alone = left_one_out(resting, placed, cameras, errors, named.sigma_m) if len(resting) > 1 else []
    metrics = solved.metrics(left_out)
    where = {mark.name: mark.surveyed_m for mark in marks}
    around = AroundControl.of(marks, solved.translation_m, placed, cameras)
    return Control(
        Correction(solved.translation_m, solved.covariance, around.excluded),
        {**metrics, "by_point": {name: _at(row, where[name]) for name, row in metrics["by_point"].items()}},
        _located(checkpoint_metrics(alone, named.sigma_m, plain=plain), where),
        _located(checkpoint_metrics(plain, named.sigma_m), where),
    )


def _known_to_the_run(context: Context) -> set[str]:
    location = context.setting("refine.control_points")
    return set() if location is None else {point.name for point in load_control_points(location).points}


def _located(metrics: dict[str, Any] | None, where: Mapping[str, Floats]) -> dict[str, Any] | None:
    """Checkpoints with their surveyed places, so that a map can show them."""
    if metrics is None:
        return None
    return {**metrics, "points": [_at(row, where[row["name"]]) for row in metrics["points"]]}


def _at(row: Mapping[str, Any], place_m: Floats) -> dict[str, Any]:
    return {**row, "position_m": place_m.tolist()}
