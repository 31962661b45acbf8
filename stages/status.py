"""status: which stages are fresh, stale or missing, and because of what."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from pipeline.engine.runfolder import RunFolder
from pipeline.engine.runner import staleness
from stages.registry import STAGES
from stages.workflow import kept_configuration


def command(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Compares each stage's inputs and configuration with what its outputs were made from."""
    folder = RunFolder(run)
    configuration = kept_configuration(folder)
    rows: dict[str, dict[str, str]] = {}
    waits_for = ""
    for name, stage in STAGES.items():
        if name not in configuration.sections:
            continue
        state = staleness(stage, folder, configuration)
        status, because = state.status, state.because
        if status == "fresh" and waits_for:
            status, because = "stale", f"{waits_for} has to run first"
        if status != "fresh" and not waits_for:
            waits_for = name
        rows[name] = {"status": status, "because": because, "summary": (folder.record(name) or {}).get("summary", "")}
    if as_json:
        typer.echo(json.dumps({"run": str(folder.root), "stages": rows}))
        return
    for name, row in rows.items():
        typer.echo(f"{name:<8}{row['status']:<9}{row['because'] or row['summary']}")
