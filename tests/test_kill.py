"""Kill -9 at any moment: the same command carries on, and what comes out is what an undisturbed run gives.

As a script, more moments and a flight of one's own: python tests/test_kill.py MOMENTS [WORKFLOW].
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from flights import PROGRAM, epitransfer, leftovers, outputs, processes_of, write_small_flight

JOBS = 2


def _heed_interrupts() -> None:
    """Tests started in the background of a script inherit an ignored SIGINT, which the run would ignore too."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def started(workflow: Path, run: Path) -> Iterator[subprocess.Popen[str]]:
    """A run in a process group of its own; nothing of it outlives the block."""
    process = subprocess.Popen(
        [*PROGRAM, "run", str(workflow), "--out", str(run), "--jobs", str(JOBS)],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=_heed_interrupts,  # noqa: PLW1509  # no threads here
    )  # fmt: skip
    try:
        yield process
    finally:
        if processes_of(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def waited(condition: Callable[[], object], seconds: float) -> bool:
    """Whether a condition comes true in time."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.005)
    return True


def begun(run: Path) -> bool:
    """Whether the run has done more than start."""
    return (run / ".lock").exists()


def killed_and_resumed(workflow: Path, run: Path, moments_s: list[float]) -> int:
    """Kills a run at each of the moments after its work begins, then lets it finish; how many kills met it alive."""
    met = 0
    for moment in moments_s:
        with started(workflow, run) as process:
            assert waited(lambda: begun(run), 60.0)
            time.sleep(moment)
            met += process.poll() is None
            if processes_of(process.pid):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    done = epitransfer("run", workflow, "--out", run, "--jobs", JOBS)
    assert done.returncode == 0, done.stderr
    return met


def working_time(workflow: Path, run: Path) -> float:
    """Seconds of an undisturbed run from its first sign of work to its end."""
    with started(workflow, run) as process:
        assert waited(lambda: begun(run), 60.0)
        began = time.monotonic()
        assert process.wait() == 0
        return time.monotonic() - began


@pytest.mark.slow
def test_killed_at_random_moments_the_outputs_are_those_of_an_undisturbed_run(
    small_flight: Path, small_run: Path, tmp_path: Path
) -> None:
    """Six moments, three to a run: the later ones meet what the earlier ones left."""
    workflow = small_flight / "workflow.toml"
    stages = json.loads((small_run / "manifest.json").read_text())["stages"]
    whole = sum(entry["seconds"] for entry in stages.values())
    moments = np.random.default_rng(20).uniform(0.0, whole, 6)
    met = 0
    for n, part in enumerate(moments.reshape(2, 3)):
        run = tmp_path / f"run{n}"
        # The same share of what is left: a resumed run is shorter.
        met += killed_and_resumed(workflow, run, sorted(part.tolist(), reverse=True))
        assert outputs(run) == outputs(small_run)
        assert leftovers(run) == []
        assert list((run / ".work").glob("*")) == []
    assert met >= 3, "kills that come after the end would show nothing"


@pytest.mark.slow
def test_workers_end_with_a_parent_that_was_killed(small_flight: Path, small_run: Path, tmp_path: Path) -> None:
    """Kill -9 of the main process alone: its workers do not linger, nor write beside the run that carries on."""
    workflow, run = small_flight / "workflow.toml", tmp_path / "run"
    with started(workflow, run) as process:
        # The main process, the fork server, its resource tracker, and at least one worker.
        assert waited(lambda: list(run.glob(".cache/features/*/*.npz")), 60.0)
        assert len(processes_of(process.pid)) >= 3
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        resumed = epitransfer("run", workflow, "--out", run, "--jobs", JOBS)
        assert resumed.returncode == 0, resumed.stderr
        assert waited(lambda: not processes_of(process.pid), 5.0), "orphans"
    assert outputs(run) == outputs(small_run)
    assert leftovers(run) == []


@pytest.mark.slow
@pytest.mark.parametrize("target", ["group", "main"])
def test_an_interrupt_ends_at_once_and_without_a_traceback(small_flight: Path, tmp_path: Path, target: str) -> None:
    """Ctrl-C goes to the whole group, a supervisor's signal to the main process."""
    run = tmp_path / "run"
    with started(small_flight / "workflow.toml", run) as process:
        assert waited(lambda: list(run.glob(".cache/features/*/*.npz")), 60.0)
        (os.killpg if target == "group" else os.kill)(process.pid, signal.SIGINT)
        _, stderr = process.communicate(timeout=20.0)
        assert process.returncode == 130
        assert "Traceback" not in stderr
        assert stderr.rstrip().endswith("interrupted; the same command carries on")
        assert waited(lambda: not processes_of(process.pid), 5.0), "workers linger"


def test_a_second_process_is_told_that_the_folder_is_in_use(small_flight: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    with started(small_flight / "workflow.toml", run):
        assert waited((run / "frames.parquet").exists, 60.0)
        second = epitransfer("run", small_flight / "workflow.toml", "--out", run)
        assert second.returncode == 2
        assert "E-RUN-01" in second.stderr
        looked = epitransfer("status", run)
        assert looked.returncode == 0, "looking is allowed"


def main() -> int:
    """Kills a run at many moments, each in a run folder of its own."""
    moments = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        workflow = Path(sys.argv[2]) if len(sys.argv) > 2 else write_small_flight(folder / "flight") / "workflow.toml"
        whole = min(working_time(workflow, folder / name) for name in ("undisturbed", "again"))
        expected = outputs(folder / "undisturbed")
        rng, differ, met, n = np.random.default_rng(0), 0, 0, 0
        while met < moments:
            moment, n = float(rng.uniform(0.0, whole)), n + 1
            run = folder / f"run{n}"
            if not killed_and_resumed(workflow, run, [moment]):
                continue  # it had ended by then
            same = outputs(run) == expected and not leftovers(run)
            met, differ = met + 1, differ + (not same)
            sys.stdout.write(
                f"{met:3} killed after {moment:6.2f} of {whole:.2f} s: {'same' if same else 'DIFFERENT'}\n"
            )
        sys.stdout.write(f"{met} kills met the run at work, {differ} differ\n")
    return int(differ > 0)


if __name__ == "__main__":
    sys.exit(main())
