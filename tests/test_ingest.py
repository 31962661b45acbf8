"""Ingest as a whole: from folders of photos to the four tables."""

import json
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from photo_files import GIMBAL, exif_block, write_photo
from PIL.TiffImagePlugin import IFDRational
from pydantic import ValidationError
from typer.testing import CliRunner

from pipeline.engine.errors import InputError, UndeterminedError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geometry.rotations import enu_from_cam, rotation_from_quaternion
from pipeline.sources.accuracy import pose_sigmas
from pipeline.sources.dji import Fix
from pipeline.sources.files import common_root, find_images, relative_to
from schemas import TABLES
from stages.app import app
from stages.ingest import Config, run, sources


class Recorder:
    """A context without a run folder."""

    def __init__(self) -> None:
        self.tables: dict[str, pa.Table] = {}
        self.known: dict[str, Any] = {}
        self.warnings: list[str] = []
        self.items = (0, 0)
        self.folder = tempfile.TemporaryDirectory()

    def write(self, name: str, table: pa.Table) -> None:
        TABLES[name].check(table)
        self.tables[name] = table

    def write_pieces(self, name: str, pieces: Iterable[pa.Table]) -> None:
        self.write(name, pa.concat_tables(list(pieces)))

    def output(self, name: str) -> Path:
        folder = Path(self.folder.name) / name
        folder.mkdir(exist_ok=True)
        return folder

    def record(self, key: str, value: Any) -> None:
        self.known[key] = json.loads(json.dumps(value, allow_nan=False))

    def warn(self, text: str) -> None:
        self.warnings.append(text)

    def count_items(self, total: int, failed: int) -> None:
        self.items = (total, failed)

    def map(
        self, function: Callable[[Sequence[Any]], Any], items: Iterable[Any], *, shard: int, label: str
    ) -> Iterator[Any]:
        del label
        listed = list(items)
        for first in range(0, len(listed), shard):
            yield function(listed[first : first + shard])

    def rows(self, name: str) -> list[dict[str, Any]]:
        return self.tables[name].to_pylist()


def ingest(photos: Path | str, **keys: Any) -> Recorder:
    context = Recorder()
    run(Config(photos=str(photos), **keys), context)  # type: ignore[arg-type]
    return context


def flight(folder: Path, count: int = 3, *, rtk: bool = False, relative: bool = True, **exif: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for n in range(1, count + 1):
        tags = {**GIMBAL, "AbsoluteAltitude": f"{150 + n:+.2f}"}
        if relative:
            tags["RelativeAltitude"] = f"{40 + n:+.2f}"
        if rtk:
            tags |= {"RtkFlag": "50", "RtkStdLon": "0.011", "RtkStdLat": "0.012", "RtkStdHgt": "0.02"}
        place = {"latitude": 37.5 + n * 4.5e-5, "longitude": -78.3, "altitude": 150.0 + n}
        exif_of_photo = exif_block(place=place, taken=f"2024:06:01 08:12:0{n}", **exif)
        write_photo(folder / f"DJI_{n:04d}.JPG", xmp=tags, exif=exif_of_photo, colour=(n, 90, 60))
    return folder


@pytest.mark.real
@pytest.mark.parametrize(
    ("folder", "photos", "usable", "datum", "source"),
    [
        ("sheffield_cross", 19, 19, "unknown", "EXIF"),
        ("mirafiori_p4m_rtk", 8, 8, "ellipsoidal", "DewarpData"),
        ("brighton_beach", 4, 2, "takeoff", "EXIF"),
        ("narrabeen_hover_gcp", 4, 1, "takeoff", "EXIF"),
    ],
)
def test_real_sets(shared: Path, *, folder: str, photos: int, usable: int, datum: str, source: str) -> None:
    found = ingest(shared / "data/photos" / folder)
    assert found.items == (photos, photos - usable)
    assert found.known["height_datum"] == datum
    assert len(found.rows("cameras")) == 1
    assert found.rows("cameras")[0]["source"].startswith(source)
    good = [row for row in found.rows("frames") if row["usable"]]
    assert {row["height_datum"] for row in good} == {datum}
    for row in good:
        assert math.dist((row["east_m"], row["north_m"], row["up_m"]), (0, 0, 0)) < 150.0
        assert math.hypot(*(row[f"q{part}"] for part in "wxyz")) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.real
def test_real_turned_photos_are_named_with_a_remedy(shared: Path) -> None:
    rows = {row["frame_id"]: row for row in ingest(shared / "data/photos/brighton_beach").rows("frames")}
    for name in ("DJI_0026", "DJI_0027"):
        assert not rows[name]["usable"]
        assert "Windows Photo Viewer" in rows[name]["problem"]
        assert "use the original file" in rows[name]["problem"]
    assert rows["DJI_0020"]["usable"]
    assert rows["DJI_0021"]["usable"]


@pytest.mark.real
def test_real_rtk_sigmas_and_lens(shared: Path) -> None:
    found = ingest(shared / "data/photos/mirafiori_p4m_rtk")
    row = found.rows("frames")[0]
    assert row["sigma_east_m"] == row["own_sigma_east_m"] == 0.01053
    assert row["sigma_up_m"] == 0.0205
    assert row["height_m"] == 349.58
    assert found.rows("cameras")[0]["distortion"][0] == -0.42275


def test_pose_of_a_flight_due_north(tmp_path: Path) -> None:
    found = ingest(flight(tmp_path))
    rows = found.rows("frames")
    steps = np.diff([[row["east_m"], row["north_m"], row["up_m"]] for row in rows], axis=0)
    # 4.5e-5 degrees of latitude at 37.5 degrees are 4.995 m.
    assert steps == pytest.approx(np.array([[0.0, 4.9949, 1.0]] * 2), abs=1e-3)
    for row in rows:
        rotation = rotation_from_quaternion(np.array([row[f"q{part}"] for part in "wxyz"]))
        assert rotation == pytest.approx(enu_from_cam(0.0, -np.pi / 2, 0.0), abs=1e-5)
    assert found.known["origin"]["height_m"] == 41.0


def test_attitude_is_turned_from_the_cameras_north_to_the_origins(tmp_path: Path) -> None:
    """At 60 degrees north, 0.1 degrees of longitude apart, the two norths differ by 0.0866 degrees."""
    for n, longitude in enumerate((10.0, 10.1, 10.2)):
        block = exif_block(place={"latitude": 60.0, "longitude": longitude, "altitude": 100.0})
        write_photo(
            tmp_path / f"DJI_000{n}.JPG", xmp={**GIMBAL, "GimbalPitchDegree": "0", "RelativeAltitude": "50"}, exif=block
        )
    rows = ingest(tmp_path).rows("frames")
    axes = [rotation_from_quaternion(np.array([row[f"q{part}"] for part in "wxyz"]))[:, 2] for row in rows]
    headings = [math.degrees(math.atan2(axis[0], axis[1])) for axis in axes]
    assert headings == pytest.approx([0.0866, 0.0, -0.0866], abs=1e-3)
    assert [row["yaw_deg"] for row in rows] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("rtk", "relative", "stated", "datum", "first_m"),
    [
        (True, True, "auto", "ellipsoidal", 151.0),
        (False, True, "auto", "takeoff", 41.0),
        (False, False, "auto", "unknown", 151.0),
        (True, True, "takeoff", "takeoff", 41.0),
        (False, True, "ellipsoidal", "ellipsoidal", 151.0),
        (False, True, "egm96", "ellipsoidal", 151.0 - 33.25),
    ],
)
def test_heights(tmp_path: Path, *, rtk: bool, relative: bool, stated: str, datum: str, first_m: float) -> None:
    found = ingest(flight(tmp_path, rtk=rtk, relative=relative), height_datum=stated, geoid=-33.25)
    row = found.rows("frames")[0]
    assert (row["height_datum"], row["height_m"], row["usable"]) == (datum, first_m, True)
    assert found.known["height_datum"] == (stated if stated != "auto" else datum)


def test_an_orthometric_height_without_its_geoid_is_exit_4(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PROJ_NETWORK", "OFF")
    with pytest.raises(UndeterminedError, match=r"ingest\.geoid=METRES"):
        ingest(flight(tmp_path), height_datum="navd88")


def test_the_minority_of_another_datum_is_left_out(tmp_path: Path) -> None:
    flight(tmp_path / "a", count=4)
    write_photo(tmp_path / "DJI_0009.JPG", xmp=GIMBAL)
    rows = {row["frame_id"]: row for row in ingest(tmp_path).rows("frames")}
    assert "the run's heights are takeoff, its height is unknown" in rows["DJI_0009"]["problem"]
    assert sum(row["usable"] for row in rows.values()) == 4


def test_a_stated_datum_that_does_not_exist_is_a_configuration_error() -> None:
    with pytest.raises(ValidationError, match="did you mean egm2008"):
        Config(photos="x", height_datum="egm2080")


def marks(folder: Path, offset_s: float = 0.0) -> None:
    """Marks of the flight above, in UTC two hours behind the photos' local time."""
    week, second = divmod(
        (datetime(2024, 6, 1, 6, 12, 0, tzinfo=UTC) - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds(), 604800
    )
    lines = [
        f"{n}\t{second + 18 + n + offset_s:.6f}\t[{int(week)}]\t 3,N\t 0,E\t 75,V\t"
        f"{37.5 + n * 4.5e-5:.10f},Lat\t-78.3,Lon\t{117.0 + n:.3f},Ellh\t0.012, 0.011, 0.021\t50,Q"
        for n in (1, 2, 3)
    ]
    (folder / "flight.MRK").write_text("\n".join(lines))


def test_exposure_marks_are_used_where_they_agree(tmp_path: Path) -> None:
    marks(flight(tmp_path))
    found = ingest(tmp_path)
    row = found.rows("frames")[0]
    assert row["height_m"] == 118.0
    assert row["height_datum"] == "ellipsoidal"
    assert row["pose_source"] == "mrk position, xmp gimbal"
    assert row["time"] == datetime(2024, 6, 1, 6, 12, 1, tzinfo=UTC)
    assert (row["sigma_north_m"], row["sigma_east_m"], row["own_sigma_up_m"]) == (0.012, 0.011, 0.021)
    clocks = {clock["clock_id"]: clock for clock in found.rows("clocks")}
    assert clocks["flight.MRK"]["anchors"] == 3
    assert {track["stream"] for track in found.rows("tracks")} == {"photo", "mrk"}


def test_exposure_marks_that_disagree_are_said_and_left(tmp_path: Path) -> None:
    marks(flight(tmp_path), offset_s=5.0)
    found = ingest(tmp_path)
    assert found.rows("frames")[0]["height_datum"] == "takeoff"
    assert "+5 s apart" in found.warnings[0]
    assert "+5 s apart" in {clock["clock_id"]: clock for clock in found.rows("clocks")}["flight.MRK"]["problem"]


def test_a_damaged_mark_file_stops(tmp_path: Path) -> None:
    (flight(tmp_path) / "flight.MRK").write_text("1\tgarbage\n")
    with pytest.raises(InputError, match=r"flight\.MRK:1"):
        ingest(tmp_path)


def test_an_empty_mark_file_is_said(tmp_path: Path) -> None:
    (flight(tmp_path) / "flight.MRK").touch()
    assert "is empty" in ingest(tmp_path).warnings[0]


def test_clock_offset_moves_frames_and_not_the_log(tmp_path: Path) -> None:
    found = ingest(flight(tmp_path), clock_offset_s=-7200.0)
    assert found.rows("frames")[0]["time"] == datetime(2024, 6, 1, 6, 12, 1, tzinfo=UTC)
    assert found.rows("tracks")[0]["time"] == datetime(2024, 6, 1, 8, 12, 1, tzinfo=UTC)
    assert found.rows("clocks")[0]["offset_s"] == -7200.0


def test_two_cameras_in_one_folder(tmp_path: Path) -> None:
    flight(tmp_path)
    write_photo(
        tmp_path / "OTHER_0001.JPG",
        xmp={**GIMBAL, "RelativeAltitude": "40"},
        exif=exif_block(model="FC220"),
        size=(64, 48),
    )
    found = ingest(tmp_path)
    assert sorted((row["width"], row["height"]) for row in found.rows("cameras")) == [(64, 48), (80, 60)]
    assert {row["camera_id"] for row in found.rows("frames")} == {row["camera_id"] for row in found.rows("cameras")}


def test_a_calibration_file_wins(tmp_path: Path) -> None:
    calibration = tmp_path / "camera.yaml"
    calibration.write_text(
        "image_width: 80\nimage_height: 60\ncamera_matrix: {rows: 3, cols: 3, data: [70, 0, 40, 0, 71, 30, 0, 0, 1]}\n"
        "distortion_model: plumb_bob\ndistortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}\n"
    )
    config = Config(photos=str(flight(tmp_path / "photos")), camera=str(calibration))
    context = Recorder()
    run(config, context)  # type: ignore[arg-type]
    (camera,) = context.rows("cameras")
    assert (camera["fx"], camera["fy"], camera["distortion"][0]) == (70.0, 71.0, 0.1)
    assert camera["source"] == "calibration file camera.yaml"
    assert calibration in sources(config)


def test_tables_do_not_depend_on_the_place_of_the_folder(tmp_path: Path) -> None:
    first, second = (ingest(flight(tmp_path / name / "photos")) for name in ("a", "b"))
    assert all(first.tables[name].equals(second.tables[name]) for name in first.tables)


@pytest.mark.parametrize(
    ("model", "fix", "datum", "whole", "own"),
    [
        ("FC6310", Fix(), "unknown", (1.5, 1.5, 3.0), (0.053, 0.053, 0.053)),
        ("FC6310", Fix(), "takeoff", (1.5, 1.5, 0.5), (0.053, 0.053, 0.053)),
        ("FC6310", Fix(sigma_horizontal_m=2.1), "unknown", (2.1, 2.1, 3.0), (0.053, 0.053, 0.053)),
        ("FC6310R", Fix(50, 0.01, 0.02, 0.03), "ellipsoidal", (0.01, 0.02, 0.03), (0.01, 0.02, 0.03)),
        ("FC6310R", Fix(34, 0.5, 0.6, 0.9), "ellipsoidal", (0.5, 0.6, 0.9), (0.053, 0.053, 0.053)),
        ("FC6310R", Fix(0, 0.5, 0.6, 0.9), "takeoff", (1.5, 1.5, 0.5), (0.053, 0.053, 0.053)),
        ("EPISIM", Fix(), "takeoff", (0.26, 0.26, 0.26), (0.053, 0.053, 0.053)),
    ],
)
def test_sigmas(model: str, fix: Fix, datum: str, whole: tuple[float, ...], own: tuple[float, ...]) -> None:
    sigmas = pose_sigmas(model, fix, datum)
    assert sigmas.position_m == whole
    assert sigmas.own_position_m == own
    assert all(a <= b for a, b in zip(sigmas.own_attitude_deg, sigmas.attitude_deg, strict=True))


def test_the_photos_own_error_estimate_is_read(tmp_path: Path) -> None:
    found = ingest(flight(tmp_path, gps={31: IFDRational(7, 2)}))
    assert found.rows("frames")[0]["sigma_east_m"] == 3.5


def test_globs_lists_and_hidden_files(tmp_path: Path) -> None:
    flight(tmp_path / "100MEDIA")
    (tmp_path / "100MEDIA" / "._DJI_0001.JPG").write_bytes(b"not a photo")
    (tmp_path / "100MEDIA" / "notes.txt").write_text("x")
    assert len(find_images(str(tmp_path))) == 3
    assert len(find_images([str(tmp_path / "*" / "DJI_000[12].JPG"), str(tmp_path / "100MEDIA" / "DJI_0001.JPG")])) == 2
    root = common_root(find_images(str(tmp_path)))
    assert root == str(tmp_path / "100MEDIA")
    assert relative_to(str(tmp_path / "100MEDIA" / "DJI_0001.JPG"), root) == "DJI_0001.JPG"


def test_photos_behind_a_url(tmp_path: Path) -> None:
    local = ingest(flight(tmp_path))
    remote = ingest(f"file://{tmp_path}")
    assert remote.tables["frames"].equals(local.tables["frames"])


def test_inspect(tmp_path: Path) -> None:
    marks(flight(tmp_path))
    (tmp_path / "DJI_0004.JPG").touch()
    result = CliRunner().invoke(app, ["inspect", "--json", str(tmp_path)])
    assert result.exit_code == 0, result.output
    photos, exposures = json.loads(result.output)["sources"]
    assert (photos["photos"], photos["usable"], photos["height_datum"]) == (4, 3, "takeoff")
    assert photos["problems"][0]["example"].endswith("DJI_0004.JPG")
    assert exposures["exposures"] == 3
    text = CliRunner().invoke(app, ["inspect", str(tmp_path)]).output
    assert "gimbal_pitch_deg    -90 .. -90" in text


@pytest.mark.real
def test_inspect_tiles(shared: Path) -> None:
    result = CliRunner().invoke(app, ["inspect", "--json", str(shared / "data/photos/brighton_beach/model.laz")])
    (tile,) = json.loads(result.output)["sources"]
    assert tile["points"] == 940393
    assert "what its heights are measured from" in tile["problem"]


def test_origin_does_not_depend_on_order(tmp_path: Path) -> None:
    origin = ingest(flight(tmp_path)).known["origin"]
    assert LocalFrame(**origin) == LocalFrame(37.50009, -78.3, 41.0)
