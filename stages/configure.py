"""configure: keeps a workflow in a run folder, and each stage's slice of it for Make."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.engine.config import load_workflow, parse_overrides, resolve, to_toml
from pipeline.engine.runfolder import RunFolder, write_json, write_text
from pipeline.engine.runner import stage_slice
from stages.options import Set
from stages.registry import MODELS, STAGES


def command(
    run: Annotated[Path, typer.Argument(help="Run folder; made if it is not there.")],
    workflow: Annotated[Path, typer.Option(help="Workflow file (TOML).")],
    set_: Set = None,
) -> None:
    """Writes RUN/workflow.toml, and RUN/.slices/STAGE.json for every stage whose keys or sources changed."""
    layers = [(workflow.name, load_workflow(workflow, MODELS)), ("command line", parse_overrides(set_ or [], MODELS))]
    configuration = resolve(layers, MODELS)
    folder = RunFolder(run)
    with folder.locked():
        write_text(folder.workflow, to_toml(configuration.given))
        for name in configuration.sections:
            parts = stage_slice(STAGES[name], folder, configuration)
            _write_if_changed(folder.root / ".slices" / f"{name}.json", parts)


def _write_if_changed(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_name(f".{path.name}.new")
    write_json(fresh, value)
    if path.exists() and path.read_bytes() == fresh.read_bytes():
        fresh.unlink()
    else:
        fresh.replace(path)
