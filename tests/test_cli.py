"""The command line: its texts, exit codes, what goes to stdout and what to stderr, and what it does not load.

The expected texts lie in tests/golden; UPDATE_GOLDEN=1 writes them anew, to be read before they are committed.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from flights import PROGRAM, STAGES, copied, epitransfer

from pipeline.engine.errors import (
    EpiTransferError,
    InputError,
    MissingPartError,
    NothingLeftError,
    ResourceError,
    TooManyFailuresError,
    UndeterminedError,
    UsageError,
)
from stages import app
from stages.app import COMMANDS
from stages.app import run as command_line

GOLDEN = Path(__file__).parent / "golden"
# Typer itself loads pydantic to judge an argument, not for its help.
HEAVY = ("numpy", "pyarrow", "pydantic", "cv2", "torch", "scipy", "pyproj", "laspy", "rich", "PIL", "pandas")


def compared(name: str, text: str, **hidden: object) -> None:
    """Compares a text with the one kept; what differs from place to place is replaced by its name first."""
    for label, value in hidden.items():
        text = text.replace(str(value), f"<{label}>")
    text = re.sub(r"\(\d+\.\d s\)", "(<seconds> s)", text)
    path = GOLDEN / f"{name}.txt"
    if os.environ.get("UPDATE_GOLDEN"):
        path.write_text(text, encoding="utf-8")
    assert text == path.read_text(encoding="utf-8")


@pytest.fixture(autouse=True)
def _plain_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("COLUMNS", "100"), ("NO_COLOR", "1"), ("TERM", "dumb")):
        monkeypatch.setenv(name, value)


def spoken(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command line run in this process."""
    capsys.readouterr()
    code = command_line([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


# --- help ---


def test_help(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = spoken(capsys, "--help")
    assert (code, err) == (0, "")
    compared("help", out)
    for name in COMMANDS:
        assert re.search(rf"^  {name} ", out, flags=re.MULTILINE)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = spoken(capsys, name, "--help")
    assert (code, err) == (0, "")
    assert f"Usage: epitransfer {name}" in out
    undescribed = re.findall(r"^  (--[\w-]+)(?:\s+[A-Z]+)?\s*$", out, flags=re.MULTILINE)
    assert undescribed == []


@pytest.mark.parametrize("arguments", [("--help",), ("--version",), ("nosuch",), ()])
def test_nothing_heavy_is_loaded_before_a_command_is_known(arguments: tuple[str, ...]) -> None:
    code = (
        "import sys; from stages.app import run; code = run(sys.argv[1:]);"
        f"print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr); sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)
    assert done.stderr.rstrip().endswith(("[]", "['pydantic']") if "help" not in "".join(arguments) else "[]")
    assert done.returncode == (0 if "--" in "".join(arguments) else 2)


def test_numeric_libraries_run_on_one_thread_from_the_start() -> None:
    """Their own threads would change last digits with the number of cores."""
    code = (
        "import os, sys, stages.app as app\n"
        "shown = lambda: os.environ['OMP_NUM_THREADS'] + str('numpy' in sys.modules)\n"
        "app.run = lambda arguments: sys.stdout.write(shown()) * 0\n"
        "app.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "1False"


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = spoken(capsys, "--version")
    assert (code, err) == (0, "")
    assert re.fullmatch(r"\d+\.\d+\.\d+\S*\n", out)


# --- schema ---


def test_schema_of_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = spoken(capsys, "schema", "depths")
    assert (code, err) == (0, "")
    compared("schema_depths", out)


def test_schema_as_json_is_one_object(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = spoken(capsys, "schema", "--json")
    assert (code, err) == (0, "")
    tables = json.loads(out)
    assert {"frames", "cameras", "pairs", "matches", "relative_poses", "depths", "points"} <= set(tables)
    for table in tables.values():
        for column in table["columns"]:
            assert column["meaning"]
            if column["name"].endswith(("_m", "_px", "_deg")):
                assert column["unit"] in column["name"].split("_"), column


# --- usage errors: exit code 2, and what to change ---

WRONG = {
    "unknown_command": ("nosuch",),
    "unknown_option": ("run", "--bogus"),
    "no_jobs": ("run", "{workflow}", "--out", "{run}", "--jobs", "0"),
    "missing_argument": ("depth",),
    "unknown_table": ("schema", "depth"),
    "unknown_key": ("run", "{workflow}", "--out", "{run}", "--set", "depth.max_rang_m=50"),
    "unknown_section": ("run", "{workflow}", "--out", "{run}", "--set", "dept.max_range_m=50"),
    "bad_value": ("run", "{workflow}", "--out", "{run}", "--set", "depth.max_range_m=far"),
    "value_out_of_range": ("run", "{workflow}", "--out", "{run}", "--set", "depth.max_relative_sigma=2"),
    "bad_choice": ("run", "{workflow}", "--out", "{run}", "--set", "depth.virtual_view=diagonal"),
    "set_without_value": ("run", "{workflow}", "--out", "{run}", "--set", "depth.max_range_m"),
    "no_such_stage": ("run", "{workflow}", "--out", "{run}", "--to", "dept"),
    "nothing_to_run": ("run", "--out", "{run}"),
    "workflow_and_photos": ("run", "{workflow}", "--photos", "x", "--out", "{run}"),
    "not_a_run": ("depth", "{nowhere}"),
    "status_of_nothing": ("status", "{nowhere}"),
    "unknown_export": ("export", "{run}", "--to", "points.xyz"),
    "bad_scheduler": ("run", "{workflow}", "--out", "{run}", "--scheduler", "nonsense"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_command_line_is_explained(
    name: str, small_flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if name == "bad_scheduler":
        pytest.importorskip("distributed")
    places = {"workflow": small_flight / "workflow.toml", "run": tmp_path / "run", "nowhere": tmp_path / "nowhere"}
    code, out, err = spoken(capsys, *(argument.format(**places) for argument in WRONG[name]))
    assert code == 2
    assert out == ""
    assert "Traceback" not in err
    compared(f"error_{name}", err, FLIGHT=small_flight, TMP=tmp_path)
    assert not (tmp_path / "run" / "frames.parquet").exists()


def test_a_workflow_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.toml"
    expected = {
        None: (3, "E-CONFIG-01"),
        "": (2, "E-RUN-07"),
        "[ingest\n": (2, "E-CONFIG-02"),
        "ingest = 3\n": (2, "E-CONFIG-03"),
        "[ingset]\n": (2, "E-CONFIG-05"),
        "[ingest]\n": (2, "E-CONFIG-09"),
        "[ingest]\nphoto = 'x'\n": (2, "E-CONFIG-06"),
        "[pair]\n": (2, "E-RUN-07"),
        "[ingest]\nphotos = 'nowhere'\n": (3, "E-FILE-01"),
    }
    for text, (code, error) in expected.items():
        if text is not None:
            path.write_text(text)
        found, out, err = spoken(capsys, "run", path, "--out", tmp_path / "run")
        assert (found, out) == (code, ""), (text, err)
        assert error in err, (text, err)
        assert "Traceback" not in err
    path.write_bytes(b"[ingest]\nphotos = '\xff\xfe'\n")
    code, _, err = spoken(capsys, "run", path, "--out", tmp_path / "run")
    assert code == 3
    assert str(path) in err


def test_missing_inputs_name_the_table_and_the_stage(
    small_flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert spoken(capsys, "configure", run, "--workflow", small_flight / "workflow.toml")[0] == 0
    code, out, err = spoken(capsys, "depth", run)
    assert (code, out) == (3, "")
    compared("error_missing_input", err, RUN=run)


# --- status ---


def test_status_of_a_fresh_run(small_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = spoken(capsys, "status", small_run)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert [line.split()[:2] for line in lines] == [[stage, "fresh"] for stage in STAGES]
    assert "6 of 6 photos usable" in lines[0]


def test_status_tells_what_changed_and_what_waits(
    small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = copied(small_run, tmp_path / "run")
    text = (run / "workflow.toml").read_text().replace("[depth]\n", "[depth]\nmax_range_m = 50\n")
    (run / "workflow.toml").write_text(text)
    (run / "points" / "item.json").unlink()
    (run / "scores" / "metrics.json").unlink()
    (run / ".stages" / "score.json").unlink()
    code, out, err = spoken(capsys, "status", run)
    assert (code, err) == (0, "")
    shown = "".join(line for line in out.splitlines(keepends=True) if " fresh " not in line)
    compared("status_stale", shown)
    code, out, err = spoken(capsys, "status", run, "--json")
    found = json.loads(out)
    assert found["run"] == str(run)
    assert found["stages"]["match"]["status"] == "fresh"
    assert found["stages"]["depth"] == {
        "status": "stale",
        "because": "changed: depth.max_range_m",
        "summary": found["stages"]["depth"]["summary"],
    }
    assert found["stages"]["score"]["status"] == "missing"


def test_status_tells_what_failed_until_it_is_mended(
    small_flight: Path, small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = copied(small_run, tmp_path / "run")
    given = ("run", small_flight / "workflow.toml", "--out", run, "--jobs", "1")
    code, _, err = spoken(capsys, *given, "--set", "depth.max_relative_sigma=1e-9")
    assert code == 5
    assert "E-DEPTH-01" in err
    stages = json.loads(spoken(capsys, "status", run, "--json")[1])["stages"]
    assert stages["refine"]["status"] == "fresh"
    assert stages["depth"]["status"] == "failed"
    assert "E-DEPTH-01" in stages["depth"]["because"]
    assert stages["score"]["status"] == "stale"
    assert spoken(capsys, *given)[0] == 0
    stages = json.loads(spoken(capsys, "status", run, "--json")[1])["stages"]
    assert {entry["status"] for entry in stages.values()} == {"fresh"}


# --- stdout and stderr, exit codes ---


def test_results_go_to_stdout_and_the_rest_to_stderr(
    small_flight: Path, small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = copied(small_run, tmp_path / "run")
    given = ("run", small_flight / "workflow.toml", "--out", run, "--jobs", "1")
    code, out, err = spoken(capsys, *given)
    assert code == 0
    assert len(out.splitlines()) == 1
    assert out.startswith(f"{run}: AbsRel epitransfer ")
    assert len(err.splitlines()) == len(STAGES)
    code, out, err = spoken(capsys, *given, "--json", "--from", "depth")
    assert set(json.loads(out)["stages"]) == {"depth", "fuse", "score", "report"}
    code, out, err = spoken(capsys, "fuse", run, "--jobs", "1")
    assert code == 0
    assert "points in" in out
    assert "up to date" in err


@pytest.mark.parametrize(
    "arguments",
    [
        ("status", "{run}", "--json"),
        ("inspect", "{flight}/photos", "{run}/frames.parquet", "--json"),
        ("schema", "--json"),
    ],
)
def test_json_is_one_object(
    arguments: tuple[str, ...], small_flight: Path, small_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    filled = (argument.format(run=small_run, flight=small_flight) for argument in arguments)
    code, out, _ = spoken(capsys, *filled)
    assert code == 0
    assert isinstance(json.loads(out), dict)


def test_a_reader_that_leaves_early_is_no_error() -> None:
    shell = " ".join(f"'{part}'" for part in PROGRAM)
    line = f"set -o pipefail; {shell} schema | head -1"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stderr == ""


RAISED: dict[str, tuple[BaseException, int]] = {
    "usage": (UsageError("E-T-1", "m"), 2),
    "input": (InputError("E-T-1", "m"), 3),
    "undetermined": (UndeterminedError("E-T-1", "m"), 4),
    "nothing": (NothingLeftError("E-T-1", "m"), 5),
    "resource": (ResourceError("E-T-1", "m"), 6),
    "missing part": (MissingPartError("E-T-1", "m"), 7),
    "failures": (TooManyFailuresError("E-T-1", "m"), 8),
    "memory": (MemoryError(), 6),
    "disk": (OSError(28, "No space left on device", "a.parquet"), 6),
    "quota": (OSError(122, "Disk quota exceeded", "a.parquet"), 6),
    "permission": (PermissionError(13, "Permission denied", "a.parquet"), 6),
    "read-only": (OSError(30, "Read-only file system", "a.parquet"), 6),
    "files": (OSError(24, "Too many open files", "a.parquet"), 6),
    "device": (OSError(5, "Input/output error", "a.parquet"), 6),
    "interrupt": (KeyboardInterrupt(), 130),
    "bug": (ZeroDivisionError("division by zero"), 1),
    "odd system error": (OSError(95, "Operation not supported"), 1),
}


@pytest.mark.parametrize("name", RAISED)
def test_every_outcome_has_its_exit_code(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    error, expected = RAISED[name]

    def raising(run: str) -> None:
        raise error

    monkeypatch.setattr("stages.status.command", raising)
    code, out, err = spoken(capsys, "status", "x")
    assert (code, out) == (expected, "")
    assert ("Traceback" in err) == (expected == 1)
    if isinstance(error, OSError) and expected == 6:
        assert "a.parquet" in err
        assert "hint" in err
    if isinstance(error, EpiTransferError):
        assert err == "error[E-T-1]: m\n"
    assert len(err.splitlines()) > 0


def test_a_missing_part_names_the_command_that_installs_it(
    small_flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    code, out, err = spoken(
        capsys, "run", small_flight / "workflow.toml", "--out", tmp_path / "run", "--scheduler", "tcp://127.0.0.1:1"
    )
    assert (code, out) == (7, "")
    assert "pip install 'epitransfer[dask]'" in err


def _impatient(client: Any, address: str, **_: object) -> Any:
    return client(address, timeout=0.5)


@pytest.mark.slow
def test_a_scheduler_that_does_not_answer(
    small_flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(distributed, "Client", partial(_impatient, distributed.Client))
    code, _, err = spoken(
        capsys, "run", small_flight / "workflow.toml", "--out", tmp_path / "run", "--scheduler", "tcp://127.0.0.1:1"
    )
    assert code == 6
    assert "E-EXEC-03" in err
    assert "tcp://127.0.0.1:1" in err


def test_what_the_data_do_not_say_the_user_must(
    small_flight: Path, small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = copied(small_run, tmp_path / "run")
    assert spoken(capsys, "ingest", run, "--set", "ingest.height_datum=unknown")[0] == 0
    code, out, err = spoken(capsys, "score", run, "--jobs", "1")
    assert (code, out) == (4, "")
    assert "E-SCORE-02" in err
    assert "--set ingest.height_datum=" in err


def test_too_many_failures_are_told_after_the_work_is_done(
    small_flight: Path, small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "photos").mkdir()
    for photo in (small_flight / "photos").iterdir():
        (tmp_path / "photos" / photo.name).write_bytes(photo.read_bytes())
    (tmp_path / "photos" / "DJI_0099.JPG").write_text("no photo")
    run = copied(small_run, tmp_path / "run")
    given = ("run", small_flight / "workflow.toml", "--out", run, "--jobs", "1", "--to", "pair")
    stated = ("--set", f"ingest.photos={tmp_path / 'photos'}", "--set", "ingest.max_failed_share=0.1")
    for _ in range(2):  # the second time everything is up to date, and the failures are still too many
        code, out, err = spoken(capsys, *given, *stated)
        assert (code, out) == (8, "")
        assert "E-RUN-06" in err
        assert "1 of 7" in err
    assert (run / "frames.parquet").exists()
    assert spoken(capsys, *given, *stated[:2])[0] == 0


def test_a_progress_line_is_json_where_there_is_no_terminal(
    small_flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("pipeline.engine.progress.INTERVAL_S", 0.001)
    code, _, err = spoken(
        capsys, "run", small_flight / "workflow.toml", "--out", tmp_path / "run", "--jobs", "1", "--to", "ingest"
    )
    assert code == 0
    lines = [json.loads(line) for line in err.splitlines() if line.startswith("{")]
    assert lines
    assert all(set(line) == {"stage", "items", "done", "total", "elapsed_s"} for line in lines)
    assert {line["stage"] for line in lines} == {"ingest"}


def test_the_installed_command_is_this_one(small_run: Path) -> None:
    script = Path(sys.executable).parent / "epitransfer"
    if not script.exists():
        pytest.skip("not installed with its console command")
    done = subprocess.run(
        [str(script), "status", str(small_run), "--json"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0
    assert json.loads(done.stdout) == json.loads(epitransfer("status", small_run, "--json").stdout)
    assert app.main.__module__ == "stages.app"
