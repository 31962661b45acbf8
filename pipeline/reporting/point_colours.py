"""What points are coloured by, and the menu that changes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.geometry.arrays import Bytes, Floats
from pipeline.reporting.scales import RISING, stops
from pipeline.reporting.thinning import ShownPoints
from pipeline.reporting.typed_arrays import singles

PHOTO, HEIGHT, SIGMA = "photo colours", "height", "sigma"
# A few points far off would take the whole scale.
_EXTREMES = (1.0, 99.0)


@dataclass(frozen=True, slots=True)
class PointColours:
    """The ways a run's points can be coloured.

    Args:
        shown: The points.
        height_title: Title of heights, with unit.
        order: `PHOTO`, `HEIGHT` and `SIGMA` as the menu lists them; the points begin with the first.
    """

    shown: ShownPoints
    height_title: str
    order: tuple[str, str, str]

    def marker(self) -> dict[str, Any]:
        """Entries of a trace's `marker` to begin with."""
        return self._of(self.order[0])

    def menu(self, trace: int) -> dict[str, Any]:
        """An entry of plotly's `updatemenus` that recolours a trace.

        Args:
            trace: Its index in the figure.
        """
        buttons = []
        for name in self.order:
            change = {f"marker.{key}": [value] for key, value in self._of(name).items()}
            buttons.append({"label": name, "method": "restyle", "args": [change, [trace]]})
        return choice(buttons, listed=False)

    def _of(self, name: str) -> dict[str, Any]:
        if name == PHOTO:
            return {"color": hex_colours(self.shown.rgb), "showscale": False}
        if name == HEIGHT:
            return _scaled(self.shown.xyz[:, 2], self.height_title)
        return _scaled(self.shown.sigma_m, "sigma of the position (m)")


def choice(buttons: list[dict[str, Any]], *, listed: bool) -> dict[str, Any]:
    """An entry of plotly's `updatemenus` above the left end of a figure.

    Args:
        buttons: The choices.
        listed: A list that opens, for what would not fit in a row.
    """
    place = {"x": 0.0, "xanchor": "left", "y": 1.0, "yanchor": "bottom", "pad": {"b": 6}}
    # plotly lights up what is pressed whatever the page's colours, so that the letters on it have to be dark.
    look = {"bgcolor": "#d5dce4", "bordercolor": "#8f9aa3", "font": {"color": "#1b2733", "size": 12}}
    form = {"type": "dropdown", "direction": "down"} if listed else {"type": "buttons", "direction": "right"}
    return {**form, "buttons": buttons, **place, **look}


def bar(title: str) -> dict[str, Any]:
    """A colour bar with its title along it."""
    return {"title": {"text": title, "side": "right"}, "thickness": 14, "outlinewidth": 0}


def hex_colours(rgb: Bytes) -> list[str]:
    """Colours as #rrggbb.

    Args:
        rgb: (n, 3).
    """
    packed = rgb.astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
    return [f"#{value:06x}" for value in packed.tolist()]


def _scaled(values: Floats, title: str) -> dict[str, Any]:
    low, high = np.percentile(values, _EXTREMES)
    return {
        "color": singles(values),
        "cmin": float(low),
        "cmax": float(max(high, low + 1e-6)),
        "colorscale": stops(RISING),
        "showscale": True,
        "colorbar": bar(title),
    }
