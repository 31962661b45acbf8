"""Points in other formats, read back by other programs."""

import csv
import sqlite3
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import geopandas
import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import typer
from pyproj import CRS
from test_points_files import COMPOUND, synthetic_columns, write_points
from typer.testing import CliRunner

from pipeline.engine.errors import InputError, ResourceError, UsageError
from pipeline.geodesy.crs import output_crs
from pipeline.geodesy.enu import LocalFrame
from pipeline.points.exporters import WRITERS, export_points
from pipeline.points.geoparquet import PointDataset
from pipeline.points.las import gps_time, wkt1
from stages.export import command

COUNT = 6000
FULL_DISK = """
import resource, signal, sys
from pathlib import Path
from pipeline.engine.errors import ResourceError
from pipeline.points.exporters import WRITERS, export_points
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
for suffix in WRITERS:
    try:
        export_points(Path(sys.argv[1]), Path(sys.argv[2]) / f"p{suffix}")
    except ResourceError as error:
        print(f"{suffix}={error.code}")
"""
SITE = LocalFrame(37.5, -78.7, 100.0)


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "points"
    write_points(folder, synthetic_columns(COUNT))
    return folder


@pytest.fixture(scope="module")
def table(points: Path) -> pa.Table:
    return pa.concat_tables(PointDataset(points).tables())


def values(table: pa.Table, name: str) -> np.ndarray:
    return table.column(name).to_numpy()


class TestLas:
    @pytest.mark.parametrize("suffix", ["laz", "las"])
    def test_opens_in_laspy_with_crs_and_sigmas(
        self, points: Path, table: pa.Table, tmp_path: Path, suffix: str
    ) -> None:
        assert export_points(points, tmp_path / f"p.{suffix}") == COUNT
        las = laspy.read(tmp_path / f"p.{suffix}")
        assert (str(las.header.version), las.header.point_format.id) == ("1.4", 7)
        assert las.header.are_points_compressed == (suffix == "laz")
        crs = las.header.parse_crs()
        assert [part.to_epsg() for part in crs.sub_crs_list] == [32617, 5703]
        for axis in "xyz":
            assert np.abs(np.asarray(las[axis]) - values(table, axis)).max() < 5.1e-4
            assert np.array_equal(las[f"sigma_{axis}"], values(table, f"sigma_{axis}_m"))
        for name in ("cov_xy", "cov_xz", "cov_yz", "n_pairs"):
            assert np.array_equal(las[name], values(table, name))
        assert np.array_equal(np.asarray(las.red) // 257, values(table, "red"))
        assert las.red.max() == 65535
        assert las.header.maxs == pytest.approx([values(table, a).max() for a in "xyz"], abs=1e-3)
        assert las.header.global_encoding.wkt
        assert las.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
        seconds = (values(table, "time").astype(np.int64) - 315_964_800 * 10**9) / 1e9 + 18 - 1e9
        assert np.abs(las.gps_time - seconds).max() < 1e-6

    def test_wkt_is_version_1(self, points: Path, tmp_path: Path) -> None:
        export_points(points, tmp_path / "p.las")
        (vlr,) = laspy.read(tmp_path / "p.las").header.vlrs.get("WktCoordinateSystemVlr")
        assert vlr.string.startswith("COMPD_CS[")

    def test_ellipsoidal_and_takeoff_crs_keep_their_vertical_part(self) -> None:
        ellipsoidal = output_crs("auto", SITE, "ellipsoidal").crs
        assert CRS.from_wkt(wkt1(ellipsoidal)) == ellipsoidal
        takeoff = CRS.from_wkt(wkt1(output_crs("auto", SITE, "takeoff").crs))
        assert takeoff.sub_crs_list[1].name == "height above take-off"

    @pytest.mark.parametrize(
        ("instant", "leap"),
        [("2024-06-01", 18), ("2016-12-31", 17), ("2017-01-01", 18), ("2012-06-30", 15), ("1980-01-06", 0)],
    )
    def test_gps_time_counts_leap_seconds(self, instant: str, leap: int) -> None:
        day = datetime.fromisoformat(instant).replace(tzinfo=UTC)
        want = (day - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds() + leap - 1e9
        assert gps_time(np.array([int(day.timestamp()) * 10**9])) == pytest.approx([want])

    def test_points_without_a_time_have_gps_time_zero(self, tmp_path: Path) -> None:
        columns = synthetic_columns(20) | {"time": pa.nulls(20, pa.timestamp("ns", "UTC"))}
        write_points(tmp_path / "points", columns)
        for suffix in WRITERS:
            export_points(tmp_path / "points", tmp_path / f"p{suffix}")
        assert not np.any(laspy.read(tmp_path / "p.laz").gps_time)


class TestPly:
    def test_header_and_values(self, points: Path, table: pa.Table, tmp_path: Path) -> None:
        export_points(points, tmp_path / "p.ply")
        head, _, body = (tmp_path / "p.ply").read_bytes().partition(b"end_header\n")
        lines = head.decode("ascii").splitlines()
        assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
        assert f"element vertex {COUNT}" in lines
        (wkt,) = [line.removeprefix("comment crs ") for line in lines if line.startswith("comment crs ")]
        assert CRS.from_wkt(wkt) == COMPOUND
        sizes = {"double": "<f8", "float": "<f4", "uchar": "u1", "int": "<i4"}
        fields = [line.split()[1:] for line in lines if line.startswith("property")]
        read = np.frombuffer(body, np.dtype([(name, sizes[kind]) for kind, name in fields]))
        assert len(read) == COUNT
        for name in ("x", "y", "z", "sigma_z_m", "cov_xy", "red", "n_pairs"):
            assert np.array_equal(read[name], values(table, name))


class TestGeoPackage:
    def test_opens_in_geopandas_with_its_compound_crs(self, points: Path, table: pa.Table, tmp_path: Path) -> None:
        export_points(points, tmp_path / "p.gpkg")
        frame = geopandas.read_file(tmp_path / "p.gpkg", layer="points")
        assert [part.to_epsg() for part in frame.crs.sub_crs_list] == [32617, 5703]
        assert frame.has_z.all()
        assert np.array_equal(frame.geometry.z, values(table, "z"))
        assert np.array_equal(frame["sigma_x_m"], values(table, "sigma_x_m"))
        assert frame["frame_id"].tolist() == table.column("frame_id").to_pylist()
        assert frame["time"].iloc[0].tz_convert("UTC") == table.column("time")[0].as_py()

    @pytest.mark.parametrize("datum", ["ellipsoidal", "takeoff"])
    def test_other_vertical_parts(self, tmp_path: Path, datum: str) -> None:
        crs = output_crs("auto", SITE, datum).crs
        write_points(tmp_path / "points", synthetic_columns(30), crs)
        export_points(tmp_path / "points", tmp_path / "p.gpkg")
        found = geopandas.read_file(tmp_path / "p.gpkg").crs
        assert found.is_projected
        assert len(found.axis_info) == 3
        assert ("take-off" in found.name) == (datum == "takeoff")

    def test_is_a_geopackage(self, points: Path, tmp_path: Path) -> None:
        export_points(points, tmp_path / "p.gpkg")
        data = (tmp_path / "p.gpkg").read_bytes()
        assert data[68:72] == b"GPKG"
        with sqlite3.connect(tmp_path / "p.gpkg") as database:
            assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
            assert database.execute("PRAGMA foreign_key_check").fetchall() == []
            required = database.execute("SELECT srs_id FROM gpkg_spatial_ref_sys ORDER BY 1").fetchall()
            assert [row[0] for row in required[:3]] == [-1, 0, 4326]
            assert database.execute("SELECT z, m FROM gpkg_geometry_columns").fetchone() == (1, 0)


class TestCsv:
    def test_values_and_crs_beside(self, points: Path, table: pa.Table, tmp_path: Path) -> None:
        export_points(points, tmp_path / "p.csv")
        with (tmp_path / "p.csv").open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        assert len(rows) == COUNT
        assert "geometry" not in rows[0]
        for axis in "xyz":
            assert np.abs(np.array([float(row[axis]) for row in rows]) - values(table, axis)).max() < 5.1e-5
        assert np.array_equal(np.array([row["sigma_z_m"] for row in rows], np.float32), values(table, "sigma_z_m"))
        assert datetime.fromisoformat(rows[7]["time"]) == table.column("time")[7].as_py()
        assert CRS.from_wkt((tmp_path / "p.prj").read_text()) == COMPOUND


class TestParquet:
    def test_one_file_with_everything(self, points: Path, table: pa.Table, tmp_path: Path) -> None:
        export_points(points, tmp_path / "p.parquet")
        assert pq.read_metadata(tmp_path / "p.parquet").num_row_groups == 1
        one = PointDataset(tmp_path)
        assert pa.concat_tables(one.tables()).equals(table)
        assert one.bounds == PointDataset(points).bounds
        assert geopandas.read_parquet(tmp_path / "p.parquet").crs == COMPOUND


class TestEveryFormat:
    @pytest.mark.parametrize("suffix", list(WRITERS))
    def test_same_points_same_bytes(self, points: Path, tmp_path: Path, suffix: str) -> None:
        for name in ("a", "b"):
            export_points(points, tmp_path / f"{name}{suffix}")
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()

    @pytest.mark.parametrize("suffix", list(WRITERS))
    def test_a_failure_leaves_the_old_file_and_nothing_else(self, tmp_path: Path, suffix: str) -> None:
        write_points(tmp_path / "points", synthetic_columns(500))
        broken = max((tmp_path / "points").iterdir())
        data = bytearray(broken.read_bytes())
        data[4:3000] = bytes(2996)
        broken.write_bytes(data)
        out = tmp_path / "out"
        out.mkdir()
        (out / f"p{suffix}").write_text("the last export")
        with pytest.raises(InputError, match="E-POINTS-02"):
            export_points(tmp_path / "points", out / f"p{suffix}")
        assert [path.name for path in out.iterdir()] == [f"p{suffix}"]
        assert (out / f"p{suffix}").read_text() == "the last export"

    @pytest.mark.parametrize("suffix", list(WRITERS))
    def test_no_folder_to_write_to(self, points: Path, tmp_path: Path, suffix: str) -> None:
        with pytest.raises(ResourceError) as caught:
            export_points(points, tmp_path / "absent" / f"p{suffix}")
        assert caught.value.exit_code == 6

    def test_full_disk(self, points: Path, tmp_path: Path) -> None:
        # A limit on the size of files stops the writing where a full disk would; it is a process's own for good.
        done = subprocess.run(
            [sys.executable, "-c", FULL_DISK, str(points), str(tmp_path)], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.split() == [f"{suffix}=E-EXPORT-02" for suffix in WRITERS]
        assert list(tmp_path.iterdir()) == []

    def test_unknown_suffix_names_the_known_ones(self, points: Path, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match=r"\.laz, \.las, \.ply, \.gpkg, \.csv, \.parquet") as caught:
            export_points(points, tmp_path / "p.e57")
        assert caught.value.exit_code == 2

    def test_run_without_points(self, tmp_path: Path) -> None:
        with pytest.raises(InputError) as caught:
            export_points(tmp_path / "points", tmp_path / "p.laz")
        assert caught.value.exit_code == 3


def test_command_says_what_it_wrote(points: Path, tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(command)
    done = CliRunner().invoke(app, [str(points.parent), "--to", str(tmp_path / "p.laz")])
    assert done.exit_code == 0
    assert f"{COUNT} points" in done.stdout
