"""Control points: OpenDroneMap's list, its places in the flight, and the factors that hold a flight to the ground."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
from flights import copied, epitransfer
from fuzzing import mutations, mutations_wanted
from hypothesis import given
from hypothesis import strategies as st
from refinement_scenes import (
    CAMERA,
    DEG,
    OWN,
    Errors,
    chained,
    log_of,
    logged,
    matches_by_pair,
    nees,
    off,
    robust_cost,
    seen_in,
    straight,
)

from pipeline.engine.errors import EpiTransferError, InputError, NothingLeftError, UndeterminedError, UsageError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import ELLIPSOIDAL
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement, PoseSigmas
from pipeline.refinement.flight.control import (
    SIGMA_PX,
    Control,
    ControlFit,
    eliminated,
    most_likely,
    offsets_px,
    sights,
)
from pipeline.refinement.flight.flight import RefinedFlight, refine_flight
from pipeline.refinement.flight.lens import Lenses
from pipeline.refinement.flight.stars import stars_by_ref
from pipeline.refinement.logged import Log
from pipeline.refinement.near import together
from pipeline.refinement.scatter import SHARED_PX
from pipeline.refinement.surveyed import control_facts, doubts
from pipeline.sources.control_places import marks_of, surveyed
from pipeline.sources.control_points import (
    ControlList,
    ControlPoint,
    Sighting,
    load_control_points,
    read_control_points,
)
from pipeline.sources.control_survey import survey
from stages.refine import Config

HEAD = "EPSG:32617\n"
ROW = "738668.4448 4153830.7326 154.9032 91.357 793.910 DJI_0001.JPG gcp01"
FRAME = LocalFrame(37.5, -78.3, 120.0)
KEY = "refine.control_height_datum"


def listed(text: str) -> ControlList:
    return read_control_points(text.encode(), "gcp_list.txt")


# --- the list ---


def test_a_list() -> None:
    found = listed(
        "\ufeff# surveyed on Monday\n\nEPSG:32617\n"
        "738668.4448\t4153830.7326\t154.9032\t91.357\t793.910\tDJI 0001.JPG\tgcp 01\n"
        "# moved\n"
        "738703.2 4153811.9 153.7 830.25 810 DJI_0001.JPG\n"
        "  738668.4448 4153830.7326 154.9032 72 -0.25 sub/DJI_0002.JPG   gcp.01.again  extra columns\r\n"
        "7.387032e5 4153811.9 +153.70 856.3 844 DJI_0002.JPG\n"
    )
    assert found.crs == pyproj.CRS("EPSG:32617")
    assert found.points == (
        ControlPoint("gcp 01", (738668.4448, 4153830.7326, 154.9032)),
        ControlPoint("point 2", (738703.2, 4153811.9, 153.7)),
    )
    assert found.sightings == (
        Sighting(0, "DJI 0001.JPG", 91.357, 793.91, 4),
        Sighting(1, "DJI_0001.JPG", 830.25, 810.0, 6),
        Sighting(0, "sub/DJI_0002.JPG", 72.0, -0.25, 7),
        Sighting(1, "DJI_0002.JPG", 856.3, 844.0, 8),
    )


@pytest.mark.parametrize(
    ("line", "epsg"),
    [
        ("+proj=utm +zone=17 +ellps=WGS84 +datum=WGS84 +units=m +no_defs", 32617),
        ("WGS84 UTM 17N", 32617),
        ("wgs84 utm 56s", 32756),
        ("WGS84 UTM 60N", 32660),
        ("WGS84 UTM 01S", 32701),
        ("WGS 84 / UTM zone 5N", 32605),
        ("epsg:4326", 4326),
    ],
)
def test_the_first_line_is_a_crs_in_any_of_three_forms(line: str, epsg: int) -> None:
    found = listed(f"{line}\n10 20 30 1 2 a.jpg\n").crs
    same = pyproj.Transformer.from_crs(pyproj.CRS(epsg), found, always_xy=True)
    np.testing.assert_allclose(same.transform(10.0, 20.0), (10.0, 20.0), atol=1e-6)


@pytest.mark.parametrize(
    ("text", "code", "line"),
    [
        ("", "E-CONTROL-01", ""),
        ("# nothing\n\n", "E-CONTROL-01", ""),
        (HEAD, "E-CONTROL-01", ""),
        (f"{ROW}\n{ROW}\n", "E-CONTROL-02", ":1"),
        (f"Musterstadt 2024\n{ROW}\n", "E-CONTROL-05", ":1"),
        (f"EPSG:5703\n{ROW}\n", "E-CONTROL-05", ":1"),
        (f"EPSG:99999\n{ROW}\n", "E-CONTROL-05", ":1"),
        (f"WGS84 UTM 61N\n{ROW}\n", "E-CONTROL-05", ":1"),
        (f"WGS 84 / UTM zone 0S\n{ROW}\n", "E-CONTROL-05", ":1"),
        (f"{HEAD}{ROW}\n738668 4153830 154 91 793\n", "E-CONTROL-01", ":3"),
        (f"{HEAD}{ROW.replace('154.9032', '154,9032')}\n", "E-CONTROL-01", ":2"),
        (f"{HEAD}{ROW.replace('154.9032', 'nan')}\n", "E-CONTROL-01", ":2"),
        (f"{HEAD}{ROW.replace('154.9032', '1e999')}\n", "E-CONTROL-01", ":2"),
        (f"{HEAD}{ROW.replace('91.357', '9_1')}\n", "E-CONTROL-01", ":2"),
        (f"EPSG:4326\n{ROW}\n", "E-CONTROL-01", ":2"),
        (f"{HEAD}{ROW}\n\n{ROW.replace('154.9', '155.9').replace('0001', '0002')}\n", "E-CONTROL-03", ":4"),
        (f"{HEAD}{ROW}\n{ROW.replace('91.357', '92')}\n", "E-CONTROL-04", ":3"),
    ],
)
def test_a_damaged_list_is_refused_by_file_and_line(text: str, code: str, line: str) -> None:
    with pytest.raises(InputError) as told:
        listed(text)
    assert (told.value.code, told.value.where) == (code, f"gcp_list.txt{line}")
    assert told.value.exit_code == 3


def test_the_same_row_twice_is_one() -> None:
    assert len(listed(f"{HEAD}{ROW}\n{ROW}\n").sightings) == 1


@given(st.one_of(st.binary(max_size=200), st.text(max_size=120).map(lambda text: f"{HEAD}{ROW}\n{text}".encode())))
def test_any_bytes(data: bytes) -> None:
    with contextlib.suppress(InputError):
        check(read_control_points(data, "gcp_list.txt"))


def test_damaged_lists_are_read_or_refused() -> None:
    data = (HEAD + "\n".join(f"{ROW[:-1]}{i}".replace("738668", f"73866{i}") for i in range(8))).encode()
    refused = 0
    for number, mutated in enumerate(mutations(data, mutations_wanted(300))):
        try:
            check(read_control_points(mutated, "gcp_list.txt"))
        except InputError as error:
            refused += 1
            named = error.where
        else:
            named = "gcp_list.txt"
        assert named.startswith("gcp_list.txt"), number
    assert 0.2 < refused / mutations_wanted(300) < 0.9


def check(found: ControlList) -> None:
    assert found.points
    assert {sighting.point for sighting in found.sightings} == set(range(len(found.points)))
    assert all(np.all(np.isfinite((*found.points[s.point].xyz, s.u_px, s.v_px))) for s in found.sightings)
    assert all(s.image.strip() for s in found.sightings)


@pytest.mark.real
def test_lists_of_real_surveys(shared: Path) -> None:
    sheffield = load_control_points(str(shared / "data/photos/sheffield_cross/gcp_file.txt"))
    assert (len(sheffield.points), len(sheffield.sightings)) == (5, 25)
    assert sheffield.sightings[0] == Sighting(0, "DJI_0065.JPG", 2699.43, 1668.72, 2)
    assert sheffield.points[0] == ControlPoint("point 1", (333158.20, 3102916.18, 3.0))
    rtk = load_control_points(str(shared / "data/logs/rtk_mrk/gcp_list.txt"))
    assert ([point.name for point in rtk.points], len(rtk.sightings)) == (list("12345"), 35)
    # Their longitudes and latitudes, in that order, are those of the surveyed UTM coordinates beside them.
    x, y = np.array([point.xyz[:2] for point in rtk.points]).T
    east, north = pyproj.Transformer.from_crs(rtk.crs, "EPSG:32633", always_xy=True).transform(x, y)
    table = (shared / "data/logs/rtk_mrk/latlon-easting_northing.csv").read_text("utf-8-sig").split()[1:]
    written = np.array([[float(value) for value in line.split(";")[1:3]] for line in table])
    for row in np.stack([east, north], axis=1):
        assert np.linalg.norm(written - row, axis=1).min() < 0.05


def test_a_missing_list(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="E-FILE-01"):
        load_control_points(str(tmp_path / "none.txt"))


# --- its places ---


def places(found: ControlList, stated: str | None, datum: str = "navd88", geoid: float | None = -33.0) -> Floats:
    return surveyed(found, FRAME, datum, geoid, stated, KEY)[0]


def test_heights_are_brought_to_the_flight_s() -> None:
    latitude, longitude = 37.5005, -78.2995
    expected = FRAME.enu_from_geodetic(latitude, longitude, 121.5)
    degrees = listed(f"EPSG:4326\n{longitude} {latitude} 154.5 1 2 a.jpg\n")
    np.testing.assert_allclose(places(degrees, "navd88")[0], expected, atol=1e-6)
    np.testing.assert_allclose(places(degrees, "ellipsoidal")[0], expected + np.array([0.0, 0.0, 33.0]), atol=0.02)
    x, y = pyproj.Transformer.from_crs(4326, 32617, always_xy=True).transform(longitude, latitude)
    for head, stated in (("EPSG:32617", "NAVD88"), ("EPSG:32617+5703", None), ("EPSG:32617", "EPSG:5703")):
        found = listed(f"{head}\n{x:.6f} {y:.6f} 154.5 1 2 a.jpg\n")
        np.testing.assert_allclose(places(found, stated)[0], expected, atol=1e-4)
    feet = listed(f"EPSG:32617\n{x:.6f} {y:.6f} {154.5 / 0.3048006096:.6f} 1 2 a.jpg\n")
    np.testing.assert_allclose(places(feet, "EPSG:6360")[0], expected, atol=1e-4)


def test_heights_from_one_zero_pass_through() -> None:
    found = listed(f"EPSG:4326\n{FRAME.longitude_deg} {FRAME.latitude_deg} 125.0 1 2 a.jpg\n")
    np.testing.assert_allclose(places(found, "local", "local", None)[0], (0.0, 0.0, 5.0), atol=1e-6)


@pytest.mark.parametrize(
    ("head", "stated", "datum", "geoid", "code", "exit_code"),
    [
        ("EPSG:32617", None, "navd88", -33.0, "E-CONTROL-06", 4),
        ("EPSG:32617", "unknown", "navd88", -33.0, "E-CONTROL-08", 2),
        ("EPSG:32617", "EPSG:4326", "navd88", -33.0, "E-CONTROL-08", 2),
        ("EPSG:32617", "sea level", "navd88", -33.0, "E-CONTROL-08", 2),
        ("EPSG:2284", "navd88", "navd88", -33.0, "E-CONTROL-07", 4),
        ("EPSG:32617", "navd88", "takeoff", None, "E-HEIGHT-06", 4),
        ("EPSG:32617", "navd88", "unknown", None, "E-HEIGHT-06", 4),
        ("EPSG:32618", "navd88", "navd88", -33.0, "E-CONTROL-11", 3),
    ],
)
def test_places_that_cannot_be_known_are_refused(
    head: str, stated: str | None, datum: str, geoid: float | None, code: str, exit_code: int
) -> None:
    with pytest.raises(EpiTransferError) as told:
        places(listed(f"{head}\n{ROW}\n"), stated, datum, geoid)
    assert (told.value.code, told.value.exit_code) == (code, exit_code)


def test_swapped_axes_are_far_away() -> None:
    x, y, *rest = ROW.split()
    with pytest.raises(InputError, match="E-CONTROL-11") as told:
        places(listed(f"{HEAD}{' '.join((y, x, *rest))}\n"), "navd88")
    assert told.value.where == "gcp_list.txt:2"


def test_a_flight_in_a_frame_of_its_own_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UndeterminedError, match="E-CONTROL-12"):
        survey(str(tmp_path / "gcp_list.txt"), None, {"world": "local", "origin": None}, None, "refine")


# --- its photos ---

PHOTOS = {"DJI_0001": "a/DJI_0001.JPG", "dji_0002": "b/dji_0002.jpg", "DJI_0003": "DJI_0003.JPG"}
SMALL = Camera("pinhole", 800, 600, 700.0, 700.0, 399.5, 299.5)


def seen_rows(*images: str, u: float = 10.0, v: float = 20.0) -> str:
    return HEAD + "".join(f"738668 4153830 154 {u} {v} {image}\n" for image in images)


def seen_by(*images: str, u: float = 10.0, v: float = 20.0) -> ControlList:
    return listed(seen_rows(*images, u=u, v=v))


@pytest.mark.parametrize(
    ("image", "frame"),
    [
        ("DJI_0001.JPG", "DJI_0001"),
        ("dji_0001.jpg", "DJI_0001"),
        ("DJI_0001", "DJI_0001"),
        ("D:\\flights\\DJI_0002.JPG", "dji_0002"),
    ],
)
def test_photos_are_known_by_name(image: str, frame: str) -> None:
    marks, left_out = marks_of(seen_by(image), np.zeros((1, 3)), PHOTOS, dict.fromkeys(PHOTOS, SMALL))
    assert [mark.frames for mark in marks] == [(frame,)]
    assert not left_out


def test_rows_of_no_photo_are_told_and_left_out() -> None:
    found = listed(
        seen_rows("DJI_0001.JPG", "DJI_0003.JPG", "DJI_0099.JPG", "a/dji_0001.jpg")
        + "738669 4153830 154 10 20 DJI_0099.JPG\n"
    )
    marks, left_out = marks_of(found, np.zeros((2, 3)), PHOTOS, {"DJI_0001": SMALL})
    assert [mark.frames for mark in marks] == [("DJI_0001",)]
    # One entry per row, however many of them are of one photo.
    assert left_out == {
        "DJI_0003.JPG, line 3": "the frame is not usable",
        "DJI_0099.JPG, line 4": "no such photo in the flight",
        "DJI_0099.JPG, line 6": "no such photo in the flight",
        "a/dji_0001.jpg, line 5": "an earlier row is of the same point and photo",
    }
    with pytest.raises(NothingLeftError, match="E-CONTROL-10"):
        marks_of(seen_by("IMG_1.JPG"), np.zeros((1, 3)), PHOTOS, {"DJI_0001": SMALL})


@pytest.mark.parametrize(
    ("u", "v", "said"),
    [
        (2699.0, 20.0, "column 2699 lies outside the photo of 800 x 600; does the list belong to photos of another"),
        (799.6, 20.0, "column 799.6 "),
        (-0.6, 20.0, "column -0.6 "),
        (10.0, 599.6, "row 599.6 "),
    ],
)
def test_pixels_outside_the_photo_are_of_another(u: float, v: float, said: str) -> None:
    with pytest.raises(InputError, match="E-CONTROL-09") as told:
        marks_of(seen_by("DJI_0001.JPG", u=u, v=v), np.zeros((1, 3)), PHOTOS, {"DJI_0001": SMALL})
    assert said in told.value.found
    assert told.value.where == "gcp_list.txt:2"
    inside = seen_by("DJI_0001.JPG", u=799.5, v=-0.5)
    assert marks_of(inside, np.zeros((1, 3)), PHOTOS, {"DJI_0001": SMALL})[0]


# --- the factors ---


def one_point(seed: int, noise_px: float = 5.0, sigma_m: float = 0.3) -> tuple[Control, list[Placement], Lenses]:
    rng = np.random.default_rng(seed)
    at = list(straight(3, seed=seed).values())
    place = at[1].centre * (1.0, 1.0, 0.0) + (20.0, 45.0, 1.0)
    pixels = np.concatenate([seen_in(one, place[None])[0] for one in at]) + rng.normal(0.0, noise_px, (3, 2))
    other = replace(CAMERA, fx=1130.0)
    lenses = Lenses.of([CAMERA, other, CAMERA], unknown=True)
    return Control("a", place + rng.normal(0.0, sigma_m, 3), sigma_m, np.arange(3), pixels), at, lenses


def profile(
    control: Control, at: Sequence[Placement], lenses: Lenses, error: Floats, scale: float
) -> tuple[float, Floats]:
    """The cost with the point where it suits best, after errors (18 + 6,) of poses and lenses; and where that is."""
    moved = [one.moved(error[6 * i : 6 * i + 6]) for i, one in enumerate(at)]
    seen = sights(control, lenses, error[18:])
    point = control.surveyed_m
    for _ in range(20):
        point = most_likely(control, seen, moved, point, scale)
    y = np.stack([(point - one.centre) @ one.rotation for one in moved])
    found = np.einsum("mij,mj->mi", seen.root, y[:, :2] / y[:, 2:] - seen.xy)
    away = (point - control.surveyed_m) / control.sigma_m
    return robust_cost(found, scale) + 0.5 * float(away @ away), point


@pytest.mark.parametrize(("seed", "scale"), [(0, 3.0), (1, 3.0), (2, 50.0)])
def test_the_gradient_is_that_of_the_cost_without_the_point(seed: int, scale: float) -> None:
    control, at, lenses = one_point(seed)
    _, point = profile(control, at, lenses, np.zeros(24), scale)
    found = eliminated(control, sights(control, lenses, np.zeros(6)), at, point, scale)
    steps = np.tile([1e-6] * 3 + [1e-4] * 3, 3).tolist() + [1e-5] * 6
    for i, step in enumerate(steps):
        error = np.zeros(24)
        error[i] = step
        up, down = (profile(control, at, lenses, sign * error, scale)[0] for sign in (1.0, -1.0))
        numeric = (up - down) / (2.0 * step)
        assert found.gradient[i] == pytest.approx(numeric, rel=2e-3, abs=1e-4 * np.abs(found.gradient).max()), i


def test_the_information_is_that_of_all_unknowns_with_the_point_taken_out() -> None:
    control, at, lenses = one_point(3, noise_px=0.0)
    exact = replace(control, surveyed_m=at[1].centre * (1.0, 1.0, 0.0) + (20.0, 45.0, 1.0), sigma_m=0.05)
    in_cameras = [(exact.surveyed_m - one.centre) @ one.rotation for one in at]
    pixels = [lenses.cameras[k].project(ray) for k, ray in zip(lenses.of_frame, in_cameras, strict=True)]
    exact = replace(exact, pixels=np.array(pixels))
    found = eliminated(exact, sights(exact, lenses, np.zeros(6)), at, exact.surveyed_m, 3.0)
    assert np.abs(found.gradient).max() < 1e-4

    def slope(error: Floats) -> Floats:
        moved = [one.moved(error[6 * i : 6 * i + 6]) for i, one in enumerate(at)]
        seen = sights(exact, lenses, error[18:])
        _, point = profile(exact, at, lenses, error, 3.0)
        return eliminated(exact, seen, moved, point, 3.0).gradient

    scale = 1.0 / np.sqrt(np.diag(found.information))
    for i in range(24):
        error = np.zeros(24)
        error[i] = 1e-3 * scale[i]
        numeric = (slope(error) - slope(-error)) / 2e-3
        np.testing.assert_allclose(numeric * scale, found.information[i] * scale[i] * scale, atol=2e-3)


def test_a_point_behind_the_camera_says_nothing() -> None:
    control, at, lenses = one_point(0)
    behind = replace(control, surveyed_m=at[0].centre - 40.0 * at[0].rotation[:, 2], sigma_m=0.05)
    seen = sights(behind, lenses, np.zeros(6))
    found = eliminated(behind, seen, at, most_likely(behind, seen, at, behind.surveyed_m, 3.0), 3.0)
    assert not found.information.any()
    assert not found.gradient.any()
    assert np.all(np.isinf(offsets_px(behind, at, [CAMERA] * 3)))


def test_a_point_that_one_of_two_cameras_does_not_see_leaves_that_lens_alone() -> None:
    control, at, lenses = one_point(4)
    seen_by_one = replace(control, frames=control.frames[[0, 2]], pixels=control.pixels[[0, 2]])
    change = np.zeros(6)
    whole, part = sights(control, lenses, change), sights(seen_by_one, lenses, change)
    np.testing.assert_array_equal(part.by_lens, whole.by_lens[[0, 2]])
    assert np.all(np.any(part.by_lens[:, :, :3] != 0.0, axis=1))
    assert not part.by_lens[:, :, 3:].any()
    found = eliminated(seen_by_one, part, [at[0], at[2]], control.surveyed_m, 3.0)
    assert found.information.shape == (18, 18)
    assert not found.information[15:].any()


# --- a flight ---

LOOSE = PoseSigmas(np.array([1.5, 1.5, 2.5]), np.array([1.5, 0.8, 0.8]) * DEG)
SURVEY_M = 0.05


@dataclass(frozen=True)
class Held:
    """A flight with control points, and what refinement made of it."""

    truth: dict[str, Placement]
    log: Log
    control: list[Control]
    found: RefinedFlight

    def off(self) -> Floats:
        """(n, 6) turns and shifts that are left."""
        return np.array([off(self.found.frames[name].placed, at) for name, at in self.truth.items()])

    def logged_off(self) -> Floats:
        return np.array([off(self.log.poses[name], at) for name, at in self.truth.items()])

    def sigmas(self) -> Floats:
        return np.array([np.sqrt(np.diag(self.found.frames[name].covariance)) for name in self.truth])

    def nees(self) -> float:
        return float(np.mean([nees(e, self.found.frames[n].covariance) for e, n in zip(self.off(), self.truth)]))  # noqa: B905


def held(seed: int, points: int, common: Floats | None = None, spoil: str = "") -> Held:
    """A redraw of everything: log, matches, survey and pixels; `common` plants what the log gets wrong alike."""
    rng = np.random.default_rng([seed, 7])
    truth = straight(5, seed=seed)
    pairs, names = chained(list(truth)), list(truth)
    errors = Errors.drawn(rng, len(truth), OWN, LOOSE)
    if common is not None:
        errors = replace(errors, common=common)
    log = log_of(logged(truth, errors, OWN, LOOSE), pairs)
    turns = rng.normal(0.0, SHARED_PX / CAMERA.focal_px, (len(truth), 3))
    seen = {n: at.moved(np.r_[turn, 0.0, 0.0, 0.0]) for (n, at), turn in zip(truth.items(), turns, strict=True)}
    found = matches_by_pair(seen, pairs, rng, 60)
    control = [clicked(f"gcp{i}", place, seen, rng) for i, place in enumerate(on_the_ground(truth, rng, points))]
    control = spoilt(control, spoil)
    stars = stars_by_ref(found, {name: i for i, name in enumerate(names)})
    return Held(truth, log, control, refine_flight(log, stars, together(tuple(names), pairs), control=control))


def on_the_ground(truth: dict[str, Placement], rng: np.random.Generator, n: int) -> Floats:
    """(n, 3) ahead of the middle frame, in sight of all."""
    forward = np.array([np.sin(23.0 * DEG), np.cos(23.0 * DEG), 0.0])
    right = np.array([forward[1], -forward[0], 0.0])
    below = list(truth.values())[2].centre * (1.0, 1.0, 0.0)
    ahead, aside, up = rng.uniform(38.0, 80.0, (n, 1)), rng.uniform(-14.0, 14.0, (n, 1)), rng.uniform(0.0, 4.0, (n, 1))
    out: Floats = below + ahead * forward + aside * right + up * (0.0, 0.0, 1.0)
    return out


def clicked(name: str, place: Floats, seen: dict[str, Placement], rng: np.random.Generator) -> Control:
    sighted = [(i, *seen_in(at, place[None])) for i, at in enumerate(seen.values())]
    frames = np.array([i for i, _, inside in sighted if inside[0]])
    pixels = np.array([pixel[0] for _, pixel, inside in sighted if inside[0]])
    pixels += rng.normal(0.0, SIGMA_PX, pixels.shape)
    return Control(name, place + rng.normal(0.0, SURVEY_M, 3), SURVEY_M, frames, pixels)


def spoilt(control: list[Control], how: str) -> list[Control]:
    if how == "a wrong survey":
        return [replace(control[0], surveyed_m=control[0].surveyed_m + np.array([6.0, -4.0, 2.0])), *control[1:]]
    if how == "a wrong photo":
        return [replace(control[0], pixels=control[0].pixels[::-1] + np.array([0.0, 150.0])), *control[1:]]
    if how == "pixels swapped":
        return [replace(one, pixels=one.pixels[:, ::-1]) for one in control]
    if how == "points permuted":
        return [
            replace(one, pixels=other.pixels) for one, other in zip(control, control[1:] + control[:1], strict=True)
        ]
    return control


PLANTED = np.array([1.2 * DEG, 0.3 * DEG, -0.2 * DEG, 2.0, -1.5, 1.5])


def test_control_points_remove_what_all_frames_get_wrong_alike() -> None:
    flight = held(0, 5, PLANTED)
    before = np.linalg.norm(flight.logged_off()[:, 3:], axis=1)
    after = np.linalg.norm(flight.off()[:, 3:], axis=1)
    assert 2.7 < before.mean() < 3.1
    assert 0.02 < after.mean() < 0.6
    assert np.all(np.abs(flight.off()) < 4.0 * flight.sigmas())
    yaw = next(found for found in flight.found.found if found.name == "boresight_yaw_rad")
    assert abs(yaw.value + PLANTED[0]) < 4.0 * yaw.sigma
    assert 0.03 * DEG < yaw.sigma < 0.4 * DEG
    facts = control_facts(flight.found.control)
    assert (facts["points"], facts["observations"], facts["observations_out_of_sight"]) == (5, 25, 0)
    assert 30.0 < facts["rms_before_px"] < 120.0
    assert 0.7 < facts["rms_after_px"] < 3.5
    assert not doubts(flight.found, flight.log, 0.05, "")


def test_the_more_points_the_less_is_left_open() -> None:
    sigma = [np.sqrt(np.mean(held(1, points).sigmas()[:, 3:] ** 2)) for points in (0, 1, 2, 5)]
    assert 1.0 < sigma[0] < 2.5
    assert 0.3 < sigma[1] < 0.8
    assert np.all(np.diff(sigma) < 0.0)
    assert 0.1 < sigma[3] < 0.35


@pytest.mark.slow
@pytest.mark.parametrize(("points", "low", "high"), [(2, 0.65, 1.15), (5, 0.8, 1.25)])
def test_sigmas_are_honest_over_redraws(points: int, low: float, high: float) -> None:
    flights = [held(seed, points) for seed in range(100, 160)]
    assert low < np.mean([flight.nees() for flight in flights]) / 6.0 < high
    shifts, sigmas = (np.array(rows)[..., 3:] for rows in zip(*((f.off(), f.sigmas()) for f in flights), strict=True))
    assert 0.75 < np.sqrt(np.mean(shifts**2) / np.mean(sigmas**2)) < 1.2
    assert np.sqrt(np.mean(shifts**2)) < 0.5 * np.sqrt(np.mean([f.logged_off()[:, 3:] ** 2 for f in flights]))


@pytest.mark.parametrize("how", ["a wrong survey", "a wrong photo"])
def test_one_wrong_point_among_five_loses_its_say(how: str) -> None:
    flight = held(2, 5, PLANTED, how)
    assert np.linalg.norm(flight.off()[:, 3:], axis=1).max() < 0.9
    by_point = {fit.name: float(np.median(fit.after_px)) for fit in flight.found.control}
    assert by_point.pop("gcp0") > 50.0
    assert max(by_point.values()) < 6.0


@pytest.mark.parametrize("how", ["pixels swapped", "points permuted"])
def test_points_that_do_not_fit_are_refused(how: str) -> None:
    flight = held(3, 5, PLANTED, how)
    worst = max(flight.found.control, key=lambda fit: float(np.median(fit.after_px)))
    with pytest.raises(InputError, match=rf"E-CONTROL-14(.|\n)*{worst.name}"):
        doubts(flight.found, flight.log, 0.05, "gcp_list.txt")
    # Points of a map may be off by so much.
    assert all("do not fit" not in said for said in doubts(flight.found, flight.log, 20.0, "gcp_list.txt"))


def test_points_out_of_sight_are_said_to_be() -> None:
    flight = held(0, 1)
    fits = tuple(
        ControlFit(fit.name, fit.before_px, np.full(len(fit.after_px), np.inf)) for fit in flight.found.control
    )
    with pytest.raises(InputError) as told:
        doubts(replace(flight.found, control=fits), flight.log, 0.05, "gcp_list.txt")
    assert told.value.found == "half of them are out of sight of their photos, gcp0 most (out of sight)"


def test_a_flight_that_control_moves_by_more_than_its_log_allows_is_doubted() -> None:
    flight = held(4, 5, PLANTED + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 33.0]))
    (said,) = doubts(flight.found, flight.log, 0.05, "")
    assert "CRS and height datum" in said
    assert "-3" in said.split("m up")[0]


# --- the stage ---


def test_control_points_need_a_flight() -> None:
    with pytest.raises(ValueError, match="control_points need mode"):
        Config(mode="pair", control_points="gcp_list.txt")
    with pytest.raises(ValueError, match="greater than 0"):
        Config(control_sigma_m=0.0)
    assert Config(mode="flight", control_points="gcp_list.txt").control_sigma_m == SURVEY_M


@pytest.mark.slow
def test_a_run_with_control_points(small_flight: Path, small_run: Path, tmp_path: Path) -> None:
    run, gcp = copied(small_run, tmp_path / "run"), tmp_path / "gcp_list.txt"
    shutil.copy(small_flight / "gcp_list.txt", gcp)
    command = ["run", small_flight / "workflow.toml", "--out", run, "--to", "refine", "--jobs", 1]
    command += ["--set", "refine.mode=flight", "--set", f"refine.control_points={gcp}"]
    refused = epitransfer(*command)
    assert refused.returncode == 4
    assert "E-CONTROL-06" in refused.stderr
    command += ["--set", f"{KEY}=navd88"]
    done = epitransfer(*command)
    assert done.returncode == 0, done.stderr
    facts = json.loads((run / "manifest.json").read_text())["stages"]["refine"]["facts"]
    assert facts["control_heights"] == "heights go from ellipsoidal to navd88 by undulation -33.0"
    control = facts["control_points"]
    assert control["points"] >= 2
    assert 0.05 < control["rms_after_px"] < 1.0 < control["rms_before_px"] < 20.0
    again = epitransfer(*command)
    assert "refine      up to date" in again.stderr
    gcp.write_text(gcp.read_text().replace("gcp01", "north"))
    assert "refine      up to date" not in epitransfer(*command).stderr
    gcp.write_text(gcp.read_text().replace("\t154.", "\t9154."))
    moved = epitransfer(*command)
    assert "of one CRS and height datum" in moved.stderr or "do not fit" in moved.stderr


def test_an_unknown_datum_is_refused_with_its_key() -> None:
    with pytest.raises(UsageError) as told:
        places(listed(f"{HEAD}{ROW}\n"), "msl")
    assert told.value.where == KEY
    assert ELLIPSOIDAL in told.value.expected
