"""Flight CSVs of DJI drones: units from the header, UTC, photos, damaged rows; and the encrypted flight record."""

import contextlib
import csv
import os
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from fuzzing import check, mutations_wanted, survives
from hypothesis import given
from hypothesis import strategies as st

from pipeline.engine.errors import InputError
from pipeline.geometry.rotations import ned_from_frd, rotation_from_quaternion
from pipeline.sources.dji_logs import csv_log as dji_csv
from pipeline.sources.dji_logs import encrypted as dji_txt
from pipeline.sources.dji_logs.columns import AIRDATA, DATCON, FLIGHT_RECORD, header_of, layout_of
from pipeline.sources.records import FlightLog

REAL = "data/logs/dji_csv/Jan-4th-2024-02-19PM-Flight-Airdata.csv"
FOOT_M = 0.3048
HEADER = (
    "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),altitude_above_seaLevel(feet), "
    "compass_heading(degrees), pitch(degrees), roll(degrees),isPhoto,gimbal_heading(degrees),gimbal_pitch(degrees),"
    "gimbal_roll(degrees),message"
)
BEGAN = datetime(2024, 1, 4, 22, 19, 40, tzinfo=UTC)


def row(i: int, photo: int = 0, offset_ms: int = 700, **changed: str) -> str:
    """A row every 100 ms; the second changes 300 ms after the start."""
    second = (i * 100 + offset_ms) // 1000
    cells = {
        "time": f"{i * 100}", "moment": f"2024-01-04 22:19:{40 + second}", "lat": f"{38.7 + i * 1e-6:.7f}",
        "lon": "-121.1679", "home": f"{i}", "sea": f"{400 + i}", "yaw": "90", "pitch": " 2.0", "roll": " -1.0",
        "photo": f"{photo}", "gyaw": "100", "gpitch": "-45", "groll": "0", "message": "",
    } | changed  # fmt: skip
    return ",".join(cells.values())


def rows(n: int = 40) -> list[str]:
    return [row(i, photo=int(i in {5, 6, 12})) for i in range(n)]


def read(tmp_path: Path, *lines: str, end: str = "\n") -> FlightLog:
    path = tmp_path / "flight.csv"
    path.write_text(end.join(lines) + end, newline="")
    log = dji_csv.read(str(path))
    check(log)
    return log


@pytest.mark.real
def test_a_real_export(shared: Path) -> None:
    """Against the csv module's own reading of the same file."""
    path = shared / REAL
    with path.open(encoding="utf-8-sig", newline="") as stream:
        reader = csv.DictReader(stream, skipinitialspace=True)
        lines = [{name.strip(): value for name, value in line.items()} for line in reader]
    log = dji_csv.read(str(path))
    check(log)
    assert dict(log.counts) == {"rows": len(lines), "photos": 16}
    assert len(lines) == 5490
    assert log.losses == ()

    def column(name: str) -> np.ndarray:
        return np.array([float(line[name]) for line in lines])

    (track,) = log.positions
    assert np.array_equal(track.time_ns, column("time(millisecond)").astype(np.int64) * 1_000_000)
    assert np.array_equal(track.latitude_deg, column("latitude"))
    assert np.array_equal(track.longitude_deg, column("longitude"))
    assert np.allclose(track.above_home_m, column("height_above_takeoff(feet)") * FOOT_M, atol=1e-9)
    assert np.allclose(track.amsl_m, column("altitude_above_seaLevel(feet)") * FOOT_M, atol=1e-9)
    # Folsom lies some 140 m above the sea, and 364 ft are 110.9 m.
    assert 130.0 < track.amsl_m[0] < 160.0
    assert 110.0 < track.above_home_m.max() < 112.0
    vehicle, gimbal = log.attitudes
    turned = [column(f"gimbal_{axis}(degrees)") for axis in ("heading", "pitch", "roll")]
    assert np.allclose(rotation_from_quaternion(gimbal.q_wxyz), ned_from_frd(*np.radians(turned)), atol=1e-9)
    turned = [column(f"{name}(degrees)") for name in ("compass_heading", "pitch", "roll")]
    assert np.allclose(rotation_from_quaternion(vehicle.q_wxyz), ned_from_frd(*np.radians(turned)), atol=1e-9)
    (photos,) = log.events
    flagged = [int(line["time(millisecond)"]) for line in lines if line["isPhoto"] == "1"]
    assert (photos.time_ns // 1_000_000).tolist() == flagged
    assert (photos.feedback, photos.sigma_s) == (False, 0.05)


@pytest.mark.real
def test_utc_of_a_real_export(shared: Path) -> None:
    base = dji_csv.read(str(shared / REAL)).time_base
    assert (base.epoch, base.late, base.problem) == ("boot", True, "")
    assert len(base.anchor_log_ns) == 549
    offset_ns = base.anchor_utc_ns - base.anchor_log_ns
    # The rows' grid is 100 ms: every change is seen on the grid's next step.
    assert np.ptp(offset_ns) == 100_000_000
    began = np.datetime64("2024-01-04T22:19:41").astype("datetime64[ns]").astype(np.int64)
    assert offset_ns.max() == began


@pytest.mark.parametrize(("unit", "scale"), [("feet", FOOT_M), ("meters", 1.0), ("m", 1.0), ("ft", FOOT_M)])
def test_units_come_from_the_header(tmp_path: Path, unit: str, scale: float) -> None:
    log = read(tmp_path, HEADER.replace("feet", unit), *rows())
    (track,) = log.positions
    assert np.allclose(track.above_home_m, np.arange(40) * scale)
    assert np.allclose(track.amsl_m, (400 + np.arange(40)) * scale)
    assert "not stated" in log.facts["height_note"]


def test_an_unknown_unit_is_told(tmp_path: Path) -> None:
    log = read(tmp_path, HEADER.replace("takeoff(feet)", "takeoff(cubits)"), *rows())
    assert np.isnan(log.positions[0].above_home_m).all()
    assert np.isfinite(log.positions[0].amsl_m).all()
    assert "height_above_takeoff [cubits]" in log.losses[0]


def test_columns_are_found_by_name(tmp_path: Path) -> None:
    expected = read(tmp_path, HEADER, *rows())
    order = list(np.random.default_rng(3).permutation(14))
    shuffled = [",".join(line.split(",")[i] for i in order) for line in (HEADER, *rows())]
    found = read(tmp_path, *shuffled)
    assert np.array_equal(found.positions[0].latitude_deg, expected.positions[0].latitude_deg)
    assert np.array_equal(found.attitudes[1].q_wxyz, expected.attitudes[1].q_wxyz)
    assert np.array_equal(found.events[0].time_ns, expected.events[0].time_ns)


def test_a_photo_is_where_the_flag_rises(tmp_path: Path) -> None:
    log = read(tmp_path, HEADER, *rows())
    assert (log.events[0].time_ns // 1_000_000).tolist() == [500, 1200]
    assert log.events[0].number.tolist() == [-1, -1]
    assert log.counts["photos"] == 2
    assert read(tmp_path, HEADER, *[row(i) for i in range(9)]).events == ()
    slow = [row(i, photo=int(i == 3), time=str(i * 1000)) for i in range(9)]
    assert read(tmp_path, HEADER, *slow).events[0].sigma_s == pytest.approx(1 / np.sqrt(12))


def test_utc_where_the_second_changes(tmp_path: Path) -> None:
    base = read(tmp_path, HEADER, *rows()).time_base
    assert (base.anchor_log_ns // 1_000_000).tolist() == [300, 1300, 2300, 3300]
    seconds = base.anchor_utc_ns / 1e9 - BEGAN.timestamp()
    assert seconds.tolist() == [1.0, 2.0, 3.0, 4.0]


def test_a_moment_out_of_line_is_left_out(tmp_path: Path) -> None:
    lines = rows()
    lines[17] = row(17, moment="2024-01-04 22:19:43")
    base = read(tmp_path, HEADER, *lines).time_base
    assert base.problem == "1 moments of UTC disagree with the others and were left out"
    early_s = (base.anchor_utc_ns - base.anchor_log_ns) / 1e9 - BEGAN.timestamp()
    assert early_s.max() == pytest.approx(0.7)


def test_local_time_is_not_taken_for_utc(tmp_path: Path) -> None:
    base = read(tmp_path, HEADER.replace("(utc)", "(local)"), *rows()).time_base
    assert base.problem == "local time without zone: 2024-01-04 22:19:40"
    assert not len(base.anchor_log_ns)


def test_no_fix_parts_the_way(tmp_path: Path) -> None:
    lines = rows(10)
    lines[4] = row(4, lat="0", lon="0")
    lines[5] = row(5, lat="", lon="")
    log = read(tmp_path, HEADER, *lines)
    assert log.positions[0].segment.tolist() == [0] * 4 + [1] * 4
    assert len(log.attitudes[0].time_ns) == 10
    assert log.losses == (
        "1 of 10 rows of AirData hold no position",
        "1 of 10 rows of AirData are at latitude 0, longitude 0: no fix",
    )


def test_damaged_rows(tmp_path: Path) -> None:
    lines = rows(10)
    lines[3] = lines[3].replace(",", "", 1)
    lines[6] = row(6, time="x")
    lines[9] = lines[9][:60]
    log = read(tmp_path, HEADER, *lines)
    assert log.losses == ("2 of 10 rows are cut off", "1 of 10 rows have no readable time")
    assert len(log.positions[0].time_ns) == 7


def test_quotes_commas_and_line_ends(tmp_path: Path) -> None:
    lines = rows(6)
    lines[2] = row(2, message='"Home Point, updated"')
    lines[3] = row(3, message='"unclosed')
    log = read(tmp_path, "\ufeff" + HEADER, *lines, end="\r\n")
    assert len(log.positions[0].time_ns) == 6
    assert log.losses == ()


def test_an_export_without_gimbal_roll(tmp_path: Path) -> None:
    lines = [",".join(line.split(",")[:12]) for line in (HEADER, *rows(5))]
    log = read(tmp_path, *lines)
    assert [a.of for a in log.attitudes] == ["vehicle", "gimbal"]
    assert "roll" in log.facts["gimbal_roll_note"]


@pytest.mark.parametrize(
    ("header", "layout"),
    [
        (HEADER, AIRDATA),
        ("Tick#,offsetTime,IMU_ATTI(0):Longitude[degrees [-180;180]],IMU_ATTI(0):Latitude[degrees [-180;180]]", DATCON),
        ("Clock:Tick#,Clock:offsetTime,GPS:Long,GPS:Lat,GPS:heightMSL", DATCON),
        ("CUSTOM.date [local],CUSTOM.updateTime [local],OSD.flyTime,OSD.flyTime [s],OSD.latitude,OSD.longitude",
         FLIGHT_RECORD),
        ("time_ns,latitude_deg,longitude_deg,height_m,yaw_deg,pitch_deg,roll_deg", None),
        ("timestamp,latitude,longitude,altitude", None),
        ("time(s),latitude,longitude", None),
        ("# timestamp tx ty tz qx qy qz qw", None),
        ("", None),
    ],
)  # fmt: skip
def test_whose_columns(header: str, layout: object) -> None:
    assert layout_of(header_of(header.split(","))) is layout
    assert dji_csv.is_format((header + "\n1,2,3\n").encode(), "flight.csv") is (layout is not None)


def test_a_long_header_cut_off(tmp_path: Path) -> None:
    header = "Clock:Tick#,Clock:offsetTime,IMU_ATTI(0):Longitude," + ",".join(f"Motor:Speed:{i}" for i in range(400))
    assert dji_csv.is_format(header.encode()[:4096], "FLY093.csv")


DATCON_OLD = (
    "Clock:Tick#,Clock:offsetTime,IMU_ATTI(0):Longitude,IMU_ATTI(0):Latitude,IMU_ATTI(0):roll:C,IMU_ATTI(0):pitch:C,"
    "IMU_ATTI(0):yaw:C,General:relativeHeight,GPS:Long,GPS:Lat,GPS:heightMSL,GPS:dateTimeStamp,Attribute|Value"
)
DATCON_NEW = (
    "Tick#,offsetTime,IMU_ATTI(0):Longitude[degrees [-180;180]],IMU_ATTI(0):Latitude[degrees [-180;180]],"
    "IMU_ATTI(0):roll[degrees],IMU_ATTI(0):pitch[degrees],IMU_ATTI(0):yaw[degrees],General:relativeHeight[meters],"
    "GPS(0):Long[degrees],GPS(0):Lat[degrees],GPS(0):heightMSL[meters],GPS:dateTimeStamp,Attribute|Value"
)


def datcon_row(i: int) -> str:
    """50 rows a second; the receiver's own values change five times a second, the estimate with every row."""
    held = i // 10
    moment = f"2021-04-19T09:31:{7 + (i + 20) // 50:02d}Z"
    return (
        f"{4500000 * i},{i * 0.02 - 1.0:.3f},{7.0 + i * 1e-7:.8f},{46.0 + i * 1e-7:.8f},1.0,-2.0,35.0,{i * 0.1:.2f},"
        f"{7.0 + held * 1e-6:.7f},{46.0 + held * 1e-6:.7f},{500 + held * 0.5},{moment},"
    )


@pytest.mark.parametrize("header", [DATCON_OLD, DATCON_NEW])
def test_both_generations_of_datcon(tmp_path: Path, header: str) -> None:
    log = read(tmp_path, header, *map(datcon_row, range(201)))
    assert log.kind == "DatCon CSV"
    fused, receiver = log.positions
    assert (fused.stream, fused.fused, len(fused.time_ns)) == ("IMU_ATTI(0)", True, 201)
    assert fused.time_ns[0] == -1_000_000_000
    assert (receiver.stream, receiver.fused) == ("GPS", False)
    assert np.allclose(receiver.above_home_m, np.arange(201) * 0.1)
    # The receiver's values are straight between its measurements.
    assert np.allclose(receiver.latitude_deg, 46.0 + np.arange(201) * 1e-7, atol=1e-12)
    assert np.allclose(receiver.amsl_m, 500.0 + np.arange(201) * 0.05)
    (vehicle,) = log.attitudes
    assert np.allclose(rotation_from_quaternion(vehicle.q_wxyz[0]), ned_from_frd(*np.radians([35.0, -2.0, 1.0])))
    base = log.time_base
    assert (base.anchor_log_ns // 1_000_000).tolist() == [-400, 600, 1600, 2600]
    assert (base.late, base.problem) == (True, "")


def test_a_flight_record_csv_of_a_converter(tmp_path: Path) -> None:
    header = (
        "CUSTOM.dateTime,OSD.flyTime,OSD.flyTime [s],OSD.latitude,OSD.longitude,OSD.height [ft],OSD.altitude [ft],"
        "OSD.pitch,OSD.roll,OSD.yaw,OSD.yaw [360],GIMBAL.pitch,GIMBAL.roll,GIMBAL.yaw,GIMBAL.yaw [360],CAMERA.isPhoto"
    )
    lines = [
        f"2024-01-04T22:19:40.{i}00Z,0m {i / 10}s,{i / 10},47.{i},8.1,{i * 10},{1000 + i * 10},1,2,-30,330,-45,0,-20,"
        f"340,{i == 4}"
        for i in range(8)
    ]
    log = read(tmp_path, "sep=,", header, *lines)
    assert log.kind == "DJI flight record CSV"
    (track,) = log.positions
    assert (track.time_ns // 1_000_000).tolist() == [i * 100 for i in range(8)]
    assert np.allclose(track.above_home_m, np.arange(8) * 3.048)
    gimbal = log.attitudes[1]
    assert np.allclose(rotation_from_quaternion(gimbal.q_wxyz[0]), ned_from_frd(*np.radians([-20.0, -45.0, 0.0])))
    assert (log.events[0].time_ns // 1_000_000).tolist() == [400]
    base = log.time_base
    assert (base.late, len(base.anchor_log_ns)) == (False, 7)
    assert set(base.anchor_utc_ns - base.anchor_log_ns) == {int(BEGAN.timestamp()) * 10**9}


def test_nothing_left(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no readable row"):
        read(tmp_path, HEADER)
    with pytest.raises(InputError, match="E-DJI-02"):
        read(tmp_path, "CUSTOM.date [local],OSD.latitude,OSD.longitude", "x,47,8")
    with pytest.raises(InputError, match="E-DJI-01"):
        read(tmp_path, "a,b,c", "1,2,3")


@given(st.one_of(st.binary(max_size=300), st.text(max_size=200).map(lambda t: f"{HEADER}\n{row(0)}\n{t}".encode())))
def test_any_bytes(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(data)
    with contextlib.suppress(InputError):
        check(dji_csv.read(str(path)))


@pytest.mark.real
def test_fuzz(shared: Path, tmp_path: Path) -> None:
    data = (shared / REAL).read_bytes()
    # The header, and rows around the first photos.
    part = data[: data.index(b"\n") + 1] + b"".join(data.splitlines(keepends=True)[3480:3520])
    outcomes = survives(dji_csv.read, part, tmp_path / "flight.csv", mutations_wanted())
    assert outcomes["whole"] > outcomes["refused"]
    assert outcomes["partial"] > 0


@pytest.mark.parametrize("version", [6, 13, 14])
def test_flight_records_are_refused_with_the_way_out(tmp_path: Path, version: int) -> None:
    path = tmp_path / "DJIFlightRecord_2024-01-04_[14-19-38].txt"
    path.write_bytes(bytes(10) + bytes([version]) + bytes(89) + os.urandom(5000))
    assert dji_txt.is_format(path.read_bytes()[:4096], str(path))
    assert dji_txt.is_format(path.read_bytes()[:4096], "/logs/renamed.txt")
    with pytest.raises(InputError, match="E-DJI-04") as caught:
        dji_txt.read(str(path))
    assert f"log version {version}" in caught.value.found
    assert ("encrypted" in caught.value.found) is (version >= 13)
    assert "airdata.com" in caught.value.hint
    assert str(path) in caught.value.where


@pytest.mark.parametrize(
    ("head", "name"),
    [
        (b"1403636579.763555 4.688319 -1.786938 0.783338 0.534108 -0.153029 -0.827383 -0.082152\n", "groundtruth.txt"),
        (b"# Image list with two lines of data per image:\n", "sparse/0/images.txt"),
        ("# Höhe über Grund, 高度\n1.0 2.0 3.0\n".encode(), "spur.txt"),
        ("# 高度データ".encode() * 200, "spur.txt"),
        (b"\xff\xfe#\x00 \x00T\x00U\x00M\x00", "windows.txt"),
        (b"1.0 2.0 3.0 0 0 0 1\n" * 20 + bytes(30) + b"1.0 2.0 3.0 0 0 0 1\n" * 20, "damaged.txt"),
        (b"", "DJIFlightRecord_2024-01-04_[14-19-38].txt"),
        (bytes(200), "flight.bin"),
    ],
)
def test_texts_are_no_flight_records(head: bytes, name: str) -> None:
    assert not dji_txt.is_format(head, name)
    assert not dji_txt.is_format(head[:4096], name)
