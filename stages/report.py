"""report: what was flown, what came out, how good, what to distrust: one page that needs no other file."""

from __future__ import annotations

import json

from pydantic import Field

from pipeline.engine.runfolder import json_text
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.reporting.gathered import RunData

_INPUTS = (
    "frames",
    "refined_cameras",
    "poses",
    "pairs",
    "relative_poses",
    "matches",
    "depths",
    "images",
    "points",
    "scores",
    "sensitivity",
)
_OPTIONAL = ("points", "scores", "sensitivity")


class Config(StageConfig):
    """What the page is called."""

    title: str | None = Field(None, min_length=1, description="Heading of the page; left out, the flight's date")


def run(config: Config, context: Context) -> str:
    """Writes `report/index.html`, and `report/report.json` with every number in it."""
    # Templates and plotly take their time to load, and no other stage needs them.
    from pipeline.reporting.numbers import numbers  # noqa: PLC0415
    from pipeline.reporting.page import page, sections  # noqa: PLC0415

    places = {name: context.path(name) for name in _INPUTS}
    gathered = RunData({name: path for name, path in places.items() if path.exists()}, context.records())
    found = numbers(gathered, config.title)
    folder = context.output("report")
    (folder / "index.html").write_text(page(found, sections(gathered, found)), encoding="utf-8")
    (folder / "report.json").write_text(json_text(json.loads(json.dumps(found, default=str))), encoding="utf-8")
    grave = sum(doubt["rank"] == "grave" for doubt in found["distrust"])
    return f"report/index.html, {len(found['distrust'])} things to distrust, {grave} of them grave"


STAGE = Stage(
    "report",
    1,
    Config,
    _INPUTS,
    ("report",),
    run,
    records_of=("ingest", "pair", "match", "refine", "depth", "fuse", "score", "sensitivity"),
    optional=_OPTIONAL,
)
