"""DJI subtitles: every firmware's way of writing, which value is latitude, repeats, and damaged files."""

import contextlib
import re
from pathlib import Path

import numpy as np
import pytest
from fuzzing import check, mutations_wanted, survives
from hypothesis import given
from hypothesis import strategies as st

from pipeline.engine.errors import InputError
from pipeline.geometry.rotations import ned_from_frd, rotation_from_quaternion
from pipeline.sources.dji_logs import srt, srt_dialects
from pipeline.sources.dji_logs.held import new_values, sloped, sloped_longitude
from pipeline.sources.records import FlightLog

# Cues of the real files as their collection tells them (an arrow line each).
CUES = {
    "MAVIC3.srt": 12318, "mavic_2pro_new.SRT": 8952, "mavic_air2.srt": 25, "mavic_mini.SRT": 117,
    "mavic_pro.SRT": 468, "mavic_pro_buggy.SRT": 546, "old_format.SRT": 468, "matrice_300.srt": 381,
    "p4p_sample.SRT": 5, "p4_rtk.SRT": 55, "mavic_air.SRT": 2, "broken_incomplete.SRT": 20,
}  # fmt: skip
MAVIC_PRO = "HOME({home}) 2017.08.05 14:11:51\nGPS({gps},16) BAROMETER:{height}\nISO:100 Shutter:60 EV: Fnum:2.2"


def stamp(ms: int) -> str:
    return f"{ms // 3_600_000:02d}:{ms // 60_000 % 60:02d}:{ms // 1000 % 60:02d},{ms % 1000:03d}"


def cues(*texts: str, step_ms: int = 1000) -> str:
    numbered = enumerate(texts)
    return "\n\n".join(f"{i + 1}\n{stamp(i * step_ms)} --> {stamp((i + 1) * step_ms)}\n{text}" for i, text in numbered)


def read(tmp_path: Path, text: str | bytes) -> FlightLog:
    path = tmp_path / "DJI_0001.SRT"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    log = srt.read(str(path))
    check(log)
    return log


def place(tmp_path: Path, text: str) -> tuple[float, float, str]:
    log = read(tmp_path, text)
    return log.positions[0].latitude_deg[0], log.positions[0].longitude_deg[0], log.facts["coordinate_order"]


@pytest.mark.real
@pytest.mark.parametrize("name", CUES)
def test_cues_of_real_files(shared: Path, name: str) -> None:
    path = shared / "data/logs/dji_srt" / name
    log = srt.read(str(path))
    check(log)
    assert log.counts["cues"] == CUES[name] == path.read_text("utf-8-sig").count("-->")
    assert log.time_base.epoch == "boot"
    assert not len(log.time_base.anchor_log_ns)


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "latitude", "longitude", "told"),
    [
        ("MAVIC3.srt", 3.41531, -3.37440, "named"),
        ("mavic_2pro_new.SRT", -35.080155, -60.286702, "named"),
        ("mavic_air2.srt", 41.420684, 2.162162, "named"),
        ("mavic_mini.SRT", 48.0771, -121.7458, "beyond 90"),
        ("mavic_pro.SRT", -20.2533, 149.0251, "beyond 90"),
        ("old_format.SRT", -20.2533, 149.0251, "beyond 90"),
        ("mavic_pro_buggy.SRT", 42.4668, -1.2218, "assumed"),
        ("p4p_sample.SRT", 47.4692, 8.2090, "assumed"),
        ("p4_rtk.SRT", -34.237922, -58.851745, "assumed"),
        ("matrice_300.srt", 36.6146, -6.1120, "metres"),
    ],
)
def test_latitude_and_longitude_of_real_files(
    shared: Path, name: str, latitude: float, longitude: float, told: str
) -> None:
    log = srt.read(str(shared / "data/logs/dji_srt" / name))
    (track,) = log.positions
    assert (track.latitude_deg[0], track.longitude_deg[0]) == (latitude, longitude)
    assert told in log.facts["coordinate_order"]
    # None of these drones flew further than that.
    assert np.ptp(track.latitude_deg) < 0.1
    assert np.ptp(track.longitude_deg) < 0.1


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("MAVIC3.srt", r"latitude: (\S+)\] \[longitude: (\S+)\] \[rel_alt: (\S+) abs_alt: (\S+)\]"),
        ("matrice_300.srt", r"GPS\((\S+?),(\S+?),\S+ BAROMETER:([-\d.]+)"),
        ("mavic_pro.SRT", r"GPS\((\S+?),(\S+?),\S+ BAROMETER:([-\d.]+)"),
        ("old_format.SRT", r"GPS\((\S+?),(\S+?),\S+ Hb:([-\d.]+)"),
        ("mavic_mini.SRT", r"GPS \((\S+?), (\S+?), \d+\), D \S+, H ([-\d.]+)m"),
        ("p4_rtk.SRT", r"GPS \((\S+?), (\S+?), \d+\).* H ([-\d.]+)m"),
    ],
)
def test_only_new_values_and_the_last_are_kept(shared: Path, name: str, said: str) -> None:
    path = shared / "data/logs/dji_srt" / name
    log = srt.read(str(path))
    values = [tuple(map(float, found)) for found in re.findall(said, path.read_text("utf-8-sig"))]
    assert len(values) == CUES[name]
    kept = [i for i in range(len(values)) if i in {0, len(values) - 1} or values[i] != values[i - 1]]
    (track,) = log.positions
    starts = [
        ((int(h) * 60 + int(m)) * 60 + int(s)) * 1000 + int(ms)
        for h, m, s, ms in re.findall(r"(\d\d):(\d\d):(\d\d),(\d{3}) -->", path.read_text("utf-8-sig"))
    ]
    assert (track.time_ns // 1_000_000).tolist() == [starts[i] for i in kept]
    assert log.facts["repeats"] == len(values) - len(kept)
    # What changed in a cue stands there as written.
    first = track.longitude_deg if "longitude" not in said and name != "matrice_300.srt" else track.latitude_deg
    written = np.array([values[i][0] for i in kept])
    moved = np.array([i == 0 or values[i][:2] != values[i - 1][:2] for i in kept])
    assert np.array_equal(first[moved], written[moved])


@pytest.mark.real
def test_heights_of_real_files(shared: Path) -> None:
    folder = shared / "data/logs/dji_srt"
    (mavic3,) = srt.read(str(folder / "MAVIC3.srt")).positions
    assert (mavic3.above_home_m[0], mavic3.amsl_m[0]) == (-2.4, 0.401)
    assert np.allclose(mavic3.amsl_m - mavic3.above_home_m, 2.801)
    (matrice,) = srt.read(str(folder / "matrice_300.srt")).positions
    assert np.isnan(matrice.amsl_m).all()
    assert matrice.barometric_m[0] == 0.3
    (mini,) = srt.read(str(folder / "mavic_mini.SRT")).positions
    assert mini.above_home_m[0] == 200.7
    air2 = srt.read(str(folder / "mavic_air2.srt"))
    assert air2.positions[0].above_home_m[-1] == 29.2
    assert "DJI does not say" in air2.facts["height_note"]


@pytest.mark.real
def test_facts_of_real_files(shared: Path) -> None:
    folder = shared / "data/logs/dji_srt"
    expected = {
        "MAVIC3.srt": (3.2, 24.0, 220.0, 1 / 8000, "2021-12-25T12:27:52.373"),
        "mavic_2pro_new.SRT": (2.8, 28.0, 110.0, 1 / 1250, "2019-09-27T10:28:08.438"),
        "mavic_air2.srt": (2.8, 24.0, 100.0, 1 / 500, "2022-05-01T15:01:58.531"),
        "old_format.SRT": (2.8, None, 100.0, 1 / 60, "2017-08-05T14:11:51.000"),
        "mavic_pro.SRT": (2.2, None, 100.0, 1 / 60, "2017-08-05T14:11:51.000"),
        "mavic_mini.SRT": (2.8, None, 260.0, 1 / 30.15, None),
    }
    for name, (f_number, focal_mm, iso, shutter_s, start) in expected.items():
        log = srt.read(str(folder / name))
        camera = log.facts["camera"]
        assert (camera["f_number"], camera.get("focal_len_mm"), camera["iso"]) == (f_number, focal_mm, iso), name
        assert camera["shutter_s"] == pytest.approx(shutter_s)
        assert log.facts.get("local_start") == start
        assert log.time_base.problem == (f"local time without zone: {start}" if start else "no date in the file")


@pytest.mark.real
def test_lost_fixes_and_joined_clips_of_real_files(shared: Path) -> None:
    folder = shared / "data/logs/dji_srt"
    buggy = srt.read(str(folder / "mavic_pro_buggy.SRT"))
    missing = (folder / "mavic_pro_buggy.SRT").read_text().count("GPS(N/A,N/A")
    assert buggy.losses == (f"{missing} of 546 cues hold no position",)
    assert missing == 16
    assert buggy.positions[0].segment[-1] == 1
    joined = srt.read(str(folder / "mavic_2pro_new.SRT"))
    frames = np.array(re.findall(r"FrameCnt : (\d+)", (folder / "mavic_2pro_new.SRT").read_text("utf-8-sig")), int)
    assert joined.facts["pieces"] == 1 + np.count_nonzero(np.diff(frames) < 0)
    assert joined.losses == ()
    assert srt.read(str(folder / "mavic_air.SRT")).losses == ("no cue holds a position",)
    assert srt.read(str(folder / "broken_incomplete.SRT")).losses == ("1 of 20 cues hold no position",)


@pytest.mark.real
@pytest.mark.parametrize("name", ["broken_empty.SRT", "broken_empty2.SRT"])
def test_empty_real_files(shared: Path, name: str) -> None:
    with pytest.raises(InputError, match="no cues") as caught:
        srt.read(str(shared / "data/logs/dji_srt" / name))
    assert name in caught.value.where


@pytest.mark.real
def test_attitudes_of_a_real_file(shared: Path) -> None:
    """The drone flies to the side on which it is down, and the gimbal's yaw is near the vehicle's."""
    log = srt.read(str(shared / "data/logs/dji_srt/p4_rtk.SRT"))
    vehicle, gimbal = log.attitudes
    assert (vehicle.of, gimbal.of, len(vehicle.time_ns)) == ("vehicle", "gimbal", 55)
    ned = rotation_from_quaternion(gimbal.q_wxyz[0])
    assert np.allclose(ned, ned_from_frd(*np.radians([110.4, -24.4, 0.0])))
    # The optical axis is 24.4 deg below the horizon, towards 110.4 deg.
    assert np.allclose(
        ned[:, 0], [np.cos(np.radians(24.4)) * f(np.radians(110.4)) for f in (np.cos, np.sin)] + [0.41310],
        atol=1e-5,
    )  # fmt: skip
    (track,) = log.positions
    moved_m = np.array([np.ptp(track.latitude_deg), np.ptp(track.longitude_deg) * np.cos(np.radians(34.2))]) * 111_000
    tilt = rotation_from_quaternion(vehicle.q_wxyz[10])[:2, 2]
    # An FRD body's down axis leans away from where thrust pushes.
    assert np.dot(moved_m, -tilt) > 0.9 * np.linalg.norm(moved_m) * np.linalg.norm(tilt)


@pytest.mark.parametrize(
    ("gps", "home", "expected", "told"),
    [
        ("149.0251,-20.2533", "149.0251,-20.2532", (-20.2533, 149.0251), "beyond 90"),
        ("-20.2533,149.0251", "-20.2532,149.0251", (-20.2533, 149.0251), "beyond 90"),
        ("12.0,47.0", "12.0,47.0", (47.0, 12.0), "assumed"),
        ("89.9,47.0", "90.1,47.0", (47.0, 89.9), "home point"),
        ("47.0,89.9", "90.1,47.0", (47.0, 89.9), "home point"),
    ],
)
def test_evidence_before_custom(tmp_path: Path, gps: str, home: str, expected: tuple[float, float], told: str) -> None:
    latitude, longitude, order = place(tmp_path, cues(MAVIC_PRO.format(gps=gps, home=home, height=1.0)))
    assert (latitude, longitude) == expected
    assert told in order


def test_metres_tell_latitude_first_unless_the_values_deny_it(tmp_path: Path) -> None:
    assert place(tmp_path, cues("GPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M"))[:2] == (36.6146, -6.1120)
    assert place(tmp_path, cues("GPS(136.6146,-6.1120,0.0M) BAROMETER:0.3M"))[:2] == (-6.1120, 136.6146)


def test_rtk_in_place_of_gps(tmp_path: Path) -> None:
    text = (
        "F/6.3, SS 60, ISO 100, EV 0, RTK (120.083799, 30.213635, 28), HOME (120.084146, 30.214243, 103.55m), "
        "D 75.36m, H 76.19m, H.S 0.30m/s, V.S 0.00m/s, F.PRY (-5.3°, 2.1°, 28.3°), G.PRY (-40.0°, 0.0°, 28.2°)"
    )
    log = read(tmp_path, cues(text).encode("latin-1"))
    assert log.positions[0].latitude_deg[0] == 30.213635
    assert log.positions[0].above_home_m[0] == 76.19
    assert [a.of for a in log.attitudes] == ["vehicle", "gimbal"]


def test_gimbal_in_brackets(tmp_path: Path) -> None:
    text = (
        '<font size="28">FrameCnt: 1, DiffTime: 33ms\n2024-11-24 17:38:01.000\n[iso: 100] [focal_len: 24.00] '
        "[dzoom_ratio: 1.00], [latitude: 48.267011] [longitude: 25.914561] [rel_alt: 102.2 abs_alt: 426.1] "
        "[gb_yaw: 0.0 gb_pitch: -90.0 gb_roll: 0.0] </font>"
    )
    log = read(tmp_path, cues(text, text.replace("FrameCnt: 1", "FrameCnt: 2"), step_ms=33))
    (gimbal,) = log.attitudes
    assert (gimbal.of, gimbal.frame) == ("gimbal", "ned")
    # Straight down at yaw 0: the optical axis is down, the image's right edge east.
    assert np.allclose(rotation_from_quaternion(gimbal.q_wxyz[0])[:, :2].T, [[0, 0, 1], [0, 1, 0]], atol=1e-12)
    assert (log.positions[0].amsl_m[0], log.positions[0].above_home_m[0]) == (426.1, 102.2)


@pytest.mark.parametrize(
    ("zone", "hours"), [("Z", 0.0), (" UTC", 0.0), ("+02:00", 2.0), (" -0330", -3.5), ("", None), (" CET", None)]
)
def test_utc_only_where_the_text_says_so(tmp_path: Path, zone: str, hours: float | None) -> None:
    texts = [f"2021-05-26 15:21:{49 + i}.250{zone}\n[latitude: 47.{i}] [longitude: 8.1]" for i in range(3)]
    base = read(tmp_path, cues(*texts)).time_base
    if hours is None:
        assert "without zone: 2021-05-26T15:21:49.250" in base.problem
        assert not len(base.anchor_utc_ns)
    else:
        utc = np.datetime64("2021-05-26T15:21:49.250") - np.timedelta64(int(hours * 3600), "s")
        assert base.anchor_utc_ns[0] == utc.astype("datetime64[ns]").astype(np.int64)
        assert base.anchor_log_ns.tolist() == [0, 1_000_000_000, 2_000_000_000]
        assert (base.late, base.problem) == (False, "")


def test_whole_seconds_of_utc_are_known_when_they_change(tmp_path: Path) -> None:
    texts = [f"2021-05-26 15:21:{49 + (i + 7) // 10}Z\n[latitude: 47.{i}] [longitude: 8.1]" for i in range(30)]
    base = read(tmp_path, cues(*texts, step_ms=100)).time_base
    assert base.late
    assert (base.anchor_log_ns // 1_000_000).tolist() == [300, 1300, 2300]


def test_repeats_become_slopes(tmp_path: Path) -> None:
    """30 cues a second over a receiver at 1 Hz: interpolated, the way is straight; as it stands it would be steps."""
    texts = [f"[latitude: {47 + i // 30 * 1e-4:.4f}] [longitude: 8.0] [rel_alt: {i // 3}.0]" for i in range(301)]
    (track,) = read(tmp_path, cues(*texts, step_ms=33)).positions
    assert len(track.time_ns) == 101
    t = np.arange(301) * 0.033
    truth = 47 + t / (30 * 0.033) * 1e-4
    error = np.abs(np.interp(t, track.time_ns / 1e9, track.latitude_deg) - truth)
    steps = np.abs(np.array([47 + i // 30 * 1e-4 for i in range(301)]) - truth)
    assert error.max() < 1e-9
    assert 0.9e-4 < steps.max() < 1.1e-4
    # Heights change more often and keep their own values.
    assert np.array_equal(track.above_home_m, np.arange(101.0))


def test_no_fix_is_left_out_and_parts_the_way(tmp_path: Path) -> None:
    fixed = [f"[latitude: 47.{i}] [longitude: 8.1]" for i in range(1, 5)]
    lost = ["[latitude: 0.000000] [longitude: 0.000000]", "[latitude: 91.0] [longitude: 8.1]", "GPS(n/a, n/a, 0)"]
    log = read(tmp_path, cues(*fixed[:2], *lost, *fixed[2:]))
    assert log.positions[0].segment.tolist() == [0, 0, 1, 1]
    assert log.losses == (
        "1 of 7 cues hold no position",
        "1 of 7 cues are at latitude 0, longitude 0: no fix",
        "1 of 7 cues hold coordinates that do not exist",
    )


def test_byte_order_mark_and_line_ends(tmp_path: Path) -> None:
    text = cues("[latitude : 47.1] [longtitude : 8.1]", "[latitude : 47.2] [longtitude : 8.2]")
    for data in (text, "\ufeff" + text, text.replace("\n", "\r\n"), "\ufeff" + text.replace("\n", "\r\n") + "\r\n\r\n"):
        log = read(tmp_path, data)
        assert log.positions[0].longitude_deg.tolist() == [8.1, 8.2]
        assert log.losses == ()


def test_without_arrow_lines_the_dates_give_the_time(tmp_path: Path) -> None:
    texts = [f"{i + 1}\n2018-09-20 13:46:1{i}\n[latitude: 47.{i}] [longitude: 8.1]" for i in range(4)]
    log = read(tmp_path, "\n\n".join(texts))
    assert (log.positions[0].time_ns // 1_000_000_000).tolist() == [0, 1, 2, 3]
    assert log.losses == ("the cues have no times in the video; they are taken from the date lines",)


def test_a_cue_whose_time_is_lost(tmp_path: Path) -> None:
    text = cues(*[f"[latitude: 47.{i}] [longitude: 8.1]" for i in range(1, 6)])
    log = read(tmp_path, text.replace("00:00:02,000 -->", "00:00:xx,000 -->"))
    assert log.positions[0].latitude_deg.tolist() == [47.1, 47.2, 47.4, 47.5]
    assert log.losses == ("1 of 5 cues have no readable time",)


def test_subtitles_of_a_film(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no flight data"):
        read(tmp_path, cues("Good morning.", "Is it?"))


def test_camera_settings() -> None:
    old = srt_dialects.settings("ISO:100 TV:60 EV: 0 IR:F2.8")
    assert old == {"iso": 100.0, "f_number": 2.8, "shutter_s": 1 / 60}
    zoom = srt_dialects.settings("[iso : 110] [shutter : 1/1250.0] [fnum : 280] [focal_len : 480]")
    assert zoom == {"iso": 110.0, "f_number": 2.8, "focal_len_mm": 48.0, "shutter_s": 1 / 1250}
    assert srt_dialects.settings("[focal_len: 284.80] [fnum: 4.4]") == {"f_number": 4.4, "focal_len_mm": 284.8}


def test_is_format() -> None:
    assert srt.is_format(b"", "/flight/DJI_0001.SRT")
    assert srt.is_format(cues("GPS(1,2,3)").encode(), "/flight/subtitles.txt")
    assert not srt.is_format(b"# a --> b\n1.0 2.0 3.0", "/flight/track.txt")


def test_slopes() -> None:
    time_ns = np.arange(8) * 1_000_000_000
    values = np.array([1.0, 1.0, 2.0, 2.0, np.nan, 5.0, 5.0, 7.0])[:, None]
    segment = np.zeros(8, np.int64)
    assert new_values(values, segment).tolist() == [True, False, True, True, True, True, False, True]
    out = sloped(time_ns, values, segment)[:, 0]
    assert np.array_equal(out, [1.0, 1.5, 2.0, 2.0, np.nan, 5.0, 6.0, 7.0], equal_nan=True)
    # Nothing is carried from one segment to the next.
    parted = np.array([0, 0, 0, 1, 1, 1])
    steps = np.array([1.0, 1.0, 1.0, 9.0, 9.0, 9.0])[:, None]
    assert np.array_equal(sloped(time_ns[:6], steps, parted), steps)


def test_slopes_across_the_antimeridian() -> None:
    longitude = np.array([179.9, 179.9, -179.9, -179.9, -179.7])
    pair = sloped_longitude(np.arange(5) * 1_000_000_000, longitude, np.full(5, -17.0), np.zeros(5, np.int64))
    assert np.allclose(np.abs(pair[:, 0]), [179.9, 180.0, 179.9, 179.8, 179.7])


@given(
    st.one_of(
        st.binary(max_size=400),
        st.lists(st.text("0123456789.,:->GPSHOME()[]latiudeo \n/n-", max_size=80), max_size=5).map(
            lambda texts: cues(*texts).encode()
        ),
    )
)
def test_any_bytes(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    with contextlib.suppress(InputError):
        read(tmp_path_factory.getbasetemp(), data)


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "size"),
    [("p4_rtk.SRT", 13_795), ("MAVIC3.srt", 20_000), ("mavic_pro_buggy.SRT", 12_000), ("matrice_300.srt", 8_000)],
)
def test_fuzz(shared: Path, tmp_path: Path, name: str, size: int) -> None:
    data = (shared / "data/logs/dji_srt" / name).read_bytes()[:size]
    # Cut between two cues, so that the part is whole.
    data = data[: 1 + max(data.rfind(b"\n\n"), data.rfind(b"\n\r\n"))]
    outcomes = survives(srt.read, data, tmp_path / "flight.srt", mutations_wanted(60))
    assert outcomes["partial"] > 0
    assert outcomes["refused"] < 0.2 * sum(outcomes.values())
