"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest
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
