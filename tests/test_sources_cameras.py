"""Intrinsics: calibration files, DewarpData, calibrated focal length, EXIF, and their order."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from photo_files import GIMBAL, exif_block, write_photo

from pipeline.engine.errors import InputError
from pipeline.geometry.cameras import Camera
from pipeline.sources.calibration import parse_calibration, read_calibration
from pipeline.sources.intrinsics import SourcedCamera, dewarp_data
from pipeline.sources.photos import PhotoRecord, read_photo
from pipeline.sources.sensors import focal_from_35mm

ROS = """
image_width: 400
image_height: 300
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [310.5, 0, 201.25, 0, 311.5, 148.75, 0, 0, 1]}
distortion_model: MODEL
distortion_coefficients: {rows: 1, cols: N, data: DATA}
"""
OPENCV = """%YAML:1.0
---
calibration_time: "Sat 01 Jun 2024"
image_width: 400
image_height: 300
Camera_Matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 3.105e+02, 0., 2.0125e+02, 0., 3.115e+02, 1.4875e+02, 0., 0., 1. ]
Distortion_Coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.1, 0.02, 0.001, -0.002, 0.003 ]
"""
DEWARP = "2018-09-04;3678.87,3671.84,10.10,27.29,-0.268652,0.114663,0.0000152688,-0.0000460707,-0.0350261"


def ros(model: str, data: str) -> bytes:
    return ROS.replace("MODEL", model).replace("DATA", data).replace("N", "5", 1).encode()


def photo(
    folder: Path,
    tags: dict[str, str],
    size: tuple[int, int] = (800, 600),
    given_camera: SourcedCamera | None = None,
    **exif: object,
) -> PhotoRecord:
    path = write_photo(folder / "DJI_0001.JPG", xmp={**GIMBAL, **tags}, exif=exif_block(**exif), size=size)  # type: ignore[arg-type]
    return read_photo(str(path), given_camera)


@pytest.mark.parametrize(
    ("data", "model", "distortion"),
    [
        (ros("plumb_bob", "[-0.1, 0.02, 0.001, -0.002, 0.003]"), "brown", (-0.1, 0.02, 0.001, -0.002, 0.003)),
        (
            ros("rational_polynomial", "[0.1, 0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6]"),
            "brown",
            (0.1, 0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6),
        ),
        (ros("equidistant", "[0.1, 0.2, 0.3, 0.4]"), "fisheye", (0.1, 0.2, 0.3, 0.4)),
        (ros("plumb_bob", "[0, 0, 0, 0, 0]"), "pinhole", ()),
        # OpenCV pads with zeros for the thin prism and tilt it did not estimate.
        (ros("rational_polynomial", f"{[0.1] * 8 + [0.0] * 6}"), "brown", (0.1,) * 8),
        (OPENCV.encode(), "brown", (-0.1, 0.02, 0.001, -0.002, 0.003)),
    ],
)
def test_calibration_files(data: bytes, model: str, distortion: tuple[float, ...]) -> None:
    camera = parse_calibration(data, "camera.yaml")
    assert camera == Camera(model, 400, 300, 310.5, 311.5, 201.25, 148.75, distortion)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xfe\x00",
        b"- a list",
        b"image_width: 400\nimage_height: 300\n",
        ros("plumb_bob", "[0.1, 0.2]"),
        ros("plumb_bob", "[.nan, 0, 0, 0, 0]"),
        ros("omnidirectional", "[0, 0, 0, 0]"),
        ros("rational_polynomial", f"{[0.1] * 8 + [0.5] * 4}"),
        ROS.replace("310.5", "0").replace("MODEL", "plumb_bob").replace("DATA", "[0,0,0,0,0]").encode(),
        b"!!python/object/apply:os.system ['true']",
    ],
)
def test_bad_calibration_files(data: bytes) -> None:
    with pytest.raises(InputError, match="E-CAMERA-0"):
        parse_calibration(data, "camera.yaml")


@given(st.one_of(st.binary(max_size=200), st.text(max_size=200).map(str.encode)))
def test_calibration_of_any_bytes(data: bytes) -> None:
    with pytest.raises(InputError):
        parse_calibration(data)


def test_a_missing_calibration_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.yaml"):
        read_calibration(str(tmp_path / "nowhere.yaml"))


def test_dewarp_data_is_relative_to_the_centre(tmp_path: Path) -> None:
    record = photo(tmp_path, {"DewarpData": DEWARP}, size=(5472, 3648), x920A=None, xA405=None)
    assert record.camera is not None
    camera = record.camera.camera
    assert (camera.fx, camera.fy) == (3678.87, 3671.84)
    assert camera.cx == pytest.approx(5471 / 2 + 10.10)
    assert camera.cy == pytest.approx(3647 / 2 + 27.29)
    assert camera.distortion == (-0.268652, 0.114663, 0.0000152688, -0.0000460707, -0.0350261)
    assert record.camera.source == "DewarpData"


def test_dewarped_pictures_have_no_lens(tmp_path: Path) -> None:
    record = photo(tmp_path, {"DewarpData": DEWARP, "DewarpFlag": "1"}, size=(5472, 3648), x920A=None, xA405=None)
    assert record.camera is not None
    assert record.camera.camera.distortion == ()
    assert record.camera.camera.model == "pinhole"
    assert record.camera.camera.fx == 3678.87


def test_a_resampled_photo_has_its_intrinsics_resampled(tmp_path: Path) -> None:
    """The tags of an original of 4000 x 3000 px in a file of 800 x 600 px: the file wins."""
    tags = {"CalibratedFocalLength": "2300", "CalibratedOpticalCenterX": "2010", "CalibratedOpticalCenterY": "1490"}
    record = photo(tmp_path, tags, xA405=20)
    assert record.camera is not None
    camera = record.camera.camera
    assert (camera.width, camera.height) == (800, 600)
    assert camera.fx == pytest.approx(460.0, rel=0.01)
    assert camera.cx == pytest.approx(401.5, abs=1.0)
    dewarped = photo(tmp_path, {"DewarpData": DEWARP}, size=(684, 456), xA405=24, xA002=5472, xA003=3648)
    assert dewarped.camera is not None
    assert dewarped.camera.camera.fx == pytest.approx(3678.87 / 8)
    assert dewarped.camera.camera.cx == pytest.approx((5471 / 2 + 10.10 + 0.5) / 8 - 0.5)


@pytest.mark.parametrize(
    ("tags", "with_file", "source", "focal"),
    [
        ({"DewarpData": DEWARP.replace("3678.87", "610").replace("3671.84", "610")}, True, "calibration file", 621.0),
        ({"DewarpData": DEWARP.replace("3678.87", "610"), "CalibratedFocalLength": "600"}, False, "DewarpData", 610.0),
        ({"DewarpData": "rubbish", "CalibratedFocalLength": "600"}, False, "CalibratedFocalLength", 600.0),
        # Millimetres by mistake: not believed.
        ({"CalibratedFocalLength": "8.8"}, False, "sensor width table", 8.8 / 13.2 * 800),
        ({}, False, "sensor width table", 8.8 / 13.2 * 800),
    ],
)
def test_order_of_sources(tmp_path: Path, tags: dict[str, str], with_file: bool, source: str, focal: float) -> None:
    file = tmp_path / "camera.yaml"
    file.write_bytes(ros("plumb_bob", "[0, 0, 0, 0, 0]"))
    record = photo(tmp_path, tags, given_camera=read_calibration(str(file)) if with_file else None)
    assert record.camera is not None
    assert source in record.camera.source
    assert record.camera.camera.fx == pytest.approx(focal)


def test_a_calibration_of_another_shape_is_refused(tmp_path: Path) -> None:
    camera = SourcedCamera(Camera("pinhole", 1600, 900, 1000.0, 1000.0, 800.0, 450.0), "calibration file x.yaml")
    assert "another shape" in photo(tmp_path, {}, given_camera=camera).problem


def test_unknown_model_takes_the_35_mm_equivalent_by_the_diagonal(tmp_path: Path) -> None:
    record = photo(tmp_path, {}, model="NEW1", xA405=24)
    assert record.camera is not None
    assert record.camera.camera.fx == pytest.approx(24 / 43.2666 * 1000, rel=1e-5)
    # A 16:9 still is a full-width crop: the same focal length, in the same pixels.
    assert focal_from_35mm(24.0, 800, 450) == focal_from_35mm(24.0, 800, 600)


def test_no_focal_length_is_a_reason(tmp_path: Path) -> None:
    assert "ingest.camera" in photo(tmp_path, {}, model="NEW1", xA405=None, x920A=None).problem


def test_digital_zoom_lengthens(tmp_path: Path) -> None:
    record = photo(tmp_path, {}, xA404=2.0)
    assert record.camera is not None
    assert record.camera.camera.fx == pytest.approx(2 * 8.8 / 13.2 * 800)


@given(st.text(max_size=80))
def test_dewarp_data_of_any_text(text: str) -> None:
    found = dewarp_data(text)
    assert found is None or (len(found) == 9 and found[0] > 0)
