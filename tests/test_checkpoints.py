"""Checkpoints: errors of surveyed points against where their rays meet, in the terms of the ASPRS standard."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from control_scenes import SURVEY_M, Scene, scene
from refinement_scenes import CAMERA, COMMON, NONE, OWN
from scipy.optimize import least_squares

from pipeline.geometry.arrays import Floats
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.geometry.poses import PoseSigmas
from pipeline.scoring.checkpoints import REQUIRED, Checkpoint, checkpoint_metrics, checkpoints, left_one_out
from pipeline.sources.control_places import Mark

BIAS = np.array([0.4, -0.3, 0.6])


def of(now: Scene) -> list[Checkpoint]:
    return checkpoints(now.marks, now.placements, now.cameras, now.errors, now.survey_m)


def loo(now: Scene) -> list[Checkpoint]:
    return left_one_out(now.marks, now.placements, now.cameras, now.errors, now.survey_m)


def biased(seed: int, points: int, own: PoseSigmas = NONE, common: PoseSigmas = NONE) -> Scene:
    return scene(seed, points, (0.4, -0.3, 0.6), own, common, click_px=1.0)


def point(name: str, *error_m: float) -> Checkpoint:
    return Checkpoint(name, np.array(error_m), np.full(3, 0.1), 3)


# --- the standard's figures ---


def test_the_figures_are_those_of_the_standard() -> None:
    found = checkpoint_metrics([point("a", 3.0, 0.0, -1.0), point("b", 0.0, 4.0, 3.0)], 0.5)
    assert found is not None
    # Mean squares: 4.5 east, 8 north, 5 up; the survey adds 0.25 along each axis.
    assert found["rmse_h_m"] == pytest.approx(np.sqrt(4.5 + 8.0 + 0.5))
    assert found["rmse_v_m"] == pytest.approx(np.sqrt(5.0 + 0.25))
    assert found["rmse_3d_m"] == pytest.approx(np.sqrt(17.5 + 0.75))
    assert found["rmse_3d_m"] == pytest.approx(np.hypot(found["rmse_h_m"], found["rmse_v_m"]))
    assert found["mean_m"] == [1.5, 2.0, 1.0]
    assert (found["n"], found["required"], found["shortfall"]) == (2, 30, 28)
    assert (found["independent"], found["by"], found["without_translation"]) == (True, "multi-ray intersection", None)
    assert found["points"][1] == {"name": "b", "error_m": [0.0, 4.0, 3.0], "sigma_m": [0.1, 0.1, 0.1], "rays": 3}
    json.dumps(found, allow_nan=False)


@pytest.mark.parametrize(("n", "short"), [(1, 29), (29, 1), (30, 0), (31, 0)])
def test_a_shortfall_is_stated(n: int, short: int) -> None:
    found = checkpoint_metrics([point(str(i), 0.1, 0.1, 0.1) for i in range(n)], 0.02)
    assert found is not None
    assert found["shortfall"] == short
    assert ("no statement of compliance" in found["statement"]) == (n < REQUIRED)
    assert (f"{short} are missing" in found["statement"]) == (short > 0)
    assert ("1 checkpoint," in found["statement"]) == (n == 1)
    assert "RMSE_3D 0.177 m" in found["statement"]
    assert "Edition 2" in found["statement"]


def test_points_that_set_the_translation_are_not_independent() -> None:
    plain = [point(str(i), 5.0, 0.0, 0.0) for i in range(40)]
    found = checkpoint_metrics([replace(one, error_m=np.zeros(3)) for one in plain], 0.02, plain)
    assert found is not None
    assert (found["independent"], found["by"]) == (False, "leave-one-out")
    assert found["rmse_h_m"] == pytest.approx(0.02 * np.sqrt(2.0))
    assert found["without_translation"]["rmse_h_m"] == pytest.approx(5.0, rel=1e-3)
    assert found["without_translation"]["n"] == 40
    assert "no statement of compliance" in found["statement"]
    assert "not independent" in found["statement"]


def test_no_checkpoints_are_no_figures() -> None:
    assert checkpoint_metrics([], 0.05) is None
    assert of(biased(0, 1).without(0)) == []
    assert loo(biased(0, 1).without(0)) == []


# --- where the rays meet ---


def test_the_error_is_where_the_rays_meet_less_the_survey() -> None:
    now = biased(0, 3)
    for mark, found in zip(now.marks, of(now), strict=True):

        def residuals(place: Floats, mark: Mark = mark) -> Floats:
            at = [now.placements[frame] for frame in mark.frames]
            return np.concatenate(
                [CAMERA.project((place - p.centre) @ p.rotation) - px for p, px in zip(at, mark.pixels, strict=True)]
            )

        meet = least_squares(residuals, mark.surveyed_m, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
        np.testing.assert_allclose(found.error_m, meet - mark.surveyed_m, atol=1e-4)
        assert np.all(np.abs(found.error_m - BIAS) < 4.0 * found.sigma_m)
        assert (found.name, found.rays) == (mark.name, len(mark.frames))


def test_a_point_whose_rays_do_not_meet_is_passed_over() -> None:
    now = biased(0, 3)
    one, two, three = now.marks
    single = replace(one, frames=one.frames[:1], pixels=one.pixels[:1])
    placements = {**now.placements, "again": now.placements[two.frames[0]]}
    twice = replace(two, frames=(two.frames[0], "again"), pixels=two.pixels[[0, 0]])
    found = checkpoints([single, twice, three], placements, {**now.cameras, "again": CAMERA}, again(now), SURVEY_M)
    assert [point.name for point in found] == [three.name]


def again(now: Scene) -> PoseErrors:
    index = {**now.errors.index, "again": len(now.errors.index)}
    names = list(now.errors.index)
    blocks = [(a, b, now.errors.between(a, b)) for i, a in enumerate(names) for b in names[i:]]
    return PoseErrors.of(tuple(index), [*blocks, ("again", "again", now.errors.between(names[0], names[0]))])


@pytest.mark.slow
@pytest.mark.parametrize(("own", "common"), [(NONE, NONE), (OWN, NONE), (OWN, COMMON)])
def test_sigmas_are_honest(own: PoseSigmas, common: PoseSigmas) -> None:
    found = [one for seed in range(60) for one in of(biased(seed, 4, own, common))]
    errors, sigmas = np.array([one.error_m - BIAS for one in found]), np.array([one.sigma_m for one in found])
    ratio = np.mean((errors / sigmas) ** 2, axis=0)
    assert np.all(ratio > 0.65)
    assert np.all(ratio < 1.35)
    assert np.mean(np.max(np.abs(errors) / sigmas, axis=1) > 3.0) < 0.03


def test_few_rays_tell_less() -> None:
    now = biased(0, 1, OWN)
    (mark,) = now.marks
    (many,) = of(now)
    (few,) = of(replace(now, marks=[replace(mark, frames=mark.frames[:3], pixels=mark.pixels[:3])]))
    assert np.max(few.sigma_m) > 2.0 * np.max(many.sigma_m)


# --- leave one out ---


def test_each_point_is_judged_by_the_translation_of_the_others() -> None:
    now = biased(1, 5, OWN, COMMON)
    plain, found = of(now), loo(now)
    for i, (one, judged) in enumerate(zip(plain, found, strict=True)):
        others = now.without(i).solved()
        np.testing.assert_allclose(judged.error_m, one.error_m - others.translation_m, atol=1e-7)
    metrics = checkpoint_metrics(found, SURVEY_M, plain)
    assert metrics is not None
    assert metrics["rmse_3d_m"] < metrics["without_translation"]["rmse_3d_m"]


def test_a_point_does_not_judge_itself() -> None:
    now = biased(1, 4)
    moved = replace(now.marks[0], surveyed_m=now.marks[0].surveyed_m + np.array([0.0, 0.0, -0.8]))
    before, after = loo(now)[0], loo(replace(now, marks=[moved, *now.marks[1:]]))[0]
    np.testing.assert_allclose(after.error_m - before.error_m, [0.0, 0.0, 0.8], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("common", [NONE, COMMON])
def test_sigmas_of_left_one_out_are_honest(common: PoseSigmas) -> None:
    found = [one for seed in range(60) for one in loo(biased(seed, 5, OWN, common))]
    ratio = np.mean(np.array([one.error_m / one.sigma_m for one in found]) ** 2, axis=0)
    assert np.all(ratio > 0.65)
    assert np.all(ratio < 1.35)
