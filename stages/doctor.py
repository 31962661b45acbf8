"""doctor: what this machine has for a run, and what it lacks."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shutil
from pathlib import Path
from typing import Annotated

import pyproj
import typer

from pipeline.clocks.gps import TABLE_HOLDS_UNTIL
from pipeline.engine.errors import MissingPartError, UndeterminedError
from pipeline.engine.executors import usable_cores
from pipeline.geodesy.heights import Geoid
from pipeline.matching.weights.files import find_weights
from pipeline.matching.weights.known import NETWORKS_OF
from pipeline.monodepth.known import INSTALL
from pipeline.monodepth.telling import states_of_baselines

REQUIRED = (
    "numpy",
    "scipy",
    "opencv-python-headless",
    "pyarrow",
    "pyproj",
    "laspy",
    "lazrs",
    "pydantic",
    "torch",
    "kornia",
    "safetensors",
    "pymavlink",
    "pyulog",
    "rosbags",
    "mcap",
    "av",
    "pycolmap",
)
OPTIONAL = {
    "distributed": "runs on a Dask cluster: pip install 'epitransfer[dask]'",
    "transformers": f"learned baselines: {INSTALL}",
}
DATUMS = ("egm96", "egm2008")


def command(as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False) -> None:
    """Checks versions, optional parts, weights, PROJ grids, GPU, disk and memory."""
    # torch takes seconds to import.
    from pipeline.matching.devices import device_in_words  # noqa: PLC0415

    found = {
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in REQUIRED},
        "optional": {name: _version(name) or f"missing; {use}" for name, use in OPTIONAL.items()},
        "weights": {"/".join(group): _weights(group) for needs in NETWORKS_OF.values() for group in needs},
        "baselines": states_of_baselines(),
        "torch_device": device_in_words(),
        "proj": {"version": pyproj.proj_version_str, "grids": {name: _grid(name) for name in DATUMS}},
        "leap_seconds_known_until": f"{TABLE_HOLDS_UNTIL:%Y-%m-%d}",
        "cores": usable_cores(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "disk_free_gib": round(shutil.disk_usage(Path.cwd()).free / 2**30, 1),
    }
    if as_json:
        typer.echo(json.dumps(found))
        return
    for name, value in found.items():
        if isinstance(value, dict):
            typer.echo(name)
            for key, entry in value.items():
                typer.echo(f"  {key:<24}{json.dumps(entry) if isinstance(entry, dict) else entry or 'missing'}")
        else:
            typer.echo(f"{name:<26}{value}")


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _grid(datum: str) -> str:
    try:
        Geoid.of(None, datum).undulation(0.0, 0.0)
    except UndeterminedError:
        return "missing: state ingest.geoid, or install the grid with projsync"
    return "installed"


def _weights(networks: tuple[str, ...]) -> str:
    try:
        return str(find_weights(networks).path)
    except MissingPartError as error:
        return f"missing: {error.hint.partition(';')[0]}"
