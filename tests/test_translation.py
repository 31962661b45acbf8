"""The one constant translation from control points: found, honest about itself, and refused where it makes no sense."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from control_scenes import CLICK_PX, FRAMES, SURVEY_M, Scene, scene
from hypothesis import given, settings
from hypothesis import strategies as st
from planted_bias import shifted_survey
from refinement_scenes import CAMERA, COMMON, DEG, NONE, OWN, nees
from scipy.optimize import least_squares

from pipeline.engine.errors import InputError, UndeterminedError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import ELLIPSOIDAL
from pipeline.geometry.arrays import Floats
from pipeline.geometry.poses import PoseSigmas
from pipeline.scoring.around_control import AroundControl
from pipeline.scoring.sighted import Sighted, best_shift
from pipeline.scoring.sighting_errors import FrameErrors
from pipeline.sources.control_places import Mark, surveyed
from pipeline.sources.control_points import read_control_points

BIAS = (22.0, -17.5, 12.0)


def sighted(of: Scene) -> Sighted:
    return Sighted.of(of.marks, of.placements, of.cameras)


# --- it is found ---


def test_the_bias_of_the_paper_is_found_from_four_points() -> None:
    found = scene(0, 4, BIAS).solved()
    metrics = found.metrics({})
    assert 430.0 < metrics["rms_before_px"] < 500.0
    assert 0.5 * CLICK_PX < metrics["rms_after_px"] < 3.0
    assert (metrics["points"], metrics["observations"], metrics["observations_out_of_sight"]) == (4, 4 * FRAMES, 0)
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.translation_m - BIAS) < 3.0 * sigma)
    assert 0.01 < sigma.min() < sigma.max() < 0.3
    assert metrics["suspects"] == []
    assert set(metrics["by_point"]) == {f"gcp{i}" for i in range(4)}
    assert 400.0 < metrics["by_point"]["gcp0"]["rms_before_px"] < 600.0
    json.dumps(metrics, allow_nan=False)


def test_it_is_least_squares_in_pixels() -> None:
    now = scene(1, 5, BIAS, OWN)

    def residuals(shift: Floats) -> Floats:
        return np.concatenate(
            [
                CAMERA.project(
                    (mark.surveyed_m + shift - now.placements[frame].centre) @ now.placements[frame].rotation
                )
                - pixel
                for mark in now.marks
                for frame, pixel in zip(mark.frames, mark.pixels, strict=True)
            ]
        )

    expected = least_squares(residuals, np.array(BIAS), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    np.testing.assert_allclose(best_shift(sighted(now)), expected, atol=1e-5)


@settings(max_examples=25, deadline=None)
@given(st.tuples(*[st.floats(-3000.0, 3000.0)] * 3))
def test_no_bias_is_too_large(bias: tuple[float, float, float]) -> None:
    found = scene(2, 4, bias, survey_m=0.0).solved()
    np.testing.assert_allclose(found.translation_m, bias, atol=0.15)
    assert 0.2 < found.metrics({})["rms_after_px"] < 1.2


def test_what_is_out_of_sight_before_has_no_pixels_and_is_counted() -> None:
    metrics = scene(2, 4, (0.0, 0.0, -400.0)).solved().metrics({"row": "why"})
    assert metrics["rms_before_px"] is None
    assert metrics["observations_out_of_sight"] == metrics["observations"] == 4 * FRAMES
    assert metrics["by_point"]["gcp1"]["rms_before_px"] is None
    assert metrics["left_out"] == {"row": "why"}


def test_derivatives_are_those_of_the_offsets() -> None:
    now, step = scene(3, 4), 1e-6
    at = sighted(now).offsets(np.array([0.3, -0.2, 0.1]))
    for i in range(6):
        error = np.eye(6)[i] * step
        up, down = (
            Sighted.of(now.marks, {n: p.moved(s * error) for n, p in now.placements.items()}, now.cameras)
            .offsets(np.array([0.3, -0.2, 0.1]))
            .found_px
            for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(at.by_pose[:, :, i], (up - down) / (2.0 * step), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(at.by_pose[:, :, 3:], -at.by_shift)


def test_points_on_a_line_and_points_of_one_photo_do() -> None:
    along = np.array([0.3, 0.95, 0.0])
    line = scene(4, bias_m=BIAS, places=np.array([24.0, 60.0, 0.5]) + np.linspace(0.0, 25.0, 3)[:, None] * along)
    found = line.solved()
    assert np.all(np.abs(found.translation_m - BIAS) < 4.0 * np.sqrt(np.diag(found.covariance)) + 0.05)
    once = replace(line, marks=[replace(mark, frames=mark.frames[:1], pixels=mark.pixels[:1]) for mark in line.marks])
    found = once.solved()
    assert np.all(np.abs(found.translation_m - BIAS) < 4.0 * np.sqrt(np.diag(found.covariance)) + 0.05)


def test_a_translation_that_few_near_points_leave_open_is_told() -> None:
    near = scene(4, places=np.array([[24.0, 60.0, 0.5], [26.0, 60.0, 0.5], [25.0, 62.0, 0.7]]))
    once = replace(near, marks=[replace(mark, frames=mark.frames[:1], pixels=mark.pixels[:1]) for mark in near.marks])
    found = once.solved()
    (said,) = found.told
    assert "along one direction" in said
    assert np.all(np.abs(found.translation_m) < 4.0 * np.sqrt(np.diag(found.covariance)))


# --- it is honest ---


@pytest.mark.slow
@pytest.mark.parametrize(
    ("points", "own", "survey_m", "low", "high"),
    [
        (4, NONE, SURVEY_M, 2.2, 4.2),
        (3, NONE, SURVEY_M, 2.0, 3.8),
        (4, OWN, SURVEY_M, 2.3, 4.0),
        (10, OWN, SURVEY_M, 2.3, 3.8),
    ],
)
def test_sigmas_are_honest_over_redraws(points: int, own: PoseSigmas, survey_m: float, low: float, high: float) -> None:
    # The first case is the one that is asked for; the others are to see that it is not luck.
    draws = 200 if points == 4 and own is NONE else 80
    found = [scene(seed, points, BIAS, own, survey_m=survey_m).solved() for seed in range(draws)]
    assert low < np.mean([nees(one.translation_m - BIAS, one.covariance) for one in found]) < high
    off = np.sqrt(np.mean([np.sum((one.translation_m - BIAS) ** 2) for one in found]))
    said = np.sqrt(np.mean([np.trace(one.covariance) for one in found]))
    assert 0.75 < off / said < 1.15
    assert not any(fit.suspect for one in found for fit in one.points)


def test_what_frames_share_is_told_from_what_is_their_own() -> None:
    now = scene(5, 4, own=OWN, common=COMMON)
    names = tuple(now.placements)
    found = FrameErrors.of(now.errors, names)
    np.testing.assert_allclose(found.own[:, 3:, 3:], np.tile(np.diag(OWN.position_m**2), (FRAMES, 1, 1)), atol=1e-9)
    turn = np.trace(found.own[:, :3, :3], axis1=1, axis2=2)
    np.testing.assert_allclose(turn, np.sum(OWN.gimbal_rad**2), rtol=0.2)


def test_sums_over_frames_count_what_these_share() -> None:
    now = scene(5, 4, own=OWN, common=COMMON)
    names = tuple(now.placements)
    factors = np.random.default_rng(0).normal(size=(FRAMES, 3, 6))
    dense = np.block([[now.errors.between(one, other) for other in names] for one in names])
    flat = factors.transpose(1, 0, 2).reshape(3, -1)
    np.testing.assert_allclose(FrameErrors.of(now.errors, names).of_sum(factors), flat @ dense @ flat.T, rtol=1e-9)
    # A covariance that is not kept is taken as what the frames share with others; the shift's is the same for all.
    kept = now.errors.couples != FRAMES - 1
    fewer = replace(now.errors, couples=now.errors.couples[kept], blocks=now.errors.blocks[kept])
    assert len(fewer.couples) == len(now.errors.couples) - 1
    factors[:, :, :3] = 0.0
    flat = factors.transpose(1, 0, 2).reshape(3, -1)
    np.testing.assert_allclose(FrameErrors.of(fewer, names).of_sum(factors), flat @ dense @ flat.T, rtol=1e-9)


# --- mistakes in the list ---


def swapped(now: Scene, one: int, other: int) -> Scene:
    marks = list(now.marks)
    marks[one] = replace(now.marks[one], frames=now.marks[other].frames, pixels=now.marks[other].pixels)
    marks[other] = replace(now.marks[other], frames=now.marks[one].frames, pixels=now.marks[one].pixels)
    return replace(now, marks=marks)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("own", [NONE, OWN])
def test_a_point_in_a_wrong_photo_is_found_and_left_out(seed: int, own: PoseSigmas) -> None:
    now = scene(seed, 4, BIAS, own)
    pixels = now.marks[2].pixels.copy()
    pixels[[1, 6]] = pixels[[6, 1]]
    found = replace(now, marks=[*now.marks[:2], replace(now.marks[2], pixels=pixels), now.marks[3]]).solved()
    assert found.rests_on(now.marks) == now.without(2).marks
    without = now.without(2).solved()
    np.testing.assert_allclose(found.translation_m, without.translation_m, atol=1e-9)
    metrics = found.metrics({})
    assert (metrics["points"], metrics["observations"]) == (3, 3 * FRAMES)
    (suspect,) = metrics["suspects"]
    assert (suspect["name"], suspect["fits"], suspect["worst_frame"] in {"f01", "f06"}) == ("gcp2", None, True)
    assert suspect["rms_px"] > 40.0
    assert metrics["by_point"]["gcp2"]["rms_after_px"] == suspect["rms_px"]
    assert "gcp2" in found.told[0]
    assert "left out" in found.told[0]


@pytest.mark.parametrize("seed", range(4))
def test_a_mistyped_coordinate_is_found(seed: int) -> None:
    now = scene(seed, 5, BIAS, OWN)
    marks = [replace(now.marks[0], surveyed_m=now.marks[0].surveyed_m + np.array([0.0, 10.0, 0.0])), *now.marks[1:]]
    found = replace(now, marks=marks).solved()
    assert [fit.name for fit in found.points if fit.suspect] == ["gcp0"]


def test_exchanged_names_are_both_found_among_six_and_refused_among_five() -> None:
    found = swapped(scene(0, 6, BIAS), 1, 4).solved()
    assert [(fit.name, fit.fits) for fit in found.points if fit.suspect] == [("gcp1", "gcp4"), ("gcp4", "gcp1")]
    assert np.all(np.abs(found.translation_m - BIAS) < 0.4)
    with pytest.raises(InputError, match="E-CONTROL-17") as told:
        swapped(scene(0, 5, BIAS), 1, 4).solved()
    assert "its pixels fit gcp1" in told.value.found
    assert "its pixels fit gcp4" in told.value.found


def test_one_wrong_point_of_three_is_refused() -> None:
    now = scene(0, 3, BIAS)
    marks = [replace(now.marks[0], surveyed_m=now.marks[0].surveyed_m + np.array([1.5, 0.0, 0.0])), *now.marks[1:]]
    with pytest.raises(InputError, match=r"E-CONTROL-1[67]") as told:
        replace(now, marks=marks).solved()
    assert told.value.exit_code == 3
    assert "gcp" in told.value.found


@pytest.mark.parametrize(
    ("how", "said"), [("exchanged", "columns and rows exchanged"), ("from the bottom", "rows counted from the top")]
)
@pytest.mark.parametrize("own", [NONE, OWN])
def test_pixels_of_another_convention_are_refused_with_its_name(how: str, said: str, own: PoseSigmas) -> None:
    now = scene(0, 5, BIAS, own)

    def wrong(mark: Mark) -> Mark:
        u, v = mark.pixels.T
        pixels = np.column_stack([v, u] if how == "exchanged" else [u, CAMERA.height - 1.0 - v])
        return replace(mark, pixels=pixels)

    with pytest.raises(InputError, match="E-CONTROL-16") as told:
        replace(now, marks=[wrong(mark) for mark in now.marks]).solved()
    assert told.value.exit_code == 3
    assert told.value.where == "gcp_list.txt"
    assert said in told.value.hint
    assert "gcp" in told.value.found
    assert "f0" in told.value.found


def test_points_permuted_are_refused() -> None:
    now = scene(0, 5, BIAS, OWN)
    moved = [
        replace(mark, surveyed_m=other.surveyed_m)
        for mark, other in zip(now.marks, [*now.marks[1:], now.marks[0]], strict=True)
    ]
    with pytest.raises(InputError, match=r"E-CONTROL-1[67]") as told:
        replace(now, marks=moved).solved()
    assert "see " in told.value.hint


def test_east_and_north_exchanged_near_the_flight_are_refused() -> None:
    now = scene(0, 5, BIAS, OWN)
    with pytest.raises(InputError, match=r"E-CONTROL-1[67]"):
        replace(now, marks=[replace(mark, surveyed_m=mark.surveyed_m[[1, 0, 2]]) for mark in now.marks]).solved()


@pytest.mark.parametrize(
    ("head", "x", "y"),
    [("EPSG:32617", 4153830.7, 738668.4), ("EPSG:4326", 37.5, -78.3), ("EPSG:32618", 738668.4, 4153830.7)],
)
def test_exchanged_axes_and_another_zone_are_refused_before(head: str, x: float, y: float) -> None:
    listed = read_control_points(f"{head}\n{x} {y} 120 10 20 a.jpg\n".encode(), "gcp_list.txt")
    with pytest.raises(InputError, match="E-CONTROL-11") as told:
        surveyed(listed, LocalFrame(37.5, -78.3, 120.0), ELLIPSOIDAL, None, ELLIPSOIDAL, "score.control_height_datum")
    assert "order of x and y" in told.value.hint


@pytest.mark.parametrize(("points", "said"), [(0, "none of 0"), (1, "one only of 1"), (2, "two only of 2")])
def test_too_few_points_are_refused(points: int, said: str) -> None:
    with pytest.raises(UndeterminedError, match="E-CONTROL-15") as told:
        scene(0, points).solved() if points else scene(0, 1).without(0).solved()
    assert told.value.exit_code == 4
    assert said in told.value.found
    assert f"add {3 - points} or more" in told.value.hint


def test_points_that_only_unplaced_frames_see_do_not_count() -> None:
    now = scene(0, 3)
    lost = replace(now.marks[0], frames=tuple(f"lost{name}" for name in now.marks[0].frames))
    with pytest.raises(UndeterminedError, match="E-CONTROL-15") as told:
        replace(now, marks=[lost, *now.marks[1:]]).solved()
    assert told.value.found == "two only of 3 points seen in photos of the flight: gcp1, gcp2"


# --- what is told ---


def test_a_shift_that_the_poses_do_not_allow_is_told_with_both_figures() -> None:
    assert scene(6, 5, own=OWN, common=COMMON).solved().told == ()
    (said,) = scene(6, 5, (0.0, 0.0, 33.0), OWN, COMMON).solved().told
    assert "m up" in said
    assert "CRS and height datum" in said
    assert f"{np.hypot(COMMON.position_m[2], OWN.position_m[2]):.2f}" in said


# --- what is not scored ---


def test_pixels_on_control_points_are_excluded() -> None:
    now = scene(0, 4, BIAS)
    frame = "f03"
    around = AroundControl.of(now.marks, np.array(BIAS), now.placements, now.cameras)
    place, placed = now.places[1], now.placements[frame]
    centre = now.marks[1].pixels[now.marks[1].frames.index(frame)]
    depth = float(((place - placed.centre) @ placed.rotation)[2])
    radius = CAMERA.focal_px / depth
    assert radius > 12.0
    turned = np.array([[np.cos(a), np.sin(a)] for a in np.arange(0.0, 360.0, 30.0) * DEG])
    assert np.all(around.excluded(centre + 0.8 * radius * turned, frame))
    others = np.array([mark.pixels[mark.frames.index(frame)] for mark in now.marks])
    rim = centre + 1.3 * radius * turned
    clear = np.all(np.linalg.norm(rim[:, None] - np.delete(others, 1, axis=0), axis=2) > 2.5 * radius, axis=1)
    assert clear.any()
    assert not np.any(around.excluded(rim[clear], frame))
    assert around.excluded(np.zeros((0, 2)), frame).shape == (0,)
    assert not around.excluded(np.array([[800.0, 600.0]]), "no such frame").any()


def test_a_frame_that_is_not_listed_but_sees_the_point_counts() -> None:
    now = scene(0, 4, BIAS)
    listed = [replace(mark, frames=mark.frames[:2], pixels=mark.pixels[:2]) for mark in now.marks]
    around = AroundControl.of(listed, np.array(BIAS), now.placements, now.cameras)
    for mark in now.marks:
        for frame, pixel in zip(mark.frames, mark.pixels, strict=True):
            assert around.excluded(pixel[None], frame).all()
    astray = AroundControl.of(listed, np.zeros(3), now.placements, now.cameras)
    assert astray.excluded(now.marks[0].pixels[:1], now.marks[0].frames[0]).all()
    assert not astray.excluded(now.marks[0].pixels[5:6], now.marks[0].frames[5]).any()


def test_a_point_under_the_camera_or_behind_it_is_no_trouble() -> None:
    now = scene(0, 1)
    placed = now.placements["f00"]
    for away in (1e-9, 0.0, -5.0):
        mark = replace(now.marks[0], surveyed_m=placed.centre + away * placed.rotation[:, 2])
        around = AroundControl.of([mark], np.zeros(3), now.placements, now.cameras)
        assert all(np.all(np.isfinite(discs)) for discs in around.discs.values())


# --- the benchmark ---


def test_the_planted_survey_is_the_example_elsewhere(tmp_path: Path) -> None:
    example, shift = tmp_path / "example", np.array([18.0, -14.0, 10.0])
    (example / "lidar").mkdir(parents=True)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = np.array([738000.0, 4153000.0, 0.0]), np.full(3, 0.001)
    tile = laspy.LasData(header)
    tile.xyz = np.random.default_rng(0).uniform(0.0, 100.0, (50, 3)) + header.offsets
    tile.write(example / "lidar" / "tile.laz")
    rows = "738668.4448\t4153830.7326\t154.9032\t91.357\t793.910\tDJI_0001.JPG\tgcp01"
    (example / "gcp_list.txt").write_text(f"EPSG:32617\n{rows}\n")
    folder = shifted_survey(example, tmp_path, shift)
    moved, before = (laspy.read(path / "lidar" / "tile.laz") for path in (folder, example))
    np.testing.assert_array_equal(moved.X, before.X)
    np.testing.assert_allclose(np.asarray(moved.xyz) - np.asarray(before.xyz), np.tile(shift, (50, 1)), atol=1e-6)
    np.testing.assert_allclose(moved.header.mins, before.header.mins + shift, atol=1e-6)
    points = [read_control_points((path / "gcp_list.txt").read_bytes()) for path in (folder, example)]
    np.testing.assert_allclose(np.subtract(*(one.points[0].xyz for one in points)), shift, atol=1e-6)
    assert points[0].sightings == points[1].sightings


@pytest.mark.real
def test_a_real_list_that_is_read_in_wrong_places_is_refused(shared: Path) -> None:
    text = (shared / "data/photos/sheffield_cross/gcp_file.txt").read_text()
    head, *rows = text.strip().splitlines()
    exchanged = [" ".join([f[1], f[0], *f[2:]]) for f in (row.split() for row in rows)]
    listed = read_control_points("\n".join([head, *exchanged]).encode(), "gcp_file.txt")
    with pytest.raises(InputError, match="E-CONTROL-11"):
        surveyed(listed, LocalFrame(28.04, -82.70, 3.0), ELLIPSOIDAL, None, ELLIPSOIDAL, "score.control_height_datum")
