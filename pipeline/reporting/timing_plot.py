"""What each stage took."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.reporting.figure import LEGEND_ABOVE, MARGIN_OF_LEGEND, Figure
from pipeline.reporting.palette import colours


def figures(records: Mapping[str, Mapping[str, Any]]) -> list[Figure]:
    """Seconds and peak memory of each stage."""
    stages = list(records)
    if not stages:
        return []
    shades = colours(["epitransfer", "dlt"])
    traces = (
        {
            "type": "bar",
            "name": "Time",
            "x": stages,
            "y": [records[stage]["seconds"] for stage in stages],
            "marker": {"color": shades["epitransfer"]},
            "offsetgroup": "time",
            "hovertemplate": "%{x}: %{y:.1f} s",
        },
        {
            "type": "bar",
            "name": "Peak memory",
            "x": stages,
            "y": [records[stage]["peak_memory_mib"] for stage in stages],
            "yaxis": "y2",
            "marker": {"color": shades["dlt"]},
            "offsetgroup": "memory",
            "hovertemplate": "%{x}: %{y:,.0f} MiB",
        },
    )
    layout = {
        "xaxis": {"title": {"text": "Stage (name)"}},
        "yaxis": {"title": {"text": "Time (s)"}, "rangemode": "tozero"},
        "yaxis2": {
            "title": {"text": "Peak memory (MiB)"},
            "overlaying": "y",
            "side": "right",
            "rangemode": "tozero",
            "showgrid": False,
        },
        "barmode": "group",
        "legend": LEGEND_ABOVE,
        "margin": MARGIN_OF_LEGEND,
    }
    caption = "Wall time and peak memory of each stage's last run; stages that were up to date kept theirs."
    return [Figure("timings", "Time and memory", caption, traces, layout, 360)]
