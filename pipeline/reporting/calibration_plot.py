"""Whether the sigmas are honest: observed against nominal shares, and observed against predicted errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pipeline.reporting.figure import LEGEND_ABOVE, MARGIN_OF_LEGEND, Figure
from pipeline.reporting.palette import QUIET, colours

_STRAIGHT = {"dash": "dash", "color": QUIET, "width": 1.5}
# A bin with fewer pixels tells nothing of its root mean square.
LEAST_PIXELS = 30


def figures(metrics: Mapping[str, Any]) -> list[Figure]:
    """The figures that `calibration` of metrics.json has numbers for."""
    calibration = metrics.get("calibration") or {}
    found = [_shares(calibration), _by_sigma(calibration)]
    return [figure for figure in found if figure is not None]


def _shares(calibration: Mapping[str, Any]) -> Figure | None:
    curve = [point for point in calibration.get("curve") or [] if point["observed"] is not None]
    if not curve:
        return None
    alone = [p for p in (calibration.get("without_pose") or {}).get("curve") or [] if p["observed"] is not None]
    traces: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": "Honest",
            "x": [0.0, 1.0],
            "y": [0.0, 1.0],
            "line": _STRAIGHT,
            "hoverinfo": "skip",
        },
        _curve("Observed", curve, calibration.get("method", "epitransfer"), "solid"),
    ]
    if alone:
        traces.append(_curve("Without the pose's part", alone, calibration.get("method", "epitransfer"), "dot"))
    layout = {
        "xaxis": {"title": {"text": "Nominal share of errors within the bound (1)"}, "range": [0.0, 1.0]},
        "yaxis": {"title": {"text": "Observed share (1)"}, "range": [0.0, 1.02]},
        "legend": LEGEND_ABOVE,
        "margin": MARGIN_OF_LEGEND,
    }
    caption = (
        "If the sigmas are honest, a share p of the errors lies within the bound that should hold a share p. Below the "
        "dashed line sigmas are too small, above it too large. Errors that frames share bend the whole curve."
    )
    return Figure("calibration", "Observed against nominal", caption, tuple(traces), layout)


def _curve(name: str, points: list[Mapping[str, Any]], method: str, dash: str) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": name,
        "x": [point["nominal"] for point in points],
        "y": [point["observed"] for point in points],
        "line": {"color": colours([method])[method], "dash": dash, "width": 2},
        "marker": {"size": 6},
        "hovertemplate": "%{x:.2f} nominal, %{y:.3f} observed",
    }


def _by_sigma(calibration: Mapping[str, Any]) -> Figure | None:
    bins = [b for b in calibration.get("by_sigma") or [] if b["n"] >= LEAST_PIXELS and b["predicted"] and b["observed"]]
    if not bins:
        return None
    method = calibration.get("method", "epitransfer")
    low = min(min(b["predicted"], b["observed"]) for b in bins) / 1.5
    high = max(max(b["predicted"], b["observed"]) for b in bins) * 1.5
    traces: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": "Honest",
            "x": [low, high],
            "y": [low, high],
            "line": _STRAIGHT,
            "hoverinfo": "skip",
        },
        {
            "type": "scatter",
            "mode": "lines+markers",
            "name": "Depths",
            "x": [b["predicted"] for b in bins],
            "y": [b["observed"] for b in bins],
            "customdata": [b["n"] for b in bins],
            "hovertemplate": "%{x:.4f} predicted, %{y:.4f} observed (%{customdata:,} pixels)",
            "line": {"color": colours([method])[method], "width": 2},
            "marker": {"size": 7},
        },
    ]
    span = [math.log10(low), math.log10(high)]
    layout = {
        "xaxis": {"title": {"text": "Predicted relative error, rms (1)"}, "type": "log", "range": span, "dtick": "D1"},
        "yaxis": {"title": {"text": "Observed relative error, rms (1)"}, "type": "log", "range": span, "dtick": "D1"},
        "legend": LEGEND_ABOVE,
        "margin": MARGIN_OF_LEGEND,
    }
    caption = (
        "Depths in bins of their predicted relative sigma: what was foretold, and what came. Above the dashed line "
        "errors are larger than foretold."
    )
    return Figure("by-sigma", "Observed against predicted error", caption, tuple(traces), layout)
