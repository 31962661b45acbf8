"""Scores of the example against a survey that lies elsewhere, with and without control points.

usage: python benchmarks/planted_bias.py EXAMPLE RUN WORK [EAST NORTH UP]

EXAMPLE is a folder that `epitransfer example` made, RUN a finished run of it (it is copied and stays as it is), WORK an
empty or absent folder. The LiDAR tiles and the list of control points are shifted by EAST NORTH UP metres of their
grid, by default so that the control points are some 463 px off their sightings, as in the paper, and back to the poses
is one constant translation. Four scores are told: the survey as it is and shifted, without and with control points.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import laspy
import numpy as np

from pipeline.geometry.arrays import Floats
from stages.app import run as epitransfer

SHIFT_M = (16.7, -12.9, 9.2)
DATUM = "navd88"
METHODS = ("epitransfer", "dlt")


def shifted_list(text: str, shift_m: Floats) -> str:
    """A gcp_list.txt whose points are surveyed elsewhere; their pixels stay."""
    head, *rows = text.splitlines()
    moved = []
    for row in rows:
        fields = row.split("\t")
        xyz = np.array([float(value) for value in fields[:3]]) + shift_m
        moved.append("\t".join([*(f"{value:.4f}" for value in xyz), *fields[3:]]))
    return "\n".join([head, *moved]) + "\n"


def shift_tile(source: Path, target: Path, shift_m: Floats) -> None:
    """A tile whose returns lie elsewhere: the header's offsets move, the records stay to the bit."""
    tile = laspy.read(source)
    tile.header.offsets = tile.header.offsets + shift_m
    tile.points.offsets = tile.header.offsets
    tile.update_header()
    tile.write(target)


def shifted_survey(example: Path, work: Path, shift_m: Floats) -> Path:
    """A folder with the example's tiles and control points, shifted."""
    folder = work / "shifted"
    (folder / "lidar").mkdir(parents=True)
    for tile in sorted((example / "lidar").glob("*.laz")):
        shift_tile(tile, folder / "lidar" / tile.name, shift_m)
    text = (example / "gcp_list.txt").read_text(encoding="utf-8")
    (folder / "gcp_list.txt").write_text(shifted_list(text, shift_m), encoding="utf-8")
    return folder


def scored(run: Path, survey: Path, *, control: bool) -> dict[str, Any]:
    """The run's metrics against a survey."""
    command = ["score", str(run), "--set", f"score.lidar={survey / 'lidar'}/*.laz"]
    if control:
        command += ["--set", f"score.control_points={survey / 'gcp_list.txt'}"]
        command += ["--set", f"score.control_height_datum={DATUM}"]
    code = epitransfer(command)
    if code:
        raise SystemExit(code)
    found: dict[str, Any] = json.loads((run / "scores" / "metrics.json").read_text(encoding="utf-8"))
    return found


def told(name: str, metrics: dict[str, Any]) -> str:
    """A line: pixels off before and after, the translation, and AbsRel on common pixels with its interval."""
    parts = [f"{name:32}"]
    control = metrics.get("control_points")
    if control:
        moved = " ".join(f"{value:+.2f}" for value in control["translation_m"])
        parts.append(f"{control['rms_before_px']:7.1f} -> {control['rms_after_px']:5.2f} px by {moved} m")
    for method in METHODS:
        found = metrics["methods"][method]
        low, high = found["interval_95"]["common"]["abs_rel"]
        parts.append(f"{method} {found['common']['abs_rel']:.4f} ({low:.4f} .. {high:.4f}, n {found['common']['n']})")
    return "  ".join(parts)


def main(arguments: Sequence[str]) -> None:
    """Tells the four scores."""
    example, source, work = (Path(argument).resolve() for argument in arguments[:3])
    shift_m = np.array([float(value) for value in arguments[3:6]] or SHIFT_M)
    work.mkdir(parents=True, exist_ok=True)
    run = work / "run"
    shutil.copytree(source, run)
    # The example's own control points would be used where none are named.
    recipe = run / "workflow.toml"
    recipe.write_text("".join(line for line in recipe.open() if not line.startswith("control_")))
    elsewhere = shifted_survey(example, work, shift_m)
    print(f"survey shifted by {shift_m} m")
    for where, survey in (("as surveyed", example), ("shifted", elsewhere)):
        for control in (False, True):
            name = f"{where}, {'with' if control else 'without'} control points"
            print(told(name, scored(run, survey, control=control)))


if __name__ == "__main__":
    main(sys.argv[1:])
