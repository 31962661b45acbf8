"""Depth images as truth: 16-bit pictures of depth along the optical axis, as TUM RGB-D and 7-Scenes have them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePosixPath

import cv2
import numpy as np

from pipeline.engine.errors import InputError, NothingLeftError
from pipeline.geometry.arrays import Floats
from pipeline.sources.files import find, opened

SUFFIXES = (".png", ".tif", ".tiff")
# 7-Scenes writes this where nothing was measured; 0 is what everybody else writes.
_NOTHING = 65535
# Time stamps of the two cameras of an RGB-D sensor differ by less (TUM's own tools look this far).
_LARGEST_GAP_S = 0.02
_ROLES = ("depth", "color", "colour", "rgb")


def find_depth_images(location: str, times_s: Mapping[str, float | None]) -> tuple[dict[str, str], float | None]:
    """The depth image of each frame: by name, or by the time stamp that is its name.

    A name is what is left without folder, suffix and a role such as ".depth": frame-000012.depth.png belongs to
    frame-000012.color.png.

    Args:
        location: A folder, glob or file.
        times_s: Of every frame by frame_id, seconds since the epoch its log counts from; None where it has none.

    Returns:
        Path or URL by frame_id, of the frames that have one; and where they were found by time, the largest difference
        to the photo's, s.

    Raises:
        InputError: There is no such file.
        NothingLeftError: None belongs to a frame.
    """
    images = find(location, SUFFIXES)
    named = {_plain(PurePosixPath(image).stem): image for image in images}
    found = {frame: named[_plain(frame)] for frame in times_s if _plain(frame) in named}
    gap = None
    if not found:
        found, gap = _by_time(named, times_s)
    if not found:
        frame = next(iter(times_s), "none")
        raise NothingLeftError(
            "E-DEPTH-12", "no depth image belongs to a frame of the run", where=location,
            found=f"{len(images)} images, {PurePosixPath(images[0]).name if images else 'none'} first",
            expected=f"images with the frames' names ({frame}), or named by time stamps within {_LARGEST_GAP_S:g} s",
            hint="see that score.depth_images is of this flight",
        )  # fmt: skip
    return found, gap


def read_depth_image(location: str, units_per_metre: float) -> Floats:
    """A depth image.

    Args:
        location: Path or URL.
        units_per_metre: 1000 for millimetres (7-Scenes), 5000 for TUM RGB-D.

    Returns:
        (h, w) m along the optical axis; NaN where nothing was measured.

    Raises:
        InputError: No image of one channel with 16 bits or floating point.
    """
    with opened(location) as stream:
        data = stream.read()
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if picture is None or picture.ndim != 2 or picture.dtype not in (np.uint16, np.float32):
        said = "nothing that decodes" if picture is None else f"{picture.shape} of {picture.dtype}"
        raise InputError(
            "E-DEPTH-11", "not a depth image", where=location, found=said,
            expected="one channel of 16 bits, or of 32-bit floating point", hint="8-bit pictures are for looking at",
        )  # fmt: skip
    depth = np.asarray(picture, np.float64)
    whole = picture.dtype == np.uint16
    nothing = ~np.isfinite(depth) | (depth <= 0.0) | (whole & (depth == _NOTHING))
    return np.where(nothing, np.nan, depth / units_per_metre)


def _by_time(named: Mapping[str, str], times_s: Mapping[str, float | None]) -> tuple[dict[str, str], float | None]:
    stamps = sorted((stamp, image) for name, image in named.items() if (stamp := _number(name)) is not None)
    if not stamps:
        return {}, None
    seconds = np.array([stamp for stamp, _ in stamps])
    found: dict[str, str] = {}
    gaps = []
    for frame, time in times_s.items():
        if time is None:
            continue
        nearest = int(np.argmin(np.abs(seconds - time)))
        gap = abs(float(seconds[nearest]) - time)
        if gap <= _LARGEST_GAP_S:
            found[frame] = stamps[nearest][1]
            gaps.append(gap)
    return found, max(gaps, default=None)


def _plain(stem: str) -> str:
    head, _, role = stem.rpartition(".")
    return head if role.lower() in _ROLES and head else stem


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
