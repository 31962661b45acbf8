"""The example flight from bare photos and every kind of log: exposures, poses and points as from the stills."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Any

import logs_truth
import numpy as np
import pytest
from flights import epitransfer

from pipeline.engine.tables import read_table
from pipeline.geodesy.enu import LocalFrame
from pipeline.simulation.bare import CLOCK_ERROR_S, FORMS, LoggedAs

KEYS = [form.key for form in FORMS]


@pytest.fixture(scope="module")
def truth(small_flight: Path) -> dict[str, datetime]:
    return logs_truth.true_times(small_flight)


@pytest.fixture(scope="module", params=FORMS, ids=KEYS)
def ingested(request: pytest.FixtureRequest, small_flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one kind of log, ingested."""
    form: LoggedAs = request.param
    run = tmp_path_factory.mktemp(form.key) / "run"
    done = epitransfer("run", small_flight / form.workflow, "--out", run, "--to", "ingest", "--jobs", 1)
    assert done.returncode == 0, done.stderr
    assert "1 photo missing on the card: DJI_0002" in done.stderr
    assert "2 exposures in the log left no photo" in done.stderr
    return run


def earth_centred(run: Path) -> dict[str, Any]:
    """Camera centres by frame_id, ECEF m."""
    origin = LocalFrame(**json.loads((run / ".stages" / "ingest.json").read_text())["facts"]["origin"])
    frames = read_table(run / "frames.parquet", "frames")
    return {
        row["frame_id"]: origin.ecef_from_enu(np.array([row["east_m"], row["north_m"], row["up_m"]]))
        for row in frames.to_pylist()
        if row["usable"]
    }


def test_every_photo_is_placed_in_time(ingested: Path, truth: dict[str, datetime]) -> None:
    frames = read_table(ingested / "frames.parquet", "frames")
    assert frames.num_rows == 5
    assert frames.column("usable").to_pylist() == [True] * 5
    assert set(frames.column("time_source").to_pylist()) == {"log event"}
    assert logs_truth.time_errors(frames, truth).max() < 0.001


def test_the_clock_is_found(ingested: Path) -> None:
    clocks = {row["source"]: row for row in read_table(ingested / "clocks.parquet", "clocks").to_pylist()}
    photos = clocks["photos"]
    assert photos["offset_s"] == pytest.approx(-CLOCK_ERROR_S, abs=0.01)
    assert photos["anchors"] == 5
    assert photos["residual_s"] < 0.002
    assert len(clocks) == 2


def test_poses_are_those_of_the_stills(ingested: Path, small_run: Path) -> None:
    stills, logged = earth_centred(small_run), earth_centred(ingested)
    apart_m = [float(np.linalg.norm(stills[name] - logged[name])) for name in logged]
    # Two samples' rounding of 1e-7 deg at most; the lever arm alone is 0.22 m.
    assert max(apart_m) < 0.015
    own = {row["frame_id"]: row for row in read_table(small_run / "frames.parquet", "frames").to_pylist()}
    for row in read_table(ingested / "frames.parquet", "frames").to_pylist():
        for angle in ("yaw_deg", "pitch_deg", "roll_deg"):
            assert row[angle] == pytest.approx(own[row["frame_id"]][angle], abs=0.002)
        assert row["height_datum"] == "ellipsoidal"
        assert row["own_sigma_east_m"] == pytest.approx(own[row["frame_id"]]["own_sigma_east_m"], abs=0.003)


@pytest.mark.slow
@pytest.mark.parametrize("key", ["bin", "mcap"])
def test_points_are_those_of_the_stills(key: str, small_flight: Path, small_run: Path, tmp_path: Path) -> None:
    form = next(form for form in FORMS if form.key == key)
    done = epitransfer("run", small_flight / form.workflow, "--out", tmp_path / "run", "--to", "depth", "--jobs", 1)
    assert done.returncode == 0, done.stderr
    apart_m = logs_truth.distances(logs_truth.observed(small_run), logs_truth.observed(tmp_path / "run"))
    assert len(apart_m) > 1000
    assert np.median(apart_m) < 0.05
