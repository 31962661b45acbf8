"""Runs a command and measures it: wall time, processor time, and the most memory its processes held together."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

_INTERVAL_S = 0.05
_PROC = Path("/proc")


@dataclass(frozen=True, slots=True)
class Cost:
    """What a command took.

    Args:
        wall_s: Wall time.
        cpu_s: Processor time of it and all its children.
        memory_mib: Most memory held at once, shared pages counted once; where the system does not tell (no /proc), the
            largest process's.
    """

    wall_s: float
    cpu_s: float
    memory_mib: float


def measured(command: Sequence[str | Path], log: Path, cwd: Path | None = None) -> Cost:
    """Runs a command to its end.

    Args:
        command: Program and arguments.
        log: Where its output goes.
        cwd: Folder it runs in.

    Raises:
        RuntimeError: It failed; its last words are in the message.
    """
    with log.open("w", encoding="utf-8") as stream:
        start = time.perf_counter()
        process = subprocess.Popen([str(part) for part in command], stdout=stream, stderr=subprocess.STDOUT, cwd=cwd)
        peak = 0.0
        while True:
            peak = max(peak, _held_mib(process.pid))
            pid, status, usage = os.wait4(process.pid, os.WNOHANG)
            if pid:
                break
            time.sleep(_INTERVAL_S)
        wall = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        last = log.read_text(encoding="utf-8", errors="replace")[-2000:]
        raise RuntimeError(f"{command[0]} ended with {process.returncode}:\n{last}")
    return Cost(wall, usage.ru_utime + usage.ru_stime, peak or usage.ru_maxrss / 1024.0)


def _held_mib(root: int) -> float:
    """Proportional set size of a process and its descendants; 0 without /proc."""
    total = 0.0
    waiting = [root]
    while waiting:
        pid = waiting.pop()
        try:
            rollup = (_PROC / str(pid) / "smaps_rollup").read_text()
            tasks = list((_PROC / str(pid) / "task").iterdir())
            waiting += [int(child) for task in tasks for child in (task / "children").read_text().split()]
        except OSError:
            # It has ended meanwhile, or there is no /proc.
            continue
        total += sum(int(line.split()[1]) for line in rollup.splitlines() if line.startswith("Pss:")) / 1024.0
    return total
