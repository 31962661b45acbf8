"""Calibration files: ROS camera_info YAML, and OpenCV's FileStorage YAML."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import yaml

from pipeline.engine.errors import InputError
from pipeline.geometry.cameras import Camera
from pipeline.sources.files import opened
from pipeline.sources.intrinsics import SourcedCamera, checked

_MAX_BYTES = 1 << 20
_SIZE = (("image_width", "width", "image_Width"), ("image_height", "height", "image_Height"))
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "k")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D", "d")
# ROS: sensor_msgs/CameraInfo; OpenCV's calibration sample says fisheye by a flag.
_MODELS = {
    "plumb_bob": "brown",
    "rational_polynomial": "brown",
    "brown": "brown",
    "radtan": "brown",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
    "kannala_brandt": "fisheye",
    "none": "pinhole",
    "": "",
}
_COUNTS = {"brown": (0, 4, 5, 8), "fisheye": (0, 4), "pinhole": (0,)}


class _Loader(yaml.SafeLoader):
    """YAML without constructors that run code, that takes OpenCV's matrices as plain mappings."""


def _opencv_matrix(loader: _Loader, node: yaml.Node) -> object:
    return loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else None


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)


def read_calibration(location: str) -> SourcedCamera:
    """Reads a calibration file.

    Args:
        location: Path or URL.

    Returns:
        The camera, source text included.

    Raises:
        InputError: Not YAML, a value missing, or a lens model that is not known.
        ResourceError: It may not be read.
    """
    with opened(location) as stream:
        data = stream.read(_MAX_BYTES + 1)
    if len(data) > _MAX_BYTES:
        raise _wrong(location, f"more than {_MAX_BYTES} bytes", "a calibration file")
    return SourcedCamera(parse_calibration(data, location), f"calibration file {location.rpartition('/')[2]}")


def parse_calibration(data: bytes, where: str = "") -> Camera:
    """The camera of a calibration file's bytes.

    Args:
        data: YAML of ROS's camera_calibration or OpenCV's FileStorage.
        where: The file's name, for messages.

    Raises:
        InputError: As `read_calibration`.

    Source: ROS REP 104; OpenCV documentation, FileStorage and the camera calibration tutorial.
    """
    try:
        text = data.decode("utf-8-sig")
        # OpenCV writes "%YAML:1.0", which is not YAML 1.x's directive.
        if text.lstrip().startswith("%YAML:"):
            text = text.lstrip().partition("\n")[2]
        content = yaml.load(text, _Loader)  # noqa: S506 - a SafeLoader
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise _wrong(where, str(error).splitlines()[0], "YAML") from error
    if not isinstance(content, Mapping):
        raise _wrong(where, type(content).__name__, "a mapping with image_width, camera_matrix, ...")
    matrix = _numbers(_value(content, _MATRIX, where), where)
    width, height = (_integer(_value(content, names, where), where) for names in _SIZE)
    distortion = _numbers(_value(content, _DISTORTION, where, default=()), where)
    return camera_of_values(_stated_model(content), width, height, matrix, distortion, where)


def camera_of_values(
    stated: str, width: int, height: int, matrix: Sequence[float], distortion: Sequence[float], where: str = ""
) -> Camera:
    """The camera of a calibration's numbers, whatever they were written in.

    Args:
        stated: Lens model by ROS's name, any case; empty for the one that the coefficients fit.
        width: Image width, px.
        height: Image height, px.
        matrix: K row by row.
        distortion: Coefficients in OpenCV's order.
        where: For messages.

    Raises:
        InputError: The model is not known, the coefficients are not of it, or no lens can be like it.

    Source: sensor_msgs/CameraInfo; foxglove.CameraCalibration for kannala_brandt.
    """
    if len(matrix) != 9:
        raise _wrong(where, f"a camera matrix of {len(matrix)} numbers", "9, row by row")
    model = _model(stated.strip().lower(), distortion, where)
    camera = Camera(model, width, height, matrix[0], matrix[4], matrix[2], matrix[5], _trimmed(model, distortion))
    return checked(camera, where)


def _stated_model(content: Mapping[str, object]) -> str:
    stated = str(content.get("distortion_model", content.get("camera_model", "")) or "").strip().lower()
    stated = "" if stated in {"pinhole", "perspective"} else stated
    return "fisheye" if not stated and content.get("fisheye_model") == 1 else stated


def _model(stated: str, distortion: Sequence[float], where: str) -> str:
    if stated not in _MODELS:
        raise _wrong(where, f"distortion_model {stated}", ", ".join(name for name in _MODELS if name))
    model = _MODELS[stated] or "brown"
    # OpenCV pads its vector with zeros (12 for thin prism, 14 for tilt); zeros beyond the model are no claim.
    count = len(distortion)
    beyond = distortion[_COUNTS[model][-1] :]
    if any(beyond) or (count not in _COUNTS[model] and count <= _COUNTS[model][-1]):
        raise _wrong(where, f"{count} distortion coefficients", f"{' or '.join(map(str, _COUNTS[model]))} for {model}")
    return "pinhole" if not any(distortion) and model == "brown" else model


def _trimmed(model: str, distortion: Sequence[float]) -> tuple[float, ...]:
    return tuple(distortion[: _COUNTS[model][-1]])


def _value(content: Mapping[str, object], names: Sequence[str], where: str, default: object = None) -> object:
    for name in names:
        if content.get(name) is not None:
            return content[name]
    if default is not None:
        return default
    raise _wrong(where, f"no {names[0]}", f"{names[0]} (found keys: {', '.join(map(str, list(content)[:12]))})")


def _numbers(value: object, where: str) -> tuple[float, ...]:
    if isinstance(value, Mapping):
        value = value.get("data")
    if isinstance(value, Sequence) and not isinstance(value, str):
        flat = [
            item for row in value for item in (row if isinstance(row, Sequence) and not isinstance(row, str) else [row])
        ]
        try:
            numbers = tuple(float(item) for item in flat)
        except (TypeError, ValueError, OverflowError) as error:
            raise _wrong(where, str(error), "numbers") from error
        if all(math.isfinite(number) for number in numbers):
            return numbers
    raise _wrong(where, repr(value)[:80], "a list of finite numbers")


def _integer(value: object, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value != int(value):
        raise _wrong(where, repr(value)[:80], "an image size in whole pixels")
    return int(value)


def _wrong(where: str, found: str, expected: str) -> InputError:
    return InputError(
        "E-CAMERA-01", "the calibration file cannot be read", where=where, found=found, expected=expected,
        hint="use a ROS camera_info YAML, or cv::FileStorage with camera_matrix and distortion_coefficients",
    )  # fmt: skip
