"""A picture of a frame as a figure: axes in pixels of the photo, and a colour bar below it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.geometry.arrays import Bytes
from pipeline.reporting.figure import Figure
from pipeline.reporting.painting import data_uri
from pipeline.reporting.scales import stops

# Width of the page, and the least of a panel on it, px: what a panel's height is reckoned from.
_PAGE_PX, _NARROWEST_PX, _WIDEST_PX = 1130, 280, 520
_MARGIN = {"l": 52, "r": 14, "t": 8, "b": 92}


def panel_width_px(panels: int) -> float:
    """About how wide a panel is on the page, by how many stand side by side."""
    return min(max(_PAGE_PX / panels, _NARROWEST_PX), _WIDEST_PX)


def colour_bar(title: str, low: float, high: float, scale: Bytes) -> dict[str, Any]:
    """A colour bar: a trace of one marker that is nowhere.

    Args:
        title: With unit.
        low: Value of the scale's first colour.
        high: Value of its last one.
        scale: (256, 3) red, green, blue.
    """
    bar = {
        "title": {"text": title, "side": "bottom"},
        "orientation": "h",
        "yref": "container",
        "y": 0.0,
        "yanchor": "bottom",
        "ypad": 2,
        "thickness": 9,
        "nticks": 6,
        "outlinewidth": 0,
    }
    ends = {"color": [low], "cmin": low, "cmax": high}
    return {**_nothing(), "marker": {**ends, "colorscale": stops(scale), "showscale": True, "colorbar": bar}}


def panel(
    key: str,
    title: str,
    caption: str,
    picture: Bytes,
    full: tuple[int, int],
    width_px: float,
    bar: Mapping[str, Any] | None = None,
) -> Figure:
    """A picture with its axes.

    Args:
        key: Of the figure.
        title: Of the figure.
        caption: Of the figure.
        picture: (height, width, 3) red, green, blue, of any size.
        full: Width and height of the photo as taken, px: what the axes count.
        width_px: About how wide it is on the page.
        bar: Of `colour_bar`.
    """
    width, height = full
    image = {
        "source": data_uri(picture),
        "xref": "x",
        "yref": "y",
        # Pixel (0, 0) is the centre of the top-left one, so the picture begins half a pixel before it.
        "x": -0.5,
        "y": -0.5,
        "sizex": width,
        "sizey": height,
        "sizing": "stretch",
        "layer": "below",
    }
    axis = {"zeroline": False, "showgrid": False, "constrain": "domain", "nticks": 5}
    across = {**axis, "title": {"text": "column u (px)", "standoff": 4}, "range": [-0.5, width - 0.5]}
    down = {**axis, "title": {"text": "row v (px)", "standoff": 4}, "range": [height - 0.5, -0.5], "scaleanchor": "x"}
    layout = {"images": [image], "xaxis": across, "yaxis": down, "margin": _MARGIN, "showlegend": False}
    inner = (width_px - _MARGIN["l"] - _MARGIN["r"]) * height / width
    # Without a trace plotly draws no axes.
    return Figure(key, title, caption, (bar or _nothing(),), layout, round(inner) + _MARGIN["t"] + _MARGIN["b"])


def _nothing() -> dict[str, Any]:
    return {"type": "scatter", "mode": "markers", "x": [None], "y": [None], "hoverinfo": "skip", "showlegend": False}
