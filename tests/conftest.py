"""Fixtures shared by all tests."""

import os
from pathlib import Path

from pipeline.engine.threads import limit_threads

# Before numpy and torch are imported: processes of tests that each take all cores wait for one another.
limit_threads()

import pytest
from flights import epitransfer, write_small_flight
from hypothesis import settings

PROJECT = Path(__file__).resolve().parents[1]

# A time limit per example fails on a busy machine and says nothing about the code.
settings.register_profile("project", deadline=None)
settings.load_profile("project")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with real photo sets. EPITRANSFER_SHARED names it, and then its absence fails; "none" says so."""
    named = os.environ.get("EPITRANSFER_SHARED")
    folder = Path(named or PROJECT.parent / "shared")
    if not (folder / "data").is_dir():
        if named and named != "none":
            pytest.fail(f"EPITRANSFER_SHARED={named} has no data folder")
        pytest.skip(f"no real photo sets at {folder}")
    return folder


@pytest.fixture(scope="session")
def small_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An example flight of six small photos, with its tiles and workflow; not to be changed."""
    return write_small_flight(tmp_path_factory.mktemp("flight") / "flight")


@pytest.fixture(scope="session")
def small_run(small_flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished, undisturbed run of `small_flight`; not to be changed."""
    run = tmp_path_factory.mktemp("run") / "run"
    done = epitransfer("run", small_flight / "workflow.toml", "--out", run, "--jobs", 1)
    assert done.returncode == 0, done.stderr
    return run
