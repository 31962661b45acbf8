"""What wrong poses would do: error against injected error, a curve per take, epipoles in the image marked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pipeline.reporting.figure import LEGEND_ABOVE, MARGIN_OF_LEGEND, Figure
from pipeline.reporting.palette import BAD, TAKES


def figures(sensitivity: Mapping[str, Any] | None) -> list[Figure]:
    """A figure per kind of injected error; none where the stage was not run.

    Args:
        sensitivity: The object of sensitivity.json.
    """
    if sensitivity is None:
        return []
    rows = [row for row in sensitivity["curves"] if row["method"] == sensitivity["method"] and row["n"]]
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    return [_figure(kind, [row for row in rows if row["kind"] == kind], sensitivity) for kind in kinds]


def _figure(kind: str, rows: Sequence[Mapping[str, Any]], sensitivity: Mapping[str, Any]) -> Figure:
    words = kind.replace("_", " ")
    layout = {
        "xaxis": {"title": {"text": f"Injected {words} error ({rows[0]['unit']})"}},
        "yaxis": {"title": {"text": f"AbsRel beside {sensitivity['reference']} (1)"}, "type": "log"},
        "legend": LEGEND_ABOVE,
        "margin": MARGIN_OF_LEGEND,
    }
    caption = (
        "Solid: the pose with the error as it is. Dotted: after the pair was refined. Rings: the epipole lies inside "
    )
    caption += "the image of some pair there, where depth is lost whatever the method."
    return Figure(f"sensitivity-{kind}", f"Sensitivity to {words}", caption, tuple(_traces(rows)), layout, 400)


def _traces(rows: Sequence[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    takes = list(dict.fromkeys(row["take"] for row in rows))
    for number, take in enumerate(takes):
        colour = TAKES[number % len(TAKES)]
        for refined, way in ((False, "as injected"), (True, "refined")):
            some = sorted((r for r in rows if r["take"] == take and r["refined"] == refined), key=_injected)
            yield {
                "type": "scatter",
                "mode": "lines+markers",
                "name": take,
                "legendgroup": take,
                "showlegend": not refined,
                "x": [row["injected"] for row in some],
                "y": [row["abs_rel"] for row in some],
                "customdata": [row["n"] for row in some],
                "hovertemplate": f"{way}: %{{x}}, AbsRel %{{y:.4f}} (%{{customdata:,}} pixels)",
                "line": {"color": colour, "width": 2, "dash": "dot" if refined else "solid"},
                "marker": {"size": 5},
            }
    marked = [row for row in rows if row["marked"] and not row["refined"]]
    if marked:
        yield {
            "type": "scatter",
            "mode": "markers",
            "name": "Epipole in the image",
            "x": [row["injected"] for row in marked],
            "y": [row["abs_rel"] for row in marked],
            "marker": {"symbol": "circle-open", "size": 13, "color": BAD, "line": {"width": 2}},
            "hoverinfo": "skip",
        }


def _injected(row: Mapping[str, Any]) -> float:
    return float(row["injected"])
