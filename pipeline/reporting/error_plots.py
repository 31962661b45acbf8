"""Where and how far the depths are off: spread of the errors, errors over the image, and errors on the ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.flight import placements_of
from pipeline.geometry.arrays import Floats
from pipeline.reporting.error_sums import ErrorSums, error_sums
from pipeline.reporting.figure import Figure
from pipeline.reporting.gathered import RunData
from pipeline.reporting.ground import Ground, ground_of
from pipeline.reporting.palette import QUIET, colours, label
from pipeline.reporting.point_colours import bar, choice
from pipeline.reporting.scales import RISING, SIGNED, stops
from pipeline.reporting.typed_arrays import singles, typed

# Bins of the histogram that is drawn, and how far it goes: wide enough for most of the published method's errors.
_DRAWN_BINS, _SHARE, _ROOM = 60, 0.98, 1.5
# Colours of cells end where most of the published method's cells do.
_CELL_SHARE = 95.0
# Cells of fewer pixels say nothing.
_LEAST = 3


def figures(run: RunData) -> list[Figure]:
    """The errors of a scored run.

    Args:
        run: The run.

    Returns:
        Their spread, their size over the image, and their place on the ground; none where nothing was scored.

    Raises:
        InputError: A table cannot be read.
    """
    if run.scores is None or not (run.scores / "pixels.parquet").exists():
        return []
    ground = ground_of(run)
    sums = error_sums(run, ground)
    if sums is None:
        return []
    return [_spread(sums), _over_image(sums), _on_ground(run, sums, ground)]


def _spread(sums: ErrorSums) -> Figure:
    limit = sums.limit_percent(_SHARE) * _ROOM
    traces = []
    for (name, colour), counts in zip(colours(sums.methods).items(), sums.histogram, strict=True):
        centres, shares, beyond = sums.rebinned(counts, limit, _DRAWN_BINS)
        published = name == sums.methods[0]
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "fill": "tozeroy" if published else "none",
                "name": f"{label(name)} ({100.0 * beyond:.1f} % beyond)",
                "x": singles(centres),
                "y": singles(100.0 * shares),
                "line": {"shape": "hvh", "color": colour, "width": 2.5 if published else 1.6},
                "hovertemplate": "%{x:.2f} %: %{y:.2f} % of pixels<extra>" + label(name) + "</extra>",
            }
        )
    layout = {
        "xaxis": {"title": {"text": "signed error (% of the reference)"}, "range": [-limit, limit]},
        "yaxis": {"title": {"text": "share of kept pixels per bin (%)"}, "rangemode": "tozero"},
        "legend": {"orientation": "h", "x": 0.0, "yref": "container", "y": 0.01, "yanchor": "bottom"},
        "margin": {"b": 110},
    }
    return Figure(
        "error-spread",
        "How the errors spread",
        "Errors of the kept depths of each method, its own pixels: right of zero is too far. A peak beside zero is a "
        "bias, which poses or calibration make; the share beyond the ends stands in the legend.",
        tuple(traces),
        layout,
        420,
    )


def _over_image(sums: ErrorSums) -> Figure:
    with np.errstate(invalid="ignore", divide="ignore"):
        means = np.where(sums.image_n >= _LEAST, 100.0 * sums.image_sum / sums.image_n, np.nan)
    width, height = sums.image_px
    top = _cell_limit(means)
    down, across = means.shape[1:]
    traces = [
        {
            "type": "heatmap",
            "name": label(name),
            "z": singles(cells),
            "x0": width / across / 2.0 - 0.5,
            "dx": width / across,
            "y0": height / down / 2.0 - 0.5,
            "dy": height / down,
            "zmin": 0.0,
            "zmax": top,
            "colorscale": stops(RISING),
            "colorbar": bar("mean |error| (% of the reference)"),
            "visible": m == 0,
            "hoverongaps": False,
            "hovertemplate": "u %{x:.0f} px, v %{y:.0f} px: %{z:.2f} %<extra>" + label(name) + "</extra>",
        }
        for m, (name, cells) in enumerate(zip(sums.methods, means, strict=True))
    ]
    layout = {
        # The cells stand beside their colour bar, however wide the page.
        "xaxis": {
            "title": {"text": "column u (px)"},
            "range": [-0.5, width - 0.5],
            "constrain": "domain",
            "constraintoward": "right",
            "showgrid": False,
            "zeroline": False,
        },
        "yaxis": {
            "title": {"text": "row v (px)"},
            "range": [height - 0.5, -0.5],
            "scaleanchor": "x",
            "constrain": "domain",
            "showgrid": False,
            "zeroline": False,
        },
        "updatemenus": _menus(sums.methods, 0),
        "margin": {"t": 56},
    }
    return Figure(
        "error-image",
        "Errors over the image",
        "Mean absolute error of the kept depths in cells of the image, all frames together. A band across the image "
        "is where the geometry is weak (near the epipole or the trifocal plane); a ring or a corner is the lens. "
        "Empty cells have too few pixels; the list chooses the method.",
        tuple(traces),
        layout,
        500,
    )


def _on_ground(run: RunData, sums: ErrorSums, ground: Ground) -> Figure:
    plan = sums.plan
    with np.errstate(invalid="ignore", divide="ignore"):
        means = np.where(sums.plan_n >= _LEAST, sums.plan_sum / sums.plan_n, np.nan)
    limit = _cell_limit(means)
    traces: list[Mapping[str, Any]] = [
        {
            "type": "heatmap",
            "name": label(name),
            "z": singles(cells),
            "x0": plan.corner[0] + plan.edge / 2.0,
            "dx": plan.edge,
            "y0": plan.corner[1] + plan.edge / 2.0,
            "dy": plan.edge,
            "zmin": -limit,
            "zmax": limit,
            "colorscale": stops(SIGNED),
            "colorbar": bar("mean error of the depth (m)"),
            "visible": m == 0,
            "hoverongaps": False,
            "hovertemplate": "%{x:,.1f}, %{y:,.1f}: %{z:.3f} m<extra>" + label(name) + "</extra>",
        }
        for m, (name, cells) in enumerate(zip(sums.methods, means, strict=True))
    ]
    placed = placements_of(run.poses)
    at = ground.place(np.array([pose.centre for pose in placed.values()]).reshape(-1, 3))
    traces.append(
        {
            "type": "scatter",
            "mode": "markers",
            "name": "frames",
            "x": typed(np.round(at[:, 0], 2)),
            "y": typed(np.round(at[:, 1], 2)),
            "text": list(placed),
            "marker": {"size": 6, "symbol": "triangle-up", "color": QUIET},
            "hovertemplate": "%{text}<extra></extra>",
        }
    )
    layout = {
        "xaxis": {"title": {"text": ground.axes[0]}, "tickformat": ",.3~f", "zeroline": False},
        "yaxis": {
            "title": {"text": ground.axes[1]},
            "tickformat": ",.3~f",
            "zeroline": False,
            "scaleanchor": "x",
        },
        "updatemenus": _menus(sums.methods, 1),
        "showlegend": False,
        "margin": {"t": 56},
        "modebar": {"remove": ["select2d", "lasso2d"]},
    }
    return Figure(
        "error-plan",
        "Errors on the ground",
        f"Mean signed error of the kept depths in cells of {plan.edge:g} m at the place of the reference: red is too "
        "far, blue too near. Triangles are the frames; the list chooses the method.",
        tuple(traces),
        layout,
        560,
    )


def _cell_limit(means: Floats) -> float:
    """Where the colours of cells end: by the published method, which is the first."""
    found = np.abs(means[0][np.isfinite(means[0])])
    return float(np.percentile(found, _CELL_SHARE)) if len(found) and found.any() else 1.0


def _menus(methods: Sequence[str], others: int) -> list[dict[str, Any]]:
    """A list that shows one method's cells, and always the last `others` traces."""
    if len(methods) < 2:
        return []
    buttons = [
        {
            "label": label(name),
            "method": "restyle",
            "args": [{"visible": [m == shown for m in range(len(methods))] + [True] * others}],
        }
        for shown, name in enumerate(methods)
    ]
    return [choice(buttons, listed=True)]
