"""Colour scales of the report: they stand on light and on dark ground, and tell colour-blind readers as much."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import Bytes, Floats

_STOPS = 18


def _ramp(*stops: tuple[int, int, int]) -> Bytes:
    places = np.linspace(0.0, 255.0, len(stops))
    channels = [np.interp(np.arange(256), places, [stop[c] for stop in stops]) for c in range(3)]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


RISING = _ramp(
    (98, 98, 200),
    (58, 110, 165),
    (38, 130, 142),
    (31, 158, 137),
    (53, 183, 121),
    (110, 206, 88),
    (181, 222, 43),
    (253, 231, 37),
)
"""Values from small to large: viridis, whose lightness tells as much as its hue, with a lighter beginning."""

DEPTH = RISING[::-1].copy()
"""Depths: near is light, far is dark."""

SIGNED = _ramp(
    (49, 116, 206),
    (120, 170, 226),
    (176, 198, 222),
    (208, 208, 208),
    (232, 182, 164),
    (230, 124, 98),
    (200, 46, 46),
)
"""Signed errors: blue below zero, red above it, and at zero a grey that neither a light nor a dark page swallows."""


def stops(scale: Bytes) -> list[list[object]]:
    """A scale as plotly's `colorscale`.

    Args:
        scale: (256, 3) red, green, blue.

    Returns:
        Places from 0 to 1 with their colour.
    """
    places = np.linspace(0, 255, _STOPS).round().astype(np.int64)
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
