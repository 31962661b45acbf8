"""Depth errors by range, by parallax and by frame, every method beside the others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pipeline.reporting.figure import LEGEND_ABOVE, MARGIN_OF_LEGEND, Figure
from pipeline.reporting.palette import colours, in_order, label

# A bin with fewer pixels tells nothing of its mean error.
LEAST_PIXELS = 30
_RELATIVE = "AbsRel (1)"


def figures(metrics: Mapping[str, Any], untrained: frozenset[str]) -> list[Figure]:
    """The figures that metrics.json has numbers for.

    Args:
        metrics: The object of metrics.json.
        untrained: Methods with random weights; they are left out.
    """
    methods = {name: metrics["methods"][name] for name in in_order(metrics["methods"]) if name not in untrained}
    found = [
        _binned(methods, "by_range", "Error by range", "Range: distance from the camera (m)"),
        _binned(methods, "by_parallax", "Error by parallax", "Parallax: angle between the two rays (deg)"),
        _frames(methods),
    ]
    return [figure for figure in found if figure is not None]


def _binned(methods: Mapping[str, Any], key: str, title: str, axis: str) -> Figure | None:
    traces = list(_bin_traces(methods, key))
    if not traces:
        return None
    spans = [_span(one) for one in next(iter(methods.values()))[key]]
    layout = {
        "xaxis": {
            "title": {"text": axis},
            "type": "category",
            "categoryorder": "array",
            "categoryarray": spans,
            "anchor": "y2",
        },
        "yaxis": {"title": {"text": _RELATIVE}, "rangemode": "tozero", "domain": [0.36, 1.0]},
        "yaxis2": {"title": {"text": "Pixels (1)"}, "domain": [0.0, 0.26], "rangemode": "tozero"},
        "barmode": "group",
        "legend": LEGEND_ABOVE,
        "margin": MARGIN_OF_LEGEND,
    }
    caption = (
        "Mean relative error of the pixels in each bin that every method keeps, and below how many these are; "
        f"bins with fewer than {LEAST_PIXELS} are left out of the lines."
    )
    return Figure(key.replace("_", "-"), title, caption, tuple(traces), layout, 480)


def _bin_traces(methods: Mapping[str, Any], key: str) -> Iterator[dict[str, Any]]:
    shades = colours(methods)
    counted = False
    for name, entry in methods.items():
        bins = entry.get(key) or []
        full = [one for one in bins if one["common"]["n"] >= LEAST_PIXELS]
        if full:
            yield {
                "type": "scatter",
                "mode": "lines+markers",
                "name": label(name),
                "x": [_span(one) for one in full],
                "y": [one["common"]["abs_rel"] for one in full],
                "customdata": [one["common"]["n"] for one in full],
                "hovertemplate": "%{x}: %{y:.4f} (%{customdata:,} pixels)",
                "line": {"color": shades[name], "width": 2},
                "marker": {"size": 7},
            }
        if full and not counted:
            counted = True
            yield {
                "type": "bar",
                "name": "Pixels",
                "x": [_span(one) for one in bins if one["common"]["n"]],
                "y": [one["common"]["n"] for one in bins if one["common"]["n"]],
                "yaxis": "y2",
                "showlegend": False,
                "marker": {"color": "#8f9aa3"},
                "hovertemplate": "%{y:,} pixels",
            }


def _span(one: Mapping[str, Any]) -> str:
    return f"over {one['from']:g}" if one["to"] is None else f"{one['from']:g} to {one['to']:g}"


def _frames(methods: Mapping[str, Any]) -> Figure | None:
    shades = colours(methods)
    traces: list[dict[str, Any]] = []
    for name, entry in methods.items():
        rows = [row for row in entry.get("per_frame") or [] if row["common"]["n"] >= LEAST_PIXELS]
        bounds = [((row.get("interval_95") or {}).get("common") or {}).get("abs_rel") for row in rows]
        if not rows:
            continue
        trace: dict[str, Any] = {
            "type": "scatter",
            "mode": "markers",
            "name": label(name),
            "x": [row["frame_id"] for row in rows],
            "y": [row["common"]["abs_rel"] for row in rows],
            "customdata": [row["common"]["n"] for row in rows],
            "hovertemplate": "%{x}: %{y:.4f} (%{customdata:,} pixels)",
            "marker": {"color": shades[name], "size": 8},
            "zorder": -len(traces),
        }
        if all(bounds):
            trace["error_y"] = _bars([row["common"]["abs_rel"] for row in rows], bounds)
        traces.append(trace)
    if not traces:
        return None
    layout = {
        "xaxis": {"title": {"text": "Frame (name)"}, "type": "category", "tickangle": -45, "automargin": True},
        "yaxis": {"title": {"text": _RELATIVE}, "rangemode": "tozero"},
        "legend": LEGEND_ABOVE,
        "margin": MARGIN_OF_LEGEND,
    }
    caption = "Mean relative error of each frame on the pixels that every method keeps; look at those that stand out."
    return Figure("by-frame", "Error by frame", caption, tuple(traces), layout)


def _bars(values: Sequence[float], bounds: Sequence[Any]) -> dict[str, Any]:
    return {
        "type": "data",
        "symmetric": False,
        "array": [high - value for value, (_, high) in zip(values, bounds, strict=True)],
        "arrayminus": [value - low for value, (low, _) in zip(values, bounds, strict=True)],
        "thickness": 1,
        "width": 3,
    }
