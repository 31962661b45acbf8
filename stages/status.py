"""status: which stages are fresh, stale or missing, and because of what."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from pipeline.engine.runfolder import RunFolder
from stages.workflow import kept_configuration, states


def command(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Compares each stage's inputs and configuration with what its outputs were made from."""
    folder = RunFolder(run)
    configuration = kept_configuration(folder)
    rows = {
        name: {
            "status": state.status,
            "because": state.because,
            "summary": (folder.record(name) or {}).get("summary", ""),
        }
        for name, state in states(folder, configuration).items()
    }
    if as_json:
        typer.echo(json.dumps({"run": str(folder.root), "stages": rows}))
        return
    for name, row in rows.items():
        typer.echo(f"{name:<8}{row['status']:<9}{row['because'] or row['summary']}")
