"""The points in three dimensions, with the cameras that saw them."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.flight import camera_by_frame, cameras_of, placements_of
from pipeline.geometry.arrays import Bytes, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement
from pipeline.reporting.figure import Figure
from pipeline.reporting.gathered import RunData
from pipeline.reporting.ground import Ground, ground_of, points_of
from pipeline.reporting.thinning import ShownPoints, thinned
from pipeline.reporting.typed_arrays import singles

MOST_POINTS = 40_000
"""Points that are drawn at most."""

MOST_FRAMES = 400
"""Cameras that are drawn at most, evenly spread over the flight."""

_CAMERAS = "#e0822b"
# Height of the pyramid of a camera, as a share of what the scene spans.
_PYRAMID_SHARE = 0.025
_EXTREMES = (1.0, 99.0)


def figures(run: RunData) -> list[Figure]:
    """The points and cameras of a run, to be turned about.

    Args:
        run: The run.

    Returns:
        One figure; none where the run has no points.

    Raises:
        InputError: The points cannot be read.
    """
    points = points_of(run)
    if points is None:
        return []
    ground, shown = ground_of(run), thinned(points, MOST_POINTS)
    corner = ground.corner
    offset = ", ".join(f"{value:,.0f}" for value in corner)
    left_out = "" if len(shown) == points.rows else f", thinned evenly from {points.rows:,}"
    traces = (_cloud(shown, corner), _cameras(run, ground, shown, corner))
    return [
        Figure(
            "cloud",
            "Points and cameras",
            f"{len(shown):,} points{left_out}, and the cameras with their pyramids of sight. Drag to turn, scroll to "
            f"come nearer; the menu chooses the colours. Coordinates are counted from {offset} m"
            f"{'' if ground.transform is None else f' of {ground.transform.crs.name}'}.",
            traces,
            _layout(shown, ground),
            620,
        )
    ]


def _cloud(shown: ShownPoints, corner: Floats) -> dict[str, Any]:
    at = np.round(shown.xyz - corner, 2)
    return {
        "type": "scatter3d",
        "mode": "markers",
        "name": "points",
        "x": singles(at[:, 0]),
        "y": singles(at[:, 1]),
        "z": singles(at[:, 2]),
        "marker": {"size": 1.6, "color": hex_colours(shown.rgb), "line": {"width": 0}, "showscale": False},
        "hovertemplate": "E %{x:.2f} m, N %{y:.2f} m, up %{z:.2f} m<extra></extra>",
    }


def hex_colours(rgb: Bytes) -> list[str]:
    """Colours as #rrggbb.

    Args:
        rgb: (n, 3).
    """
    packed = rgb.astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
    return [f"#{value:06x}" for value in packed.tolist()]


def colour_menu(shown: ShownPoints, height_title: str, corner_m: float, trace: int) -> dict[str, Any]:
    """A menu that colours points by photo, height or sigma.

    Args:
        shown: The points.
        height_title: Title of the heights.
        corner_m: What heights are counted from.
        trace: Index of the points' trace.

    Returns:
        An entry of plotly's `updatemenus`.
    """
    choices = [("photo colours", {"marker.color": [hex_colours(shown.rgb)], "marker.showscale": False})]
    for name, title, values, scale in (
        ("height", height_title, shown.xyz[:, 2] - corner_m, "Viridis"),
        ("sigma", "sigma of the position (m)", shown.sigma_m, "Cividis"),
    ):
        low, high = np.percentile(values, _EXTREMES) if len(values) else (0.0, 1.0)
        bar = {"title": {"text": title, "side": "right"}, "thickness": 14, "len": 0.7, "outlinewidth": 0}
        choices.append(
            (
                name,
                {
                    "marker.color": [singles(values)],
                    "marker.cmin": float(low),
                    "marker.cmax": float(high),
                    "marker.colorscale": scale,
                    "marker.showscale": True,
                    "marker.colorbar": [bar],
                },
            )
        )
    return {
        "type": "buttons",
        "direction": "right",
        "x": 0.0,
        "xanchor": "left",
        "y": 1.0,
        "yanchor": "bottom",
        "pad": {"b": 4},
        "buttons": [{"label": name, "method": "restyle", "args": [change, [trace]]} for name, change in choices],
    }


def _cameras(run: RunData, ground: Ground, shown: ShownPoints, corner: Floats) -> dict[str, Any]:
    placed = placements_of(run.poses)
    cameras = camera_by_frame(run.frames, cameras_of(run.cameras))
    names = list(placed)
    names = [names[i] for i in np.unique(np.linspace(0, len(names) - 1, MOST_FRAMES).round().astype(np.int64))]
    centres = np.array([placed[name].centre for name in names])
    span = np.ptp(np.concatenate([shown.xyz, ground.place(centres)])[:, :2], axis=0).max()
    lines = [_pyramid(placed[name], cameras[name], _PYRAMID_SHARE * float(span)) for name in names]
    at = np.round(ground.place(np.concatenate(lines)) - corner, 2)
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": "cameras",
        "x": singles(at[:, 0]),
        "y": singles(at[:, 1]),
        "z": singles(at[:, 2]),
        "line": {"color": _CAMERAS, "width": 2},
        "text": [name for name, line in zip(names, lines, strict=True) for _ in line],
        "hovertemplate": "%{text}<extra></extra>",
        "connectgaps": False,
    }


def _pyramid(placed: Placement, camera: Camera, height_m: float) -> Floats:
    """A line along the edges of a camera's pyramid of sight, (11, 3) m, ENU; its last point is a gap."""
    right, bottom = camera.width / 2.0 / camera.fx, camera.height / 2.0 / camera.fy
    corners = np.array([[-right, -bottom, 1.0], [right, -bottom, 1.0], [right, bottom, 1.0], [-right, bottom, 1.0]])
    a, b, c, d = placed.centre + height_m * corners @ placed.rotation.T
    o, gap = placed.centre, np.full(3, np.nan)
    return np.array([o, a, b, o, c, b, c, d, o, d, a, gap])


def _layout(shown: ShownPoints, ground: Ground) -> dict[str, Any]:
    counted = "from the corner (m)"
    return {
        "scene": {
            "aspectmode": "data",
            "xaxis": {"title": {"text": f"E {counted}"}},
            "yaxis": {"title": {"text": f"N {counted}"}},
            "zaxis": {"title": {"text": "up (m)"}},
            "camera": {"eye": {"x": -0.9, "y": -0.9, "z": 0.7}},
        },
        "updatemenus": [colour_menu(shown, "up (m)", float(ground.corner[2]), 0)],
        "margin": {"l": 0, "r": 0, "t": 44, "b": 0},
        "legend": {"orientation": "h"},
    }
