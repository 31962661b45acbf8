"""Camera models against OpenCV, their exact inverse, and the fold of strong distortion."""

from __future__ import annotations

import warnings

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pixel_noise import matrices, slanted

from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera

WIDTH, HEIGHT = 4000, 3000
DISTORTIONS = {
    "pinhole": ("pinhole", ()),
    "mild": ("brown", (-0.03, 0.01, 0.0004, -0.0003, 0.0)),
    "strong": ("brown", (-0.28, 0.12, 0.001, -0.0008, -0.03)),
    "rational": ("brown", (0.3, -0.12, 0.0005, -0.0004, 0.02, 0.55, -0.1, 0.03)),
    "fisheye": ("fisheye", (-0.02, 0.01, -0.004, 0.001)),
    "equidistant": ("fisheye", (0.0, 0.0, 0.0, 0.0)),
}


def camera(model: str, distortion: tuple[float, ...], focal: float = 2800.0) -> Camera:
    return Camera(model, WIDTH, HEIGHT, focal, focal * 1.002, 1985.3, 1512.7, distortion)


@pytest.fixture(params=DISTORTIONS)
def any_camera(request: pytest.FixtureRequest) -> Camera:
    return camera(*DISTORTIONS[request.param])


def points_in_front(n: int = 200, reach: float = 0.7) -> Floats:
    rng = np.random.default_rng(7)
    xy = rng.uniform(-reach, reach, (n, 2))
    return np.column_stack([xy, np.ones(n)]) * rng.uniform(2.0, 90.0, (n, 1))


def opencv_pixels(of: Camera, points: Floats) -> Floats:
    coefficients = np.array(of.distortion or (0.0,) * 4)
    project = cv2.fisheye.projectPoints if of.model == "fisheye" else cv2.projectPoints
    zero = np.zeros(3)
    found = project(points[:, None, :], zero, zero, of.matrix, coefficients)[0]
    return np.asarray(found, np.float64).reshape(-1, 2)


def test_project_is_opencv_s(any_camera: Camera) -> None:
    points = points_in_front()
    np.testing.assert_allclose(any_camera.project(points), opencv_pixels(any_camera, points), atol=1e-8)


def test_rays_are_opencv_s_undistorted_points(any_camera: Camera) -> None:
    pixels = np.random.default_rng(3).uniform((0.0, 0.0), (WIDTH - 1.0, HEIGHT - 1.0), (200, 2))
    k, d = any_camera.matrix, np.array(any_camera.distortion or (0.0,) * 4)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    if any_camera.model == "fisheye":
        expected = cv2.fisheye.undistortPoints(pixels[:, None, :], k, d, criteria=criteria)
    else:
        # OpenCV 4 takes the criteria in a function of another name.
        undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
        expected = undistort(pixels[:, None, :], k, d, R=np.eye(3), P=np.eye(3), criteria=criteria)
    rays = any_camera.rays(pixels)
    np.testing.assert_array_equal(rays[:, 2], 1.0)
    np.testing.assert_allclose(rays[:, :2], np.asarray(expected).reshape(-1, 2), atol=1e-8)


def test_rays_and_project_are_inverse_over_the_whole_image(any_camera: Camera) -> None:
    u, v = np.meshgrid(np.linspace(-0.5, WIDTH - 0.5, 41), np.linspace(-0.5, HEIGHT - 0.5, 31))
    pixels = np.stack([u, v], axis=-1)
    rays = any_camera.rays(pixels)
    assert rays.shape == (31, 41, 3)
    np.testing.assert_allclose(any_camera.project(rays), pixels, atol=1e-6)


def test_the_principal_point_is_the_axis(any_camera: Camera) -> None:
    np.testing.assert_allclose(any_camera.project(np.array([0.0, 0.0, 5.0])), (any_camera.cx, any_camera.cy))
    np.testing.assert_allclose(any_camera.rays(np.array([any_camera.cx, any_camera.cy])), (0.0, 0.0, 1.0), atol=1e-15)


@given(
    k=st.tuples(st.floats(-0.45, 0.3), st.floats(-0.1, 0.2), st.floats(-0.05, 0.05)),
    p=st.tuples(st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3)),
    angle=st.floats(-np.pi, np.pi),
    share=st.floats(0.0, 0.97),
)
def test_round_trip_up_to_the_fold_of_strong_distortion(
    k: tuple[float, float, float], p: tuple[float, float], angle: float, share: float
) -> None:
    of = camera("brown", (*k[:2], *p, k[2]))
    r = np.linspace(1e-3, 1.2, 4000)
    slope = 1.0 + 3.0 * k[0] * r**2 + 5.0 * k[1] * r**4 + 7.0 * k[2] * r**6
    limit = float(r[np.argmax(slope <= 0.02)] if np.any(slope <= 0.02) else r[-1])
    radius = share * limit
    ray = np.array([radius * np.cos(angle), radius * np.sin(angle), 1.0])
    np.testing.assert_allclose(of.rays(of.project(ray)), ray, atol=1e-8)


@given(
    k=st.tuples(st.floats(-0.1, 0.12), st.floats(-0.02, 0.02), st.floats(-0.004, 0.004)),
    angle=st.floats(-np.pi, np.pi),
    theta=st.floats(0.0, np.radians(85.0)),
)
def test_fisheye_round_trip_up_to_85_degrees(k: tuple[float, float, float], angle: float, theta: float) -> None:
    t = np.linspace(0.0, np.radians(89.0), 500) ** 2
    assume(np.all(1.0 + 3.0 * k[0] * t + 5.0 * k[1] * t**2 + 7.0 * k[2] * t**3 > 0.05))
    of = camera("fisheye", (*k, 0.0), focal=900.0)
    ray = np.array([np.tan(theta) * np.cos(angle), np.tan(theta) * np.sin(angle), 1.0])
    found = of.rays(of.project(ray))
    assert np.arccos(min(1.0, found @ ray / np.linalg.norm(found) / np.linalg.norm(ray))) < 1e-7


# The largest distorted radius is r (1 + k1 r^2) at r = (-3 k1)^-1/2: 0.6086 for k1 = -0.4. A k2 raises a second branch.
@pytest.mark.parametrize(
    ("distortion", "largest"), [((-0.4,), 0.60858), ((-0.5, 0.1), 0.6), ((-0.4, 0, 0, 0, 0, 0.0, 0, 0), 0.60858)]
)
def test_pixels_beyond_the_fold_have_no_ray(distortion: tuple[float, ...], largest: float) -> None:
    of = camera("brown", distortion)
    angle = np.linspace(0.0, 2.0 * np.pi, 37)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    centre = np.array([of.cx, of.cy])
    for radius in (1.001 * largest, 0.62, 0.7, 0.85, 1.0, 1.3, 3.0):
        assert np.isnan(of.rays(centre + radius * circle * (of.fx, of.fy))[:, :2]).all(), radius
    assert np.isfinite(of.rays(centre + 0.995 * largest * circle * (of.fx, of.fy))).all()


@pytest.mark.parametrize("distortion", [(-0.4,), (-0.5, 0.1), (-0.35, 0.05)])
def test_points_beyond_the_fold_are_not_folded_back_into_the_image(distortion: tuple[float, ...]) -> None:
    of = camera("brown", distortion)
    slopes = np.linspace(0.0, 6.0, 2001)
    pixels = of.project(np.column_stack([slopes, 0.0 * slopes, np.ones_like(slopes)]))
    known = np.isfinite(pixels[:, 0])
    assert known[0]
    assert not known[-1]
    first_lost = int(np.argmin(known))
    assert not known[first_lost:].any()
    assert np.all(np.diff(pixels[:first_lost, 0]) > 0.0)


def test_a_fisheye_that_stops_growing_has_no_ray_beyond() -> None:
    of = camera("fisheye", (-0.2, 0.0, 0.0, 0.0), focal=900.0)
    fold = np.sqrt(1.0 / 0.6)
    theta = np.array([0.98, 1.02]) * fold
    pixels = of.project(np.column_stack([np.sin(theta), [0.0, 0.0], np.cos(theta)]))
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1]).all()
    largest = fold * (1.0 - 0.2 * fold**2)
    assert np.isnan(of.rays(np.array([of.cx + 1.01 * largest * of.fx, of.cy]))[:2]).all()


def test_equidistant_pixels_are_angles() -> None:
    of = camera("fisheye", (), focal=900.0)
    theta = np.radians(60.0)
    assert of.project(np.array([np.sin(theta), 0.0, np.cos(theta)]))[0] == pytest.approx(of.cx + of.fx * theta)
    assert of.rays(np.array([of.cx + of.fx * theta, of.cy]))[0] == pytest.approx(np.tan(theta))
    assert np.isnan(of.rays(np.array([of.cx + of.fx * np.radians(91.0), of.cy]))[0])


def test_points_behind_and_nan_have_no_pixel_and_stay_in_their_row(any_camera: Camera) -> None:
    points = np.array([[0.1, 0.1, 1.0], [0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [np.nan, 0.0, 1.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pixels = any_camera.project(points)
        rays = any_camera.rays(pixels)
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1:3]).all()
    assert np.isnan(pixels[3, 0])
    np.testing.assert_allclose(rays[0], points[0], atol=1e-9)
    assert np.isnan(rays[1:, 0]).all()


def test_no_pixels_are_no_rays(any_camera: Camera) -> None:
    assert any_camera.rays(np.zeros((0, 2))).shape == (0, 3)
    assert any_camera.project(np.zeros((0, 3))).shape == (0, 2)


def test_pixel_jacobian_is_the_derivative(any_camera: Camera) -> None:
    rays, h = points_in_front(50), 1e-6
    rays = rays / rays[:, 2:]
    found = any_camera.pixel_jacobian(rays)
    for axis in (0, 1):
        step = np.zeros(3)
        step[axis] = h
        slope = (any_camera.project(rays + step) - any_camera.project(rays - step)) / (2.0 * h)
        np.testing.assert_allclose(found[:, :, axis], slope, rtol=1e-6, atol=1e-4)


def test_pixel_jacobian_on_the_axis(any_camera: Camera) -> None:
    found = any_camera.pixel_jacobian(np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(found, np.diag([any_camera.fx, any_camera.fy]), rtol=1e-12)


def test_plane_covariance_is_that_of_undistorted_pixels(any_camera: Camera) -> None:
    """Finite differences of the undistortion, with a covariance of another shape and slant at every pixel."""
    rays, h = points_in_front(60), 1e-3
    rays = rays / rays[:, 2:]
    pixels, covariance = any_camera.project(rays), slanted(len(rays))
    slope = np.stack(
        [(any_camera.rays(pixels + h * e) - any_camera.rays(pixels - h * e))[:, :2] / (2.0 * h) for e in np.eye(2)],
        axis=2,
    )
    expected = slope @ matrices(covariance) @ slope.transpose(0, 2, 1)
    found = any_camera.plane_covariance(rays, covariance)
    assert found.shape == (3, len(rays))
    scale = np.sqrt(expected[:, [0, 0, 1], [0, 0, 1]] * expected[:, [0, 1, 1], [0, 1, 1]])
    np.testing.assert_allclose(found.T / scale, expected[:, [0, 0, 1], [0, 1, 1]] / scale, atol=1e-5)
    assert any_camera.plane_covariance(rays[:0], covariance[:0]).shape == (3, 0)


@pytest.mark.parametrize("size", [(2000, 1500), (1000, 900), (8000, 6000)])
def test_scaled_is_the_resampled_image(any_camera: Camera, size: tuple[int, int]) -> None:
    points, small = points_in_front(50), any_camera.scaled(*size)
    # A resampled image keeps its edges: the corner (-0.5, -0.5) stays, so pixel centres move by half a pixel's change.
    expected = (any_camera.project(points) + 0.5) * (size[0] / WIDTH, size[1] / HEIGHT) - 0.5
    np.testing.assert_allclose(small.project(points), expected, atol=1e-9)
    assert (small.width, small.height) == size


def test_scaled_agrees_with_opencv_s_area_resampling() -> None:
    full = Camera("pinhole", 64, 48, 50.0, 50.0, 31.5, 23.5)
    image = np.zeros((48, 64), np.float32)
    image[20:24, 40:44] = 1.0
    half = cv2.resize(image, (16, 12), interpolation=cv2.INTER_AREA)
    row, column = np.argwhere(half > 0.9)[0]
    ray = full.rays(np.array([41.5, 21.5]))
    np.testing.assert_allclose(full.scaled(16, 12).project(ray), (column, row), atol=1e-12)


def test_focal_px_is_the_geometric_mean() -> None:
    assert Camera("pinhole", 10, 10, 4.0, 9.0, 0.0, 0.0).focal_px == pytest.approx(6.0)
