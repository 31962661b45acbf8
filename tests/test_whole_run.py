"""From photos to scored points, as a user runs it: the contract, the same bytes every way, and only what changed."""

from __future__ import annotations

import csv
import json
import re
import runpy
import shutil
import sqlite3
import sys
from pathlib import Path

import laspy
import numpy as np
import pyarrow.parquet as pq
import pytest
from flights import SMALL, STAGES, copied, epitransfer, leftovers, outputs, write_small_flight

from pipeline.flight import relative_poses_of
from schemas import TABLES
from stages.app import run as command_line

TABLE_FILES = {"cameras", "frames", "tracks", "clocks", "pairs", "relative_poses", "poses"} | {
    "pose_covariances",
    "refined_cameras",
}


def test_a_run_holds_what_the_contract_says(small_run: Path) -> None:
    names = set(outputs(small_run))
    assert {f"{name}.parquet" for name in TABLE_FILES} <= names
    assert {"matches/part-00000.parquet", "depths/part-00000.parquet", "points/item.json"} <= names
    assert {"scores/metrics.json", "scores/pixels.parquet"} <= names
    assert any(re.fullmatch(r"points/t_\d+_\d+\.parquet", name) for name in names)
    assert leftovers(small_run) == []
    assert list((small_run / ".work").glob("*")) == []


def test_every_table_of_a_run_is_of_its_schema(small_run: Path) -> None:
    assert set(TABLES) > {"curves"}, "which only sensitivity makes"
    for name, schema in TABLES.items():
        if name == "curves":
            continue
        folder = {"pixels": small_run / "scores"}.get(name, small_run / name)
        files = sorted(folder.glob("*.parquet")) if folder.is_dir() else [small_run / f"{name}.parquet"]
        assert files
        for file in files:
            with pq.ParquetFile(file, arrow_extensions_enabled=False) as stored:
                schema.check_schema(stored.schema_arrow)
                assert stored.metadata.num_rows > 0


@pytest.mark.real
def test_the_contract_s_own_checker_agrees(
    small_run: Path, shared: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["check_contract.py", str(small_run)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(shared / "tools" / "check_contract.py"), run_name="__main__")
    assert ended.value.code == 0, capsys.readouterr().out


def test_its_figures_are_sane(small_run: Path) -> None:
    metrics = json.loads((small_run / "scores" / "metrics.json").read_text())
    methods = metrics["methods"]
    assert set(methods) == {"epitransfer", "dlt", "epitransfer-lateral", "epitransfer-vertical"}
    common = {name: found["common"] for name, found in methods.items()}
    assert len({found["n"] for found in common.values()}) == 1, "the same pixels for every method"
    assert 0.001 < methods["epitransfer"]["all"]["abs_rel"] < 0.02
    without = metrics["without_control"]["methods"]["epitransfer"]["all"]["abs_rel"]
    assert methods["epitransfer"]["all"]["abs_rel"] < without < 0.1, "the flight as a whole is off"
    assert methods["epitransfer"]["all"]["abs_rel"] < methods["dlt"]["all"]["abs_rel"]
    assert methods["epitransfer"]["kept_share"] > 0.7
    assert 0.5 < metrics["calibration"]["within_1_sigma"] <= 1.0
    poses = relative_poses_of(pq.read_table(small_run / "relative_poses.parquet"))
    assert all(np.linalg.eigvalsh(pose.covariance).min() > 0.0 for pose in poses.values())


def test_the_manifest_tells_every_stage(small_run: Path) -> None:
    stages = json.loads((small_run / "manifest.json").read_text())["stages"]
    assert set(stages) == set(STAGES)
    for entry in stages.values():
        assert {"version", "config", "outputs", "seconds", "peak_memory_mib", "parts"} <= set(entry)
    assert stages["ingest"]["config"]["geoid"] == {"value": -33.0, "from": "workflow.toml"}
    assert stages["depth"]["config"]["max_range_m"]["from"] == "default"
    assert stages["depth"]["outputs"]["depths"]["rows"] == sum(
        pq.read_metadata(file).num_rows for file in (small_run / "depths").glob("*.parquet")
    )


# --- the same bytes every way ---


def test_two_processes_give_the_same_bytes(small_flight: Path, small_run: Path, tmp_path: Path) -> None:
    done = epitransfer("run", small_flight / "workflow.toml", "--out", tmp_path / "run", "--jobs", 2)
    assert done.returncode == 0, done.stderr
    assert outputs(tmp_path / "run") == outputs(small_run)


def test_a_dask_cluster_gives_the_same_bytes(small_flight: Path, small_run: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, protocol="tcp://", dashboard_address=None
    ) as cluster:
        address = cluster.scheduler_address
        code = command_line(
            ["run", str(small_flight / "workflow.toml"), "--out", str(tmp_path / "run"), "--scheduler", address]
        )
    assert code == 0
    assert outputs(tmp_path / "run") == outputs(small_run)


def test_stage_by_stage_gives_the_same_bytes(small_flight: Path, small_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert command_line(["ingest", str(run), "--workflow", str(small_flight / "workflow.toml"), "--jobs", "1"]) == 0
    for stage in STAGES[1:]:
        assert command_line([stage, str(run), "--jobs", "1"]) == 0
    assert outputs(run) == outputs(small_run)


# --- only what changed ---


def ran(stderr: str) -> dict[str, bool]:
    """Stage to whether it ran (or was up to date)."""
    found = {}
    for line in stderr.splitlines():
        stage = line.split(" ")[0]
        if stage in STAGES:
            found[stage] = "up to date" not in line
    return found


def again(
    capsys: pytest.CaptureFixture[str], flight: Path, run: Path, *arguments: str, expected: int = 0
) -> dict[str, bool]:
    capsys.readouterr()
    code = command_line(["run", str(flight / "workflow.toml"), "--out", str(run), "--jobs", "1", *arguments])
    text = capsys.readouterr().err
    assert code == expected, text
    return ran(text)


def test_only_the_stages_that_read_a_changed_key_run_again(
    small_flight: Path, small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = copied(small_run, tmp_path / "run")
    assert again(capsys, small_flight, run) == dict.fromkeys(STAGES, False)
    nearer = again(capsys, small_flight, run, "--set", "depth.max_range_m=40")
    assert [stage for stage, did in nearer.items() if did] == ["depth", "fuse", "score", "report"]
    assert outputs(run) != outputs(small_run)
    coarser = again(capsys, small_flight, run, "--set", "depth.max_range_m=40", "--set", "fuse.voxel_m=1.0")
    assert [stage for stage, did in coarser.items() if did] == ["fuse", "score", "report"]
    back = again(capsys, small_flight, run)
    assert [stage for stage, did in back.items() if did] == ["depth", "fuse", "score", "report"]
    assert outputs(run) == outputs(small_run), "back to where it was"
    assert leftovers(run) == []


def test_from_and_to_choose_stages(
    small_flight: Path, small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = copied(small_run, tmp_path / "run")
    chosen = again(capsys, small_flight, run, "--from", "refine", "--to", "depth")
    assert chosen == {"refine": True, "depth": False}, "the same poses as before: depth has nothing to do"
    assert outputs(run) == outputs(small_run)
    assert again(capsys, small_flight, tmp_path / "new", "--to", "pair") == {"ingest": True, "pair": True}
    assert not (tmp_path / "new" / "matches").exists()
    assert again(capsys, small_flight, tmp_path / "other", "--from", "depth", expected=3) == {}


def test_a_lost_output_is_made_again_alone(
    small_flight: Path, small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = copied(small_run, tmp_path / "run")
    (run / "pairs.parquet").unlink()
    (run / "scores" / "metrics.json").write_text("{}")
    did = again(capsys, small_flight, run)
    assert [stage for stage, it in did.items() if it] == ["pair", "score"]
    assert outputs(run) == outputs(small_run)


def test_another_photo_changes_all_that_follows(
    small_flight: Path, small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = shutil.copytree(small_flight, tmp_path / "flight")
    run = copied(small_run, tmp_path / "run")
    (flight / "photos" / "DJI_0003.JPG").unlink()
    did = again(capsys, flight, run, "--to", "match")
    assert did == {"ingest": True, "pair": True, "match": True}
    assert pq.read_metadata(run / "frames.parquet").num_rows == 5


def test_photos_that_moved_are_found_and_nothing_else_runs_again(
    small_flight: Path, small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From the card to the disk: later stages read the images where they are now, not where they were."""
    first = shutil.copytree(small_flight, tmp_path / "card")
    run = copied(small_run, tmp_path / "run")
    again(capsys, first, run)
    moved = first.rename(tmp_path / "disk")
    assert command_line(["status", str(run), "--json"]) == 0, "status does not need the sources"
    assert json.loads(capsys.readouterr().out)["stages"]["ingest"]["status"] == "stale"
    did = again(capsys, moved, run)
    assert [stage for stage, it in did.items() if it] == ["ingest", "report"]
    coarser = again(capsys, moved, run, "--set", "fuse.voxel_m=1.0")
    assert [stage for stage, it in coarser.items() if it] == ["fuse", "score", "report"]


# --- sources on the command line, exports ---


def test_photos_and_tiles_stand_in_for_a_workflow(
    small_flight: Path, small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    given = f"--photos {small_flight / 'photos'} --lidar {small_flight / 'lidar'} --out {run} --jobs 1 --to pair --json"
    stated = ("ingest.height_datum=navd88", "ingest.geoid=-33.0", "ingest.crs=EPSG:32617+5703")
    code = command_line(["run", *given.split(), *(part for item in stated for part in ("--set", item))])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    assert set(json.loads(captured.out)["stages"]) == {"ingest", "pair"}
    kept = (run / "workflow.toml").read_text()
    assert f'photos = "{small_flight / "photos"}"' in kept
    assert "[score]" in kept
    frames = "frames.parquet"
    assert outputs(run)[frames] == outputs(small_run)[frames]


def rows_in(path: Path) -> int:
    """Points in an exported file, by a reader that is not ours."""
    if path.suffix in {".laz", ".las"}:
        with laspy.open(path) as reader:
            points = reader.read()
            assert reader.header.parse_crs() is not None
            assert "sigma_z" in " ".join(points.point_format.extra_dimension_names)
            return len(points)
    if path.suffix == ".csv":
        with path.open(newline="") as stream:
            return sum(1 for row in csv.reader(stream) if row and not row[0].startswith("#")) - 1
    if path.suffix == ".gpkg":
        with sqlite3.connect(path) as base:
            table = base.execute("SELECT table_name FROM gpkg_contents").fetchone()[0]
            return int(base.execute(f'SELECT COUNT(*) FROM "{table}"').fetchone()[0])  # noqa: S608 - the file's own name
    if path.suffix == ".ply":
        found = re.search(rb"element vertex (\d+)", path.read_bytes()[:4000])
        assert found
        return int(found.group(1))
    return int(pq.read_metadata(path).num_rows)


@pytest.mark.parametrize("kind", ["laz", "las", "ply", "gpkg", "csv", "parquet"])
def test_every_export_opens_with_all_points(
    small_run: Path, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"points.{kind}"
    assert command_line(["export", str(small_run), "--to", str(path)]) == 0
    count = sum(pq.read_metadata(file).num_rows for file in (small_run / "points").glob("*.parquet"))
    assert rows_in(path) == count > 1000
    assert str(count) in capsys.readouterr().out
    # A format that has no room for the CRS has it beside.
    assert {p.name for p in tmp_path.iterdir() if p.is_file()} <= {path.name, "points.prj"}


def test_two_cameras_in_one_flight(small_flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every other photo by a camera of another size: pairs across the two give depths too."""
    other = write_small_flight(tmp_path / "other", camera=SMALL.scaled(360, 270))
    flight = shutil.copytree(small_flight, tmp_path / "flight")
    for n in (2, 4, 6):
        name = f"DJI_000{n}.JPG"
        shutil.copy(other / "photos" / name, flight / "photos" / name)
    # The control points are those of photos of the first size.
    recipe = flight / "workflow.toml"
    recipe.write_text("".join(line for line in recipe.open() if not line.startswith("control_")))
    again(capsys, flight, tmp_path / "run")
    assert pq.read_metadata(tmp_path / "run" / "cameras.parquet").num_rows == 2
    depths = pq.read_table(tmp_path / "run" / "depths").to_pandas()
    mixed = depths[depths.pair_id.isin(["DJI_0002~DJI_0001", "DJI_0003~DJI_0002"]) & (depths.method == "epitransfer")]
    assert mixed.kept.sum() > 100
    metrics = json.loads((tmp_path / "run" / "scores" / "metrics.json").read_text())
    assert metrics["methods"]["epitransfer"]["all"]["abs_rel"] < 0.1
