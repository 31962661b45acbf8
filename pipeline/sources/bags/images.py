"""Images in bag messages as image files: JPEG and PNG as they are, raw pixels as PNG."""

from __future__ import annotations

import base64
from typing import Any

import cv2
import numpy as np

from pipeline.geometry.arrays import AnyArray
from pipeline.sources.png import png

_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
# Bytes per channel, channels, and OpenCV's conversion to BGR. OpenCV names a Bayer pattern by the second and third
# pixel of its second row, ROS by the first two rows.
_RAW: dict[str, tuple[int, int, int | None]] = {
    "mono8": (1, 1, None),
    "8uc1": (1, 1, None),
    "mono16": (2, 1, None),
    "bgr8": (1, 3, None),
    "8uc3": (1, 3, None),
    "bgr16": (2, 3, None),
    "rgb8": (1, 3, cv2.COLOR_RGB2BGR),
    "rgb16": (2, 3, cv2.COLOR_RGB2BGR),
    "bgra8": (1, 4, cv2.COLOR_BGRA2BGR),
    "8uc4": (1, 4, cv2.COLOR_BGRA2BGR),
    "rgba8": (1, 4, cv2.COLOR_RGBA2BGR),
    "bayer_rggb8": (1, 1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": (1, 1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": (1, 1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": (1, 1, cv2.COLOR_BayerGB2BGR),
    "bayer_rggb16": (2, 1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr16": (2, 1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg16": (2, 1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg16": (2, 1, cv2.COLOR_BayerGB2BGR),
    "yuv422": (1, 2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (1, 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (1, 2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": (1, 2, cv2.COLOR_YUV2BGR_YUY2),
}


class UnknownEncodingError(ValueError):
    """An image encoding that nobody here knows.

    Args:
        found: What the message says.
        expected: What is known.
    """

    def __init__(self, found: str, expected: str) -> None:
        super().__init__(found)
        self.expected = expected


def image_file(message: Any) -> tuple[bytes, str]:
    """An image message as a file.

    Args:
        message: sensor_msgs Image or CompressedImage, Foxglove RawImage or CompressedImage.

    Returns:
        Content and suffix.

    Raises:
        UnknownEncodingError: The encoding is not known.
        AttributeError, TypeError, ValueError, OverflowError: It is damaged.

    Source: sensor_msgs/image_encodings; Foxglove schemas RawImage, CompressedImage; REP 118 for depth formats.
    """
    if hasattr(message, "encoding"):
        return png(pixels(message)), ".png"
    data = payload(message.data)
    if bytes(data[: len(_JPEG)]) == _JPEG:
        return bytes(data), ".jpg"
    if bytes(data[: len(_PNG)]) == _PNG:
        return bytes(data), ".png"
    form = str(message.format)
    if "depth" in form.lower() or not any(name in form.lower() for name in ("jpg", "jpeg", "png")):
        raise UnknownEncodingError(form, "jpeg or png")
    raise ValueError(f"{form} data that begin with {bytes(data[:8])!r}")


def pixels(message: Any) -> AnyArray:
    """The pixels of a raw image message.

    Args:
        message: With width, height, encoding, step, data, and is_bigendian where it has it.

    Returns:
        (height, width) or (height, width, 3) BGR, 8 or 16 bits.

    Raises:
        UnknownEncodingError: The encoding is not known.
        AttributeError, TypeError, ValueError, OverflowError: Sizes and data do not fit.
    """
    encoding = str(message.encoding).strip().lower()
    if encoding not in _RAW:
        raise UnknownEncodingError(str(message.encoding), ", ".join(_RAW))
    size, channels, conversion = _RAW[encoding]
    width, height = int(message.width), int(message.height)
    row = width * channels * size
    step = int(message.step) or row
    data = np.frombuffer(payload(message.data), np.uint8)
    if min(width, height) < 1 or step < row or len(data) < step * (height - 1) + row:
        raise ValueError(f"{len(data)} bytes for {height} rows of {step}")
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1), writeable=False)
    order = ">" if size == 2 and int(getattr(message, "is_bigendian", 0)) else "<"
    image = np.ascontiguousarray(rows).view(f"{order}u{size}").astype(f"u{size}", copy=False)
    image = image.reshape((height, width) if channels == 1 else (height, width, channels))
    try:
        return image if conversion is None else cv2.cvtColor(image, conversion)
    except cv2.error as error:
        raise ValueError(f"{encoding}: {error}") from error


def payload(data: Any) -> memoryview:
    """A message's bytes: as they are, or from the base 64 of JSON.

    Raises:
        ValueError, TypeError: Neither.
    """
    return memoryview(base64.b64decode(data, validate=True) if isinstance(data, str) else data).cast("B")
