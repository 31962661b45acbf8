"""Depth images as truth: found by name or time, read in their units, and a reference that is exact on planes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.engine.errors import InputError, NothingLeftError
from pipeline.geometry.cameras import Camera
from pipeline.lidar.visibility import View
from pipeline.scoring.depth_images import DepthImages
from pipeline.scoring.truth import FrameView
from pipeline.sources.depth_images import find_depth_images, read_depth_image

CAMERA = Camera("brown", 160, 120, 150.0, 150.0, 79.5, 59.5, (-0.05, 0.01, 0.0, 0.0, 0.0))


def written(path: Path, depth_m: np.ndarray, units: float = 1000.0) -> Path:
    cv2.imwrite(str(path), np.rint(depth_m * units).astype(np.uint16))
    return path


def plane(camera: Camera) -> np.ndarray:
    """Depths of the plane 0.2 x - 0.1 y + z = 2 m at every pixel."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(np.stack([u, v], axis=-1).reshape(-1, 2).astype(float))
    return (2.0 / (rays @ np.array([0.2, -0.1, 1.0]))).reshape(camera.height, camera.width)


def frame(name: str = "a") -> FrameView:
    return FrameView(name, View(CAMERA, np.zeros(3), np.eye(3)), np.eye(6))


@pytest.mark.parametrize("units", [1000.0, 5000.0])
def test_values_are_read_in_their_units_and_nothing_is_nothing(tmp_path: Path, units: float) -> None:
    stored = np.full((6, 8), 2.5)
    path = written(tmp_path / "d.png", stored, units)
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    raw[0, 0], raw[1, 1] = 0, 65535
    cv2.imwrite(str(path), raw)
    found = read_depth_image(str(path), units)
    assert np.isnan(found[[0, 1], [0, 1]]).all()
    assert np.nanmax(np.abs(found - 2.5)) < 1e-12
    assert np.isfinite(found).sum() == 46


def test_an_8_bit_picture_is_for_looking_at(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "d.png"), np.zeros((6, 8), np.uint8))
    with pytest.raises(InputError, match="E-DEPTH-11"):
        read_depth_image(str(tmp_path / "d.png"), 1000.0)


def test_images_are_found_by_name_whatever_their_role(tmp_path: Path) -> None:
    for name in ("frame-000000.depth.png", "frame-000001.depth.png"):
        written(tmp_path / name, np.ones((4, 4)))
    found, gap = find_depth_images(str(tmp_path), {"frame-000000.color": None, "frame-000001.color": None, "x": 5.0})
    assert {frame: Path(path).name for frame, path in found.items()} == {
        "frame-000000.color": "frame-000000.depth.png", "frame-000001.color": "frame-000001.depth.png",
    }  # fmt: skip
    assert gap is None


def test_images_are_found_by_time_no_further_off_than_a_sensor_is(tmp_path: Path) -> None:
    for name in ("1305031102.160407.png", "1305031102.194330.png"):
        written(tmp_path / name, np.ones((4, 4)))
    found, gap = find_depth_images(
        str(tmp_path), {"rgb1": 1305031102.175304, "rgb2": 1305031102.25, "rgb3": None, "rgb4": 1305031102.19}
    )
    assert {frame: Path(path).name for frame, path in found.items()} == {
        "rgb1": "1305031102.160407.png", "rgb4": "1305031102.194330.png",
    }  # fmt: skip
    assert gap == pytest.approx(0.014897, abs=1e-5)


def test_a_truth_from_another_flight_is_told_with_both_names(tmp_path: Path) -> None:
    written(tmp_path / "other_0001.png", np.ones((4, 4)))
    with pytest.raises(NothingLeftError, match="E-DEPTH-12") as caught:
        find_depth_images(str(tmp_path), {"DJI_0001": 1.0})
    assert "other_0001.png" in str(caught.value)
    assert "DJI_0001" in str(caught.value)


@pytest.mark.parametrize("size", [(160, 120), (320, 240)])
def test_the_reference_is_exact_on_a_slanted_plane(tmp_path: Path, size: tuple[int, int]) -> None:
    depth = plane(CAMERA.scaled(*size))
    path = written(tmp_path / "a.png", depth, 20_000.0)
    seen = DepthImages({"a": str(path)}, 20_000.0, 50.0).seen_by(frame())
    pixels = np.random.default_rng(0).uniform((10, 10), (149, 109), (300, 2))
    found = seen.reference_at(pixels)
    truth = 2.0 / (CAMERA.rays(pixels) @ np.array([0.2, -0.1, 1.0]))
    assert found.valid.all()
    # Values are stored to 0.05 mm; the window is centred on a pixel, not on the place asked for.
    assert np.max(np.abs(found.depth_m - truth)) < 2e-4
    assert np.all(seen.pose_sigma(pixels, found) == 0.0)
    at = seen.reference_at(seen.pixels)
    assert at.depth_m[at.valid] == pytest.approx(seen.depth_m[at.valid], abs=2e-4)


def test_edges_holes_and_what_is_too_far_have_none(tmp_path: Path) -> None:
    depth = np.full((120, 160), 2.0)
    depth[:, 80:] = 3.0
    depth[40:50, 20:30] = 0.0
    depth[100:, :] = 6.0
    path = written(tmp_path / "a.png", depth)
    seen = DepthImages({"a": str(path)}, 1000.0, 5.0).seen_by(frame())
    pixels = np.array([[40.0, 20.0], [80.0, 20.0], [25.0, 45.0], [40.0, 110.0], [0.0, 0.0], [np.nan, 3.0]])
    assert seen.reference_at(pixels).valid.tolist() == [True, False, False, False, False, False]


def test_a_frame_without_an_image_sees_nothing_and_one_of_another_shape_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.png", np.ones((100, 160)))
    truth = DepthImages({"a": str(path)}, 1000.0, 5.0)
    nothing = truth.seen_by(frame("b"))
    assert not len(nothing.depth_m)
    assert not nothing.reference_at(np.array([[5.0, 5.0]])).valid.any()
    with pytest.raises(InputError, match="E-DEPTH-13"):
        truth.seen_by(frame())
