"""One stage on a run folder: the commands `epitransfer STAGE RUN`."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from pipeline.engine.config import Sections, absolute_paths, load_workflow, parse_overrides, resolve
from pipeline.engine.errors import UsageError
from pipeline.engine.executors import usable_cores
from pipeline.engine.runfolder import RunFolder
from stages.options import Device, Jobs, Scheduler, Set, on_device
from stages.registry import MODELS, ON_REQUEST, STAGES
from stages.workflow import execute, kept_sections

Run = Annotated[Path, typer.Argument(help="Run folder.")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout, with every number of the stage.")]


def ingest(
    run: Run,
    workflow: Annotated[Path | None, typer.Option(help="Workflow file; kept in the run folder.")] = None,
    photos: Annotated[str | None, typer.Option(help="Photo folder.")] = None,
    logs: Annotated[list[str] | None, typer.Option(help="Log or bag with the poses; repeatable.")] = None,
    bags: Annotated[list[str] | None, typer.Option(help="Bag whose images are used too; repeatable.")] = None,
    videos: Annotated[list[str] | None, typer.Option(help="DJI video with its .SRT beside it; repeatable.")] = None,
    camera: Annotated[str | None, typer.Option(help="Camera calibration YAML.")] = None,
    set_: Set = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    as_json: AsJson = False,
) -> None:
    """Reads the sources; takes them from a workflow file, the options, or the run folder."""
    folder = RunFolder(run)
    layers: list[tuple[str, Sections]] = []
    if workflow is not None:
        layers.append((workflow.name, load_workflow(workflow, MODELS)))
    elif logs and not (photos or bags or videos or folder.workflow.exists()):
        raise UsageError(
            "E-RUN-09",
            "nothing to run",
            found="a log alone",
            expected="--photos DIR, --bags FILE or --videos FILE beside it",
            hint="epitransfer ingest --help",
        )
    elif not (photos or bags or videos) or folder.workflow.exists():
        layers.append(("run folder", kept_sections(folder)))
    else:
        layers.append(("default", {name: {} for name in STAGES if name not in ON_REQUEST}))
    named = {"photos": photos, "logs": logs, "bags": bags, "videos": videos, "camera": camera}
    given = {key: value for key, value in named.items() if value}
    layers.append(("command line", absolute_paths({"ingest": given}, MODELS, Path.cwd())))
    _run("ingest", folder, layers, set_, jobs, scheduler, as_json=as_json)


def match(
    run: Run,
    set_: Set = None,
    jobs: Jobs = None,
    device: Device = None,
    scheduler: Scheduler = None,
    as_json: AsJson = False,
) -> None:
    """Runs match with the configuration kept in the run folder."""
    layers = [*_kept("match", run), ("command line", on_device(device))]
    _run("match", RunFolder(run), layers, set_, jobs, scheduler, as_json=as_json)


def _kept(name: str, run: Path) -> list[tuple[str, Sections]]:
    # A stage the kept workflow has no section for runs with its defaults.
    return [("default", {name: {}}), ("run folder", kept_sections(RunFolder(run)))]


def _stage_command(name: str) -> Callable[..., None]:
    def command(
        run: Run, set_: Set = None, jobs: Jobs = None, scheduler: Scheduler = None, as_json: AsJson = False
    ) -> None:
        _run(name, RunFolder(run), _kept(name, run), set_, jobs, scheduler, as_json=as_json)

    command.__doc__ = f"Runs {name} with the configuration kept in the run folder."
    return command


def _run(
    name: str,
    folder: RunFolder,
    layers: list[tuple[str, Sections]],
    set_: list[str] | None,
    jobs: int | None,
    scheduler: str | None,
    *,
    as_json: bool,
) -> None:
    configuration = resolve([*layers, ("command line", parse_overrides(set_ or [], MODELS))], MODELS)
    records = execute(folder, configuration, [name], jobs=jobs or usable_cores(), scheduler=scheduler)
    typer.echo(json.dumps(_told(folder, name, records[name])) if as_json else records[name]["summary"])


def _told(folder: RunFolder, name: str, record: Mapping[str, Any]) -> dict[str, Any]:
    """What a stage recorded, and the JSON files among its outputs by their names."""
    files = sorted(file for output in record["outputs"] for file in folder.output(output).glob("*.json"))
    told = ("summary", "items", "facts", "warnings", "seconds", "peak_memory_mib")
    return {
        "run": str(folder.root),
        "stage": name,
        **{key: record[key] for key in told},
        **{file.stem: json.loads(file.read_text(encoding="utf-8")) for file in files},
    }


pair, refine, depth, fuse, score, sensitivity, report = (
    _stage_command(name) for name in ("pair", "refine", "depth", "fuse", "score", "sensitivity", "report")
)
