"""The points in three dimensions, with the cameras that saw them."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.flight import camera_by_frame, cameras_of, placements_of
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement
from pipeline.reporting.figure import Figure
from pipeline.reporting.gathered import RunData
from pipeline.reporting.ground import Ground, ground_of, points_of
from pipeline.reporting.point_colours import HEIGHT, PHOTO, SIGMA, PointColours
from pipeline.reporting.thin import evenly
from pipeline.reporting.thinning import ShownPoints, thinned
from pipeline.reporting.typed_arrays import singles

MOST_POINTS = 40_000
"""Points that are drawn at most."""

MOST_FRAMES = 400
"""Cameras that are drawn at most, evenly spread over the flight."""

_CAMERAS = "#e0822b"
# Height of the pyramid of a camera, as a share of what the scene spans.
_PYRAMID_SHARE = 0.025


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
    corner, colours = ground.corner, PointColours(shown, ground.axes[2], (PHOTO, HEIGHT, SIGMA))
    left_out = "" if len(shown) == points.rows else f", thinned evenly from {points.rows:,}"
    traces = (_cloud(shown, corner, colours), _cameras(run, ground, shown, corner))
    return [
        Figure(
            "cloud",
            "Points and cameras",
            f"{len(shown):,} points{left_out}, and the cameras with their pyramids of sight. Drag to turn, scroll to "
            f"come nearer; the buttons choose the colours.{_counted(ground)}",
            traces,
            _layout(colours),
            620,
        )
    ]


def _cloud(shown: ShownPoints, corner: Floats, colours: PointColours) -> dict[str, Any]:
    at = np.round(shown.xyz - corner, 2)
    return {
        "type": "scatter3d",
        "mode": "markers",
        "name": "points",
        "x": singles(at[:, 0]),
        "y": singles(at[:, 1]),
        "z": singles(at[:, 2]),
        "marker": {"size": 2, "line": {"width": 0}, **colours.marker()},
        "hovertemplate": "east %{x:.2f} m, north %{y:.2f} m, height %{z:.2f} m<extra></extra>",
    }


def _cameras(run: RunData, ground: Ground, shown: ShownPoints, corner: Floats) -> dict[str, Any]:
    placed = placements_of(run.poses)
    cameras = camera_by_frame(run.frames, cameras_of(run.cameras))
    names = evenly(np.array(list(placed), object), MOST_FRAMES).tolist()
    centres = np.array([placed[name].centre for name in names])
    span = np.ptp(np.concatenate([shown.xyz, ground.place(centres)])[:, :2], axis=0).max()
    lines = [pyramid(placed[name], cameras[name], _PYRAMID_SHARE * float(span)) for name in names]
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


def pyramid(placed: Placement, camera: Camera, height_m: float) -> Floats:
    """A line along the edges of a camera's pyramid of sight, (11, 3) m, ENU; its last point is a gap."""
    right, bottom = camera.width / 2.0 / camera.fx, camera.height / 2.0 / camera.fy
    corners = np.array([[-right, -bottom, 1.0], [right, -bottom, 1.0], [right, bottom, 1.0], [-right, bottom, 1.0]])
    a, b, c, d = placed.centre + height_m * corners @ placed.rotation.T
    o, gap = placed.centre, np.full(3, np.nan)
    return np.array([o, a, b, o, c, b, c, d, o, d, a, gap])


def _counted(ground: Ground) -> str:
    """What the level coordinates are counted from, where that is not the origin."""
    if ground.transform is None:
        return ""
    east, north, _ = ground.corner
    return f" East and north are counted from {east:,.0f} and {north:,.0f} m of {ground.transform.crs.name}."


def _layout(colours: PointColours) -> dict[str, Any]:
    return {
        "scene": {
            "aspectmode": "data",
            "xaxis": {"title": {"text": "east (m)"}},
            "yaxis": {"title": {"text": "north (m)"}},
            "zaxis": {"title": {"text": "height (m)"}},
            "camera": {"eye": {"x": -1.0, "y": -1.9, "z": 1.25}, "center": {"x": 0.0, "y": 0.0, "z": -0.2}},
        },
        "updatemenus": [colours.menu(0)],
        "margin": {"l": 0, "r": 0, "t": 44, "b": 0},
        "legend": {"x": 0.0, "y": 0.0, "yanchor": "bottom"},
    }
