"""Flights over surveyed points: true poses, a log that is off, a survey that is shifted, sightings that are clicked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from refinement_scenes import CAMERA, NONE, Errors, logged, seen_in, straight

from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.geometry.poses import Placement, PoseSigmas
from pipeline.scoring.translation import Translation, solve_translation
from pipeline.sources.control_places import Mark

SURVEY_M, CLICK_PX, FRAMES = 0.05, 0.5, 8


@dataclass(frozen=True)
class Scene:
    """What a scorer is given, and what is true."""

    marks: list[Mark]
    placements: dict[str, Placement]
    cameras: dict[str, Camera]
    errors: PoseErrors
    truth: dict[str, Placement]
    places: Floats
    survey_m: float

    def solved(self) -> Translation:
        return solve_translation(self.marks, self.placements, self.cameras, self.errors, self.survey_m, "gcp_list.txt")

    def without(self, *numbers: int) -> Scene:
        return replace(self, marks=[mark for i, mark in enumerate(self.marks) if i not in numbers])


def on_the_ground(rng: np.random.Generator, n: int) -> Floats:
    """(n, 3) ahead of the leg's middle, in sight of most of its frames."""
    forward = np.array([np.sin(np.radians(23.0)), np.cos(np.radians(23.0)), 0.0])
    right = np.array([forward[1], -forward[0], 0.0])
    ahead, aside = rng.uniform(62.0, 95.0, (n, 1)), rng.uniform(-18.0, 18.0, (n, 1))
    out: Floats = ahead * forward + aside * right + rng.uniform(0.0, 4.0, (n, 1)) * (0.0, 0.0, 1.0)
    return out


def scene(
    seed: int,
    points: int = 4,
    bias_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    own: PoseSigmas = NONE,
    common: PoseSigmas = NONE,
    survey_m: float = SURVEY_M,
    places: Floats | None = None,
    click_px: float = CLICK_PX,
) -> Scene:
    """A redraw of everything; `bias_m` is what brings the survey to the poses."""
    rng = np.random.default_rng([seed, 11])
    truth = straight(FRAMES, seed=seed)
    places = on_the_ground(rng, points) if places is None else places
    poses = logged(truth, Errors.drawn(rng, FRAMES, own, common), own, common)
    marks = [
        clicked(f"gcp{i}", place, place - bias_m + rng.normal(0.0, survey_m, 3), truth, rng, click_px)
        for i, place in enumerate(places)
    ]
    placed = {name: Placement(pose.rotation, pose.centre) for name, pose in poses.items()}
    errors = PoseErrors.of_log(poses, combinations(poses, 2))
    return Scene(marks, placed, dict.fromkeys(truth, CAMERA), errors, truth, places, max(survey_m, 1e-3))


def clicked(
    name: str,
    place: Floats,
    surveyed: Floats,
    truth: Mapping[str, Placement],
    rng: np.random.Generator,
    click_px: float,
) -> Mark:
    seen = {frame: seen_in(at, place[None]) for frame, at in truth.items()}
    frames = tuple(frame for frame, (_, inside) in seen.items() if inside[0])
    pixels = np.array([seen[frame][0][0] for frame in frames])
    return Mark(name, surveyed, frames, pixels + rng.normal(0.0, click_px, pixels.shape))
