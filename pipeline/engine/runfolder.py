"""The run folder: records of finished stages, the commit of a stage's outputs, and the manifest.

A stage's outputs are made in `.work/`, renamed as a whole to `.pending/STAGE` (the commit), and rolled forward from
there: old output aside, new one in place, the stage's record last. Opening a folder finishes what a killed run had
committed.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.engine.errors import ResourceError, UsageError
from schemas import TABLES

RECORD = "record.json"
FAILURE = "failure.txt"
DATASETS = frozenset({"matches", "depths", "points", "scores", "images", "sweeps", "report", "sensitivity"})


class RunFolder:
    """A folder that holds one run.

    Args:
        root: The folder; made when it is missing.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()

    @property
    def workflow(self) -> Path:
        """The configuration the run was made with."""
        return self.root / "workflow.toml"

    @property
    def cache(self) -> Path:
        """Content-addressed files that later runs may reuse."""
        return self.root / ".cache"

    def output(self, name: str) -> Path:
        """Where a table or dataset lies."""
        return self.root / output_name(name)

    def record_path(self, stage: str) -> Path:
        """The record of the stage's last successful run: the target a Make rule waits for."""
        return self.root / ".stages" / f"{stage}.json"

    def record(self, stage: str) -> dict[str, Any] | None:
        """The record of the stage's last successful run."""
        try:
            record = json.loads(self.record_path(stage).read_text())
        except (OSError, ValueError):
            return None
        # A damaged record is none: the stage runs again.
        return record if isinstance(record, dict) and {"key", "parts", "outputs", "items"} <= record.keys() else None

    def intact(self, record: dict[str, Any]) -> bool:
        """Whether the outputs a record names are still there in their recorded size."""
        return all(
            (path := self.output(name)).exists() and tree_size(path) == entry["bytes"]
            for name, entry in record["outputs"].items()
        )

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Holds the folder for one process and finishes what a killed one left.

        Raises:
            UsageError: Another process holds it.
            ResourceError: It cannot be made or written.
        """
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            lock = (self.root / ".lock").open("w")
        except OSError as error:
            raise ResourceError(
                "E-RUN-10",
                "the run folder cannot be written",
                where=str(self.root),
                found=error.strerror or str(error),
                expected="a folder that may be made or written",
                hint="give another --out",
            ) from error
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise UsageError(
                    "E-RUN-01",
                    "another process works on this run folder",
                    where=str(self.root),
                    hint="wait for it, or use another --out",
                ) from error
            self.recover()
            yield

    def work(self, stage: str, key: str) -> Path:
        """A folder to make outputs in; one left by a killed run with the same key is taken up again."""
        folder = self.root / ".work" / f"{stage}-{key[:16]}"
        for other in (self.root / ".work").glob(f"{stage}-*"):
            if other != folder:
                shutil.rmtree(other)
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def failure(self, stage: str, key: str) -> Path:
        """Where the error of the last attempt with this key is kept until it is tried again."""
        return self.root / ".work" / f"{stage}-{key[:16]}" / FAILURE

    def commit(self, stage: str, work: Path, record: dict[str, Any]) -> None:
        """Puts a stage's outputs in place together with its record."""
        write_json(work / RECORD, record)
        pending = self.root / ".pending" / stage
        pending.parent.mkdir(exist_ok=True)
        work.rename(pending)
        self._roll_forward(pending)

    def recover(self) -> None:
        """Finishes the commits a killed run had begun."""
        for pending in sorted((self.root / ".pending").glob("*")):
            self._roll_forward(pending)
        self.write_manifest()

    def _roll_forward(self, pending: Path) -> None:
        stage = pending.name
        aside = self.root / ".old" / stage
        if (pending / RECORD).exists():
            record = json.loads((pending / RECORD).read_text())
            for name in record["outputs"]:
                made, place = pending / output_name(name), self.output(name)
                if made.exists():
                    shutil.rmtree(aside, ignore_errors=True)
                    aside.mkdir(parents=True)
                    if place.exists():
                        place.rename(aside / place.name)
                    made.rename(place)
            self.record_path(stage).parent.mkdir(exist_ok=True)
            (pending / RECORD).rename(self.record_path(stage))
        shutil.rmtree(pending)
        shutil.rmtree(aside, ignore_errors=True)
        self.write_manifest()

    def write_manifest(self) -> None:
        """Gathers the records into manifest.json, where they are not there already."""
        found = {path.stem: self.record(path.stem) for path in sorted((self.root / ".stages").glob("*.json"))}
        records = {stage: record for stage, record in found.items() if record is not None}
        path, text = self.root / "manifest.json", json_text({"schema": 1, "stages": records})
        if records and not (path.exists() and path.read_bytes() == text.encode()):
            write_text(path, text)


def output_name(name: str) -> str:
    """File or folder name of an output: `scores/` and other datasets are folders, other tables single files."""
    bare = name.rstrip("/")
    return bare if bare in DATASETS or bare not in TABLES else f"{bare}.parquet"


def tree_size(path: Path) -> int:
    """Bytes of a file, or of all files of a folder."""
    if path.is_file():
        return path.stat().st_size
    return sum(p.stat().st_size for p in path.rglob("*") if p.is_file())


def write_json(path: Path, value: Any) -> None:
    """Writes JSON atomically."""
    write_text(path, json_text(value))


def json_text(value: Any) -> str:
    """JSON as it is written into a run folder."""
    return json.dumps(value, indent=1, sort_keys=False, default=str) + "\n"


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically: a full disk or a kill leaves the old one."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        with temporary.open("w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
