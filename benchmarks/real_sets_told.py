"""What is known of three real drone flights beside their logs: ground points, a flat ground, a model of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pycolmap
from real_runs import model_poses
from real_truth import Depths, GroundPoints, agreement, cameras, placed
from whole_path import colmap_observations

from pipeline.engine.tables import read_table
from pipeline.flight import column
from pipeline.geometry.arrays import Bools, Floats

_MODEL_LINE = "COLMAP"
# The drone turned by 180 deg between these photos.
_TURN = "DJI_0140~DJI_0130"


def sheffield(folder: Path, runs: Mapping[str, Path], model: pycolmap.Reconstruction | None) -> Iterator[str]:
    """How far the clicks of the ground points are missed."""
    run = runs["none"]
    points = GroundPoints.of(folder / "gcp_file.txt", run)
    poses = {mode: placed(of_mode) for mode, of_mode in runs.items()}
    if model is not None:
        poses[_MODEL_LINE] = model_poses(model, run)
    clicks = f"{len(points.enu)} ground points, {len(points.point)} clicks in {len(set(points.frame_id))} photos"
    yield f"{clicks}; px of the photos at hand, root mean square, and m per px on the ground about 0.14"
    yield f"{'':12}{'one shift':>10}{'about mean':>12}{'free':>8}   shift east, north, up (m)"
    for mode, some in poses.items():
        if not set(points.frame_id) <= set(some):
            yield f"  {mode:10}lacks a photo of these"
            continue
        one, about, free, shift = points.figures(some, cameras(runs.get(mode, run)))
        yield f"  {mode:10}{one:10.2f}{about:12.2f}{free:8.2f}   " + " ".join(f"{value:+.2f}" for value in shift)
    yield (
        "One shift: the list moved as a whole; its points are read off a map, a metre or so each. About mean: every\n"
        "point's clicks about their own mean, so that the list's errors drop out and the spread between photos is\n"
        "left. Free: every point where its clicks put it; the clicks' own error is in it. One of the photos is of\n"
        "another strip, 22 m beside; the workflow's pairs end at 20 m and tie no strip to another. Lens: flight with\n"
        "refine.calibrate. Wide: flight, with pairs to 45 m and an overlap of 0.3. COLMAP matches all pairs; its\n"
        "camera is ours as given."
    )


def mirafiori(folder: Path, runs: Mapping[str, Path], model: pycolmap.Reconstruction | None) -> Iterator[str]:
    """How the depths of one pixel by several pairs agree, and how high the camera flew by every pair's depths."""
    del folder
    found = {mode: Depths.of(run) for mode, run in runs.items()}
    # The wide pairs are others, so that their rows are; the modes' are the same.
    shared_by = [depths.kept for depths in found.values() if len(depths.kept) == len(found["none"].kept)]
    everywhere: Bools = np.logical_and.reduce(shared_by)
    yield f"{'':12}{'pixels':>8}{'spread':>9}{'in sigmas':>11}{'height m':>10}{'of pairs':>10}{'turn: height m':>16}"
    for mode, depths in found.items():
        turning: Bools = depths.pair_id == _TURN
        rows = everywhere if len(depths.kept) == len(everywhere) else depths.kept
        several, spread, sigmas = agreement(depths, rows & ~turning)
        medians = _medians(depths, depths.kept & ~turning)
        after = _medians(depths, depths.kept & turning)
        said = f"{np.median(after):16.1f}" if after.size else f"{'-':>16}"
        yield (
            f"  {mode:10}{several:8,}{spread:9.3%}{sigmas:11.2f}{np.median(medians):10.2f}{np.std(medians):10.2f}{said}"
        )
    if model is not None:
        observed, _ = colmap_observations(model, runs["none"])
        yield f"  {_MODEL_LINE:10}{'':28}{np.median(observed.depth_m):10.2f}"
    yield (
        "Lens: flight with refine.calibrate. Wide: flight, with pairs to 30 m, on its own kept pixels.\n"
        "Straight down over flat ground: the median depth of a pair is the height flown at, 44.5 m above take-off by\n"
        "the log. Of pairs: its standard deviation over them. Steps of 3 m at 48 m: the length of a baseline is known\n"
        "to the positions' sigma alone, so pairs refined by themselves disagree where a flight's do not."
    )


def _medians(depths: Depths, rows: Bools) -> Floats:
    names = np.unique(depths.pair_id[rows].astype(str))
    return np.array([np.median(depths.depth[rows & (depths.pair_id == name)]) for name in names])


def brighton(folder: Path, runs: Mapping[str, Path], model: pycolmap.Reconstruction | None) -> Iterator[str]:
    """The scores against the model that others made of the same flight's photos."""
    del folder, model
    yield f"{'':12}{'scored':>8}{'AbsRel':>9}{'d / g':>9}{'AbsRel without':>16}{'sigma':>8}"
    for mode, run in runs.items():
        table = read_table(run / "scores" / "pixels.parquet", "pixels")
        ratio = np.asarray(column(table, "depth_m"), np.float64) / column(table, "reference_m")
        relative = column(table, "sigma_depth_m") / column(table, "depth_m")
        middle = float(np.median(ratio))
        cells = f"{np.mean(np.abs(ratio - 1.0)):9.2%}{middle:9.4f}{np.mean(np.abs(ratio / middle - 1.0)):16.3%}"
        yield f"  {mode:10}{len(ratio):8,}{cells}{np.median(relative):8.2%}"
    yield (
        "One usable pair: the length of its baseline is the log's, and scales all depths alike. d / g is the median\n"
        "ratio of depth to model; without: that ratio divided out. Sigma: the median predicted one over depth. The\n"
        "model is of the same flight's photos, and so no independent truth of its own height below the cameras.\n"
        "Lens: flight with refine.calibrate."
    )
