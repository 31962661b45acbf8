"""The simulated room from its bag to points scored against the bag's own LiDAR sweeps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from flights import epitransfer

from pipeline.engine.tables import read_table


@pytest.mark.slow
def test_a_room_is_scored_against_its_own_sweeps(tmp_path: Path) -> None:
    made = epitransfer("example", tmp_path / "room", "--indoor", "--frames", 12)
    assert made.returncode == 0, made.stderr
    done = epitransfer("run", tmp_path / "room" / "workflow.toml", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    frames = read_table(tmp_path / "run" / "frames.parquet", "frames").to_pylist()
    assert len(frames) == 12
    for frame in frames:
        assert frame["usable"], frame["problem"]
        assert frame["image"].startswith("run://images/")
        assert frame["latitude_deg"] is None
        assert frame["height_datum"] == "local"
        # The room is 4 m high; in the frame as captured this would be the y axis.
        assert 0.5 < frame["up_m"] < 3.5
    metrics = json.loads((tmp_path / "run" / "scores" / "metrics.json").read_text())
    found = metrics["methods"]["epitransfer"]["all"]
    assert found["n"] > 2000
    assert 0.0005 < found["abs_rel"] < 0.02
    assert found["delta1"] > 0.97
    assert metrics["calibration"]["within_1_sigma"] > 0.6
    # Moved as a whole, a run reads its images where they are now.
    (tmp_path / "run").rename(tmp_path / "moved")
    again = epitransfer("fuse", tmp_path / "moved", "--set", "fuse.voxel_m=0.04")
    assert again.returncode == 0, again.stderr
