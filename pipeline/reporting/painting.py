"""Pictures of values at pixels: dots in the colours of a scale, on a darkened photo."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from pipeline.geometry.arrays import AnyArray, Bytes, Floats
from pipeline.matching.images import resized, shrunk_size

WIDEST_PX = 640
_QUALITY = 78
_DARKEST_SHARE = 0.22
# Where there is no photo: a grey on which dark and light dots both stand out.
_PLAIN_GREY = 48
# Share of the picture that dots cover if they do not touch, and the radii they are kept within.
_COVER = 0.5
_SMALLEST_PX, _LARGEST_PX = 1, 4


def _ramp(stops: tuple[tuple[int, int, int], ...]) -> Bytes:
    places = np.linspace(0.0, 255.0, len(stops))
    channels = [np.interp(np.arange(256), places, [stop[c] for stop in stops]) for c in range(3)]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


# Depth: near is light and far is dark on a scale whose lightness tells as much as its hue (viridis, turned round and
# without its darkest part, which a darkened photo would swallow).
DEPTH = _ramp(
    (
        (253, 231, 37),
        (181, 222, 43),
        (110, 206, 88),
        (53, 183, 121),
        (31, 158, 137),
        (38, 130, 142),
        (49, 104, 142),
        (68, 79, 150),
    )
)
# Signed errors: blue is too near, red too far, white none.
SIGNED = _ramp(
    ((49, 116, 206), (120, 170, 226), (190, 213, 240), (250, 250, 250), (248, 196, 176), (230, 124, 98), (200, 46, 46))
)


def scale_stops(scale: Bytes) -> list[list[object]]:
    """A scale as plotly's `colorscale`.

    Args:
        scale: (256, 3) red, green, blue.

    Returns:
        Some 17 places from 0 to 1 with their colour.
    """
    places = np.linspace(0, 255, 18).round().astype(np.int64)
    return [[float(place) / 255.0, "rgb({},{},{})".format(*scale[place])] for place in places]


def coloured(values: Floats, low: float, high: float, scale: Bytes) -> Bytes:
    """The colours of values; what lies outside the range takes the colour of its end.

    Args:
        values: (n,), finite.
        low: Value of the scale's first colour.
        high: Value of its last one.
        scale: (256, 3).

    Returns:
        (n, 3) red, green, blue.
    """
    share = (values - low) / (high - low) if high > low else np.full(len(values), 0.5)
    return scale[np.clip(np.round(share * 255.0), 0, 255).astype(np.int64)]


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
    for across, down in _dot(_radius_px(height * width, len(np.unique(places, axis=0)))):
        at = places + np.array([across, down])
        inside = ((at >= 0) & (at < (width, height))).all(axis=1)
        out[at[inside, 1], at[inside, 0]] = colours[inside]
    return out


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
