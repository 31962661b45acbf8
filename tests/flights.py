"""Small flights, runs of them, and the command line, for tests of the whole."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from pipeline.geometry.cameras import Camera
from pipeline.simulation.example import write_example
from pipeline.simulation.render import CAMERA

# The example's camera at a third of its size: the same lens, a flight in seconds.
SMALL = CAMERA.scaled(480, 360)
PROGRAM = (sys.executable, "-c", "from stages.app import main; main()")
STAGES = ("ingest", "pair", "match", "refine", "depth", "fuse", "score", "report")


def write_small_flight(folder: Path, frames: int = 6, camera: Camera = SMALL) -> Path:
    """An example flight of small photos."""
    write_example(folder, frames, 7, 1, camera)
    return folder


def epitransfer(
    *arguments: object, cwd: Path | None = None, timeout_s: float = 180.0, prepare: Callable[[], None] | None = None
) -> subprocess.CompletedProcess[str]:
    """Runs the command line as a user does, in a process of its own."""
    return subprocess.run(
        [*PROGRAM, *map(str, arguments)], cwd=cwd, text=True, capture_output=True, timeout=timeout_s, check=False,
        preexec_fn=prepare,
    )  # fmt: skip


def outputs(run: Path) -> dict[str, str]:
    """Digest of every file of a run that the contract promises, but manifest and report, which tell its time."""
    return {
        path.relative_to(run).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(run.rglob("*"))
        if path.is_file() and not any(part.startswith((".", "report")) for part in path.relative_to(run).parts)
        and path.name not in {"manifest.json", "workflow.toml"}
    }  # fmt: skip


def leftovers(run: Path) -> list[str]:
    """What a finished run folder should not hold: temporary files outside the engine's folders, and open commits."""
    found = [
        path.relative_to(run).as_posix()
        for path in run.rglob("*")
        if path.is_file() and (path.suffix in {".tmp", ".new"} or ".tmp." in path.name)
    ]
    return [name for name in found if not name.startswith((".work/", ".pending/"))] + [
        path.relative_to(run).as_posix() for path in (run / ".pending").glob("*")
    ]


def copied(run: Path, place: Path) -> Path:
    """A run folder to change; times of change are kept, so that it is as fresh as the original."""
    shutil.copytree(run, place, copy_function=shutil.copy2)
    return place


def processes_of(group: int) -> list[int]:
    """Processes of a process group that are alive."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[2]) == group and fields[0] != "Z":
                found.append(int(entry.name))
    return found


def is_root() -> bool:
    """Whether permission bits stop nobody here."""
    return os.geteuid() == 0
