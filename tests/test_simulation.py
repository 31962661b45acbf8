"""The synthetic site and flight: exact geometry, natural tags, the same bytes every time."""

import csv
import errno
import hashlib
import json
import tomllib
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from pyproj import CRS, Transformer

from pipeline.engine.errors import ResourceError, UsageError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import enu_from_cam, gimbal_angles, rotation_from_quaternion, skew
from pipeline.simulation import example
from pipeline.simulation.control import observe
from pipeline.simulation.flight import (
    CONSUMER_DRONE,
    FORWARD,
    SIDEWAYS,
    PoseNoise,
    fly,
    logged_poses,
    noisy_poses,
)
from pipeline.simulation.lawn import FEW_FRAMES
from pipeline.simulation.render import CAMERA, Renderer, camera_rays, scene_depth
from pipeline.simulation.shading import Shader
from pipeline.simulation.site import GROUND, SKY, UNDULATION_M, Site
from pipeline.simulation.solids import TOP, Building, Pole
from pipeline.simulation.terrain import Hill, Terrain
from pipeline.sources.dji import attitude, exposure_time, position
from pipeline.sources.exif import read_exif
from pipeline.sources.intrinsics import dewarp_data
from pipeline.sources.xmp import read_xmp

SMALL = CAMERA.scaled(640, 480)
FRAMES, SEED = 4, 7


@pytest.fixture(scope="module")
def site() -> Site:
    return Site.seeded(SEED)


@pytest.fixture(scope="module")
def shader(site: Site) -> Shader:
    return Shader.of(site)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("example") / "flight"
    example.write_example(folder, FRAMES, SEED, 1, SMALL)
    return folder


def digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def true_poses(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    with (folder / "truth" / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {
        row["frame_id"]: (
            rotation_from_quaternion(np.array([float(row[k]) for k in ("qw", "qx", "qy", "qz")])),
            np.array([float(row[k]) for k in ("east_m", "north_m", "up_m")]),
        )
        for row in rows
    }


# --- geometry


def test_slopes_are_the_derivatives_of_the_height(site: Site) -> None:
    x, y = np.random.default_rng(0).uniform(-150.0, 150.0, (2, 500))
    _, slope_x, slope_y = site.terrain.surface(x, y)
    step = 1e-4
    np.testing.assert_allclose(
        slope_x, (site.terrain.height(x + step, y) - site.terrain.height(x - step, y)) / (2 * step), atol=1e-8
    )
    np.testing.assert_allclose(
        slope_y, (site.terrain.height(x, y + step) - site.terrain.height(x, y - step)) / (2 * step), atol=1e-8
    )
    assert 0.02 < np.max(np.hypot(slope_x, slope_y)) < 0.15
    assert 2.0 < np.ptp(site.terrain.height(x, y)) < 8.0


def test_rays_meet_the_ground_where_marching_does(site: Site) -> None:
    rng = np.random.default_rng(1)
    n = 200
    origins = np.column_stack([rng.uniform(-50.0, 50.0, (n, 2)), rng.uniform(25.0, 35.0, n)])
    falls = np.radians(rng.uniform(8.0, 80.0, n))
    bearing = rng.uniform(-np.pi, np.pi, n)
    directions = np.column_stack([np.cos(falls) * np.sin(bearing), np.cos(falls) * np.cos(bearing), -np.sin(falls)])
    t = site.terrain.cast(origins, directions)
    p = origins + t[:, None] * directions
    np.testing.assert_allclose(p[:, 2], site.terrain.height(p[:, 0], p[:, 1]), atol=1e-8)
    share = np.linspace(0.0, 0.999, 2000)
    for i in range(n):
        before = origins[i] + (share * t[i])[:, None] * directions[i]
        assert np.all(before[:, 2] > site.terrain.height(before[:, 0], before[:, 1])), "an earlier crossing was missed"


def test_steep_ground_falls_back_to_bisection() -> None:
    terrain = Terrain((Hill(0.0, 0.0, 20.0, 4.0),))
    origins = np.array([-60.0, 0.1, 30.0])
    directions = np.column_stack([np.ones(100), np.zeros(100), -np.linspace(0.2, 1.2, 100)])
    t = terrain.cast(origins, directions)
    p = origins + t[:, None] * directions
    np.testing.assert_allclose(p[:, 2], terrain.height(p[:, 0], p[:, 1]), atol=1e-7)


def test_rays_that_do_not_fall_end_in_the_sky(site: Site) -> None:
    hits = site.cast(np.array([0.0, 0.0, 60.0]), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.3], [1.0, 0.0, -0.001]]))
    assert np.all(np.isinf(hits.distance))
    assert set(hits.thing) == {SKY}


@settings(max_examples=25, deadline=None)
@given(st.floats(0.0, 6.3), st.floats(1.0, 8.0), st.floats(1.0, 8.0), st.floats(-1.5, 1.5), st.integers(0, 2**32 - 1))
def test_a_box_is_met_where_rays_enter_it(
    heading: float, half_length: float, half_width: float, lift: float, seed: int
) -> None:
    box = Building(3.0, -2.0, half_length, half_width, heading, -1.0, 5.0)
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(-np.pi, np.pi, 40)
    origins = box.centre_in_enu_m + 30.0 * np.column_stack([np.sin(bearing), np.cos(bearing), np.full(40, lift)])
    aims = box.centre_in_enu_m + rng.uniform(-1.3, 1.3, (40, 3)) * box.half_m @ box.axes
    t, face = box.cast(origins, aims - origins)
    steps = np.linspace(0.0, 2.0, 4001)
    for i in range(40):
        along = np.abs(box.local(origins[i] + steps[:, None] * (aims[i] - origins[i])))
        inside = np.flatnonzero(np.all(along < box.half_m - 1e-9, axis=1))
        if len(inside):
            assert steps[inside[0]] - 6e-4 <= t[i] <= steps[inside[0]], (t[i], steps[inside[0]])
        if np.isfinite(t[i]):
            local = box.local(origins[i] + t[i] * (aims[i] - origins[i]))
            axis, sign = face[i] // 2, 1.0 if face[i] % 2 == 0 else -1.0
            assert local[axis] * sign == pytest.approx(box.half_m[axis], abs=1e-9) or origins[i, 2] < box.floor_m
            assert np.all(np.abs(local) < box.half_m + 1e-9)


@settings(max_examples=25, deadline=None)
@given(st.floats(0.15, 0.6), st.floats(-1.0, 2.0), st.integers(0, 2**32 - 1))
def test_a_pole_is_met_where_rays_enter_it(radius: float, lift: float, seed: int) -> None:
    pole = Pole(1.0, 2.0, radius, -1.0, 7.0)
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(-np.pi, np.pi, 40)
    origins = pole.centre_in_enu_m + 12.0 * np.column_stack([np.sin(bearing), np.cos(bearing), np.full(40, lift)])
    aims = pole.centre_in_enu_m + rng.uniform(-1.2, 1.2, (40, 3)) * (radius, radius, 4.0)
    t, face = pole.cast(origins, aims - origins)
    steps = np.linspace(0.0, 2.0, 20001)
    for i in range(40):
        p = origins[i] + steps[:, None] * (aims[i] - origins[i])
        inside = np.hypot(p[:, 0] - 1.0, p[:, 1] - 2.0) < radius - 1e-6
        inside &= (p[:, 2] > -1.0 + 1e-6) & (p[:, 2] < 7.0 - 1e-6)
        if origins[i, 2] > -1.0:
            assert not inside.any() or abs(t[i] - steps[np.argmax(inside)]) < 2e-4
        if np.isfinite(t[i]):
            hit = origins[i] + t[i] * (aims[i] - origins[i])
            expected = (
                hit[2] == pytest.approx(7.0)
                if face[i] == TOP
                else np.hypot(*(hit[:2] - (1, 2))) == pytest.approx(radius)
            )
            assert expected


def test_the_site_is_what_the_issue_asks_for(site: Site) -> None:
    buildings = [solid for solid in site.solids if isinstance(solid, Building)]
    poles = [solid for solid in site.solids if isinstance(solid, Pole)]
    assert 12 <= len(buildings) <= 18
    assert 8 <= len(poles) <= 12
    for solid in buildings:
        ground = float(site.terrain.height(solid.east_m, solid.north_m))
        assert 3.0 < solid.roof_m - ground < 13.0
        corners = solid.corners()
        assert np.all(solid.floor_m < site.terrain.height(corners[:, 0], corners[:, 1]))
    assert site.sees(np.array([0.0, 0.0, 60.0]), site.control_in_enu_m).sum() >= 4


def test_sees_knows_what_stands_between(site: Site) -> None:
    house = next(solid for solid in site.solids if isinstance(solid, Building))
    behind = house.centre_in_enu_m[:2] + house.axes[0, :2] * (house.half_length_m + 1.0)
    before = house.centre_in_enu_m[:2] - house.axes[0, :2] * (house.half_length_m + 1.0)
    points = np.array([[*xy, site.terrain.height(*xy)] for xy in (behind, before)])
    eye = house.centre_in_enu_m - house.axes[0] * 60.0 + (0.0, 0.0, 12.0)
    assert site.sees(eye, points).tolist() == [False, True]


# --- pictures


@pytest.mark.parametrize("frame", [0, 3])
def test_rendered_depth_is_the_ray_cast_at_every_pixel(site: Site, shader: Shader, frame: int) -> None:
    camera = CAMERA.scaled(240, 180)
    renderer = Renderer(camera, camera_rays(camera), shader)
    poses = fly(site.terrain, FRAMES, SEED)
    rotation, centre = poses.rotation_enu_from_cam[frame], poses.centre_in_enu_m[frame]
    picture, depth = renderer.render(rotation, centre)
    u, v = np.meshgrid(np.arange(240.0), np.arange(180.0))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(depth.ravel(), scene_depth(site, camera, rotation, centre, pixels), rtol=1e-12)
    directions = camera.rays(pixels) @ rotation.T
    hits = site.cast(centre, directions)
    assert {SKY, GROUND} < set(hits.thing.tolist())
    roofs = np.flatnonzero((hits.face == TOP) & (hits.thing >= 0))
    assert len(roofs) > 500
    tops = np.array([s.roof_m if isinstance(s, Building) else s.top_m for s in site.solids])[hits.thing[roofs]]
    # A roof is a level plane: the oracle needs no slabs.
    np.testing.assert_allclose(depth.ravel()[roofs], (tops - centre[2]) / directions[roofs, 2], rtol=1e-12)
    assert 20.0 < picture.std() < 80.0


def test_a_known_point_lands_on_its_pixel(site: Site, shader: Shader) -> None:
    poses = fly(site.terrain, 24, SEED)
    seen = observe(site, CAMERA, poses)
    assert {o.point for o in seen} == set(range(len(site.control_in_enu_m)))
    assert len(seen) >= 3 * len(site.control_in_enu_m)
    for o in seen:
        rotation, centre = poses.rotation_enu_from_cam[o.frame], poses.centre_in_enu_m[o.frame]
        mark = site.control_in_enu_m[o.point]
        depth = scene_depth(site, CAMERA, rotation, centre, np.array([[o.u, o.v]]))
        assert depth[0] == pytest.approx(float(rotation[:, 2] @ (mark - centre)), abs=1e-6)
        # The painted quarters meet at the point: white north-east and south-west, black on the other diagonal.
        corners = mark + 0.15 * np.array([[1, 1, 0], [-1, -1, 0], [1, -1, 0], [-1, 1, 0]], np.float64)
        hits = site.cast(centre, corners - centre)
        grey = shader.colours(centre, corners - centre, hits, 1e-5).mean(axis=1)
        assert min(grey[:2]) > 1.8 * max(grey[2:])


def test_detail_fades_with_range_instead_of_aliasing(site: Site, shader: Shader) -> None:
    """Neighbouring pixels stay alike at any range; detail is there at any range too."""
    middle = np.array([0.0, 0.0])
    for above in (15.0, 100.0):
        camera = Camera("pinhole", 160, 120, 1120.0, 1120.0, 79.5, 59.5)
        picture, _ = Renderer(camera, camera_rays(camera), shader).render(
            enu_from_cam(0.0, np.radians(-90.0), 0.0), np.array([*middle, above])
        )
        grey = picture.mean(axis=2)
        change = np.abs(np.diff(grey, axis=1)).mean()
        assert 1.0 < change < 0.5 * grey.std() + 6.0, above


# --- flight and log


def test_the_flight_has_two_legs(site: Site) -> None:
    poses = fly(site.terrain, 24, SEED)
    leg = np.array(poses.leg)
    assert (np.sum(leg == FORWARD), np.sum(leg == SIDEWAYS)) == (14, 10)
    axis = poses.rotation_enu_from_cam[:, :, 2]
    for name, along in ((FORWARD, 1.0), (SIDEWAYS, 0.0)):
        steps = np.diff(poses.centre_in_enu_m[leg == name], axis=0)
        level = axis[leg == name][1:, :2] / np.linalg.norm(axis[leg == name][1:, :2], axis=1)[:, None]
        assert np.linalg.norm(steps, axis=1).mean() == pytest.approx(5.0, abs=0.4)
        assert np.abs(
            np.sum(steps[:, :2] * level, axis=1) / np.linalg.norm(steps[:, :2], axis=1)
        ).mean() == pytest.approx(along, abs=0.1)
    assert np.degrees(gimbal_angles(poses.rotation_enu_from_cam)[:, 1]).mean() == pytest.approx(-20.0, abs=0.6)
    assert np.all(np.diff(poses.time_s) >= 2.0)


@pytest.mark.parametrize("frames", [4, 5, 9])
def test_short_flights_have_both_legs(site: Site, frames: int) -> None:
    leg = fly(site.terrain, frames, SEED).leg
    assert len(leg) == frames
    assert min(leg.count(FORWARD), leg.count(SIDEWAYS)) >= 2


def test_redraws_of_the_log_have_the_stated_sigmas(site: Site) -> None:
    truth = fly(site.terrain, 12, SEED)
    rng = np.random.default_rng(5)
    draws = [noisy_poses(truth, CONSUMER_DRONE, rng) for _ in range(400)]
    position = np.array([d.centre_in_enu_m - truth.centre_in_enu_m for d in draws])
    angle = np.degrees([d.angles_rad - truth.angles_rad for d in draws])
    own, common = position - position.mean(axis=1, keepdims=True), position.mean(axis=1)
    assert own.std() * np.sqrt(12 / 11) == pytest.approx(0.053, rel=0.03)
    assert np.diff(position, axis=1).std() == pytest.approx(0.075, rel=0.03)
    np.testing.assert_allclose(common.std(axis=0), 0.25, rtol=0.12)
    np.testing.assert_allclose(angle.std(axis=(0, 1)), (np.hypot(0.25, 0.25), 0.08, 0.08), rtol=0.08)
    assert np.diff(angle[..., 0], axis=1).std() == pytest.approx(0.25 * np.sqrt(2), rel=0.05)


def test_no_noise_is_the_truth(site: Site) -> None:
    truth = fly(site.terrain, 5, SEED)
    same = noisy_poses(truth, PoseNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), np.random.default_rng(0))
    np.testing.assert_array_equal(same.centre_in_enu_m, truth.centre_in_enu_m)
    np.testing.assert_array_equal(same.angles_rad, truth.angles_rad)


# --- what is written


def test_photos_carry_the_logged_pose(made: Path, site: Site) -> None:
    log = logged_poses(fly(site.terrain, FRAMES, SEED), CONSUMER_DRONE, SEED)
    for index in range(FRAMES):
        path = made / "photos" / f"DJI_{index + 1:04d}.JPG"
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
        assert exif.latitude_deg == pytest.approx(where.latitude_deg, abs=1e-9)
        assert exif.longitude_deg == pytest.approx(where.longitude_deg, abs=1e-9)
        assert exif.altitude_m == pytest.approx(height - UNDULATION_M, abs=1e-3)
        assert exif.horizontal_error_m == pytest.approx(0.26)
        assert (exif.make, exif.model) == ("DJI", "EPISIM")
        assert exposure_time(exif, xmp) == (log.exposure(index), "exif+offset")
        values = dewarp_data(xmp.dji["DewarpData"])
        assert values is not None
        fx, fy, dx, dy, *lens = values
        found = (fx, fy, (SMALL.width - 1) / 2 + dx, (SMALL.height - 1) / 2 + dy)
        np.testing.assert_allclose(found, (SMALL.fx, SMALL.fy, SMALL.cx, SMALL.cy), atol=1e-6)
        np.testing.assert_allclose(lens, SMALL.distortion, atol=1e-9)


def test_depth_maps_are_the_truth_to_a_part_in_five_thousand(made: Path, site: Site) -> None:
    rng = np.random.default_rng(3)
    pixels = np.column_stack([rng.integers(0, SMALL.width, 3000), rng.integers(0, SMALL.height, 3000)])
    for name, (rotation, centre) in true_poses(made).items():
        with np.load(made / "truth" / "depth" / f"{name}.npz") as stored:
            depth = stored["depth_m"]
        assert (depth.dtype, depth.shape) == (np.float32, (SMALL.height, SMALL.width))
        exact = scene_depth(site, SMALL, rotation, centre, pixels.astype(np.float64))
        found = depth[pixels[:, 1], pixels[:, 0]]
        np.testing.assert_array_equal(np.isinf(found), np.isinf(exact))
        # A pose read back from twelve digits may see another surface on an outline.
        off = np.abs(found[np.isfinite(exact)] / exact[np.isfinite(exact)] - 1.0)
        assert np.mean(off < 1.3e-4) > 0.999
        assert np.median(off) > 1e-5


@pytest.mark.parametrize("frame", [1, 3])
def test_matches_fit_the_true_poses(made: Path, frame: int) -> None:
    """SIFT on neighbours of either leg: the pictures hold the geometry to a part of a pixel."""
    poses = true_poses(made)
    names = [f"DJI_{frame:04d}", f"DJI_{frame + 1:04d}"]
    sift = cv2.SIFT_create(3000)
    points, features = [], []
    for name in names:
        grey = cv2.imread(str(made / "photos" / f"{name}.JPG"), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        keypoints, descriptors = sift.detectAndCompute(grey, None)  # type: ignore[call-overload]
        points.append(np.array([keypoint.pt for keypoint in keypoints]))
        features.append(descriptors)
    pairs = cv2.BFMatcher().knnMatch(features[0], features[1], 2)
    good = [(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < 0.75 * b.distance]
    assert len(good) > 300
    ref, src = (SMALL.rays(points[side][[pair[side] for pair in good]]) for side in (0, 1))
    (ref_rotation, ref_centre), (src_rotation, src_centre) = (poses[name] for name in names)
    essential = skew(src_rotation.T @ (ref_centre - src_centre)) @ src_rotation.T @ ref_rotation
    lines = ref @ essential.T
    residual = np.abs(np.sum(src * lines, axis=1)) / np.hypot(lines[:, 0], lines[:, 1]) * SMALL.focal_px
    assert np.median(residual) < 0.3
    assert np.mean(residual < 2.0) > 0.9


def test_tiles_lie_on_the_surfaces(made: Path, site: Site) -> None:
    clouds = [laspy.read(path) for path in sorted((made / "lidar").glob("*.laz"))]
    assert len(clouds) == 2
    east, west = clouds
    assert west.x.max() <= east.x.min()
    for cloud in clouds:
        assert (str(cloud.header.version), cloud.header.point_format.id) == ("1.4", 6)
        assert cloud.header.parse_crs() == CRS("EPSG:32617+5703")
        assert abs(np.asarray(cloud.scan_angle) * 0.006).max() == pytest.approx(20.0, abs=1.5)
    xyz = np.concatenate([np.asarray(cloud.xyz) for cloud in clouds])
    classes = np.concatenate([np.asarray(cloud.classification) for cloud in clouds])
    assert set(np.unique(classes)) == {2, 6, 7, 64}
    # PROJ alone takes the tiles back to the local frame: not the code that made them.
    f = site.frame
    back = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=utm +zone=17 +ellps=WGS84 +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={f.longitude_deg} +lat_0={f.latitude_deg} +h_0={f.height_m}"
    )
    p = np.column_stack(back.transform(xyz[:, 0], xyz[:, 1], xyz[:, 2] + UNDULATION_M))
    ground = p[classes == 2]
    above = ground[:, 2] - site.terrain.height(ground[:, 0], ground[:, 1])
    assert abs(above.mean()) < 1e-3
    assert above.std() == pytest.approx(0.02, rel=0.05)
    box = (np.abs(p[:, 0] - 60.0) < 20.0) & (np.abs(p[:, 1] - 60.0) < 20.0)
    assert 7.0 < box.sum() / 1600.0 < 9.0
    houses = p[classes == 6]
    faces = np.array([np.min(np.abs(np.abs(b.local(houses)) - b.half_m), axis=1) for b in site.solids[:16]])
    inside = np.array([np.all(np.abs(b.local(houses)) < b.half_m + 0.15, axis=1) for b in site.solids[:16]])
    off = np.min(np.where(inside, np.abs(faces), np.inf), axis=0)
    assert np.quantile(off, 0.99) < 0.06
    roofs = np.array([np.abs(b.local(houses)[:, 2] - b.half_m[2]) < 0.1 for b in site.solids[:16]]) & inside
    assert 200 < np.sum(~roofs.any(axis=0)) < 0.3 * len(houses), "walls have returns too, but not most"


def test_control_points_agree_with_the_true_poses(made: Path) -> None:
    header, *lines = (made / "gcp_list.txt").read_text().splitlines()
    assert header == "EPSG:32617"
    assert lines
    facts = json.loads((made / "truth" / "site.json").read_text())
    frame = LocalFrame(**{k: v for k, v in facts["frame_enu"].items() if k != "height_datum"})
    to_degrees = Transformer.from_crs("EPSG:32617", "EPSG:4326", always_xy=True, allow_ballpark=False)
    poses = true_poses(made)
    for line in lines:
        x, y, z, u, v, image, name = line.split()
        longitude, latitude = to_degrees.transform(float(x), float(y))
        p = frame.enu_from_geodetic(latitude, longitude, float(z) + facts["undulation_m"])
        rotation, centre = poses[Path(image).stem]
        np.testing.assert_allclose(SMALL.project((p - centre) @ rotation), (float(u), float(v)), atol=5e-3)
        assert name.startswith("gcp")


def test_the_workflow_names_what_is_there(made: Path) -> None:
    workflow = tomllib.loads((made / "workflow.toml").read_text())
    assert list(workflow) == ["ingest", "pair", "match", "refine", "depth", "fuse", "score", "report"]
    assert len(list((made / workflow["ingest"]["photos"]).glob("*.JPG"))) == FRAMES
    assert len(list(made.glob(workflow["score"]["lidar"]))) == 2
    assert workflow["ingest"]["geoid"] == UNDULATION_M


def test_bytes_do_not_depend_on_the_processes(tmp_path: Path) -> None:
    tiny = CAMERA.scaled(160, 120)
    for jobs in (1, 2):
        example.write_example(tmp_path / str(jobs), FRAMES, SEED, jobs, tiny)
    first, second = digests(tmp_path / "1"), digests(tmp_path / "2")
    assert first == second
    # Photos, bare photos but one, depth maps; tiles; lists and truth; camera; five workflows; six files of logs.
    own = 3 * FRAMES - 1 + 2 + 4 + 1 + 5 + 6
    # The lawn's photos and depth maps, tiles, truth and workflow.
    assert len(first) == own + 2 * FEW_FRAMES + 2 + 2 + 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", "2"], "nothing temporary is left"


def test_another_seed_is_another_site() -> None:
    assert Site.seeded(8).solids != Site.seeded(7).solids


# --- refusals


@pytest.mark.parametrize(("frames", "seed", "jobs"), [(3, 7, 1), (10_000, 7, 1), (4, -1, 1), (4, 7, 0)])
def test_numbers_out_of_range_are_refused(tmp_path: Path, frames: int, seed: int, jobs: int) -> None:
    with pytest.raises(UsageError):
        example.write_example(tmp_path / "flight", frames, seed, jobs)
    assert not list(tmp_path.iterdir())


def test_a_folder_with_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match="not empty") as caught:
        example.write_example(tmp_path, FRAMES)
    assert caught.value.exit_code == 2
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_the_current_folder_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match="folder you are in"):
        example.write_example(Path(), FRAMES)


def test_a_place_that_cannot_be_written_is_a_resource_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ResourceError) as caught:
        example.write_example(tmp_path / "file" / "flight", FRAMES)
    assert caught.value.exit_code == 6


def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(example, "save_photo", full)
    with pytest.raises(ResourceError, match="disk is full"):
        example.write_example(tmp_path / "flight", FRAMES, SEED, 1, CAMERA.scaled(80, 60))
    assert not list(tmp_path.iterdir())
