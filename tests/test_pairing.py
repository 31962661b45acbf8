"""Pair rules against brute force: epipole, region of interest, view angle, overlap, and the candidates themselves."""

from __future__ import annotations

import time
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import enu_from_cam
from pipeline.pairing.candidates import pairs_within
from pipeline.pairing.geometry import View, epipoles, view_angles
from pipeline.pairing.select import Candidates, Frames, PairRules, select_pairs

DEG = np.pi / 180.0
PLAIN = Camera("pinhole", 4000, 3000, 2800.0, 2810.0, 2010.0, 1490.0)
LENS = Camera("brown", 4000, 3000, 2800.0, 2810.0, 2010.0, 1490.0, (-0.1, 0.02, 0.001, -0.0005, 0.0))
STRONG = Camera("brown", 4000, 3000, 3600.0, 3600.0, 1999.5, 1499.5, (-0.3, 0.0, 0.0, 0.0, 0.0))
WIDE = Camera("fisheye", 2000, 2000, 800.0, 800.0, 999.5, 999.5, (0.02, -0.003, 0.0, 0.0))
RULES = PairRules((2.0, 20.0), 45.0 * DEG, 0.4, 50.0, "ground", 100.0)
OPEN = PairRules((0.1, 50.0), np.pi, 0.0, -1e9, "ground", 100.0)


def flight(
    centres: object,
    *,
    yaw: object = 0.0,
    pitch: object = -20.0,
    roll: object = 0.0,
    cameras: tuple[Camera, ...] = (PLAIN,),
) -> Frames:
    """Frames over level ground at up = 0; angles in degrees."""
    centre = np.asarray(centres, np.float64)
    n = len(centre)
    angles = (np.broadcast_to(np.radians(np.asarray(a, np.float64)), n) for a in (yaw, pitch, roll))
    camera = np.arange(n) % len(cameras)
    return Frames(enu_from_cam(*angles).reshape(n, 3, 3), centre, centre[:, 2], camera, cameras)


def judged(frames: Frames, rules: PairRules = RULES) -> Candidates:
    """All blocks of candidates as one."""
    blocks = list(select_pairs(frames, rules))
    return Candidates(*(np.concatenate([getattr(block, name) for block in blocks]) for name in Candidates.__slots__))


def northward(step: float, n: int = 4, up: float = 31.0) -> Floats:
    return np.stack([np.zeros(n), step * np.arange(n), np.full(n, up)], axis=1)


def ground_mask(camera: Camera, rotation: Floats, up: float, range_m: float, pixels: Floats) -> Bools:
    """Which pixels look at level ground within a range: each ray cut with the ground, one by one in the large."""
    rays = camera.rays(pixels) @ rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = up * np.linalg.norm(rays, axis=1) / -rays[:, 2]
    out: Bools = (rays[:, 2] < 0.0) & (distance <= range_m)
    return out


# --- epipole ---


@given(
    angles=st.tuples(st.floats(-180, 180), st.floats(-89, 30), st.floats(-20, 20)),
    src=st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(-20, 20)),
)
def test_the_epipole_is_where_the_src_centre_projects(angles: tuple[float, ...], src: tuple[float, ...]) -> None:
    rotation = enu_from_cam(*(np.radians(a) for a in angles))
    ref = View(rotation[None], np.array([[100.0, 50.0, 30.0]]))
    other = View(rotation[None], ref.centre + np.array(src))
    in_ref = rotation.T @ np.array(src)
    found = epipoles(ref, other, PLAIN)[0]
    if abs(in_ref[2]) < 1e-2 * (1e-9 + np.linalg.norm(in_ref)):
        return
    # A centre behind the camera has its epipole where the point opposite to it projects.
    expected = PLAIN.project(in_ref * np.sign(in_ref[2]))
    np.testing.assert_allclose(found, expected, atol=1e-6 * max(1.0, np.abs(expected).max()))


def test_an_epipole_at_infinity_is_no_number_and_its_margin_infinite() -> None:
    sideways = flight([[0.0, 0.0, 30.0], [5.0, 0.0, 30.0]], pitch=-20.0)
    found = judged(sideways)
    assert np.isnan(found.epipole_px).all()
    assert found.margin_px.tolist() == [np.inf]
    assert found.reason.tolist() == [""]


def seen(camera: Camera, points: Floats) -> Bools:
    return camera.holds(camera.project(points))


def brute_margin(
    camera: Camera, rotation: Floats, up: float, epipole: Floats, box: tuple[float, ...], roi: str
) -> float:
    """Signed distance to a region painted on a dense raster, in ideal pixels."""
    n = 261
    u = np.linspace(box[0] * camera.width, box[2] * camera.width, n) - 0.5
    v = np.linspace(box[1] * camera.height, box[3] * camera.height, n) - 0.5
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    ideal = camera.rays(pixels)[:, :2] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    mask = ground_mask(camera, rotation, up, 100.0, pixels) if roi == "ground" else np.ones(n * n, np.bool_)
    mask = mask if mask.any() else ~mask
    distance = np.linalg.norm(ideal - epipole, axis=1)
    nearest = int(np.argmin(distance))
    if distance[nearest] < 1.5 * max(u[1] - u[0], v[1] - v[0]) and mask[nearest]:
        rim = np.zeros((n, n), np.bool_)
        rim[[0, -1]] = rim[:, [0, -1]] = True
        return -float(distance[~mask | rim.ravel()].min())
    return float(distance[mask].min())


@pytest.mark.parametrize("camera", [PLAIN, LENS], ids=["pinhole", "brown"])
@pytest.mark.parametrize("roi", ["ground", "image", (0.2, 0.5, 0.9, 1.0)], ids=["ground", "image", "box"])
def test_margins_are_those_of_a_painted_region(camera: Camera, roi: str | tuple[float, ...]) -> None:
    rng = np.random.default_rng(5)
    rules = PairRules((0.1, 1e3), np.pi, 0.0, -1e9, roi, 100.0)  # type: ignore[arg-type]
    box = (0.0, 0.0, 1.0, 1.0) if isinstance(roi, str) else roi
    signs = set()
    for _ in range(20):
        yaw, pitch, roll, up = rng.uniform(-180, 180), rng.uniform(-60, 5), rng.normal(0, 5), rng.uniform(10, 95)
        rotation = enu_from_cam(yaw * DEG, pitch * DEG, roll * DEG)
        epipole = rng.uniform([-1200, -1200], [5200, 4200])
        ray = np.array([*(epipole - (camera.cx, camera.cy)) / (camera.fx, camera.fy), 1.0])
        centre = np.array([0.0, 0.0, up])
        src = centre + 5.0 * rotation @ ray / np.linalg.norm(ray)
        frames = Frames(
            np.stack([rotation] * 2), np.stack([src, centre]), np.full(2, up), np.zeros(2, np.int64), (camera,)
        )
        margin = judged(frames, rules).margin_px[0]
        expected = brute_margin(camera, rotation, up, epipole, box, "ground" if roi == "ground" else "box")
        signs.add(np.sign(expected))
        # The border is straight within a cell: a few pixels near it, a hundredth far away; the raster adds its step.
        assert margin == pytest.approx(expected, abs=12.0 + 0.02 * abs(expected))
    assert signs == {-1.0, 1.0}


def test_a_small_region_is_not_lost_between_the_pixels_of_the_grid() -> None:
    """Steep and high: only the lowest strip of the image sees ground within reach."""
    frames = flight(northward(5.0, 2, up=90.0), pitch=-40.0)
    found = judged(frames, OPEN)
    rotation = frames.rotation[1]
    expected = brute_margin(PLAIN, rotation, 90.0, found.epipole_px[0], (0.0, 0.0, 1.0, 1.0), "ground")
    assert expected > 500.0
    assert found.margin_px[0] == pytest.approx(expected, rel=0.02)


# --- the rules on flights a pilot knows ---


def test_forward_flight_looking_down_20_degrees_is_accepted() -> None:
    found = judged(flight(northward(5.0)))
    neighbours = found.ref - found.src == 1
    assert (found.reason[neighbours] == "").all()
    # The epipole is inside the image, near its top, and outside the ground within 100 m.
    assert ((found.epipole_px > 0.0) & (found.epipole_px < (4000.0, 1500.0))).all()
    assert (found.margin_px > 50.0).all()
    # The ground within 100 m begins 18 deg below the horizon.
    expected = 2810.0 * (np.tan(20.0 * DEG) + np.tan(np.arcsin(0.31) - 20.0 * DEG))
    np.testing.assert_allclose(found.margin_px[neighbours], expected, rtol=0.02)


def test_the_whole_image_as_region_rejects_it() -> None:
    rules = PairRules((2.0, 20.0), 45.0 * DEG, 0.4, 50.0, "image", 100.0)
    found = judged(flight(northward(5.0)), rules)
    assert all(reason.startswith("epipole margin -") for reason in found.reason[found.ref - found.src == 1])


def test_a_level_forward_camera_near_the_ground_is_rejected_by_the_epipole() -> None:
    """From 2 m, ground within 100 m reaches up to 1.1 deg below the horizon: 56 px; at 1 m, 28 px."""
    for up, accepted in ((2.0, True), (1.0, False)):
        found = judged(flight(northward(5.0, 2, up), pitch=0.0))
        assert found.margin_px[0] == pytest.approx(2810.0 * up / 100.0, abs=6.0)
        assert (found.reason[0] == "") == accepted
    assert found.reason[0].startswith("epipole margin 2")
    assert found.reason[0].endswith("px, below 50")


def test_a_level_camera_that_sees_no_ground_within_reach_has_its_whole_image_as_region() -> None:
    found = judged(flight(northward(5.0, 2, up=120.0), pitch=0.0))
    assert found.margin_px[0] < -1000.0
    assert found.reason[0].startswith("epipole margin -")


def test_diving_at_the_ground_is_rejected() -> None:
    down = np.array([[0.0, 0.0, 60.0], [0.0, 0.0, 55.0]])
    found = judged(flight(down, pitch=-90.0))
    assert found.margin_px[0] == pytest.approx(-1500.0, rel=0.02)
    assert found.reason[0].startswith("epipole margin -")


def test_sideways_flight_is_accepted() -> None:
    centres = northward(5.0)[:, [1, 0, 2]]
    found = judged(flight(centres, yaw=0.0))
    assert (found.reason[found.ref - found.src == 1] == "").all()


def test_a_hover_has_no_candidates() -> None:
    rng = np.random.default_rng(0)
    centres = np.array([0.0, 0.0, 30.0]) + rng.normal(0.0, 0.1, (40, 3))
    assert list(select_pairs(flight(centres), RULES)) == []
    spot = np.broadcast_to([3.0, 2.0, 30.0], (300, 3))
    assert list(select_pairs(flight(spot), RULES)) == []


@pytest.mark.parametrize("n", [0, 1])
def test_none_or_one_frame(n: int) -> None:
    assert list(select_pairs(flight(np.zeros((n, 3)) + 30.0), RULES)) == []


def test_strips_are_paired_across_not_only_along() -> None:
    """Two strips flown in opposite directions, 12 m apart, nadir: frames 0..4 and 5..9 side by side."""
    along = 4.0 * np.arange(5.0)
    east = np.r_[np.zeros(5), np.full(5, 12.0)]
    centres = np.stack([east, np.r_[along, along[::-1]], np.full(10, 40.0)], axis=1)
    found = judged(flight(centres, yaw=[0.0] * 5 + [180.0] * 5, pitch=-89.0))
    selected = {(int(i), int(j)) for i, j, why in zip(found.ref, found.src, found.reason, strict=True) if not why}
    assert {(9, 0), (5, 4), (8, 1), (9, 1), (1, 0)} <= selected
    assert all(i > j for i, j in selected)


# --- view angle and baseline ---


@given(st.lists(st.floats(-180, 180), min_size=6, max_size=6))
def test_view_angles_are_between_the_optical_axes(angles: list[float]) -> None:
    a, b = (enu_from_cam(*np.radians(part)) for part in (angles[:3], angles[3:]))
    found = view_angles(View(a[None], np.zeros((1, 3))), View(b[None], np.zeros((1, 3))))[0]
    assert np.cos(found) == pytest.approx(a[:, 2] @ b[:, 2], abs=1e-9)


def test_reasons_tell_what_was_found_and_what_is_allowed() -> None:
    frames = flight([[0.0, 0.0, 30.0], [0.0, 1.5, 30.0], [0.0, 23.0, 30.0]], yaw=[0.0, 0.0, 50.0], pitch=-60.0)
    found = judged(frames)
    assert dict(zip(zip(found.ref.tolist(), found.src.tolist(), strict=True), found.reason, strict=True)) == {
        (1, 0): "baseline 1.5 m, below 2",
        (2, 0): "baseline 23 m, above 20",
        (2, 1): "baseline 21.5 m, above 20",
    }
    assert np.isnan(found.margin_px).all()
    assert np.isnan(found.overlap).all()
    turned = judged(flight([[0.0, 0.0, 30.0], [0.0, 5.0, 30.0]], yaw=[0.0, 120.0], pitch=-40.0))
    assert turned.reason[0].startswith("view angle 83")
    assert turned.reason[0].endswith("deg, above 45")
    apart = judged(flight([[0.0, 0.0, 10.0], [0.0, 19.0, 10.0]], pitch=-85.0))
    assert apart.reason[0] == "overlap 0 below 0.4"


def test_candidates_far_from_the_limits_are_not_kept() -> None:
    found = judged(flight(northward(1.0, 60)))
    length = found.baseline_m
    assert length.min() == pytest.approx(2.0)  # 1 m is less than 2 m / 1.5
    assert length.max() == pytest.approx(30.0)
    assert set(found.reason[length > 20.0].tolist()) != {""}
    assert ((found.reason == "") <= (length <= 20.0)).all()


# --- overlap ---


@pytest.mark.parametrize("camera", [PLAIN, STRONG, WIDE], ids=["pinhole", "barrel", "fisheye"])
@pytest.mark.parametrize("src_camera", [PLAIN, WIDE], ids=["to pinhole", "to fisheye"])
def test_overlap_is_the_share_of_ground_points_that_both_see(camera: Camera, src_camera: Camera) -> None:
    rng = np.random.default_rng(11)
    shares, errors = [], []
    for _ in range(12):
        step = rng.normal(0.0, 8.0, 3) * (1.0, 1.0, 0.2)
        frames = flight(
            np.array([0.0, 0.0, 35.0]) + np.stack([np.zeros(3), step]),
            yaw=rng.normal(0.0, 15.0, 2), pitch=-50.0 + rng.normal(0.0, 15.0, 2), roll=rng.normal(0.0, 3.0, 2),
            cameras=(src_camera, camera),
        )  # fmt: skip
        found = judged(frames, OPEN)
        pixels = rng.uniform(0.0, (camera.width - 1, camera.height - 1), (4000, 2))
        seen = ground_mask(camera, frames.rotation[1], frames.centre[1, 2], 100.0, pixels)
        rays = camera.rays(pixels[seen]) @ frames.rotation[1].T
        points = frames.centre[1] + rays * (frames.centre[1, 2] / -rays[:, 2:])
        at = src_camera.project((points - frames.centre[0]) @ frames.rotation[0])
        both = np.all((at >= -0.5) & (at <= np.array([src_camera.width, src_camera.height]) - 0.5), axis=1).mean()
        shares.append(both)
        # 36 points stand for the image.
        assert found.overlap[0] == pytest.approx(both, abs=0.11)
        errors.append(found.overlap[0] - both)
    assert abs(np.mean(errors)) < 0.03, "no bias towards the image's edges"
    if src_camera is PLAIN:
        assert max(shares) - min(shares) > 0.3


def test_distortion_does_not_fold_far_points_into_the_image() -> None:
    """With k1 = -0.3 the polynomial turns back at 46 deg: points at 60..89 deg would land in the image's middle."""
    angles = np.radians(np.linspace(47.0, 89.0, 60))
    turns = np.linspace(0.0, 2.0 * np.pi, 60)
    points = np.stack([np.sin(angles) * np.cos(turns), np.sin(angles) * np.sin(turns), np.cos(angles)], axis=1)
    folded = STRONG._distort(points[:, :2] / points[:, 2:])[0] * 3600.0 + (1999.5, 1499.5)
    assert np.any(np.all((folded > 0.0) & (folded < (3999.0, 2999.0)), axis=1)), "the trap is real"
    assert not seen(STRONG, points).any()
    assert seen(STRONG, np.array([[0.3, 0.2, 1.0]])).all()
    assert not seen(STRONG, np.array([[0.3, 0.2, -1.0], [0.0, 0.0, 0.0]])).any()


@pytest.mark.parametrize("camera", [PLAIN, LENS, STRONG, WIDE])
def test_every_pixel_is_in_its_own_image(camera: Camera) -> None:
    pixels = np.stack(np.meshgrid([0.0, 900.0, camera.width - 1.0], [0.0, 900.0, camera.height - 1.0]), -1).reshape(
        -1, 2
    )
    rays = camera.rays(pixels)
    known = np.isfinite(rays).all(axis=1)
    assert known.sum() >= 5
    assert seen(camera, rays[known] * 17.0).all()


# --- candidates ---


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 600), nearest=st.floats(0.0, 3.0), width=st.floats(0.0, 4.0))
def test_candidates_are_those_of_all_pairs_in_order(seed: int, n: int, nearest: float, width: float) -> None:
    centres = np.random.default_rng(seed).uniform(0.0, 10.0, (n, 3))
    blocks = list(pairs_within(centres, nearest, nearest + width))
    found = np.concatenate([np.empty((0, 2), np.int64), *blocks])
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    later, earlier = np.nonzero((distance >= nearest) & (distance <= nearest + width) & np.tri(n, k=-1, dtype=np.bool_))
    assert found.tolist() == np.stack([later, earlier], axis=1).tolist()


def test_the_order_and_the_judgement_do_not_depend_on_the_block() -> None:
    rng = np.random.default_rng(3)
    centres = rng.uniform((0.0, 0.0, 30.0), (120.0, 120.0, 33.0), (700, 3))
    yaw = rng.uniform(-180.0, 180.0, 700)
    found = judged(flight(centres, yaw=yaw, pitch=-70.0, cameras=(LENS, PLAIN)))
    order = np.lexsort((found.src, found.ref))
    assert order.tolist() == list(range(len(order)))
    for at in rng.choice(len(found.ref), 30, replace=False):
        i, j = int(found.ref[at]), int(found.src[at])
        all_frames = flight(centres, yaw=yaw, pitch=-70.0, cameras=(LENS, PLAIN))
        two = Frames(
            all_frames.rotation[[j, i]], centres[[j, i]], centres[[j, i], 2], all_frames.camera[[j, i]], (LENS, PLAIN)
        )
        alone = judged(two)
        assert alone.reason[0] == found.reason[at]
        np.testing.assert_allclose(alone.margin_px, found.margin_px[at : at + 1], rtol=1e-9)


def survey(n: int) -> Frames:
    """Strips of 200 nadir photos, 5 m along and 15 m across."""
    line, place = np.divmod(np.arange(n), 200)
    rng = np.random.default_rng(0)
    centres = np.stack([line * 15.0, place * 5.0, np.full(n, 60.0)], axis=1) + rng.normal(0.0, 0.1, (n, 3))
    return flight(centres, yaw=np.where(line % 2, 180.0, 0.0) + rng.normal(0.0, 0.5, n), pitch=-80.0, cameras=(LENS,))


@pytest.mark.slow
def test_twenty_thousand_frames_take_seconds_and_little_memory() -> None:
    frames = survey(20_000)
    began = time.process_time()
    counts = [(len(block.ref), int((block.reason == "").sum())) for block in select_pairs(frames, RULES)]
    seconds = time.process_time() - began
    candidates, selected = np.sum(counts, axis=0)
    # About 17 candidates a frame, whatever the flight's length.
    assert 10 < candidates / 20_000 < 25
    assert selected > 5 * 20_000
    assert max(count for count, _ in counts) <= 4096
    # 4 s on a quiet core; the limit leaves room for a busy one.
    assert seconds < 30.0


def test_candidates_grow_with_the_flight_not_with_its_square() -> None:
    small, large = (sum(len(pairs) for pairs in pairs_within(survey(n).centre, 2.0 / 1.5, 30.0)) for n in (2000, 8000))
    assert 4.0 < large / small < 4.6


def test_a_long_hover_stays_within_memory() -> None:
    """All 3000 frames near one another: 4.5 million pairs of which none is long enough."""
    centres = np.random.default_rng(0).normal(0.0, 0.1, (3000, 3)) + np.array([0.0, 0.0, 30.0])
    tracemalloc.start()
    assert sum(len(pairs) for pairs in pairs_within(centres, 2.0 / 1.5, 30.0)) == 0
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 80 << 20
