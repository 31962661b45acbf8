"""run: every stage of a workflow, in order."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from pipeline.engine.config import Sections, absolute_paths, load_workflow, parse_overrides, resolve
from pipeline.engine.errors import UsageError
from pipeline.engine.executors import usable_cores
from pipeline.engine.runfolder import RunFolder
from stages.options import Device, Jobs, Scheduler, Set, on_device
from stages.registry import MODELS, ON_REQUEST, STAGES
from stages.workflow import chosen_stages, execute

# Whose words end a run, where they are among its stages.
_TELLING = ("score", "report")


def command(
    workflow: Annotated[Path | None, typer.Argument(help="Workflow file (TOML).")] = None,
    out: Annotated[Path, typer.Option(help="Run folder; made, or carried on.")] = Path("run"),
    set_: Set = None,
    first: Annotated[str | None, typer.Option("--from", metavar="STAGE", help="Run again from this stage.")] = None,
    last: Annotated[str | None, typer.Option("--to", metavar="STAGE", help="Stop after this stage.")] = None,
    jobs: Jobs = None,
    device: Device = None,
    scheduler: Scheduler = None,
    photos: Annotated[str | None, typer.Option(help="Photo folder, instead of a workflow.")] = None,
    logs: Annotated[list[str] | None, typer.Option(help="Log or bag with the poses; repeatable.")] = None,
    bags: Annotated[list[str] | None, typer.Option(help="Bag whose images are used too; repeatable.")] = None,
    videos: Annotated[list[str] | None, typer.Option(help="DJI video with its .SRT beside it; repeatable.")] = None,
    camera: Annotated[str | None, typer.Option(help="Camera calibration YAML of all images.")] = None,
    lidar: Annotated[str | None, typer.Option(help="LiDAR tiles to score against, with --photos.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Runs every stage the workflow has a section for; what is up to date is skipped."""
    given = {"photos": photos, "logs": logs, "bags": bags, "videos": videos, "camera": camera}
    layers = [
        _sources(workflow, given, lidar),
        ("command line", parse_overrides(set_ or [], MODELS)),
        ("command line", on_device(device)),
    ]
    configuration = resolve(layers, MODELS)
    if "ingest" not in configuration.sections:
        raise UsageError(
            "E-RUN-07", "the workflow has no [ingest] section", where=str(workflow), hint="add [ingest] photos"
        )
    names = chosen_stages(configuration, first, last)
    folder = RunFolder(out)
    records = execute(folder, configuration, names, jobs=jobs or usable_cores(), scheduler=scheduler, forced=first)
    if as_json:
        typer.echo(json.dumps({"run": str(folder.root), "stages": {k: v["summary"] for k, v in records.items()}}))
    else:
        told = [records[name]["summary"] for name in _TELLING if name in records]
        told = told or [record["summary"] for record in records.values()][-1:] or ["nothing to do"]
        typer.echo(f"{folder.root}: {'; '.join(told)}")


def _sources(workflow: Path | None, ingest: Mapping[str, Any], lidar: str | None) -> tuple[str, Sections]:
    if workflow is not None:
        if workflow.suffix.lower() != ".toml":
            raise UsageError(
                "E-RUN-12",
                "this is no workflow file",
                found=str(workflow),
                expected="a file whose name ends in .toml",
                hint="sources go by option: --photos DIR --logs FILE --logs FILE",
            )
        if clash := [name for name, value in {**ingest, "lidar": lidar}.items() if value]:
            raise UsageError(
                "E-RUN-08",
                f"--{clash[0]} stands in for a workflow file, and one is given",
                found=str(workflow),
                hint=f"use --set {'score.lidar' if clash[0] == 'lidar' else 'ingest.' + clash[0]}=...",
            )
        return workflow.name, load_workflow(workflow, MODELS)
    if not (ingest["photos"] or ingest["bags"] or ingest["videos"]):
        raise UsageError(
            "E-RUN-09",
            "nothing to run",
            expected="WORKFLOW.toml, --photos DIR, --bags FILE or --videos FILE",
            hint="epitransfer run --help",
        )
    sections: Sections = {name: {} for name in STAGES if name not in ON_REQUEST}
    sections["ingest"] = {key: value for key, value in ingest.items() if value}
    if lidar:
        sections["score"] = {"lidar": lidar}
    return "command line", absolute_paths(sections, MODELS, Path.cwd())
