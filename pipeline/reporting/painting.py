"""Pictures of values at pixels: coloured dots on a darkened photo."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from pipeline.geometry.arrays import AnyArray, Bytes, Floats
from pipeline.matching.images import resized, shrunk_size

WIDEST_PX = 640
_QUALITY = 78
_DARKEST_SHARE = 0.3
# Where there is no photo: a grey on which dark and light dots both stand out.
_PLAIN_GREY = 48
# Share of the picture that dots cover if they do not touch, and the radii they are kept within.
_COVER = 0.4
_SMALLEST_PX, _LARGEST_PX = 1, 3


def backdrop(photo: Bytes | None, full: tuple[int, int]) -> Bytes:
    """What values are painted on: the photo in dark grey, or plain grey where there is none.

    Args:
        photo: (height, width, 3) at the size of the picture, or None.
        full: Width and height of the photo as taken.

    Returns:
        (height, width, 3) at the size of the picture.
    """
    if photo is None:
        width, height = shrunk_size(*full, WIDEST_PX)
        return np.full((height, width, 3), _PLAIN_GREY, np.uint8)
    grey = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    return np.repeat((grey * _DARKEST_SHARE).astype(np.uint8)[:, :, None], 3, axis=2)


def small(photo: Bytes) -> Bytes:
    """A photo at the size of a picture."""
    height, width = photo.shape[:2]
    return resized(photo, shrunk_size(width, height, WIDEST_PX))


def painted(ground: Bytes, full: tuple[int, int], pixels: Floats, colours: Bytes) -> Bytes:
    """Dots on a picture, later ones over earlier ones; a dot's centre lies over every rim.

    Args:
        ground: (height, width, 3), the picture.
        full: Width and height of the photo that the pixels belong to.
        pixels: (n, 2) u, v of that photo; (0, 0) is the centre of its top-left pixel.
        colours: (n, 3).

    Returns:
        The picture with the dots.
    """
    out = ground.copy()
    height, width = ground.shape[:2]
    places = np.round((pixels + 0.5) * (np.array([width, height]) / np.array(full)) - 0.5).astype(np.int64)
    flat = out.reshape(-1, 3)
    for across, down in _dot(_radius_px(height * width, _distinct(places, width))):
        u, v = places[:, 0] + across, places[:, 1] + down
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        flat[v[inside] * width + u[inside]] = colours[inside]
    return out


def _distinct(places: AnyArray, width: int) -> int:
    """How many pixels of the picture some places are in."""
    flat = places[:, 1] * width + places[:, 0]
    return int(np.count_nonzero(np.bincount(flat - flat.min()))) if len(flat) else 0


def _radius_px(area: int, dots: int) -> int:
    radius = np.sqrt(_COVER * area / (np.pi * max(dots, 1)))
    return int(np.clip(np.floor(radius), _SMALLEST_PX, _LARGEST_PX))


def _dot(radius: int) -> AnyArray:
    """The (k, 2) pixels of a dot about its centre, from its rim inwards."""
    reach = np.arange(-radius, radius + 1)
    around = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    distance = np.hypot(*around.T)
    order = np.argsort(-distance, kind="stable")
    inside: AnyArray = around[order][distance[order] <= radius + 0.3]
    return inside


def data_uri(picture: Bytes) -> str:
    """A picture as WebP in a URI that a page can hold.

    Args:
        picture: (height, width, 3) red, green, blue.
    """
    _, encoded = cv2.imencode(".webp", picture[:, :, ::-1], [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    return "data:image/webp;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")
