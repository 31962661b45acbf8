"""Which pairs were chosen, and which rule rejected the others."""

from __future__ import annotations

from typing import Any

from pipeline.flight import column
from pipeline.reporting.counts import pair_rules, rule_of
from pipeline.reporting.figure import LEGEND_ABOVE, MARGIN_OF_LEGEND, Figure
from pipeline.reporting.gathered import RunData
from pipeline.reporting.palette import BAD, GOOD
from pipeline.reporting.thin import evenly

# Points a browser draws without a wait; of more candidates an even choice is shown.
_SHOWN = 4000


def figures(run: RunData) -> list[Figure]:
    """Rejected pairs by rule, and all candidates by baseline and view angle."""
    if not run.pairs.num_rows:
        return []
    return [*_rules(run), _candidates(run)]


def _rules(run: RunData) -> list[Figure]:
    rules = pair_rules(run)
    if not rules:
        return []
    trace = {
        "type": "bar",
        "orientation": "h",
        "y": list(rules)[::-1],
        "x": list(rules.values())[::-1],
        "text": list(rules.values())[::-1],
        "marker": {"color": BAD},
        "hovertemplate": "%{y}: %{x} pairs",
    }
    layout = {
        "xaxis": {"title": {"text": "Pairs rejected (1)"}, "rangemode": "tozero"},
        "yaxis": {"title": {"text": "Rule (name)"}, "automargin": True},
        "showlegend": False,
    }
    caption = "Rules are tried in order, cheapest first; a pair counts for the first that rejects it."
    return [Figure("rejected", "Rejected pairs by rule", caption, (trace,), layout, 150 + 34 * len(rules))]


def _candidates(run: RunData) -> Figure:
    baseline, angle = column(run.pairs, "baseline_m"), column(run.pairs, "view_angle_deg")
    names, reasons = column(run.pairs, "pair_id"), column(run.pairs, "reason")
    selected = column(run.pairs, "selected").astype(bool)
    traces = []
    for rows, name, colour, symbol in ((~selected, "Rejected", BAD, "x-thin"), (selected, "Selected", GOOD, "circle")):
        some = evenly(rows.nonzero()[0], _SHOWN)
        told = [rule_of(reason) or "selected" for reason in reasons[some].tolist()]
        trace: dict[str, Any] = {
            "type": "scatter",
            "mode": "markers",
            "name": name,
            "x": [round(float(value), 3) for value in baseline[some]],
            "y": [round(float(value), 3) for value in angle[some]],
            "text": [f"{pair}: {why}" for pair, why in zip(names[some].tolist(), told, strict=True)],
            "marker": {"color": colour, "symbol": symbol, "size": 7, "line": {"color": colour, "width": 1.5}},
            "hovertemplate": "%{text}<br>%{x:.2f} m, %{y:.1f} deg",
        }
        traces.append(trace)
    layout = {
        "xaxis": {"title": {"text": "Baseline (m)"}, "rangemode": "tozero"},
        "yaxis": {"title": {"text": "Angle between the optical axes (deg)"}, "rangemode": "tozero"},
        "legend": LEGEND_ABOVE,
        "margin": MARGIN_OF_LEGEND,
    }
    caption = "Every candidate pair: how far apart the cameras stood, and how far their axes were turned."
    return Figure("candidates", "Candidate pairs", caption, tuple(traces), layout)
