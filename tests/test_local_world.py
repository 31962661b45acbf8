"""Runs in a frame tied to no place on earth: the engineering CRS in every product, and LiDAR in the same frame."""

from __future__ import annotations

import csv
import json
import sqlite3
from pathlib import Path
from typing import Any

import geopandas
import laspy
import numpy as np
import pyarrow.parquet as pq
import pytest
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS
from test_points_files import synthetic_columns, write_points
from test_score import HEIGHT_M, FakeContext, make_context, scores

from pipeline.engine.config import resolve
from pipeline.engine.errors import InputError, NothingLeftError, UndeterminedError, UsageError
from pipeline.engine.executors import SerialExecutor
from pipeline.engine.progress import Reporter
from pipeline.engine.runfolder import RunFolder, output_name
from pipeline.engine.runner import run_stage, staleness
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.geodesy.crs import local_output
from pipeline.geodesy.local_world import LOCAL_WKT, LocalTransform, is_engineering
from pipeline.geometry.cameras import Camera
from pipeline.lidar.nearby import LocalTiles
from pipeline.lidar.spacing import surface_spacing_m
from pipeline.lidar.sweeps import write_sweeps
from pipeline.lidar.tiles import read_local_tile, read_tile
from pipeline.lidar.visibility import View, visible_returns
from pipeline.points.exporters import WRITERS, export_points
from pipeline.points.geoparquet import PointDataset
from pipeline.points.stac import item
from pipeline.sources.records import Sweep
from schemas import CLOCKS
from stages import fuse, score

LOCAL = CRS.from_wkt(LOCAL_WKT)
FACTS: dict[str, Any] = {"world": "local", "origin": None, "height_datum": "local"}


def settings(crs: str) -> Any:
    return {"ingest.crs": crs, "ingest.geoid": None}.get


# ---- the CRS


def test_the_crs_is_an_engineering_one_with_three_axes_in_metres() -> None:
    crs = LocalTransform().crs
    assert [part.type_name for part in crs.sub_crs_list] == ["Engineering CRS", "Vertical CRS"]
    assert [(axis.direction, axis.unit_conversion_factor) for axis in crs.axis_info] == [
        ("east", 1.0),
        ("north", 1.0),
        ("up", 1.0),
    ]
    for again in (CRS.from_json(crs.to_json()), CRS.from_wkt(crs.to_wkt("WKT2_2019")), CRS.from_wkt(crs.to_wkt())):
        assert again == crs
    assert is_engineering(CRS.from_wkt(crs.to_wkt("WKT1_GDAL")))
    assert not is_engineering(CRS("EPSG:32617+5703"))


def test_the_transform_changes_nothing_and_keeps_its_hands_off_the_input() -> None:
    transform = LocalTransform()
    points = np.random.default_rng(0).normal(0.0, 10.0, (4, 5, 3))
    for found in (transform.from_enu(points), transform.enu_from(points)):
        assert np.array_equal(found, points)
        assert not np.shares_memory(found, points)
    assert np.array_equal(transform.jacobian(points), np.broadcast_to(np.eye(3), (4, 5, 3, 3)))
    assert transform.jacobian(points[0, 0]).shape == (3, 3)


@pytest.mark.parametrize("crs", ["auto", "local", " Local "])
def test_local_poses_give_local_points(crs: str) -> None:
    assert local_output(crs).crs == LOCAL
    fuse.foresee(fuse.Config(), settings(crs), FACTS)


def test_local_poses_reach_no_crs_on_earth() -> None:
    with pytest.raises(UsageError, match=r"E-CRS-07(.|\n)*ingest\.crs(.|\n)*EPSG:32617(.|\n)*auto or local"):
        fuse.foresee(fuse.Config(), settings("EPSG:32617"), FACTS)


def test_flights_on_earth_are_as_before() -> None:
    earth = {"origin": {"latitude_deg": 37.5, "longitude_deg": -78.3, "height_m": 120.0}, "height_datum": "ellipsoidal"}
    fuse.foresee(fuse.Config(), settings("EPSG:32617"), earth)
    fuse.foresee(fuse.Config(), settings("auto"), {**earth, "world": "earth"})
    fuse.foresee(fuse.Config(), settings("auto"), {**earth, "origin": None})
    with pytest.raises(UsageError, match="E-CRS-01"):
        fuse.foresee(fuse.Config(), settings("local"), earth)


# ---- points in every format


def room_columns() -> dict[str, object]:
    columns = synthetic_columns(3000)
    rng = np.random.default_rng(1)
    return columns | {axis: rng.uniform(-6.0, 6.0, 3000).round(3) for axis in "xyz"}


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "points"
    files = write_points(folder, room_columns(), LOCAL)
    (folder / "item.json").write_text(json.dumps(item(files, LOCAL, "points", "text")))
    return folder


def test_geoparquet_holds_the_crs_twice(points: Path) -> None:
    dataset = PointDataset(points)
    assert (dataset.crs, dataset.rows, len(dataset.files)) == (LOCAL, 3000, 4)
    metadata = pq.read_metadata(dataset.files[0])
    geo = json.loads(metadata.metadata[b"geo"])["columns"]["geometry"]
    assert geo["crs"]["type"] == "CompoundCRS"
    kind = json.loads(metadata.schema.column(0).logical_type.to_json())
    assert CRS.from_json(kind["crs"]) == LOCAL
    assert geopandas.read_parquet(dataset.files[0]).crs == LOCAL


def test_stac_item_has_no_place_on_earth(points: Path) -> None:
    described = json.loads((points / "item.json").read_text())
    # STAC 1.1.0, item-spec: bbox is prohibited where the geometry is null.
    assert described["geometry"] is None
    assert "bbox" not in described
    assert CRS.from_json_dict(described["properties"]["proj:projjson"]) == LOCAL
    assert described["properties"]["proj:code"] is None
    assert described["properties"]["proj:bbox"] == pytest.approx(list(PointDataset(points).bounds))
    assert described["properties"]["pc:count"] == 3000


@pytest.mark.parametrize("suffix", list(WRITERS))
def test_every_format_takes_it(points: Path, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"p{suffix}"
    assert export_points(points, path) == 3000
    if suffix in {".las", ".laz"}:
        las = laspy.read(path)
        crs, z = las.header.parse_crs(), np.asarray(las.z)
        assert las.header.vlrs.get("WktCoordinateSystemVlr")[0].string.startswith('COMPD_CS["local frame",LOCAL_CS[')
    elif suffix == ".gpkg":
        frame = geopandas.read_file(path)
        crs, z = frame.crs, frame.geometry.z.to_numpy()
        with sqlite3.connect(path) as database:
            query = "SELECT definition_12_063 FROM gpkg_spatial_ref_sys WHERE srs_id = 100000"
            assert CRS.from_wkt(database.execute(query).fetchone()[0]) == LOCAL
    elif suffix == ".parquet":
        frame = geopandas.read_parquet(path)
        crs, z = frame.crs, frame.geometry.z.to_numpy()
    elif suffix == ".csv":
        crs = CRS.from_wkt(path.with_suffix(".prj").read_text())
        with path.open(newline="") as stream:
            z = np.array([float(row["z"]) for row in csv.DictReader(stream)])
    else:
        head = path.read_bytes().split(b"end_header")[0].decode()
        crs = CRS.from_wkt(next(line[12:] for line in head.splitlines() if line.startswith("comment crs ")))
        z = np.sort(np.concatenate([table.column("z") for table in PointDataset(points).tables()]))
    assert is_engineering(crs)
    assert [axis.direction for axis in crs.axis_info] == ["east", "north", "up"]
    want = np.concatenate([table.column("z") for table in PointDataset(points).tables()])
    assert np.abs(np.sort(z) - np.sort(want)).max() < 6e-4


# ---- LiDAR in the same frame


def write_local(path: Path, points_m: np.ndarray, wkt: str | None) -> Path:
    header = laspy.LasHeader(point_format=6, version="1.4")
    if wkt:
        header.vlrs.append(WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
    header.scales, header.offsets = np.full(3, 0.001), np.floor(points_m.min(axis=0))
    las = laspy.LasData(header)
    las.x, las.y, las.z = points_m.T
    las.write(path)
    return path


def ground() -> np.ndarray:
    """Flat ground at up 0, 6 returns per square metre, as the scene of test_score has it."""
    rng = np.random.default_rng(0)
    e, n = np.meshgrid(np.arange(-60.0, 60.0, 0.4), np.arange(0.0, 120.0, 0.4))
    level = np.column_stack([e.ravel(), n.ravel(), np.zeros(e.size)])
    level[:, :2] += rng.uniform(0.0, 0.4, (e.size, 2))
    return level


def moved(points_m: np.ndarray, east_m: float = 0.0, up_m: float = 0.0) -> np.ndarray:
    return points_m + np.array([east_m, 0.0, up_m])


def still(instants: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.broadcast_to(np.eye(3), (len(instants), 3, 3)), np.tile([0.0, 0.0, 1.5], (len(instants), 1))


def local_context(folder: Path, **changes: Any) -> FakeContext:
    context = make_context(folder, datum="local", **changes)
    context.ingest = dict(FACTS)
    (folder / "sweeps").mkdir(exist_ok=True)
    return context


def sweep_ground(folder: Path, points: np.ndarray | None = None) -> int:
    seen = (ground() if points is None else points) - (0.0, 0.0, 1.5)
    return write_sweeps([Sweep(0, seen, np.zeros(len(seen)))], still, folder / "sweeps" / "bag-00", max_range_m=200.0)


@pytest.mark.parametrize("wkt", [None, LOCAL_WKT, LOCAL.to_wkt("WKT1_GDAL"), 'LOCAL_CS["mine",UNIT["metre",1]]'])
def test_tiles_in_the_frame_of_the_poses_need_no_crs_on_earth(tmp_path: Path, wkt: str | None) -> None:
    path = write_local(tmp_path / "a.laz", ground(), wkt)
    context = local_context(tmp_path)
    config = score.Config(lidar=str(path))
    score.foresee(config, settings("auto"), context.ingest)
    score.STAGE.run(config, context)
    methods = scores(context)["methods"]
    assert methods["dlt"]["all"]["abs_rel"] == pytest.approx(0.2, abs=2e-4)
    assert methods["dlt"]["all"]["n"] > 800
    assert context.recorded["lidar_heights"] == ["local frame"]
    assert context.recorded["lidar"] == "tiles named"


@pytest.mark.parametrize(
    ("wkt", "code"),
    [
        (CRS("EPSG:32617+5703").to_wkt("WKT1_GDAL"), "E-LIDAR-10"),
        (CRS("EPSG:4979").to_wkt(), "E-LIDAR-10"),
        ('LOCAL_CS["site",UNIT["US survey foot",0.304800609601219],AXIS["E",EAST],AXIS["N",NORTH]]', "E-LIDAR-11"),
    ],
)
def test_tiles_on_earth_or_in_feet_do_not_meet_a_local_frame(tmp_path: Path, wkt: str, code: str) -> None:
    path = write_local(tmp_path / "a.laz", ground(), wkt)
    with pytest.raises(UndeterminedError, match=rf"{code}(.|\n)*a\.laz"):
        score.foresee(score.Config(lidar=str(path)), settings("auto"), FACTS)
    with pytest.raises(UndeterminedError, match=code):
        score.STAGE.run(score.Config(lidar=str(path)), local_context(tmp_path))


def test_a_tile_in_a_frame_of_its_own_does_not_meet_a_flight_on_earth(tmp_path: Path) -> None:
    path = write_local(tmp_path / "a.laz", ground(), LOCAL.to_wkt("WKT1_GDAL"))
    with pytest.raises(UndeterminedError, match=r"E-LIDAR-09(.|\n)*a\.laz"):
        read_tile(path, "ellipsoidal")
    assert read_local_tile(path).crs == LOCAL


@pytest.mark.parametrize("world", ["local", "earth"])
def test_without_tiles_the_runs_own_sweeps_are_the_reference(tmp_path: Path, world: str) -> None:
    returns = sweep_ground(tmp_path)
    # Heights above take-off are as good as any here: sweeps and cameras were posed alike.
    context = local_context(tmp_path) if world == "local" else make_context(tmp_path, datum="takeoff")
    config = score.Config()
    score.foresee(config, settings("auto"), {**context.ingest, "sweep_points": returns})
    score.STAGE.run(config, context)
    methods = scores(context)["methods"]
    assert methods["dlt"]["all"]["abs_rel"] == pytest.approx(0.2, abs=2e-4)
    assert methods["epitransfer"]["all"]["abs_rel"] == pytest.approx(0.1, abs=2e-4)
    assert methods["dlt"]["all"]["n"] > 800
    assert context.recorded["lidar"] == "the run's own sweeps"
    assert score.sources(config) == ()


def test_neither_tiles_nor_sweeps_is_refused_before_and_after(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"E-SCORE-06(.|\n)*score\.lidar") as early:
        score.foresee(score.Config(), settings("auto"), FACTS)
    assert early.value.exit_code == 2
    context = local_context(tmp_path)
    with pytest.raises(UsageError, match="E-SCORE-06"):
        score.STAGE.run(score.Config(), context)
    (tmp_path / "sweeps").rmdir()
    with pytest.raises(UsageError, match="E-SCORE-06"):
        score.STAGE.run(score.Config(), context)


def test_sweeps_elsewhere_and_on_nothing_matched_are_told_in_metres(tmp_path: Path) -> None:
    sweep_ground(tmp_path, moved(ground()[:50], east_m=500.0))
    with pytest.raises(InputError, match="E-LIDAR-01"):
        score.STAGE.run(score.Config(lidar=str(tmp_path / "none")), local_context(tmp_path))
    path = write_local(tmp_path / "a.laz", moved(ground(), east_m=5000.0), None)
    with pytest.raises(NothingLeftError, match=r"E-SCORE-03(.|\n)*east 4940(.|\n)*frame of the poses"):
        score.STAGE.run(score.Config(lidar=str(path)), local_context(tmp_path))
    high = write_local(tmp_path / "b.laz", moved(ground(), up_m=200.0), None)
    with pytest.raises(NothingLeftError, match=r"E-SCORE-04(.|\n)*one frame"):
        score.STAGE.run(score.Config(lidar=str(high)), local_context(tmp_path))


def test_a_ceiling_hides_nothing_below_it(tmp_path: Path) -> None:
    # The ground of the scene under a ceiling five metres above the cameras: as columns, it would hide all.
    under = np.concatenate([ground(), moved(ground(), up_m=HEIGHT_M + 5.0)])
    sweep_ground(tmp_path, under)
    context = local_context(tmp_path)
    score.STAGE.run(score.Config(), context)
    assert scores(context)["methods"]["dlt"]["all"]["abs_rel"] == pytest.approx(0.2, abs=2e-4)
    assert scores(context)["methods"]["dlt"]["all"]["n"] > 800


def test_a_wall_hides_what_is_behind_it_without_columns() -> None:
    rng = np.random.default_rng(3)
    far = np.column_stack([rng.uniform(-4, 4, 6000), np.full(6000, 8.0), rng.uniform(0, 4, 6000)])
    near = np.column_stack([rng.uniform(-1, 0.5, 3000), np.full(3000, 3.0), rng.uniform(0, 4, 3000)])
    points = np.concatenate([far, near])
    looking_north = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    view = View(Camera("pinhole", 640, 480, 500.0, 500.0, 319.5, 239.5), np.array([0.0, 0.0, 2.0]), looking_north)
    seen = visible_returns(view, points, None, surface_spacing_m(points), 20.0)
    behind = seen.index[seen.index < 6000]
    # The shadow of the near wall on the far one.
    shadow = (far[behind, 0] > -1 * 8 / 3 + 0.2) & (far[behind, 0] < 0.5 * 8 / 3 - 0.2)
    assert len(behind) > 800
    assert np.mean(shadow) < 0.005
    assert np.sum(seen.index >= 6000) > 1000


def test_tiles_in_the_run_frame_are_not_from_above(tmp_path: Path) -> None:
    tile = read_local_tile(write_local(tmp_path / "a.laz", ground(), None))
    tiles = LocalTiles((tile,))
    assert not tiles.from_above
    assert tiles.meeting(np.zeros((1, 3)), 10.0) == (tile,)
    assert tiles.meeting(np.full((1, 3), 500.0), 10.0) == ()


# ---- the engine


class MakeConfig(StageConfig):
    tiles: int = 0


def _make(config: MakeConfig, context: Context) -> str:
    for number in range(config.tiles):
        (context.output("sweeps") / f"s_{number}_0.laz").write_bytes(b"LASF" + bytes(number))
    return "made"


def _use(config: StageConfig, context: Context) -> str:
    del config
    folder = context.path("sweeps")
    context.record("seen", len(list(folder.glob("*.laz"))))
    context.write("clocks", CLOCKS.empty())
    return "used"


MAKE = Stage("make", 1, MakeConfig, (), ("sweeps",), _make)
USE = Stage("use", 1, StageConfig, ("sweeps",), ("clocks",), _use)


def run_both(folder: RunFolder, tiles: int) -> int:
    configuration = resolve([("test", {"make": {"tiles": tiles}, "use": {}})], {"make": MakeConfig, "use": StageConfig})
    with folder.locked(), SerialExecutor() as executor:
        for stage in (MAKE, USE):
            if staleness(stage, folder, configuration).status != "fresh":
                run_stage(stage, folder, configuration, executor, Reporter())
        assert staleness(MAKE, folder, configuration).status == "fresh"
        assert staleness(USE, folder, configuration).status == "fresh"
    record = folder.record("use")
    assert record is not None
    return int(record["facts"]["seen"])


def test_the_engine_keeps_a_folder_of_tiles_as_it_keeps_tables(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    assert output_name("sweeps") == "sweeps"
    assert run_both(folder, 0) == 0
    assert folder.output("sweeps").is_dir()
    assert run_both(folder, 2) == 2
    assert sorted(path.name for path in folder.output("sweeps").iterdir()) == ["s_0_0.laz", "s_1_0.laz"]
    # Tiles that came or went make stale what reads them.
    assert run_both(folder, 1) == 1
    (folder.output("sweeps") / "s_0_0.laz").unlink()
    assert run_both(folder, 1) == 1


def test_a_run_made_before_there_were_sweeps_can_still_be_read(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    configuration = resolve([("test", {"use": {}})], {"use": StageConfig})
    with folder.locked(), SerialExecutor() as executor:
        assert run_stage(USE, folder, configuration, executor, Reporter())["facts"]["seen"] == 0
