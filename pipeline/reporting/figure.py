"""A figure of the report: plotly's traces and layout as plain data, without colours of the page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

# A legend above the axes, and room for two rows of it below the buttons.
LEGEND_ABOVE = {"orientation": "h", "x": 0.0, "y": 1.0, "yanchor": "bottom"}
MARGIN_OF_LEGEND = {"t": 76}


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of the report, drawn by the page.

    Args:
        key: Its anchor in the page, unique there.
        title: What it shows.
        caption: One or two sentences that say how to read it.
        traces: plotly traces of what JSON can hold.
        layout: plotly layout; axes have a title with a unit. The colours of background, letters and grid are the
            page's, light or dark.
        height_px: Height on the page.
    """

    key: str
    title: str
    caption: str
    traces: tuple[Mapping[str, Any], ...]
    layout: Mapping[str, Any]
    height_px: int = 420


@dataclass(frozen=True, slots=True)
class OverlayRow:
    """Pictures of one frame side by side.

    Args:
        frame_id: The frame.
        why: Why this one is shown.
        panels: The pictures, in order.
    """

    frame_id: str
    why: str
    panels: tuple[Figure, ...]


def axis_titles(figure: Figure) -> dict[str, str]:
    """The title of every axis of a figure by the axis's place in the layout; "" where one has none.

    Args:
        figure: The figure.

    Returns:
        "xaxis", "yaxis2", "scene.zaxis" ... and their titles. Axes that are not shown are left out.
    """
    found: dict[str, str] = {}
    for name, value in figure.layout.items():
        if name.startswith("scene"):
            found |= {f"{name}.{axis}": _title(value.get(axis, {})) for axis in ("xaxis", "yaxis", "zaxis")}
        elif name.startswith(("xaxis", "yaxis")) and value.get("visible", True):
            found[name] = _title(value)
    return found


def _title(axis: Mapping[str, Any]) -> str:
    title = axis.get("title", "")
    return str(title if isinstance(title, str) else title.get("text", ""))
