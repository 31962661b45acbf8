"""Running the stages of a configuration in order, and saying what came out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from pipeline.engine.config import Configuration, Sections, load_workflow, resolve, to_toml
from pipeline.engine.errors import TooManyFailuresError, UsageError
from pipeline.engine.executors import executor_for
from pipeline.engine.progress import Reporter
from pipeline.engine.runfolder import RunFolder, write_text
from pipeline.engine.runner import State, run_stage, staleness
from stages.registry import MODELS, STAGES


def kept_sections(folder: RunFolder) -> Sections:
    """The configuration kept in a run folder.

    Raises:
        UsageError: The folder holds no run.
    """
    sections = load_workflow(folder.workflow, MODELS) if folder.workflow.exists() else {}
    if not sections:
        raise UsageError(
            "E-RUN-04",
            "this folder holds no run",
            where=str(folder.root),
            expected="a folder with workflow.toml",
            hint="epitransfer run WORKFLOW.toml --out RUN, or epitransfer ingest RUN --workflow WORKFLOW.toml",
        )
    return sections


def kept_configuration(folder: RunFolder) -> Configuration:
    """The resolved configuration kept in a run folder."""
    return resolve([("run folder", kept_sections(folder))], MODELS)


def states(folder: RunFolder, configuration: Configuration) -> dict[str, State]:
    """The state of every stage the configuration has a section for; what follows a stale stage is stale."""
    found: dict[str, State] = {}
    waits_for = ""
    for name, stage in STAGES.items():
        if name not in configuration.sections:
            continue
        state = staleness(stage, folder, configuration)
        if state.status == "fresh" and waits_for:
            state = replace(state, status="stale", because=f"{waits_for} has to run first")
        if state.status != "fresh" and not waits_for:
            waits_for = name
        found[name] = state
    return found


def chosen_stages(configuration: Configuration, first: str | None, last: str | None) -> list[str]:
    """The stages a workflow has sections for, between two of them.

    Raises:
        UsageError: A stage is unknown, or the workflow has no section for it.
    """
    names = [name for name in STAGES if name in configuration.sections]
    for name in (first, last):
        if name is not None and name not in names:
            raise UsageError(
                "E-RUN-05",
                f"the workflow has no stage {name}",
                expected=", ".join(names),
                hint=f"add a section [{name}]" if name in STAGES else "one of the stages named",
            )
    begin = names.index(first) if first else 0
    end = names.index(last) + 1 if last else len(names)
    if begin >= end:
        raise UsageError(
            "E-RUN-11",
            f"--from {first} comes after --to {last}",
            expected=", ".join(names),
            hint=f"--from {last} --to {first}",
        )
    return names[begin:end]


def execute(
    folder: RunFolder,
    configuration: Configuration,
    names: Sequence[str],
    *,
    jobs: int,
    scheduler: str | None = None,
    forced: str | None = None,
) -> dict[str, Any]:
    """Runs stages, skipping what is up to date.

    Args:
        folder: The run folder.
        configuration: Resolved.
        names: Stages in order.
        jobs: Processes.
        scheduler: Address of a Dask scheduler.
        forced: A stage that runs even if it is up to date.

    Returns:
        The record of each stage.

    Raises:
        TooManyFailuresError: All ran, but too many items failed.
    """
    reporter = Reporter()
    records: dict[str, Any] = {}
    with folder.locked(), executor_for(jobs, scheduler) as executor:
        write_text(folder.workflow, to_toml(configuration.given))
        for name in names:
            stage = STAGES[name]
            record = folder.record(name)
            if record and name != forced and staleness(stage, folder, configuration).status == "fresh":
                folder.record_path(name).touch()
                reporter.say(f"{name:<12}up to date: {record['summary']}")
            else:
                record = run_stage(stage, folder, configuration, executor, reporter)
                reporter.say(f"{name:<12}{record['summary']} ({record['seconds']:.1f} s)")
            records[name] = record
            if name == "ingest":
                _foresee(configuration, names, record["facts"])
    _check_failures(records, configuration)
    return records


def _foresee(configuration: Configuration, names: Sequence[str], facts: Mapping[str, Any]) -> None:
    for name in names:
        STAGES[name].foresee(configuration.sections[name], configuration.value, facts)


def _check_failures(records: Mapping[str, Any], configuration: Configuration) -> None:
    for name, record in records.items():
        total, failed = record["items"]["total"], record["items"]["failed"]
        allowed = configuration.sections[name].max_failed_share
        if total and failed / total > allowed:
            raise TooManyFailuresError(
                "E-RUN-06",
                f"{name}: too many items failed; the run is finished all the same",
                found=f"{failed} of {total}",
                expected=f"at most {allowed:.0%}",
                hint="nothing is left to go on with; the warnings above and the tables say why"
                if failed == total
                else f"the reasons are in the tables; --set {name}.max_failed_share=1 accepts them",
            )
