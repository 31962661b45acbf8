"""The page: one HTML file that needs no other, from a run's numbers, tables and figures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from pipeline.reporting import (
    accuracy_plots,
    calibration_plot,
    cloud_view,
    error_plots,
    flown,
    overlays,
    pair_plots,
    sensitivity_plots,
    timing_plot,
    verdict,
)
from pipeline.reporting.figure import Figure, OverlayRow
from pipeline.reporting.gathered import RunData
from pipeline.reporting.quality import untrained
from pipeline.reporting.tables import (
    Table,
    accuracy_tables,
    checkpoint_table,
    cloud_table,
    configuration_table,
    control_table,
    frame_table,
    m3c2_table,
    provenance_table,
    stage_table,
)


@dataclass(frozen=True, slots=True)
class Section:
    """A section of the page.

    Args:
        key: Its anchor.
        title: Its heading.
        lead: A sentence below the heading.
        tables: Its tables, before the figures.
        figures: Its figures.
        rows: Pictures of frames side by side.
        folded: Tables that are folded away on the screen.
    """

    key: str
    title: str
    lead: str
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()
    rows: tuple[OverlayRow, ...] = ()
    folded: tuple[Table, ...] = ()

    @property
    def all_figures(self) -> tuple[Figure, ...]:
        """Its figures, those of the rows among them."""
        return (*self.figures, *(panel for row in self.rows for panel in row.panels))


def sections(run: RunData, numbers: dict[str, Any]) -> list[Section]:
    """The sections below the minute, those without content left out.

    Args:
        run: The run.
        numbers: The object of report.json.
    """
    del numbers
    found = [
        _accuracy(run),
        Section(
            "where",
            "Where",
            "What was flown over what, and the points it gave.",
            figures=(*flown.figures(run), *cloud_view.figures(run)),
        ),
        Section(
            "pictures",
            "Pictures",
            "Depths on the photos, a column per method. Black or bare photo is no depth: none was published there.",
            rows=tuple(overlays.rows(run)),
        ),
        Section(
            "uncertainty",
            "Uncertainty",
            "Whether errors are as large as the sigmas say.",
            figures=tuple(calibration_plot.figures(run.metrics)) if run.metrics else (),
        ),
        Section(
            "pairs",
            "Pairs",
            "Which frames were paired, and which rule rejected the others.",
            figures=tuple(pair_plots.figures(run)),
        ),
        Section(
            "sensitivity",
            "Sensitivity",
            "What an error of the logged pose would do to the depths.",
            figures=tuple(sensitivity_plots.figures(run.sensitivities)),
        ),
        _run(run),
    ]
    return [one for one in found if one.tables or one.figures or one.rows or one.folded]


def _accuracy(run: RunData) -> Section:
    metrics = run.metrics
    if metrics is None:
        return Section("accuracy", "Accuracy", "")
    random = untrained(run)
    others = (
        checkpoint_table(metrics.get("checkpoints")),
        control_table(metrics.get("control_points")),
        cloud_table(metrics.get("cloud")),
        m3c2_table(metrics.get("m3c2_ep")),
    )
    return Section(
        "accuracy",
        "Accuracy",
        "Estimated depths beside the reference, the methods beside one another. Arrows point to the better side.",
        tables=(*accuracy_tables(metrics, random), *(table for table in others if table)),
        figures=(*accuracy_plots.figures(metrics, random), *error_plots.figures(run)),
    )


def _run(run: RunData) -> Section:
    frames = frame_table(run)
    return Section(
        "run",
        "Run",
        "What each stage did and took, what it was told, and what it wrote.",
        tables=(stage_table(run.records),),
        figures=tuple(timing_plot.figures(run.records)),
        folded=(
            *((frames,) if frames else ()),
            configuration_table(run.records),
            provenance_table(run.records),
        ),
    )


def page(numbers: dict[str, Any], parts: Sequence[Section]) -> str:
    """The HTML of the report.

    Args:
        numbers: The object of report.json.
        parts: The sections.
    """
    environment = Environment(
        loader=PackageLoader("pipeline.reporting", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["figure_json"] = figure_json
    return environment.get_template("report.html.jinja").render(
        title=numbers["title"],
        headline=verdict.headline(numbers),
        minute=(
            ("What was flown", verdict.flown_lines(numbers)),
            ("What came out", verdict.out_lines(numbers)),
            ("How good", verdict.good_lines(numbers)),
        ),
        doubts=verdict.doubt_lines(numbers),
        sections=parts,
        # The library's own text: nothing of a user's is in it.
        plotly=Markup(_plotly()),  # noqa: S704
    )


def figure_json(figure: Figure) -> Markup:
    """A figure's data for a script element: no text in it can end the element."""
    text = json.dumps({"traces": figure.traces, "layout": figure.layout}, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))  # noqa: S704


def _plotly() -> str:
    return (resources.files("plotly") / "package_data" / "plotly.min.js").read_text(encoding="utf-8")
