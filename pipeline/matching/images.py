"""Decoding photos for matching and colours."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import fsspec
import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Bytes, Floats


def read_grey(path: Path | str) -> Bytes:
    """A photo's luminance.

    Args:
        path: File or URL.

    Returns:
        (height, width).

    Raises:
        InputError: It cannot be read or decoded.
    """
    return _decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)


def read_colour(path: Path | str) -> Bytes:
    """A photo's colours.

    Returns:
        (height, width, 3) red, green, blue.

    Raises:
        InputError: It cannot be read or decoded.
    """
    return np.ascontiguousarray(_decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)[:, :, ::-1])


def _decode(path: Path | str, flags: int) -> Bytes:
    # Orientation tags are ignored: the camera model is that of the pixels as stored.
    buffer = io.BytesIO()
    try:
        with fsspec.open(str(path), "rb") as stream:
            buffer.write(stream.read())
        image = cv2.imdecode(np.frombuffer(buffer.getbuffer(), np.uint8), flags) if buffer.tell() else None
    except (OSError, cv2.error) as error:
        raise InputError(
            "E-IMAGE-01",
            "cannot read the image",
            where=str(path),
            found=str(error),
            hint="run ingest again: was it moved?",
        ) from error
    if image is None:
        raise InputError("E-IMAGE-02", "cannot decode the image", where=str(path), hint="is it a whole JPEG?")
    return np.asarray(image, np.uint8)


def shrunk_size(width: int, height: int, longest_px: int) -> tuple[int, int]:
    """The size an image is matched at: as it is, or its longer side brought to `longest_px`."""
    scale = min(1.0, longest_px / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def resized(image: Bytes, size: tuple[int, int]) -> Bytes:
    """An image brought to a size, each pixel the mean of those it covers; the image itself where it has that size.

    Args:
        image: (height, width) or (height, width, 3).
        size: Width and height.
    """
    if size == (image.shape[1], image.shape[0]):
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def to_full_pixels(pixels: Floats, shrunk: tuple[int, int], full: tuple[int, int]) -> Floats:
    """Pixels of a shrunk image in those of the full one (pixel centres, so half a pixel right).

    Args:
        pixels: (n, 2).
        shrunk: Width and height of the image the pixels belong to.
        full: Width and height of the image as given.

    Returns:
        (n, 2).
    """
    out: Floats = (pixels + 0.5) * (np.array(full) / np.array(shrunk)) - 0.5
    return out
