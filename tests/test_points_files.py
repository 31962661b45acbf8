"""The points dataset: tiles, Hilbert order, GeoParquet in the hands of other programs, STAC."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import duckdb
import duckdb_extension_spatial
import geopandas
import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS

from pipeline.engine.errors import InputError
from pipeline.geodesy.crs import output_crs
from pipeline.geodesy.enu import LocalFrame
from pipeline.points import stac, tiles, wkb
from pipeline.points.geoparquet import ROW_GROUP, PointDataset, TileFile, tile_table, write_dataset
from schemas import POINTS, SchemaError

COMPOUND = CRS("EPSG:32617+5703")
COUNT = 120_000
TILE_M = 250
LOW, HIGH = np.array([704_200.0, 4_152_000.0]), np.array([704_500.0, 4_152_250.0])
# A corner of one tile: 20 m by 20 m of 300 m by 250 m.
WINDOW = (704_300.0, 4_152_010.0, 704_320.0, 4_152_030.0)


def synthetic_columns(count: int = COUNT, seed: int = 3) -> dict[str, object]:
    """Columns of POINTS, rows in no order."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(LOW, HIGH, (count, 2)).round(3)
    floats = {
        name: rng.uniform(low, high, count).astype(np.float32)
        for name, low, high in (
            *((f"sigma_{axis}_m", 0.05, 0.5) for axis in "xyz"),
            *((name, -1e-3, 1e-3) for name in ("cov_xy", "cov_xz", "cov_yz")),
            *(("u", 0, 4000), ("v", 0, 3000), ("depth_m", 10, 90), ("parallax_deg", 1, 9)),
        )
    }
    colours = {name: rng.integers(0, 256, count).astype(np.uint8) for name in ("red", "green", "blue")}
    instants = 1_717_229_523_000_000_000 + 10**9 * rng.integers(0, 900, count)
    return {
        "x": xy[:, 0],
        "y": xy[:, 1],
        "z": rng.normal(110.0, 5.0, count).round(3),
        **floats,
        **colours,
        "n_pairs": rng.integers(1, 9, count),
        "n_frames": rng.integers(2, 10, count),
        "frame_id": np.array([f"DJI_{i:04d}" for i in range(40)])[rng.integers(0, 40, count)],
        "time": pa.array(instants).cast(pa.timestamp("ns", "UTC")),
    }


def tables_of(columns: dict[str, object]) -> Iterator[pa.Table]:
    xyz = np.column_stack([columns[axis] for axis in "xyz"])
    for name, rows in tiles.split(xyz, TILE_M):
        taken = {key: v.take(pa.array(rows)) if isinstance(v, pa.Array) else v[rows] for key, v in columns.items()}
        yield tile_table(taken, name)


def write_points(folder: Path, columns: dict[str, object], crs: CRS = COMPOUND) -> list[TileFile]:
    folder.mkdir(parents=True)
    return write_dataset(folder, tables_of(columns), crs)


@pytest.fixture(scope="module")
def columns() -> dict[str, object]:
    return synthetic_columns()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory, columns: dict[str, object]) -> Path:
    folder = tmp_path_factory.mktemp("run") / "points"
    write_points(folder, columns)
    return folder


@pytest.fixture(scope="module")
def largest(dataset: Path) -> Path:
    return dataset / "t_704250_4152000.parquet"


def inside(columns: dict[str, object]) -> int:
    x, y = columns["x"], columns["y"]
    return int(np.sum((x >= WINDOW[0]) & (y >= WINDOW[1]) & (x <= WINDOW[2]) & (y <= WINDOW[3])))


def window_filter() -> ds.Expression:
    xmin, ymin = ds.field("bbox", "xmin"), ds.field("bbox", "ymin")
    return (xmin >= WINDOW[0]) & (xmin <= WINDOW[2]) & (ymin >= WINDOW[1]) & (ymin <= WINDOW[3])


class TestTiles:
    def test_hilbert_neighbours_are_neighbours(self) -> None:
        # A corner block of the square is a stretch of the curve: every index once, every step to an adjacent cell.
        side = 32
        cells = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
        index = tiles.hilbert_index(cells)
        order = np.argsort(index)
        assert np.array_equal(index[order], np.arange(side * side))
        assert np.all(np.abs(np.diff(cells[order], axis=0)).sum(axis=1) == 1)

    def test_hilbert_covers_the_whole_square(self) -> None:
        corners = np.array([[0, 0], [65535, 0], [0, 65535], [65535, 65535]])
        index = tiles.hilbert_index(corners)
        # It begins in one corner, ends in the next along an edge, and passes the two others in between.
        assert index.min() == 0
        assert index.max() == 2**32 - 1
        assert len(set(index.tolist())) == 4

    @given(st.lists(st.tuples(st.integers(0, 65535), st.integers(0, 65535)), min_size=2, max_size=50, unique=True))
    def test_hilbert_is_one_to_one(self, cells: list[tuple[int, int]]) -> None:
        assert len(set(tiles.hilbert_index(np.array(cells)).tolist())) == len(cells)

    def test_edges_belong_to_the_tile_above_and_right(self) -> None:
        points = np.array([[704_250.0, 4_152_000.0, 1.0], [704_249.999, 4_152_249.999, 1.0], [-0.1, -250.0, 0.0]])
        names = [tiles.tile_name(corner) for corner in tiles.tile_corners(points, 250)]
        assert names == ["t_704250_4152000", "t_704000_4152000", "t_-250_-250"]

    def test_split_keeps_every_row_once_whatever_their_order(self) -> None:
        rng = np.random.default_rng(0)
        points = rng.uniform(0, 900, (5000, 3))
        shuffled = rng.permutation(5000)
        one = {name: points[rows] for name, rows in tiles.split(points, 250)}
        two = {name: points[shuffled][rows] for name, rows in tiles.split(points[shuffled], 250)}
        assert sum(map(len, one.values())) == 5000
        assert len(one) == 16
        assert all(np.array_equal(one[name], two[name]) for name in one)
        assert list(tiles.split(np.zeros((0, 3)), 250)) == []


class TestWkb:
    def test_a_point_byte_for_byte(self) -> None:
        # OGC 06-103r4: order 1, type 1001, three doubles.
        want = bytes.fromhex("01e9030000000000000000f03f0000000000000040000000000000f0bf")
        assert wkb.point_z(np.array([[1.0, 2.0, -1.0]])) == want
        assert wkb.point_z_column(np.array([[1.0, 2.0, -1.0]] * 2)).to_pylist() == [want, want]

    def test_shapely_reads_it(self) -> None:
        points = np.random.default_rng(2).normal(0, 1e6, (50, 3))
        read = shapely.from_wkb(wkb.point_z_column(points).to_pylist())
        assert np.array_equal(shapely.get_coordinates(read, include_z=True), points)


class TestDataset:
    def test_files_hold_the_schema_and_every_point(self, dataset: Path, columns: dict[str, object]) -> None:
        points = PointDataset(dataset)
        tables = list(points.tables())
        for table in tables:
            POINTS.check(table)
        joined = pa.concat_tables(tables)
        assert points.rows == joined.num_rows == COUNT
        order = [np.lexsort(np.column_stack([source[a] for a in "xyz"]).T) for source in (columns, joined.to_pydict())]
        for name in ("x", "z", "sigma_z_m", "blue", "n_pairs"):
            assert np.array_equal(np.asarray(columns[name])[order[0]], joined.column(name).to_numpy()[order[1]])
        assert points.crs == COMPOUND
        assert points.bounds[2] == np.min(columns["z"])

    def test_parquet_geometry_and_geo_key_side_by_side(self, largest: Path) -> None:
        metadata = pq.read_metadata(largest)
        kind = json.loads(metadata.schema.column(0).logical_type.to_json())
        assert kind["Type"] == "Geometry"
        assert CRS.from_json(kind["crs"]) == COMPOUND
        statistics = metadata.row_group(0).column(0).geo_statistics
        geo = json.loads(metadata.metadata[b"geo"])
        column = geo["columns"][geo["primary_column"]]
        assert geo["version"] == "1.1.0"
        assert column["encoding"] == "WKB"
        assert column["geometry_types"] == ["Point Z"]
        assert column["crs"]["type"] == "CompoundCRS"
        assert column["covering"]["bbox"]["zmax"] == ["bbox", "zmax"]
        assert len(column["bbox"]) == 6
        assert column["bbox"][0] <= statistics.xmin
        assert column["bbox"][5] >= statistics.zmax
        assert list(statistics.geospatial_types) == [wkb.POINT_Z]

    def test_encodings(self, largest: Path) -> None:
        group = pq.read_metadata(largest).row_group(0)
        found = {c.path_in_schema: c for c in map(group.column, range(group.num_columns))}
        assert {c.compression for c in found.values()} == {"ZSTD"}
        for name in ("x", "sigma_z_m", "bbox.xmin"):
            assert "BYTE_STREAM_SPLIT" in found[name].encodings
        assert "RLE_DICTIONARY" in found["frame_id"].encodings
        assert "RLE_DICTIONARY" not in found["x"].encodings

    def test_equal_input_gives_equal_bytes(self, tmp_path: Path) -> None:
        columns = synthetic_columns(3000)
        for name in ("one", "two"):
            write_points(tmp_path / name, columns)
        for file in sorted((tmp_path / "one").iterdir()):
            assert file.read_bytes() == (tmp_path / "two" / file.name).read_bytes()

    def test_a_window_reads_only_its_row_groups(self, largest: Path, columns: dict[str, object]) -> None:
        metadata = pq.read_metadata(largest)
        assert metadata.num_row_groups > 1
        assert max(metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)) <= ROW_GROUP
        fragment = next(ds.dataset(largest).get_fragments())
        kept = fragment.split_by_row_group(window_filter())
        assert len(kept) == 1
        assert sum(piece.count_rows(filter=window_filter()) for piece in kept) == inside(columns) > 0

    def test_a_window_skips_other_files(self, dataset: Path) -> None:
        whole = ds.dataset(dataset, format="parquet")
        touched = [f for f in whole.get_fragments() if f.split_by_row_group(window_filter())]
        assert len(list(whole.get_fragments())) == 2
        assert [Path(f.path).name for f in touched] == ["t_704250_4152000.parquet"]

    def test_columns_must_be_the_schemas(self) -> None:
        columns = synthetic_columns(5)
        columns.pop("v")
        with pytest.raises(SchemaError, match="v"):
            tile_table(columns, "t_0_0")

    def test_no_dataset(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="epitransfer fuse"):
            PointDataset(tmp_path / "points")

    def test_damaged_files_are_named(self, tmp_path: Path) -> None:
        write_points(tmp_path / "points", synthetic_columns(500))
        file = min((tmp_path / "points").iterdir())
        whole = file.read_bytes()
        for damaged in (whole[: len(whole) // 2], b"", b"PAR1 not parquet"):
            file.write_bytes(damaged)
            with pytest.raises(InputError, match=re.escape(file.name)):
                PointDataset(tmp_path / "points")
        pq.write_table(pa.table({"x": [1.0]}), file)
        with pytest.raises(InputError, match="E-POINTS-03"):
            PointDataset(tmp_path / "points")

    def test_damage_inside_a_row_group_is_an_input_error(self, tmp_path: Path) -> None:
        write_points(tmp_path / "points", synthetic_columns(500))
        file = min((tmp_path / "points").iterdir())
        data = bytearray(file.read_bytes())
        data[4:2000] = bytes(1996)
        file.write_bytes(data)
        with pytest.raises(InputError, match="E-POINTS-02"):
            list(PointDataset(tmp_path / "points").tables())


class TestOtherPrograms:
    def test_geopandas(self, dataset: Path, largest: Path, columns: dict[str, object]) -> None:
        frame = geopandas.read_parquet(dataset)
        assert len(frame) == COUNT
        assert frame.crs == COMPOUND
        assert frame.has_z.all()
        assert np.array_equal(frame.geometry.x, frame["x"])
        assert len(geopandas.read_parquet(largest, bbox=WINDOW)) == inside(columns)

    def test_duckdb(self, dataset: Path, columns: dict[str, object]) -> None:
        files = f"'{dataset}/*.parquet'"
        with duckdb.connect() as connection:
            (kind,) = connection.sql(f"select distinct typeof(geometry) from {files}").fetchall()  # noqa: S608  # ours
            where = f"bbox.xmin between {WINDOW[0]} and {WINDOW[2]} and bbox.ymin between {WINDOW[1]} and {WINDOW[3]}"
            (count,) = connection.sql(f"select count(*) from {files} where {where}").fetchall()  # noqa: S608  # ours
        crs = re.fullmatch(r"GEOMETRY\('(.*)'\)", kind[0])
        assert crs is not None
        assert CRS.from_json(crs[1]) == COMPOUND
        assert count[0] == inside(columns)

    @pytest.mark.parametrize("check", ["all", "bbox", "compression", "row-group", "spatial"])
    def test_gpio_check(self, largest: Path, gpio_home: Path, check: str) -> None:
        done = run_gpio(gpio_home, "check", check, str(largest))
        assert done.returncode == 0, done.stdout + done.stderr
        # `all` counts one failure, the one that test_gpio_spec looks at.
        assert "✗" not in done.stdout or check == "all"

    def test_gpio_spec(self, largest: Path, gpio_home: Path) -> None:
        done = run_gpio(gpio_home, "check", "spec", "--json", str(largest))
        checks = json.loads(done.stdout[done.stdout.index("{") :])["checks"]
        failed = [check for check in checks if check["status"] == "failed"]
        # geoparquet-io holds that GEOMETRY belongs to 2.0; the files carry it on top of a complete 1.1.
        assert all("native" in json.dumps(check) for check in failed), failed
        assert len(failed) <= 1
        assert len(checks) > 20

    def test_ellipsoidal_and_takeoff_crs_are_read_too(self, tmp_path: Path) -> None:
        frame = LocalFrame(37.5, -78.3, 100.0)
        for datum in ("ellipsoidal", "takeoff"):
            crs = output_crs("auto", frame, datum).crs
            write_points(tmp_path / datum, synthetic_columns(50), crs)
            found = geopandas.read_parquet(tmp_path / datum).crs
            assert (
                found.to_3d() == crs
                if datum == "ellipsoidal"
                else found.sub_crs_list[1].name == "height above take-off"
            )


class TestStac:
    def make(self, tmp_path: Path, crs: CRS = COMPOUND) -> dict[str, object]:
        return stac.item(write_points(tmp_path / "points", synthetic_columns(4000), crs), crs, "flight", "Points.")

    def test_item_is_whole_and_plain_json(self, tmp_path: Path) -> None:
        item = json.loads(json.dumps(self.make(tmp_path), allow_nan=False))
        for key in ("type", "stac_version", "id", "geometry", "bbox", "properties", "links", "assets"):
            assert key in item
        properties = item["properties"]
        assert item["type"] == "Feature"
        assert properties["pc:type"] == "eopc"
        assert properties["pc:count"] == 4000
        assert properties["proj:code"] is None
        assert CRS.from_json_dict(properties["proj:projjson"]) == COMPOUND
        assert len(properties["proj:bbox"]) == 6
        assert properties["datetime"] is None
        assert re.fullmatch(r"2024-06-01T08:1\d:\d\dZ", properties["start_datetime"])
        assert properties["start_datetime"] < properties["end_datetime"]
        assert {s["name"]: (s["size"], s["type"]) for s in properties["pc:schemas"]}["red"] == (1, "unsigned")
        for asset in item["assets"].values():
            assert (tmp_path / "points" / asset["href"]).is_file()

    def test_footprint_holds_the_points_and_runs_counterclockwise(self, tmp_path: Path) -> None:
        item = self.make(tmp_path)
        ring = np.array(item["geometry"]["coordinates"][0])
        assert np.array_equal(ring[0], ring[-1])
        x, y = ring.T
        assert np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) > 0
        assert item["bbox"] == [x.min(), y.min(), x.max(), y.max()]
        assert item["bbox"][:2] == pytest.approx([-78.70, 37.49], abs=0.02)

    def test_no_times(self, tmp_path: Path) -> None:
        columns = synthetic_columns(10) | {"time": pa.nulls(10, pa.timestamp("ns", "UTC"))}
        item = stac.item(write_points(tmp_path / "points", columns), COMPOUND, "flight", "Points.")
        assert item["properties"]["start_datetime"] < "1800"
        assert item["properties"]["end_datetime"] > "9000"

    def test_no_wall_clock(self, tmp_path: Path) -> None:
        assert self.make(tmp_path / "a") == self.make(tmp_path / "b")


@pytest.fixture(scope="module")
def gpio_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home folder where DuckDB finds its spatial extension, as the package of that name carries it."""
    home = tmp_path_factory.mktemp("home")
    shutil.copytree(Path(duckdb_extension_spatial.__file__).with_name("extensions"), home / "packaged")
    (packaged,) = (home / "packaged").rglob("spatial.duckdb_extension*")
    with duckdb.connect() as connection:
        (platform,) = connection.sql("pragma platform").fetchone()
    place = home / ".duckdb" / "extensions" / f"v{duckdb.__version__}" / platform
    place.mkdir(parents=True)
    shutil.copy(packaged, place / packaged.name)
    return home


def run_gpio(home: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    gpio = str(Path(sys.executable).with_name("gpio"))
    environment = os.environ | {"COLUMNS": "200", "NO_COLOR": "1", "HOME": str(home)}
    return subprocess.run([gpio, *arguments], capture_output=True, text=True, check=False, env=environment)
