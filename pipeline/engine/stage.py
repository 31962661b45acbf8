"""What a stage is and what it is given: the two small interfaces between the engine and the steps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

import pyarrow as pa
from pydantic import BaseModel, ConfigDict, Field

Item = TypeVar("Item")
Result = TypeVar("Result")


class StageConfig(BaseModel):
    """Base of every stage's configuration: frozen, and an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    max_failed_share: float = Field(
        default=0.5, ge=0.0, le=1.0, description="Share of items that may fail before the run ends with exit code 8 (1)"
    )


class Context(Protocol):
    """What the engine lends a stage while it runs. A stage touches the run folder through this alone."""

    def read(self, name: str) -> pa.Table:
        """An input table as a whole, its schema checked."""

    def path(self, name: str) -> Path:
        """Where an input table (a file) or dataset (a folder) lies."""

    def output(self, name: str) -> Path:
        """Where to write an output: a file `NAME.parquet` or, for datasets, a folder that exists."""

    def write(self, name: str, table: pa.Table) -> None:
        """Writes an output table as a whole."""

    def write_pieces(self, name: str, pieces: Iterable[pa.Table]) -> None:
        """Writes an output table from pieces that need not fit into memory together."""

    def setting(self, key: str) -> Any:
        """The value of another stage's key ("ingest.geoid"); the stage must declare it in `reads`."""

    def facts(self, stage: str) -> Mapping[str, Any]:
        """What an earlier stage recorded with `record`."""

    def records(self) -> Mapping[str, Mapping[str, Any]]:
        """The records of the finished stages among `records_of`: configuration, outputs, facts, warnings, timings."""

    def record(self, key: str, value: Any) -> None:
        """Records a fact (JSON value) of this run in the manifest: an assumption made, a count, a source."""

    def warn(self, text: str) -> None:
        """Tells the user on stderr, and keeps the text in the manifest."""

    def count_items(self, total: int, failed: int) -> None:
        """Tells how many items the stage had and how many became rows with a reason instead of a result."""

    def map(
        self,
        function: Callable[[Sequence[Item]], Result],
        items: Iterable[Item],
        *,
        shard: int,
        label: str,
        here: bool = False,
    ) -> Iterator[Result]:
        """Applies a picklable function to shards of items, in parallel, results in order.

        Progress is shown per item. The results do not depend on the number of processes. With `here` it runs in this
        process alone: for work that a device does, not the cores.
        """

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
        """As `map`, each shard's table written as one part of the output dataset `name`.

        A part that an interrupted run with the same key has finished is not made again.
        """

    @property
    def scratch(self) -> Path:
        """A folder for what the stage needs between its own passes; it is gone afterwards."""

    @property
    def cache(self) -> Path:
        """A folder for content-addressed files that later runs may reuse."""


def nothing_to_foresee(config: Any, setting: Callable[[str], Any], facts: Mapping[str, Any]) -> None:
    """For stages whose refusals depend on the tables they read."""
    del config, setting, facts


def no_sources(config: Any) -> Sequence[Path]:
    """For stages that read nothing from outside the run folder."""
    del config
    return ()


@dataclass(frozen=True, slots=True)
class Stage:
    """One step of the pipeline.

    Args:
        name: The command's and the configuration section's name.
        version: Raised whenever the same inputs would give other outputs.
        config: The configuration's model.
        inputs: Tables and datasets of the run folder it reads.
        outputs: Those it writes; a name with a trailing "/" is a dataset folder.
        run: The work, from configuration and context to outputs; returns a line for people.
        reads: Keys of other stages' configuration it reads, "ingest.geoid".
        facts_of: Stages whose recorded facts it reads; those facts are part of its staleness key.
        records_of: Stages whose whole records it reads; all but how long they took is part of its staleness key.
        sources: Files from outside the run folder that it reads; their bytes are part of its staleness key.
        foresee: Raises what the stage would refuse anyway, from configuration and the facts of ingest alone, so that a
            run is refused before the long stages and not after them.
        optional: Inputs that a run may lack.
        place: The fact that tells where the sources lie, and how it follows from the configuration. The stage runs
            again when they moved, to tell it anew; later stages do not, for what they were made from is the same.
    """

    name: str
    version: int
    config: type[StageConfig]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    run: Callable[[Any, Context], str]
    reads: tuple[str, ...] = ()
    facts_of: tuple[str, ...] = ()
    records_of: tuple[str, ...] = ()
    sources: Callable[[Any], Sequence[Path | str]] = field(default=no_sources)
    foresee: Callable[[Any, Callable[[str], Any], Mapping[str, Any]], None] = field(default=nothing_to_foresee)
    optional: tuple[str, ...] = ()
    place: tuple[str, Callable[[Any], str]] | None = None
