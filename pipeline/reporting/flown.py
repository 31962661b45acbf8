"""The map: where the frames stand and look, which pairs were made of them, and the points they gave."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.flight import column, columns, placements_of
from pipeline.geometry.arrays import Bools, Floats
from pipeline.reporting.figure import Figure
from pipeline.reporting.gathered import RunData
from pipeline.reporting.ground import Ground, ground_of, points_of
from pipeline.reporting.point_colours import HEIGHT, PHOTO, SIGMA, PointColours
from pipeline.reporting.thin import evenly
from pipeline.reporting.thinning import ShownPoints, thinned
from pipeline.reporting.typed_arrays import typed

MOST_POINTS = 6_000
"""Points that are drawn at most: each is an element of the page."""

MOST_REJECTED = 5_000
"""Rejected pairs that are drawn at most, evenly spread over the table."""

_FRAMES, _PAIRS, _REJECTED, _MARKS = "#e0822b", "#2f7fd1", "#8f9aa3", "#b562b8"
_SIGMAS = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
# Length of the lines of view, as a share of what the map spans.
_SIGHT_SHARE = 0.05


def figures(run: RunData) -> list[Figure]:
    """The map of a flight.

    Args:
        run: The run.

    Returns:
        One figure.

    Raises:
        InputError: The points cannot be read.
    """
    ground, points = ground_of(run), points_of(run)
    shown = ShownPoints.none() if points is None else thinned(points, MOST_POINTS)
    colours = PointColours(shown, ground.axes[2], (HEIGHT, SIGMA, PHOTO)) if len(shown) else None
    traces = [
        *([] if colours is None else [_points(shown, colours)]),
        *_pairs(run, ground),
        *_frames(run, ground, shown),
        *_surveyed(run, ground),
    ]
    of_points = "" if points is None else f" {len(shown):,} of {points.rows:,} points, spread evenly."
    return [
        Figure(
            "map",
            "Frames, pairs and points",
            "Each frame with a line towards what it looks at, and lines between the frames of a pair."
            f"{of_points} A click in the legend hides a kind or shows it again.",
            tuple(traces),
            _layout(ground, colours),
            620,
        )
    ]


def _points(shown: ShownPoints, colours: PointColours) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "markers",
        "name": "points",
        "x": typed(np.round(shown.xyz[:, 0], 2)),
        "y": typed(np.round(shown.xyz[:, 1], 2)),
        "customdata": typed(np.round(shown.xyz[:, 2:], 2)),
        "marker": {"size": 3, **colours.marker()},
        "hovertemplate": "%{x:.2f}, %{y:.2f}, height %{customdata[0]:.2f} m<extra></extra>",
    }


def _pairs(run: RunData, ground: Ground) -> list[dict[str, Any]]:
    centres = {name: placed.centre for name, placed in placements_of(run.poses).items()}
    ends = [column(run.pairs, name) for name in ("ref_frame_id", "src_frame_id")]
    placed = np.array([one in centres and other in centres for one, other in zip(*ends, strict=True)], np.bool_)
    selected = np.asarray(column(run.pairs, "selected"), np.bool_)
    rejected = np.flatnonzero(placed & ~selected)
    drawn = np.isin(np.arange(len(placed)), evenly(rejected, MOST_REJECTED))

    def lines(which: Bools) -> Floats:
        both = np.array([[centres[name] for name in end[which]] for end in ends]).reshape(2, -1, 3)
        return _strokes(*ground.place(both))

    return [
        _line("rejected pairs", lines(drawn), _REJECTED, 0.45, 1.0),
        _line("selected pairs", lines(placed & selected), _PAIRS, 0.8, 1.4),
    ]


def _strokes(start: Floats, end: Floats) -> Floats:
    """(3 n, 2) ends of lines with gaps between them."""
    out: Floats = np.stack([start, end, np.full_like(start, np.nan)], axis=1).reshape(-1, 3)[:, :2]
    return out


def _line(name: str, at: Floats, colour: str, opacity: float, width: float) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": typed(np.round(at[:, 0], 2)),
        "y": typed(np.round(at[:, 1], 2)),
        "line": {"color": colour, "width": width},
        "opacity": opacity,
        "hoverinfo": "skip",
    }


def _frames(run: RunData, ground: Ground, shown: ShownPoints) -> list[dict[str, Any]]:
    placed = placements_of(run.poses)
    if not placed:
        return []
    centres = np.array([pose.centre for pose in placed.values()])
    axes = np.array([pose.rotation[:, 2] for pose in placed.values()])
    at = ground.place(centres)
    span = float(np.ptp(np.concatenate([at, shown.xyz])[:, :2], axis=0).max())
    sight = _strokes(at, ground.place(centres + max(_SIGHT_SHARE * span, 0.1) * axes))
    sigma = columns(run.poses, _SIGMAS)
    told = np.column_stack([at[:, 2], np.hypot(sigma[:, 0], sigma[:, 1]), sigma[:, 2]])
    return [
        _line("view direction", sight, _FRAMES, 1.0, 1.6),
        {
            "type": "scatter",
            "mode": "markers",
            "name": "frames",
            "x": typed(np.round(at[:, 0], 2)),
            "y": typed(np.round(at[:, 1], 2)),
            "text": list(placed),
            "customdata": typed(np.round(told, 3)),
            "marker": {"size": 7, "color": _FRAMES, "line": {"width": 1, "color": "#ffffff"}},
            "hovertemplate": "<b>%{text}</b><br>height %{customdata[0]:.2f} m<br>"
            "one sigma: %{customdata[1]:.3f} m level, %{customdata[2]:.3f} m up<extra></extra>",
        },
    ]


def _surveyed(run: RunData, ground: Ground) -> list[dict[str, Any]]:
    """Control points and checkpoints whose place the scores tell."""
    metrics = run.metrics or {}
    control = (metrics.get("control_points") or {}).get("by_point", {})
    checked = (metrics.get("checkpoints") or {}).get("points", [])
    kinds = (
        ("control points", "triangle-up", {name: one.get("position_m") for name, one in control.items()}),
        ("checkpoints", "diamond", {one["name"]: one.get("position_m") for one in checked}),
    )
    found = []
    for kind, symbol, places in kinds:
        known = {name: place for name, place in places.items() if place is not None}
        if not known:
            continue
        at = ground.place(np.array(list(known.values()), np.float64))
        found.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": kind,
                "x": typed(np.round(at[:, 0], 2)),
                "y": typed(np.round(at[:, 1], 2)),
                "text": list(known),
                "marker": {"size": 10, "symbol": symbol, "color": _MARKS, "line": {"width": 1, "color": "#ffffff"}},
                "hovertemplate": "<b>%{text}</b><extra>" + kind + "</extra>",
            }
        )
    return found


def _layout(ground: Ground, colours: PointColours | None) -> dict[str, Any]:
    return {
        "xaxis": {"title": {"text": ground.axes[0]}, "tickformat": ",.3~f", "zeroline": False},
        "yaxis": {
            "title": {"text": ground.axes[1]},
            "tickformat": ",.3~f",
            "zeroline": False,
            "scaleanchor": "x",
            "scaleratio": 1,
        },
        "updatemenus": [] if colours is None else [colours.menu(0)],
        "legend": {"orientation": "h", "x": 0.0, "yref": "container", "y": 0.01, "yanchor": "bottom"},
        "hovermode": "closest",
        "margin": {"t": 56, "b": 96},
        "modebar": {"remove": ["select2d", "lasso2d"]},
    }
