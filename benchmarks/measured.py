"""Runs a command and measures it: wall time, processor time, and the most memory its processes held together."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

_INTERVAL_S = 0.1
_PROC = Path("/proc")


@dataclass(frozen=True, slots=True)
class Cost:
    """What a command took.

    Args:
        wall_s: Wall time.
        cpu_s: Processor time of all its processes.
        memory_mib: Most memory its processes held together, files they share left out.
    """

    wall_s: float
    cpu_s: float
    memory_mib: float


class _Processes:
    """A process and its descendants, seen from outside: the system's own sums leave out workers of a fork server."""

    def __init__(self, root: int) -> None:
        self._root = root
        self._cpu_s: dict[int, float] = {}
        self.peak_mib = 0.0

    @property
    def cpu_s(self) -> float:
        return sum(self._cpu_s.values())

    def look(self) -> None:
        """Notes what each process has used so far, and what they hold together now."""
        held, waiting = 0, [self._root]
        while waiting:
            pid = waiting.pop()
            folder = _PROC / str(pid)
            try:
                # Fields after the name, which may hold spaces: utime and stime are the 14th and 15th of all.
                times = (folder / "stat").read_text().rpartition(")")[2].split()[11:13]
                resident, shared = (folder / "statm").read_text().split()[1:3]
                for task in (folder / "task").iterdir():
                    waiting += [int(child) for child in (task / "children").read_text().split()]
            except OSError:
                # It has ended meanwhile.
                continue
            self._cpu_s[pid] = sum(map(int, times)) / os.sysconf("SC_CLK_TCK")
            held += int(resident) - int(shared)
        self.peak_mib = max(self.peak_mib, held * os.sysconf("SC_PAGE_SIZE") / 2**20)


def measured(command: Sequence[str | Path], log: Path) -> Cost:
    """Runs a command to its end, on a system with /proc.

    Args:
        command: Program and arguments.
        log: Where its output goes.

    Raises:
        RuntimeError: It failed; its last words are in the message.
    """
    with log.open("w", encoding="utf-8") as stream:
        start = time.perf_counter()
        process = subprocess.Popen([str(part) for part in command], stdout=stream, stderr=subprocess.STDOUT)
        processes = _Processes(process.pid)
        while process.poll() is None:
            processes.look()
            time.sleep(_INTERVAL_S)
        wall = time.perf_counter() - start
    if process.returncode:
        last = log.read_text(encoding="utf-8", errors="replace")[-2000:]
        raise RuntimeError(f"{command[0]} ended with {process.returncode}:\n{last}")
    return Cost(wall, processes.cpu_s, processes.peak_mib)
