"""The choices of [score] on a small run: dense correspondence, depth images, learned baselines, control points."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from flights import copied, epitransfer


def scored(run: Path, *settings: str, code: int = 0) -> dict[str, Any]:
    given = [word for setting in settings for word in ("--set", setting)]
    done = epitransfer("score", run, "--jobs", "1", "--json", *given)
    assert done.returncode == code, done.stderr
    return json.loads(done.stdout) if code == 0 else {"stderr": done.stderr}


@pytest.mark.slow
def test_dense_depths_at_the_truth_s_pixels_are_as_good_as_those_of_matches(small_run: Path, tmp_path: Path) -> None:
    run = copied(small_run, tmp_path / "run")
    sparse = scored(run)["metrics"]
    dense = scored(run, "score.correspondence=dense", "score.dense_points=300")["metrics"]
    assert dense["truth"]["correspondence"] == "dense"
    assert set(dense["methods"]) == set(sparse["methods"])
    ours, theirs = (found["methods"]["epitransfer"]["common"] for found in (dense, sparse))
    assert ours["n"] > 300
    assert 0.3 * theirs["abs_rel"] < ours["abs_rel"] < 3.0 * theirs["abs_rel"]


@pytest.mark.slow
def test_depth_images_are_a_truth_without_a_pose(small_flight: Path, small_run: Path, tmp_path: Path) -> None:
    run, folder = copied(small_run, tmp_path / "run"), tmp_path / "depth"
    folder.mkdir()
    for file in sorted((small_flight / "truth" / "depth").glob("*.npz")):
        with np.load(file, allow_pickle=False) as kept:
            depth = kept["depth_m"]
        stored = np.where(np.isfinite(depth) & (depth < 65.0), depth, 0.0)
        cv2.imwrite(str(folder / f"{file.stem}.depth.png"), np.rint(stored * 1000.0).astype(np.uint16))
    recipe = run / "workflow.toml"
    recipe.write_text("".join(line for line in recipe.open() if not line.startswith(("lidar", "control_"))))
    told = scored(run, f"score.depth_images={folder}")
    metrics = told["metrics"]
    assert metrics["truth"]["kind"] == "depth images"
    assert metrics["cloud"] is None
    assert 0.0002 < metrics["methods"]["epitransfer"]["all"]["abs_rel"] < 0.02
    assert told["facts"]["depth_images"]["with_depth"] == 6
    other = tmp_path / "other"
    other.mkdir()
    (folder / "DJI_0001.depth.png").rename(other / "elsewhere.depth.png")
    assert "E-DEPTH-12" in scored(run, f"score.depth_images={other}", code=5)["stderr"]


@pytest.mark.slow
def test_networks_are_columns_of_the_same_tables(small_run: Path, tmp_path: Path) -> None:
    tiny = pytest.importorskip("tiny_monodepth")
    run, models = copied(small_run, tmp_path / "run"), tmp_path / "models"
    tiny.write_zoedepth(models / "zoedepth")
    tiny.write_depth_anything(models / "depth-anything-v2")
    names = ("zoedepth", "depth-anything-v2")
    told = scored(run, f"score.baselines={json.dumps(names)}", f"score.models={models}")
    metrics = told["metrics"]
    assert set(names) < set(metrics["methods"])
    assert len({found["common"]["n"] for found in metrics["methods"].values()}) == 1
    assert all(metrics["methods"][name]["all"]["n"] > 100 for name in names)
    assert all(told["facts"]["baselines"][name]["untrained"] for name in names), "random, and said so"
    missing = scored(run, 'score.baselines=["zoedepth"]', f"score.models={tmp_path / 'none'}", code=3)
    assert "E-BASELINE-02" in missing["stderr"]


@pytest.mark.slow
def test_two_control_points_are_too_few_and_figures_without_them_stand_beside(
    small_flight: Path, small_run: Path, tmp_path: Path
) -> None:
    run, listed = copied(small_run, tmp_path / "run"), tmp_path / "gcp_list.txt"
    metrics = json.loads((small_run / "scores" / "metrics.json").read_text())
    control, without = metrics["control_points"], metrics["without_control"]
    assert control["rms_after_px"] < 1.0 < control["rms_before_px"]
    assert metrics["methods"]["epitransfer"]["all"]["abs_rel"] < without["methods"]["epitransfer"]["all"]["abs_rel"]
    assert without["checkpoints"]["independent"]
    assert not metrics["checkpoints"]["independent"]
    rows = (small_flight / "gcp_list.txt").read_text().splitlines()
    names = sorted({row.split("\t")[-1] for row in rows[1:]})[:2]
    listed.write_text("\n".join([rows[0], *(row for row in rows[1:] if row.split("\t")[-1] in names)]) + "\n")
    assert "E-CONTROL-15" in scored(run, f"score.control_points={listed}", code=4)["stderr"]
