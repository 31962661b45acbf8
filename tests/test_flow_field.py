"""Dense matches against motions, planes and depths that are known, and where they are asked for."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from known_motion import HOMOGRAPHIES, endpoint_error, moved_by, noise_image
from scipy.ndimage import map_coordinates

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Bools, Bytes, Floats, Singles
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import RelativePose
from pipeline.geometry.rotations import rotation_from_vector
from pipeline.geometry.transfer import VirtualView, transfer
from pipeline.matching.flow.estimators import DisFlow, FlowEstimator, ImagePair
from pipeline.matching.flow.field import DenseMatches, FlowSetting, dense_field
from pipeline.matching.flow.grid_points import grid_points
from pipeline.matching.flow.raft import SMALL, Raft, raft_from_state
from pipeline.matching.flow.raft_flow import RaftFlow
from pipeline.matching.flow.start import FlowView, bilinear, likeliest_inverse, pixel_grid, resampled, seen_at

SETTING = FlowSetting(1600, 5.0)


@pytest.fixture(scope="module")
def raft(shared: Path) -> RaftFlow:
    state = torch.load(shared / "weights/raft-small.pth", map_location="cpu", weights_only=True)
    return RaftFlow(raft_from_state(state), "c7d4", torch.device("cpu"))


def grey(image: Bytes) -> Bytes:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def of_pose(turn_deg: Sequence[float], centre: Sequence[float]) -> RelativePose:
    rotation = rotation_from_vector(np.radians(turn_deg)).T
    return RelativePose(rotation, -rotation @ np.asarray(centre, np.float64), np.zeros((6, 6)))


# --- estimators ---


@pytest.mark.parametrize("picture", range(2))
@pytest.mark.parametrize("name", HOMOGRAPHIES)
def test_dis_finds_known_motions(name: str, picture: int) -> None:
    image = noise_image(600, 800, picture)
    src, truth = moved_by(HOMOGRAPHIES[name], image)
    (fine,) = DisFlow().flows([(grey(image), grey(src))])
    (rough,) = DisFlow(1).flows([(grey(image), grey(src))])
    assert fine.dtype == np.float32
    errors = [endpoint_error(found.astype(np.float64), truth).mean() for found in (fine, rough)]
    if name == "shift":
        # Whole pixels are met exactly.
        assert max(errors) < 0.01
    else:
        assert 0.01 < errors[0] < 0.06
        assert errors[0] < errors[1] < 0.1


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (12, 300), (33, 17)])
def test_dis_takes_images_of_any_size_and_without_texture(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    for image in (np.zeros(size, np.uint8), rng.integers(0, 255, size).astype(np.uint8)):
        (flow,) = DisFlow().flows([(image, image)])
        assert flow.shape == (*size, 2)
        assert np.abs(flow).max() < 1e-3


def test_raft_keeps_the_order_of_pairs_of_different_sizes_and_the_batch_changes_nothing() -> None:
    torch.manual_seed(1)
    network = raft_from_state(Raft(SMALL).state_dict())
    images = [noise_image(height, 96, seed) for seed, height in enumerate((72, 72, 80, 72, 72))]
    pairs = [(image, np.roll(image, 3, axis=1)) for image in images]
    one, three = (RaftFlow(network, "", torch.device("cpu"), iterations=2, batch=batch) for batch in (1, 3))
    alone = [one.flows([pair])[0] for pair in pairs]
    assert [flow.shape for flow in alone] == [(*image.shape[:2], 2) for image in images]
    assert np.abs(alone[0] - alone[1]).max() > 1e-4
    for found, expected in zip(three.flows(pairs), alone, strict=True):
        assert np.allclose(found, expected, atol=1e-4)
    assert three.notes == []


def test_settings_tell_all_that_a_result_depends_on() -> None:
    network, cpu = Raft(SMALL), torch.device("cpu")
    raft = RaftFlow(network, "ab", cpu)
    told = {
        raft.settings,
        replace(raft, weights_sha256="cd").settings,
        replace(raft, iterations=20).settings,
        replace(raft, tile_px=512).settings,
        DisFlow().settings,
        DisFlow(1).settings,
        DisFlow(tile_px=512).settings,
    }
    assert len(told) == 7
    assert replace(raft, batch=4).settings == raft.settings


# --- a plane seen by two cameras of different lenses and sizes ---


@dataclass(frozen=True)
class Plane:
    """A textured plane normal . X = offset in ref, and its two images."""

    ref: FlowView
    src: FlowView
    pose: RelativePose
    normal: Floats
    offset: float

    def truth(self, ref_px: Floats) -> Floats:
        rays = self.ref.camera.rays(ref_px)
        points = rays * (self.offset / (rays @ self.normal))[..., None]
        return self.src.camera.project(points @ self.pose.rotation.T + self.pose.translation)


def view_of_plane(
    camera: Camera, rotation: Floats, centre: Floats, normal: Floats, offset: float, texture: Bytes, px_per_m: float
) -> Bytes:
    """Rotation is ref_from_camera."""
    pixels = pixel_grid(camera.width, camera.height)
    rays = camera.rays(pixels) @ rotation.T
    points = centre + rays * ((offset - centre @ normal) / (rays @ normal))[..., None]
    first = np.cross(normal, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    at = np.stack([points @ first, points @ second], -1) * px_per_m + np.array(texture.shape[1::-1]) / 2
    return np.asarray(cv2.remap(texture, at.astype(np.float32), None, cv2.INTER_CUBIC, None, cv2.BORDER_REFLECT))


def plane(*, colour: bool = False, size: int = 1) -> Plane:
    """Ground 40 m away, leaning 20 deg, seen from 9 m apart."""
    ref_camera = Camera("brown", 800, 600, 640.0, 642.0, 405.0, 296.0, (-0.12, 0.03, 0.001, -0.0005, 0.0))
    src_camera = Camera("fisheye", 1000, 640, 700.0, 700.0, 490.0, 325.0, (0.02, -0.003, 0.0, 0.0))
    pose = of_pose([0.0, 6.0, 8.0], [9.0, 1.0, -1.0])
    normal = np.array([0.2, 0.3, 1.0]) / np.linalg.norm([0.2, 0.3, 1.0])
    texture = noise_image(1600, 2000, 3)
    texture = texture if colour else grey(texture)
    images = [
        view_of_plane(camera, rotation, centre, normal, 40.0, texture, 16.0)
        for camera, rotation, centre in (
            (ref_camera, np.eye(3), np.zeros(3)),
            (src_camera, pose.rotation.T, pose.centre),
        )
    ]
    views = (FlowView(image, camera) for image, camera in zip(images, (ref_camera, src_camera), strict=True))
    return Plane(*views, pose, normal, 40.0)


@pytest.fixture(scope="module")
def ground() -> Plane:
    return plane()


def matched(of: Plane, estimator: FlowEstimator, ref_px: Floats, setting: FlowSetting = SETTING) -> DenseMatches:
    return dense_field(of.ref, of.src, of.pose, estimator, setting).sample(ref_px)


def consistent(found: DenseMatches) -> Bools:
    with np.errstate(invalid="ignore"):
        return found.valid & (found.discrepancy_px < 1.0)


def check_plane(of: Plane, estimator: FlowEstimator, longest_px: int, median_px: float) -> None:
    ref_px = grid_points(of.ref.image, 3000, longest_px)
    found = matched(of, estimator, ref_px, replace(SETTING, longest_px=longest_px))
    truth = of.truth(ref_px)
    assert np.array_equal(found.ref_px, ref_px)
    error = np.linalg.norm(found.src_px - truth, axis=1)
    good = consistent(found)
    seen = of.src.camera.holds(truth)
    assert 0.5 < seen.mean() < 0.98
    assert good[seen].mean() > 0.93
    # What src does not see is not found there.
    assert good[~seen].mean() < 0.05
    assert 0.005 < np.median(error[good]) < median_px
    assert np.quantile(error[good], 0.98) < 6.0 * median_px
    # The pose alone, at one depth, is far off: the motion is found in the images.
    start = seen_at(of.ref.camera.rays(ref_px), of.pose, 1.0 / 40.0, of.src.camera)
    assert np.median(np.linalg.norm(start - truth, axis=1)[good]) > 10 * median_px


@pytest.mark.parametrize(("longest_px", "median_px"), [(1600, 0.1), (600, 0.15)])
def test_dis_on_a_plane_through_two_lenses(ground: Plane, longest_px: int, median_px: float) -> None:
    check_plane(ground, DisFlow(), longest_px, median_px)


@pytest.mark.real
@pytest.mark.slow
def test_raft_on_a_plane_through_two_lenses(raft: RaftFlow) -> None:
    # At half the size and with fewer steps, a processor's time being what it is.
    check_plane(plane(colour=True), replace(raft, iterations=8), 400, 0.45)


@pytest.mark.parametrize("wrong_deg", [(2.0, -2.0, 3.0), (-3.0, 3.0, 0.0)])
def test_a_pose_wrong_by_degrees_still_finds_the_motion(ground: Plane, wrong_deg: tuple[float, float, float]) -> None:
    turn = rotation_from_vector(np.radians(wrong_deg))
    logged = replace(ground.pose, rotation=turn @ ground.pose.rotation, translation=turn @ ground.pose.translation)
    ref_px = grid_points(ground.ref.image, 2000, 1600)
    found = dense_field(ground.ref, ground.src, logged, DisFlow(), SETTING).sample(ref_px)
    truth = ground.truth(ref_px)
    seen = ground.src.camera.holds(truth)
    good = consistent(found)
    assert good[seen].mean() > 0.9
    assert np.median(np.linalg.norm(found.src_px - truth, axis=1)[good]) < 0.15


def test_tiles_agree_with_the_image_in_one_piece(ground: Plane) -> None:
    ref_px = grid_points(ground.ref.image, 3000, 1600)
    whole, tiled = (matched(ground, DisFlow(tile_px=tile), ref_px) for tile in (1024, 300))
    both = consistent(whole) & consistent(tiled)
    apart = np.linalg.norm(whole.src_px - tiled.src_px, axis=1)[both]
    assert both.sum() > 0.97 * consistent(whole).sum()
    assert 0.0 < np.median(apart) < 0.05
    assert np.quantile(apart, 0.99) < 0.15


def test_pixels_do_not_depend_on_which_others_are_asked_for(ground: Plane) -> None:
    ref_px = np.random.default_rng(0).uniform((-20, -20), (820, 620), (400, 2))
    dense = dense_field(ground.ref, ground.src, ground.pose, DisFlow(tile_px=300), SETTING)
    together = dense.sample(ref_px)
    some = np.arange(399, 0, -7)
    alone = dense.sample(ref_px[some])
    assert np.array_equal(alone.src_px, together.src_px[some], equal_nan=True)
    assert np.array_equal(alone.discrepancy_px, together.discrepancy_px[some], equal_nan=True)
    # A pixel beyond the image has no match.
    outside = ~ground.ref.camera.holds(ref_px)
    assert outside.sum() > 10
    assert not together.valid[outside].any()
    assert np.isnan(together.src_px[~together.valid]).all()
    assert dense.sample(np.empty((0, 2))).src_px.shape == (0, 2)


def test_the_number_of_threads_changes_nothing(ground: Plane) -> None:
    ref_px = grid_points(ground.ref.image, 500, 1600)
    before = cv2.getNumThreads()
    found = []
    try:
        for threads in (1, 3):
            cv2.setNumThreads(threads)
            found.append(matched(ground, DisFlow(tile_px=400), ref_px))
    finally:
        cv2.setNumThreads(before)
    assert found[0].src_px.tobytes() == found[1].src_px.tobytes()
    assert found[0].discrepancy_px.tobytes() == found[1].discrepancy_px.tobytes()


def test_an_unrelated_image_is_not_consistent(ground: Plane) -> None:
    other = FlowView(grey(noise_image(640, 1000, 9)), ground.src.camera)
    ref_px = grid_points(ground.ref.image, 2000, 1600)
    found = matched(replace(ground, src=other), DisFlow(), ref_px)
    assert consistent(found).mean() < 0.3


@dataclass(frozen=True)
class Still:
    """Says that nothing moves, and how often it was asked."""

    channels: int = 1
    tile_px: int = 200
    settings: str = "still"
    sizes: list[tuple[int, ...]] = field(default_factory=list)

    def flows(self, pairs: Sequence[ImagePair]) -> list[Singles]:
        for pair in pairs:
            assert pair[0].shape == pair[1].shape
            assert (pair[0].ndim == 3) == (self.channels == 3)
            assert max(pair[0].shape) <= self.tile_px
        self.sizes.extend(pair[0].shape for pair in pairs)
        return [np.zeros((*pair[0].shape[:2], 2), np.float32) for pair in pairs]


@pytest.mark.parametrize(("channels", "colour"), [(1, False), (1, True), (3, False), (3, True)])
@pytest.mark.parametrize("longest_px", [5000, 500])
def test_without_motion_the_matches_are_those_of_the_pose(channels: int, longest_px: int, *, colour: bool) -> None:
    of = plane(colour=colour)
    estimator = Still(channels)
    dense = dense_field(of.ref, of.src, of.pose, estimator, FlowSetting(longest_px, 5.0, margin_px=20))
    ref_px = np.random.default_rng(1).uniform(0, (799, 599), (3000, 2))
    found = dense.sample(ref_px)
    expected = seen_at(of.ref.camera.rays(ref_px), of.pose, dense.start.inverse_m, of.src.camera)
    inside = of.src.camera.holds(expected)
    assert (found.valid == inside).mean() > 0.995
    both = found.valid & inside
    assert np.abs(found.src_px - expected)[both].max() < 0.05
    assert np.all(found.discrepancy_px[both] == 0.0)


def test_only_tiles_that_are_asked_for_are_run(ground: Plane) -> None:
    estimator = Still()
    dense = dense_field(ground.ref, ground.src, ground.pose, estimator, FlowSetting(5000, 5.0, margin_px=20))
    estimator.sizes.clear()
    dense.sample(np.array([[780.0, 300.0], [781.0, 310.0]]))
    # There and back.
    assert len(estimator.sizes) == 2
    dense.sample(np.array([[400.0, 300.0], [781.0, 310.0]]))
    assert len(estimator.sizes) == 6


def test_an_image_that_is_not_of_its_camera_is_refused(ground: Plane) -> None:
    wrong = replace(ground.src, image=ground.src.image[:-1])
    with pytest.raises(InputError, match="E-FLOW-01") as caught:
        dense_field(ground.ref, wrong, ground.pose, DisFlow(), SETTING)
    assert caught.value.found == "image 1000x639"


def test_the_same_image_twice_stays_where_it_is() -> None:
    camera = Camera("brown", 700, 500, 600.0, 600.0, 352.0, 251.0, (-0.1, 0.01, 0.0, 0.0, 0.0))
    view = FlowView(grey(noise_image(500, 700)), camera)
    same = of_pose([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    ref_px = np.random.default_rng(1).uniform(0, (699, 499), (500, 2))
    found = dense_field(view, view, same, DisFlow(), SETTING).sample(ref_px)
    assert found.valid.all()
    assert np.abs(found.src_px - ref_px).max() < 0.01
    assert found.discrepancy_px.max() < 0.01


def test_a_turn_without_a_baseline_is_removed_exactly() -> None:
    """50 deg about the optical axis: no estimator finds it by itself."""
    camera = Camera("pinhole", 700, 700, 600.0, 600.0, 349.5, 349.5)
    pose = of_pose([0.0, 0.0, 50.0], [0.0, 0.0, 0.0])
    image = grey(noise_image(700, 700))
    homography = camera.matrix @ pose.rotation @ np.linalg.inv(camera.matrix)
    src, truth = moved_by(homography, image)
    found = dense_field(FlowView(image, camera), FlowView(src, camera), pose, DisFlow(), SETTING).sample(
        pixel_grid(700, 700)[::9, ::9].reshape(-1, 2)
    )
    error = np.linalg.norm(found.src_px - found.ref_px - truth[::9, ::9].reshape(-1, 2), axis=1)
    known = np.isfinite(error)
    assert known.mean() > 0.6
    assert np.quantile(error[known], 0.98) < 0.1


def test_images_without_texture_cross_without_a_crash(ground: Plane) -> None:
    black = [FlowView(np.zeros_like(view.image), view.camera) for view in (ground.ref, ground.src)]
    assert len(grid_points(black[0].image, 500, 1600)) == 0
    found = matched(replace(ground, ref=black[0], src=black[1]), DisFlow(), np.array([[400.0, 300.0]]))
    assert found.src_px.shape == (1, 2)


# --- where it starts ---


@pytest.mark.parametrize("depth_m", [9.0, 20.0, 60.0, 1e6])
def test_the_depth_at_which_the_images_look_alike_is_found(depth_m: float) -> None:
    camera = Camera("pinhole", 640, 480, 520.0, 520.0, 319.5, 239.5)
    pose = of_pose([1.0, 4.0, -2.0], [3.0, 0.5, 0.2])
    normal = np.array([0.0, 0.0, 1.0])
    texture = grey(noise_image(2000, 3000, 5))
    scale = 520.0 / depth_m
    ref, src = (
        FlowView(view_of_plane(camera, turn, centre, normal, depth_m, texture, scale), camera)
        for turn, centre in ((np.eye(3), np.zeros(3)), (pose.rotation.T, pose.centre))
    )
    # A step is six pixels of parallax at a quarter of the size; one beside the nearest does as well.
    step = 24.0 / (520.0 * np.linalg.norm(pose.centre))
    assert abs(likeliest_inverse(ref, src, pose, 5.0) - 1.0 / depth_m) < 1.6 * step
    # The sweep is not to be right by its first or middle candidate.
    assert step < 0.25 / 5.0


@given(data=st.data(), width=st.integers(1, 9), height=st.integers(1, 9))
@settings(max_examples=60)
def test_bilinear_is_scipys(data: st.DataObject, width: int, height: int) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    values = rng.normal(size=(height, width, 2))
    at = rng.uniform(-3, 12, (5, 4, 2))
    expected = [
        map_coordinates(values[..., i], at[..., ::-1].transpose(2, 0, 1), order=1, mode="nearest") for i in (0, 1)
    ]
    assert np.allclose(bilinear(values, at), np.stack(expected, -1), atol=1e-12)
    at[2, 1, 0] = np.nan
    assert np.isnan(bilinear(values, at)[2, 1]).all()
    assert np.isfinite(bilinear(values, at)).sum() == 38


def test_resampling_takes_src_where_it_is_seen_and_ref_elsewhere() -> None:
    src, ref = (noise_image(60, 90, seed) for seed in (1, 2))
    places = pixel_grid(50, 40) + np.array([20.0, 12.0])
    inside = np.zeros((40, 50), np.bool_)
    inside[5:30, 10:44] = True
    places[~inside] = np.nan
    found = resampled(src, places, inside, ref[:40, :50])
    assert np.array_equal(found[inside], src[12:52, 20:70][inside])
    assert np.array_equal(found[~inside], ref[:40, :50][~inside])
    nothing = resampled(src, places, np.zeros_like(inside), ref[:40, :50])
    assert np.array_equal(nothing, ref[:40, :50])


# --- where matches are asked for ---


def test_one_point_per_cell_and_it_is_the_best_textured() -> None:
    image = grey(noise_image(300, 400))
    points = grid_points(image, 48, 1600)
    assert len(points) == 48
    assert np.array_equal(points, points.round())
    eigenvalue = np.asarray(cv2.cornerMinEigenVal(image, 5))
    for u, v in points.astype(int):
        top, left = v // 50 * 50, u // 50 * 50
        assert eigenvalue[v, u] == pytest.approx(eigenvalue[top : top + 50, left : left + 50].max())
    assert len({(u // 50, v // 50) for u, v in points}) == 48


@given(width=st.integers(1, 90), height=st.integers(1, 90), count=st.integers(1, 4000))
@settings(max_examples=60)
def test_about_as_many_points_as_wanted_and_all_in_the_image(width: int, height: int, count: int) -> None:
    image = np.random.default_rng(0).integers(0, 255, (height, width)).astype(np.uint8)
    points = grid_points(image, count, 1600)
    assert len(np.unique(points, axis=0)) == len(points)
    assert Camera("pinhole", width, height, 1.0, 1.0, 0.0, 0.0).holds(points).all()
    assert len(points) <= min(2 * count, width * height)
    if min(width, height) > 8:
        assert len(points) >= 0.4 * min(count, width * height)


def test_points_are_pixels_of_the_image_as_given() -> None:
    image = noise_image(600, 900)
    large = np.asarray(cv2.resize(image, (1800, 1200), interpolation=cv2.INTER_NEAREST), np.uint8)
    points = grid_points(image, 500, 900)
    assert np.allclose(grid_points(large, 500, 900), 2.0 * points + 0.5)


@pytest.mark.parametrize(
    ("image", "share"),
    [
        (np.zeros((300, 400), np.uint8), (0.0, 0.0)),
        (np.full((300, 400, 3), 255, np.uint8), (0.0, 0.0)),
        # A ramp slides along itself; so does an edge.
        (np.tile(np.linspace(0, 255, 400).astype(np.uint8), (300, 1)), (0.0, 0.0)),
        (np.tile(np.repeat(np.uint8([20, 220]), 200), (300, 1)), (0.0, 0.0)),
        (np.random.default_rng(0).normal(100, 1.0, (300, 400)).round().astype(np.uint8), (0.0, 0.01)),
        (np.random.default_rng(0).normal(100, 6.0, (300, 400)).round().astype(np.uint8), (1.0, 1.0)),
    ],
    ids=["black", "white", "ramp", "edge", "a level of noise", "texture of six levels"],
)
def test_cells_that_noise_does_not_let_place_give_no_points(image: Bytes, share: tuple[float, float]) -> None:
    assert share[0] <= len(grid_points(image, 300, 1600)) / 300 <= share[1]


# --- size ---

_LARGE = """
import re, sys
from pathlib import Path
import cv2, numpy as np
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import RelativePose
from pipeline.matching.flow.estimators import DisFlow
from pipeline.matching.flow.field import FlowSetting, FlowView, dense_field
peak = lambda: int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024
cv2.setNumThreads(1)
width, height = 11600, 8700
image = np.empty((height, width), np.uint8)
small = cv2.resize(np.random.default_rng(0).integers(0, 255, (900, 1200)).astype(np.uint8), (2900, 2900))
for top in range(0, height, 2900):
    for left in range(0, width, 2900):
        image[top:top + 2900, left:left + 2900] = small[::-1] if (top + left) // 2900 % 2 else small
src = np.empty_like(image)
src[:, :-200], src[:, -200:] = image[:, 200:], 0
camera = Camera("brown", width, height, 9000.0, 9000.0, 5800.0, 4350.0, (-0.01, 0.0, 0.0, 0.0, 0.0))
pose = RelativePose(np.eye(3), np.array([-1.0, 0.0, 0.0]), np.zeros((6, 6)))
before = peak()
field = dense_field(FlowView(image, camera), FlowView(src, camera), pose, DisFlow(1), FlowSetting(12000, 10.0))
ref_px = np.random.default_rng(1).uniform((600, 2000), (11000, 2600), (2000, 2))
found = field.sample(ref_px)
error = np.abs(found.src_px - ref_px - (-200.0, 0.0)).max(axis=1)
print(peak() - before, np.nanmean(error < 0.5), found.valid.mean())
"""


@pytest.mark.slow
def test_an_image_of_100_megapixels_needs_little_more_than_itself() -> None:
    done = subprocess.run([sys.executable, "-c", _LARGE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    more_mb, right, valid = (float(word) for word in done.stdout.split())
    # A field of that size would be 800 MB; each image is 101 MB.
    assert more_mb < 300
    assert right > 0.9
    assert valid > 0.9


# --- real photos with exact poses ---


def fountain(shared: Path, number: int) -> tuple[FlowView, Floats, Floats]:
    folder = shared / "data/truth/fountain_p11"
    values = next((folder / "gt_dense_cameras").glob(f"*{number:04d}*")).read_text().split()
    k, rotation = np.array(values[:9], float).reshape(3, 3), np.array(values[12:21], float).reshape(3, 3)
    image = np.asarray(cv2.imread(str(next((folder / "images").glob(f"*{number:04d}*")))))[..., ::-1]
    height, width = image.shape[:2]
    camera = Camera("pinhole", width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    return FlowView(np.ascontiguousarray(image), camera), rotation, np.array(values[21:24], float)


def off_epipolar_line(found: DenseMatches, ref: Camera, src: Camera, pose: RelativePose) -> Floats:
    """Px of src."""
    line = np.cross(pose.translation, ref.rays(found.ref_px) @ pose.rotation.T) @ np.linalg.inv(src.matrix)
    at = np.concatenate([found.src_px, np.ones((len(line), 1))], axis=1)
    return np.abs(np.sum(at * line, axis=1)) / np.hypot(line[:, 0], line[:, 1])


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize("name", ["dis", "raft"])
def test_a_building_under_its_laser_poses(shared: Path, raft: RaftFlow, name: str) -> None:
    estimator, longest_px = (DisFlow(), 1600) if name == "dis" else (replace(raft, iterations=8), 384)
    (ref, ref_turn, ref_centre), (src, src_turn, src_centre) = (fountain(shared, number) for number in (4, 5))
    pose = RelativePose(src_turn.T @ ref_turn, src_turn.T @ (ref_centre - src_centre), np.zeros((6, 6)))
    ref_px = grid_points(ref.image, 4000, longest_px)
    found = dense_field(ref, src, pose, estimator, FlowSetting(longest_px, 1.0)).sample(ref_px)
    good = consistent(found)
    assert good.mean() > 0.6
    shrunk = 3072 / longest_px
    off = off_epipolar_line(found, ref.camera, src.camera, pose)[good] / shrunk
    assert 0.02 < np.median(off) < (0.12 if name == "dis" else 0.2)
    assert np.quantile(off, 0.9) < (0.5 if name == "dis" else 0.7)


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize("name", ["dis", "raft"])
def test_depths_of_a_room_against_its_measured_ones(shared: Path, raft: RaftFlow, name: str) -> None:
    folder = shared / "data/truth/hololens"
    k = np.loadtxt(folder / "K.txt")
    poses = np.loadtxt(folder / "poses.txt").reshape(-1, 4, 4)
    rows = list(csv.DictReader((folder / "selected_frames.csv").open()))
    ref_row, src_row = rows[0], rows[4]
    camera = Camera("pinhole", 540, 360, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    ref, src = (
        FlowView(np.ascontiguousarray(np.asarray(cv2.imread(str(folder / "images" / r["name"])))[..., ::-1]), camera)
        for r in (ref_row, src_row)
    )
    src_from_ref = np.linalg.inv(poses[int(src_row["pose_row"])]) @ poses[int(ref_row["pose_row"])]
    pose = RelativePose(src_from_ref[:3, :3], src_from_ref[:3, 3], np.zeros((6, 6)))
    estimator, longest_px = (DisFlow(), 540) if name == "dis" else (replace(raft, iterations=8), 400)
    ref_px = grid_points(ref.image, 2000, longest_px)
    found = dense_field(ref, src, pose, estimator, FlowSetting(longest_px, 0.5)).sample(ref_px)
    good = consistent(found)
    rays, src_rays = (view.camera.rays(px[good])[:, :2].T for view, px in ((ref, found.ref_px), (src, found.src_px)))
    depth_m = transfer(rays, src_rays, pose, VirtualView.ADAPTIVE)
    measured = np.asarray(cv2.imread(str(folder / "depth" / ref_row["name"]), cv2.IMREAD_UNCHANGED)) / 1000.0
    measured = cv2.resize(measured, (540, 360), interpolation=cv2.INTER_NEAREST)
    at = found.ref_px[good].round().astype(int)
    there = measured[at[:, 1], at[:, 0]]
    error = np.abs(depth_m[there > 0.2] / there[there > 0.2] - 1.0)
    assert len(error) > 150
    assert 0.002 < np.median(error) < (0.015 if name == "dis" else 0.025)
