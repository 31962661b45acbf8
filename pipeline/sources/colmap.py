"""COLMAP models: a folder with cameras and images, binary or text.

The files are read here and not by pycolmap: on a model cut short it reads on without end, and it wants the 3D points,
which nobody needs here and which are most of a model.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import rotation_from_quaternion
from pipeline.sources.files import opened
from pipeline.sources.intrinsics import checked
from pipeline.sources.records import FlightLog, LocalPoses, LoggedCamera, TimeBase
from pipeline.sources.streams import unit

# COLMAP's numbers and names of its models.
_NAMES = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE",
)  # fmt: skip
# Our model, focal lengths, and distortion coefficients of those that have an equal here.
_MODELS = {
    "SIMPLE_PINHOLE": ("pinhole", 1, 0),
    "PINHOLE": ("pinhole", 2, 0),
    "SIMPLE_RADIAL": ("brown", 1, 1),
    "RADIAL": ("brown", 1, 2),
    "OPENCV": ("brown", 2, 4),
    "FULL_OPENCV": ("brown", 2, 8),
    "OPENCV_FISHEYE": ("fisheye", 2, 4),
}
# COLMAP's pixel (0, 0) is the corner of the top-left pixel, here it is its centre.
HALF_PIXEL = 0.5
_NO_EQUAL = "E-COLMAP-02"
_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT2D_BYTES = 24
_LONGEST_NAME = 4096
_LONGEST_LINE = 1 << 16
_NOT_UNIT = 0.01
_MOST_BAD_SHARE = 0.05


def is_format(head: bytes, name: str) -> bool:
    """Whether a folder holds cameras and images of COLMAP."""
    return not head and all(_file(name, part) is not None for part in ("cameras", "images"))


def read(location: str) -> FlightLog:
    """Reads a COLMAP model.

    Args:
        location: The folder.

    Returns:
        A pose per image and the cameras, their principal points with OpenCV's pixel centre; `facts["camera_of_image"]`
        says which camera took which image.

    Raises:
        InputError: A file is missing or damaged, a camera model has no equal here, or an image comes twice.
        ResourceError: It may not be read.

    Source: COLMAP documentation, "Output Format" and "Camera Models" (src/colmap/sensor/models.h).
    """
    losses: list[str] = []
    cameras = _cameras(location, losses)
    images = _images(location, losses)
    unknown = [name for name, camera in zip(images.name, images.camera, strict=True) if camera not in cameras]
    if unknown:
        losses.append(f"{len(unknown)} images ({', '.join(unknown[:3])}) name a camera that the model does not hold")
    return FlightLog(
        location=location,
        kind="COLMAP model",
        counts={"images": len(images.name), "cameras": len(cameras)},
        time_base=TimeBase("boot", problem="no times in a COLMAP model"),
        poses=(_poses(location, images),),
        cameras=tuple(LoggedCamera(str(number), "", camera) for number, camera in cameras.items()),
        losses=tuple(losses),
        facts={"camera_of_image": {n: str(c) for n, c in zip(images.name, images.camera, strict=True) if c in cameras}},
    )


@dataclass(slots=True)
class _Images:
    """Rows of an images file: quaternion and translation cam_from_world."""

    pose: list[tuple[float, ...]] = field(default_factory=list)
    camera: list[int] = field(default_factory=list)
    name: list[str] = field(default_factory=list)

    def add(self, pose: tuple[float, ...], camera: int, name: str) -> None:
        """Takes an image.

        Raises:
            ValueError: It has no pose or no name.
        """
        if not all(map(math.isfinite, pose)) or abs(math.hypot(*pose[:4]) - 1.0) > _NOT_UNIT:
            raise ValueError("no unit quaternion and position")
        if not name:
            raise ValueError("no name")
        self.pose.append(pose)
        self.camera.append(camera)
        self.name.append(name)


def _poses(location: str, images: _Images) -> LocalPoses:
    order = sorted(range(len(images.name)), key=images.name.__getitem__)
    pose = np.array(images.pose, np.float64)[order]
    q_cam_from_world = unit(pose[:, :4])
    cam_from_world = rotation_from_quaternion(q_cam_from_world)
    centre: Floats = -np.einsum("nji,nj->ni", cam_from_world, pose[:, 4:])
    zeros = np.zeros(len(order), np.int64)
    return LocalPoses(
        stream=Path(location).name, time_ns=zeros, position_m=centre, q_wxyz=q_cam_from_world * (1.0, -1.0, -1.0, -1.0),
        parent="world", child="camera", of="camera", axes="rdf", image=tuple(images.name[n] for n in order),
        segment=zeros,
    )  # fmt: skip


def _file(folder: str, part: str) -> str | None:
    """The file of a part; the binary one where there are both, as COLMAP has it."""
    found = (Path(folder) / f"{part}{suffix}" for suffix in (".bin", ".txt"))
    return next((str(path) for path in found if path.is_file()), None)


def _located(folder: str, part: str) -> str:
    location = _file(folder, part)
    if location is None:
        raise _wrong(folder, f"no {part}.bin or {part}.txt", "a folder with both cameras and images")
    return location


def _cameras(folder: str, losses: list[str]) -> dict[int, Camera]:
    location = _located(folder, "cameras")
    cameras: dict[int, Camera] = {}
    with opened(location) as stream:
        rows = _camera_records(stream, location) if location.endswith(".bin") else _camera_lines(stream, location)
        try:
            for number, name, width, height, parameters in rows:
                cameras[number] = _camera(name, width, height, parameters, f"{location}: camera {number}")
        except InputError as error:
            if error.code == _NO_EQUAL:
                raise
            # Poses are worth having without their cameras: a calibration file may stand in.
            losses.append(f"{Path(location).name} is damaged behind {len(cameras)} cameras: {error.found}")
    return cameras


def _camera(name: str, width: int, height: int, parameters: tuple[float, ...], where: str) -> Camera:
    if name not in _MODELS:
        raise InputError(
            _NO_EQUAL, "a camera model that has no equal here", where=where, found=name,
            expected=", ".join(_MODELS), hint="undistort the images (colmap image_undistorter) and take that model",
        )  # fmt: skip
    model, focals, coefficients = _MODELS[name]
    if len(parameters) != focals + 2 + coefficients:
        raise _wrong(where, f"{len(parameters)} parameters", f"{focals + 2 + coefficients} for {name}")
    fx, fy = parameters[0], parameters[focals - 1]
    cx, cy = (value - HALF_PIXEL for value in parameters[focals : focals + 2])
    return checked(Camera(model, width, height, fx, fy, cx, cy, parameters[focals + 2 :]), where)


_CameraRow = tuple[int, str, int, int, tuple[float, ...]]


def _camera_records(stream: BinaryIO, location: str) -> Iterator[_CameraRow]:
    for _ in range(_count(stream, location)):
        number, model, width, height = _unpacked(stream, _CAMERA, location)
        name = _NAMES[model] if 0 <= model < len(_NAMES) else f"number {model}"
        kept = _MODELS.get(name)
        # Of other models not even the size is known; the error comes before the next record is read.
        parameters = _unpacked(stream, struct.Struct(f"<{kept[1] + 2 + kept[2]}d"), location) if kept else ()
        yield number, name, width, height, parameters


def _camera_lines(stream: BinaryIO, location: str) -> Iterator[_CameraRow]:
    for number, line in _lines(stream):
        parts = line.split()
        if not parts:
            continue
        try:
            values = tuple(float(part) for part in parts[4:])
            yield int(parts[0]), parts[1], int(parts[2]), int(parts[3]), values
        except (ValueError, IndexError) as error:
            where = f"{location}:{number}"
            raise _wrong(where, f"{line[:80]!r}: {error}", "CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from error


def _images(folder: str, losses: list[str]) -> _Images:
    location = _located(folder, "images")
    with opened(location) as stream:
        read_rows = _image_records if location.endswith(".bin") else _image_lines
        images = read_rows(stream, location, losses)
    if not images.name:
        raise _wrong(location, "no images", "at least one image with a pose")
    twice = [name for name, rows in Counter(images.name).items() if rows > 1]
    if twice:
        raise _wrong(location, f"image {twice[0]} several times", "each image once")
    return images


def _image_records(stream: BinaryIO, location: str, losses: list[str]) -> _Images:
    images = _Images()
    size = stream.seek(0, 2)
    stream.seek(0)
    promised = _count(stream, location)
    while len(images.name) < promised:
        try:
            _, *pose, camera = _unpacked(stream, _IMAGE, location)
            images.add(tuple(pose), camera, _name(stream))
            (points,) = _unpacked(stream, _COUNT, location)
            stream.seek(min(stream.tell() + points * _POINT2D_BYTES, size))
        except (ValueError, InputError):
            # Records have no marks to find the next one by.
            if lost := promised - len(images.name):
                losses.append(f"{Path(location).name} is damaged or cut short: {lost} of {promised} images lost")
            return images
    if stream.tell() < size:
        losses.append(f"{size - stream.tell()} bytes behind the last image of {Path(location).name} were left out")
    return images


def _image_lines(stream: BinaryIO, location: str, losses: list[str]) -> _Images:
    images, bad = _Images(), []
    after_image = False
    for number, line in _lines(stream):
        if _points(line):
            after_image = False
            continue
        parts = line.split(maxsplit=9)
        try:
            images.add(tuple(float(part) for part in parts[1:8]), int(parts[8]), parts[9].strip())
            after_image = True
        except (ValueError, IndexError):
            # Behind an image it is a line of points, which nobody needs.
            bad += [] if after_image else [number]
            after_image = False
    # The last line of a file that was cut is one, however short the file.
    if len(bad) > max(1.0, _MOST_BAD_SHARE * (len(images.name) + len(bad))):
        where, expected = f"{location}:{bad[0]}", "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and a line of points"
        raise _wrong(where, f"{len(bad)} lines are no images", expected)
    if bad:
        lines = ", ".join(map(str, bad[:10]))
        losses.append(f"{len(bad)} lines of {Path(location).name} are no images and were left out: {lines}")
    return images


def _points(line: str) -> bool:
    """Whether a line is one of 2D points, as follows each image: empty, or numbers by threes."""
    parts = line.split()
    try:
        return len(parts) % 3 == 0 and all(math.isfinite(float(part)) for part in parts)
    except ValueError:
        return False


def _lines(stream: BinaryIO) -> Iterator[tuple[int, str]]:
    """Lines but for comments, with their numbers; of long lines (points by the thousand) the beginning."""
    number, within = 0, False
    while line := stream.readline(_LONGEST_LINE):
        begins, within = not within, not line.endswith(b"\n")
        if begins:
            number += 1
            if not line.startswith(b"#"):
                yield number, line.decode("utf-8", "replace").strip("\r\n\0\ufeff")


def _count(stream: BinaryIO, location: str) -> int:
    (count,) = _unpacked(stream, _COUNT, location)
    return int(count)


def _unpacked(stream: BinaryIO, layout: struct.Struct, location: str) -> tuple[Any, ...]:
    data = stream.read(layout.size)
    if len(data) < layout.size:
        raise _wrong(location, "the file ends early", "all the records that its head promises")
    return layout.unpack(data)


def _name(stream: BinaryIO) -> str:
    """A name, which ends in a zero byte."""
    name = bytearray()
    while len(name) < _LONGEST_NAME:
        byte = stream.read(1)
        if byte == b"\0":
            return name.decode()
        if not byte:
            break
        name += byte
    raise ValueError("a name without an end")


def _wrong(where: str, found: str, expected: str) -> InputError:
    return InputError(
        "E-COLMAP-01", "the COLMAP model cannot be read", where=where, found=found, expected=expected,
        hint="colmap model_converter writes it anew",
    )  # fmt: skip
