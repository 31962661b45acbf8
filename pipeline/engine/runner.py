"""Runs a stage: staleness, inputs checked, outputs made aside, checked and committed, the record kept."""

from __future__ import annotations

import json
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.engine.config import Configuration, is_path
from pipeline.engine.digests import FileDigests, digest_json, digest_tree
from pipeline.engine.errors import EpiTransferError, InputError, MissingPartError
from pipeline.engine.executors import Executor, SerialExecutor
from pipeline.engine.progress import Reporter
from pipeline.engine.runfolder import DATASETS, RunFolder, output_name, tree_size, write_text
from pipeline.engine.stage import Stage
from pipeline.engine.tables import check_stored, parquet_files, read_table, write_pieces, write_table
from schemas import TABLES

# What changes no output, so that following a hint about it does not run the stage again.
NOT_IN_KEY = frozenset({"max_failed_share"})
# What a record tells of the machine rather than of the outputs.
MEASURED = frozenset({"seconds", "peak_memory_mib"})

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class State:
    """Whether a stage's outputs are what its inputs and configuration would give.

    Args:
        name: The stage.
        status: "fresh", "stale", "missing", or "failed" when the last attempt with this key ended in an error.
        because: Which keys or inputs changed, or the error; empty when fresh.
        key: The staleness key.
        parts: What the key is made of.
    """

    name: str
    status: str
    because: str
    key: str
    parts: Mapping[str, Any]


def staleness(stage: Stage, folder: RunFolder, configuration: Configuration) -> State:
    """Compares what a stage would run with now with what it last ran with."""
    parts = _key_parts(stage, folder, configuration)
    key = digest_json(parts)
    record = folder.record(stage.name)
    failure = folder.failure(stage.name, key)
    if failure.exists():
        return State(stage.name, "failed", failure.read_text(encoding="utf-8").splitlines()[0], key, parts)
    if record is None:
        return State(stage.name, "missing", "never run", key, parts)
    if record["key"] != key:
        changed = sorted(name for name in {*parts, *record["parts"]} if parts.get(name) != record["parts"].get(name))
        return State(stage.name, "stale", "changed: " + ", ".join(changed), key, parts)
    if not folder.intact(record):
        return State(stage.name, "stale", "an output is missing or was changed", key, parts)
    return State(stage.name, "fresh", "", key, parts)


def stage_slice(stage: Stage, folder: RunFolder, configuration: Configuration) -> dict[str, Any]:
    """What a stage's outputs depend on besides its input tables: its version, the keys it reads, its sources."""
    config = configuration.sections[stage.name]
    digests = FileDigests(folder.cache / "digests.json")
    parts: dict[str, Any] = {"stage version": stage.version}
    for name, info in type(config).model_fields.items():
        # Sources enter by content, below: a folder that moved is the same source.
        if name not in NOT_IN_KEY and (not is_path(info) or isinstance(getattr(config, name), int | float)):
            parts[f"{stage.name}.{name}"] = config.model_dump(mode="json")[name]
    for key in stage.reads:
        parts[key] = _by_content(configuration, key, digests)
    try:
        sources = stage.sources(config)
        if stage.place:
            parts["place of the sources"] = stage.place[1](config)
    except MissingPartError as error:
        # Weights that are not found here: as far as anyone can tell they are the same.
        known = (folder.record(stage.name) or {}).get("parts", {})
        parts["sources"], sources = known.get("sources", error.message), ()
    except InputError as error:
        # Whether outputs are fresh can be asked without the sources at hand; running the stage tells what is missing.
        parts["sources"], sources = error.message, ()
    if sources:
        parts["sources"] = digests.of_all(sources)
    if folder.root.exists():
        digests.save()
    # A trip through JSON, so that a key compares equal with the one kept in the record.
    plain: dict[str, Any] = json.loads(json.dumps(parts, default=str))
    return plain


def _key_parts(stage: Stage, folder: RunFolder, configuration: Configuration) -> dict[str, Any]:
    parts = stage_slice(stage, folder, configuration)
    for upstream in stage.facts_of:
        earlier = folder.record(upstream) or {}
        facts = {key: value for key, value in earlier.get("facts", {}).items() if key != earlier.get("place")}
        parts[f"facts of {upstream}"] = digest_json(facts)
    for upstream in stage.records_of:
        told = {key: value for key, value in (folder.record(upstream) or {}).items() if key not in MEASURED}
        parts[f"record of {upstream}"] = digest_json(told)
    for name in stage.inputs:
        parts[name] = _input_digest(folder, name)
    return parts


def _by_content(configuration: Configuration, key: str, digests: FileDigests) -> Any:
    """Another stage's value as it enters a key: a file by its bytes, all else as it is."""
    value = configuration.value(key)
    section, _, name = key.partition(".")
    config = configuration.sections.get(section)
    names_file = config is not None and is_path(type(config).model_fields[name]) and isinstance(value, str)
    return digests.of(value) if names_file and Path(value).exists() else value


def _input_digest(folder: RunFolder, name: str) -> str:
    for path in sorted((folder.root / ".stages").glob("*.json")):
        outputs = (folder.record(path.stem) or {}).get("outputs", {})
        for output, entry in outputs.items():
            if output.rstrip("/") == name:
                return str(entry["sha256"])
    return "missing"


def run_stage(
    stage: Stage, folder: RunFolder, configuration: Configuration, executor: Executor, reporter: Reporter
) -> dict[str, Any]:
    """Runs one stage and commits its outputs.

    Returns:
        The stage's record.

    Raises:
        InputError: An input is missing or of another schema.
        EpiTransferError: What the stage itself raises; the last good outputs stay.
    """
    state = staleness(stage, folder, configuration)
    # A dataset without a schema is of files that not every run has.
    for name in (name for name in stage.inputs if name.rstrip("/") in TABLES):
        if not folder.output(name).exists():
            if name in stage.optional:
                continue
            raise InputError(
                "E-RUN-02",
                f"{stage.name} needs {name}, which is not there",
                where=str(folder.output(name)),
                expected="the table of an earlier stage",
                hint=f"run the stages before {stage.name} first; a workflow needs a section for each of them",
            )
        check_stored(folder.output(name), name.rstrip("/"))
    work = folder.work(stage.name, state.key)
    context = _StageContext(stage, folder, configuration, executor, reporter, work)
    for name in stage.outputs:
        if output_name(name) in DATASETS:
            (work / output_name(name)).mkdir(exist_ok=True)
    began = time.monotonic()
    failure = folder.failure(stage.name, state.key)
    failure.unlink(missing_ok=True)
    try:
        summary = stage.run(configuration.sections[stage.name], context)
    except EpiTransferError as error:
        with suppress(OSError):
            write_text(failure, f"{error}\n")
        raise
    record = {
        "version": stage.version,
        "summary": summary,
        "key": state.key,
        "parts": dict(state.parts),
        "config": _explained_config(stage, configuration),
        "outputs": {name: _output_entry(work, name) for name in stage.outputs},
        "items": context.items,
        "facts": context.facts_recorded,
        "place": stage.place[0] if stage.place else None,
        "warnings": context.warnings,
        "seconds": round(time.monotonic() - began, 3),
        "peak_memory_mib": peak_memory_mib(),
    }
    _drop_strays(work, stage)
    folder.commit(stage.name, work, record)
    return record


def _explained_config(stage: Stage, configuration: Configuration) -> dict[str, Any]:
    values = configuration.sections[stage.name].model_dump(mode="json")
    return {
        key: {"value": value, "from": configuration.origins[f"{stage.name}.{key}"]} for key, value in values.items()
    }


def _output_entry(work: Path, name: str) -> dict[str, Any]:
    path = work / output_name(name)
    if not path.exists():
        raise InputError("E-RUN-03", f"the stage did not write {name}", where=str(path))
    entry: dict[str, Any] = {"sha256": digest_tree(path), "bytes": tree_size(path)}
    schema = TABLES.get(name.rstrip("/"))
    if schema is not None:
        files = parquet_files(path)
        for file in files:
            schema.check_schema(_stored_schema(file))
        entry["rows"] = sum(pq.read_metadata(file).num_rows for file in files)
        entry["table_version"] = schema.version
    return entry


def _stored_schema(file: Path) -> pa.Schema:
    # Extension types (the geometry) are compared by what they store.
    return pq.ParquetFile(file, arrow_extensions_enabled=False).schema_arrow


def _drop_strays(work: Path, stage: Stage) -> None:
    wanted = {output_name(name) for name in stage.outputs}
    for path in work.iterdir():
        if path.name not in wanted:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def peak_memory_mib() -> float:
    """Largest resident size of this process or any finished worker so far, MiB."""
    unit = 1024.0 if sys.platform != "darwin" else 1024.0**2
    usage = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return round(max(usage) / unit, 1)


@dataclass(slots=True)
class _StageContext:
    """What a stage sees of the engine; see `pipeline.engine.stage.Context`."""

    stage: Stage
    folder: RunFolder
    configuration: Configuration
    executor: Executor
    reporter: Reporter
    work: Path
    items: dict[str, int] = field(default_factory=lambda: {"total": 0, "failed": 0})
    facts_recorded: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @property
    def cache(self) -> Path:
        self.folder.cache.mkdir(parents=True, exist_ok=True)
        return self.folder.cache

    @property
    def scratch(self) -> Path:
        folder = self.work / "scratch"
        folder.mkdir(exist_ok=True)
        return folder

    def read(self, name: str) -> pa.Table:
        return read_table(self.path(name), name)

    def path(self, name: str) -> Path:
        if name not in self.stage.inputs:
            raise KeyError(f"{self.stage.name} does not declare the input {name}")
        return self.folder.output(name)

    def output(self, name: str) -> Path:
        if name not in self.stage.outputs:
            raise KeyError(f"{self.stage.name} does not declare the output {name}")
        return self.work / output_name(name)

    def write(self, name: str, table: pa.Table) -> None:
        TABLES[name].check(table)
        write_table(self.output(name), table)

    def write_pieces(self, name: str, pieces: Iterable[pa.Table]) -> None:
        write_pieces(self.output(name), TABLES[name].arrow(), (_checked(name, piece) for piece in pieces))

    def setting(self, key: str) -> Any:
        if key not in self.stage.reads:
            raise KeyError(f"{self.stage.name} does not declare that it reads {key}")
        return self.configuration.value(key)

    def facts(self, stage: str) -> Mapping[str, Any]:
        if stage not in self.stage.facts_of:
            raise KeyError(f"{self.stage.name} does not declare that it reads the facts of {stage}")
        facts: Mapping[str, Any] = (self.folder.record(stage) or {}).get("facts", {})
        return facts

    def records(self) -> Mapping[str, Mapping[str, Any]]:
        found = {stage: self.folder.record(stage) for stage in self.stage.records_of}
        return {stage: record for stage, record in found.items() if record is not None}

    def record(self, key: str, value: Any) -> None:
        self.facts_recorded[key] = value

    def warn(self, text: str) -> None:
        self.warnings.append(text)
        self.reporter.say(f"warning: {text}")

    def count_items(self, total: int, failed: int) -> None:
        self.items = {"total": total, "failed": failed}

    def map(
        self,
        function: Callable[[Sequence[Item]], Result],
        items: Iterable[Item],
        *,
        shard: int,
        label: str,
        here: bool = False,
    ) -> Iterator[Result]:
        listed = list(items)
        shards = list(_shards(listed, shard))
        with self.reporter.meter(self.stage.name, label, len(listed)) as meter:
            for part, result in zip(shards, self._executor(here).map(function, shards), strict=True):
                meter.advance(len(part))
                yield result

    def map_tables(
        self,
        name: str,
        function: Callable[[Sequence[Item]], pa.Table],
        items: Iterable[Item],
        *,
        shard: int,
        label: str,
        here: bool = False,
    ) -> None:
        numbered = list(enumerate(_shards(list(items), shard)))
        job = partial(_write_part, self.output(name), name, function)
        with self.reporter.meter(self.stage.name, label, sum(len(part) for _, part in numbered)) as meter:
            for (_, part), _done in zip(numbered, self._executor(here).map(job, numbered), strict=True):
                meter.advance(len(part))

    def _executor(self, here: bool) -> Executor:
        return SerialExecutor() if here else self.executor


def _checked(name: str, table: pa.Table) -> pa.Table:
    TABLES[name].check(table)
    return table


def _write_part(
    folder: Path, name: str, function: Callable[[Sequence[Item]], pa.Table], numbered: tuple[int, Sequence[Item]]
) -> None:
    index, items = numbered
    path = folder / f"part-{index:05d}.parquet"
    if path.exists():
        return
    table = function(items)
    TABLES[name].check(table)
    temporary = path.with_suffix(".tmp")
    write_table(temporary, table)
    temporary.replace(path)


def _shards(items: Sequence[Item], size: int) -> Iterator[Sequence[Item]]:
    source = iter(items)
    while part := list(islice(source, size)):
        yield part
