"""The second flight of the example: a lawn and a wide roof, with truth of the same form and little to match."""

import json
import tomllib
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
from flight_truth import FlightTruth, reprojection_errors
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from pipeline.geometry.arrays import Floats
from pipeline.simulation import example
from pipeline.simulation.flight import CONSUMER_DRONE, FORWARD, SIDEWAYS, fly, logged_poses
from pipeline.simulation.lawn import FEW_FRAMES, FRAMES, HALL, fly_lawn, lawn_frames, lawn_seed, lawn_site
from pipeline.simulation.lawn_looks import LawnShader
from pipeline.simulation.render import CAMERA, Renderer, camera_rays, scene_depth
from pipeline.simulation.site import GROUND, UNDULATION_M, Site, place
from pipeline.simulation.solids import TOP, Building, Crown
from pipeline.sources.dji import attitude, position
from pipeline.sources.exif import read_exif
from pipeline.sources.xmp import read_xmp

SMALL = CAMERA.scaled(640, 480)
SEED = 7


@pytest.fixture(scope="module")
def site() -> Site:
    return lawn_site(lawn_seed(SEED))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("example") / "flight"
    example.write_example(folder, 4, SEED, 1, SMALL)
    return folder


# --- geometry


@settings(max_examples=25, deadline=None)
@given(st.floats(0.3, 5.0), st.floats(-1.0, 2.0), st.integers(0, 2**32 - 1))
def test_a_crown_is_met_where_rays_enter_it(radius: float, lift: float, seed: int) -> None:
    crown = Crown(1.0, 2.0, 3.0, radius)
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(-np.pi, np.pi, 40)
    origins = crown.centre_in_enu_m + 12.0 * np.column_stack([np.sin(bearing), np.cos(bearing), np.full(40, lift)])
    aims = crown.centre_in_enu_m + rng.uniform(-1.2, 1.2, (40, 3)) * radius
    t, _ = crown.cast(origins, aims - origins)
    steps = np.linspace(0.0, 2.0, 20001)
    for i in range(40):
        away = np.linalg.norm(origins[i] + steps[:, None] * (aims[i] - origins[i]) - crown.centre_in_enu_m, axis=1)
        within = np.flatnonzero(away < radius - 1e-9)
        if len(within):
            assert steps[within[0]] - 2e-4 <= t[i] <= steps[within[0]]
        if np.isfinite(t[i]):
            hit = origins[i] + t[i] * (aims[i] - origins[i])
            assert np.linalg.norm(hit - crown.centre_in_enu_m) == pytest.approx(radius, abs=1e-9)


def test_a_ray_from_inside_a_crown_leaves_it() -> None:
    t, _ = Crown(0.0, 0.0, 0.0, 2.0).cast(np.array([0.5, 0.0, 0.0]), np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(t, (1.5, 2.5))


def test_nothing_floats_and_nothing_is_in_the_way(site: Site) -> None:
    hall = site.solids[HALL]
    assert isinstance(hall, Building)
    corners = hall.corners()
    ground = site.terrain.height(corners[:, 0], corners[:, 1])
    assert np.all(hall.floor_m < ground)
    assert 7.0 < hall.roof_m - float(ground.mean()) < 8.5
    for solid in site.solids:
        assert np.all(solid.corners()[:, 2] < 15.0), "the flight passes 31 m above the ground"
        if isinstance(solid, Building) and solid is not hall:
            assert solid.floor_m < hall.roof_m < solid.roof_m
            assert np.all(np.abs(hall.local(solid.corners()))[:, :2] < hall.half_m[:2])


def test_most_of_every_picture_is_lawn_roof_and_meadow(site: Site) -> None:
    poses = fly_lawn(site, FRAMES)
    u, v = np.meshgrid(np.linspace(0, CAMERA.width - 1, 80), np.linspace(0, CAMERA.height - 1, 60))
    rays = CAMERA.rays(np.stack([u, v], axis=-1).reshape(-1, 2))
    roofs = []
    for rotation, centre in zip(poses.rotation_enu_from_cam, poses.centre_in_enu_m, strict=True):
        hits = site.cast(centre, rays @ rotation.T)
        roof = (hits.thing == HALL) & (hits.face == TOP)
        roofs.append(roof.mean())
        assert np.mean((hits.thing == GROUND) | roof) > 0.65
    assert 0.12 < np.mean(roofs) < 0.25
    assert max(roofs) > 0.22


def test_the_flight_is_the_first_ones_but_for_its_draws_and_its_hour(site: Site) -> None:
    poses, first = fly_lawn(site, FRAMES), fly(Site.seeded(SEED).terrain, FRAMES, SEED)
    assert (poses.leg.count(FORWARD), poses.leg.count(SIDEWAYS)) == (5, 3)
    np.testing.assert_array_equal(poses.time_s - first.time_s, 1800.0)
    off = poses.centre_in_enu_m[:, :2] - first.centre_in_enu_m[:, :2]
    assert 0.05 < np.std(off) < 0.5
    assert lawn_seed(7) != lawn_seed(8) != 8


@pytest.mark.parametrize(("frames", "expected"), [(4, FEW_FRAMES), (23, FEW_FRAMES), (24, FRAMES), (200, FRAMES)])
def test_a_small_example_has_a_small_lawn(frames: int, expected: int) -> None:
    assert lawn_frames(frames) == expected


# --- looks


def rough(grey: Floats) -> float:
    """One sigma of the detail finer than 12 px."""
    return float((grey - cv2.GaussianBlur(grey, (0, 0), 12)).std())


def test_the_contrast_is_low_but_not_nothing(site: Site) -> None:
    poses = fly_lawn(site, FRAMES)
    renderer = Renderer(CAMERA, camera_rays(CAMERA), LawnShader.of(site))
    picture, _ = renderer.render(poses.rotation_enu_from_cam[4], poses.centre_in_enu_m[4])
    grey = picture.mean(axis=2)
    for v, u in ((1050, 200), (1050, 400), (800, 300), (600, 500)):
        assert 2.5 < rough(grey[v : v + 60, u : u + 60]) < 4.5, "lawn"
        red, green, blue = picture[v : v + 60, u : u + 60].reshape(-1, 3).mean(axis=0)
        assert green > 1.2 * red > 1.2 * blue
    for v, u in ((1050, 1000), (800, 1400), (600, 1200)):
        assert 2.5 < rough(grey[v : v + 60, u : u + 60]) < 6.0, "roof"


def test_a_place_looks_the_same_from_elsewhere(site: Site) -> None:
    """Texture lies on the ground, not on the picture: two places of the eye at the same range see the same."""
    shader = LawnShader.of(site)
    rng = np.random.default_rng(2)
    middle = place(np.array([[40.0, -18.0]]))[0]
    spots = middle + rng.uniform(-5.0, 5.0, (400, 2))
    spots = np.column_stack([spots, site.terrain.height(spots[:, 0], spots[:, 1])])
    seen = []
    for side in (-15.0, 15.0):
        eye = np.array([middle[0] + side, middle[1], 31.0])
        rays = spots - eye
        seen.append(shader.colours(eye, rays, site.cast(eye, rays), 1.0 / CAMERA.focal_px).mean(axis=1))
    assert np.std(seen[0]) > 1.0
    assert np.corrcoef(*seen)[0, 1] > 0.95


# --- what is written


def test_photos_carry_the_logged_pose(made: Path, site: Site) -> None:
    log = logged_poses(fly_lawn(site, FEW_FRAMES), CONSUMER_DRONE, site.seed)
    paths = sorted((made / "lawn" / "photos").glob("*.JPG"))
    assert len(paths) == FEW_FRAMES
    for index, path in enumerate(paths):
        with Image.open(path) as image:
            xmp = read_xmp(image.info["xmp"])
            assert image.size == (SMALL.width, SMALL.height)
        exif = read_exif(path.read_bytes())
        where, looks = position(exif, xmp), attitude(exif, xmp)
        height = float(xmp.dji["AbsoluteAltitude"]) + UNDULATION_M
        centre = site.frame.enu_from_geodetic(where.latitude_deg, where.longitude_deg, height)
        np.testing.assert_allclose(centre, log.centre_in_enu_m[index], atol=1e-3)
        degrees = np.degrees(log.angles_rad[index])
        np.testing.assert_allclose((looks.yaw_deg, looks.pitch_deg, looks.roll_deg), degrees, atol=6e-4)


def test_the_truth_is_read_as_the_first_flights(made: Path, site: Site) -> None:
    truth = FlightTruth.of(made / "lawn")
    poses = fly_lawn(site, FEW_FRAMES)
    assert [pose.leg for pose in truth.poses.values()] == list(poses.leg)
    facts, first = (json.loads((made / f / "truth" / "site.json").read_text()) for f in ("lawn", "."))
    assert facts.keys() == first.keys()
    assert (facts["camera"], facts["pose_noise"]) == (first["camera"], first["pose_noise"])
    assert facts["frame_enu"] != first["frame_enu"]
    rng = np.random.default_rng(3)
    pixels = np.column_stack([rng.uniform(0, SMALL.width - 1, 2000), rng.uniform(0, SMALL.height - 1, 2000)])
    for name, pose in truth.poses.items():
        exact = scene_depth(site, SMALL, pose.rotation, pose.centre, pixels)
        found = truth.depths(name, pixels)
        known = np.isfinite(found) & np.isfinite(exact)
        assert known.mean() > 0.75
        assert np.mean(np.abs(found[known] / exact[known] - 1.0) < 1e-3) > 0.99


def test_tiles_lie_on_the_surfaces(made: Path) -> None:
    clouds = [laspy.read(path) for path in sorted((made / "lawn" / "lidar").glob("*.laz"))]
    assert len(clouds) == 2
    xyz = np.concatenate([np.asarray(cloud.xyz) for cloud in clouds])
    classes = np.concatenate([np.asarray(cloud.classification) for cloud in clouds])
    assert set(np.unique(classes)) == {2, 5, 6, 7, 64}
    # The ground undulates by less than a metre; the roof is one level, but for what stands on it.
    assert 0.2 < np.ptp(xyz[classes == 2, 2]) < 1.5
    roof = xyz[classes == 6, 2]
    level = np.median(roof)
    assert 6.5 < level - np.median(xyz[classes == 2, 2]) < 8.5
    assert 0.95 < np.mean(np.abs(roof - level) < 0.1) < 0.998


def test_the_workflow_is_the_first_ones_with_its_own_places(made: Path) -> None:
    first, lawn = (tomllib.loads((made / f"workflow{name}.toml").read_text()) for name in ("", "_lawn"))
    assert len(list((made / lawn["ingest"]["photos"]).glob("*.JPG"))) == FEW_FRAMES
    assert len(list(made.glob(lawn["score"]["lidar"]))) == 2
    lawn["ingest"]["photos"], lawn["score"]["lidar"] = first["ingest"]["photos"], first["score"]["lidar"]
    # Only the first flight has control points, and a report.
    assert first["score"].pop("control_points") == "gcp_list.txt"
    del first["score"]["control_height_datum"], first["report"]
    assert lawn == first


def test_sift_finds_little_on_the_lawn_and_what_it_finds_is_right(made: Path) -> None:
    found = {}
    for folder in (made, made / "lawn"):
        truth = FlightTruth.of(folder)
        names = ["DJI_0001", "DJI_0002"]
        ref, src = (truth.poses[name] for name in names)
        a, b = _matches(*(folder / "photos" / f"{name}.JPG" for name in names))
        off = reprojection_errors(a, b, truth.depths(names[0], a), SMALL, ref=ref, src=src)
        found[folder] = int(np.sum(np.linalg.norm(off, axis=1) < 2.0))
    assert 10 < found[made / "lawn"] < 0.25 * found[made]


def _matches(ref: Path, src: Path) -> tuple[Floats, Floats]:
    sift = cv2.SIFT_create(3000)
    points, features = [], []
    for path in (ref, src):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        keypoints, descriptors = sift.detectAndCompute(grey, None)  # type: ignore[call-overload]
        points.append(np.array([keypoint.pt for keypoint in keypoints]))
        features.append(descriptors)
    pairs = [m for m in cv2.BFMatcher().knnMatch(features[0], features[1], 2) if m[0].distance < 0.8 * m[1].distance]
    return points[0][[m[0].queryIdx for m in pairs]], points[1][[m[0].trainIdx for m in pairs]]
