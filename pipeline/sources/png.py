"""Pixels as PNG files: what is taken out of bags and videos must not lose anything."""

from __future__ import annotations

from pipeline.geometry.arrays import AnyArray

# Fast rather than small: the images are read once or twice and are no archive.
_EFFORT = 1


def png(image: AnyArray) -> bytes:
    """An image as a PNG file.

    Args:
        image: (height, width) or (height, width, 3) BGR, 8 or 16 bits.

    Raises:
        ValueError: No image that PNG can hold.
    """
    import cv2  # noqa: PLC0415 - heavy

    try:
        good, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _EFFORT])
    except cv2.error as error:
        raise ValueError(str(error)) from error
    if not good:
        raise ValueError("no image")
    return data.tobytes()
