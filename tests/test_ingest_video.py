"""Videos with their subtitles, and bags whose poses are in another log, through ingest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import av
import bag_files
import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from bag_files import NS, write_folder, write_mcap
from flights import SMALL, epitransfer
from test_ingest import Recorder
from test_ingest import ingest as ingest_photos
from test_sources_video import CODECS, HEIGHT, WIDTH, painted, told, write_video

from pipeline.engine.errors import InputError, UndeterminedError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import enu_from_cam, gimbal_angles, quaternion_from_rotation, rotation_from_quaternion
from pipeline.simulation.bare import camera_yaml
from stages.app import run as command_line
from stages.ingest import Config, run

HOME = LocalFrame(47.0, 8.0, 400.0)
LENS = Camera("brown", WIDTH, HEIGHT, 110.0, 111.0, 63.0, 32.5, (-0.1, 0.02, 0.0, 0.0, 0.0))
BEGIN = datetime(2024, 6, 1, 8, 0, 0, tzinfo=UTC)
BEGIN_NS = int(BEGIN.timestamp()) * NS
# Ten seconds at 10 Hz, in ticks of 1/30000 s.
TICKS = range(0, 300_000, 3000)
SPEED_M_S = 3.0
# A hundred-millionth of a degree times 111 km, halved; a tenth of a degree, halved.
RTK_M, RTK_DEG = 0.056, 0.05
FOOT_M = 0.3048


def way(time_s: Floats | float) -> Floats:
    """Where the drone is, ENU of home: north, then from second 5 on east as well; it climbs."""
    time_s = np.asarray(time_s, np.float64)
    late_s = np.maximum(time_s - 5.0, 0.0)
    east = late_s * SPEED_M_S * 0.6
    north = np.minimum(time_s, 5.0) * SPEED_M_S + late_s * SPEED_M_S * 0.8
    return np.stack([east, north, 40.0 + 0.2 * time_s], axis=-1)


def aim(time_s: Floats | float) -> Floats:
    """Yaw, pitch and roll of the optical axis, deg."""
    time_s = np.asarray(time_s, np.float64)
    return np.stack([20.0 + 2.0 * time_s, -24.0 - 0.5 * time_s, np.zeros_like(time_s)], axis=-1)


def degrees(time_s: Floats | float) -> tuple[Floats, Floats]:
    latitude, longitude, _ = HOME.geodetic_from_enu(way(time_s))
    return latitude, longitude


def clock_time(seconds: float) -> str:
    ms = round(seconds * 1000.0)
    return f"{ms // 3_600_000:02d}:{ms // 60_000 % 60:02d}:{ms // 1000 % 60:02d},{ms % 1000:03d}"


def subtitles(video: Path, cue: Callable[[float], str], step_s: float, begin_s: float = 0.0) -> Path:
    """Subtitles beside a video of ten seconds that began at `begin_s` of the flight."""
    times = np.arange(0.0, 10.0, step_s)
    texts = [
        f"{n + 1}\n{clock_time(t)} --> {clock_time(t + step_s)}\n{cue(begin_s + t)}\n"
        for n, t in enumerate(times.tolist())
    ]
    path = video.with_suffix(".SRT")
    path.write_text("\n".join(texts))
    return path


def rtk_cue(time_s: float, *, gimbal: bool = True) -> str:
    """As a Phantom 4 RTK writes them, once a second."""
    latitude, longitude = degrees(time_s)
    yaw, pitch, roll = aim(time_s)
    aimed = f", F.PRY (2.7°, -7.0°, 110.1°), G.PRY ({pitch:.1f}°, {roll:.1f}°, {yaw:.1f}°)" if gimbal else ""
    return (
        f"F/5.6, SS 400, ISO 100, EV 0, GPS ({longitude:.6f}, {latitude:.6f}, 15), "
        f"HOME (8.000000, 47.000000, -57.98m), D 698.70m, H {way(time_s)[2]:.2f}m, H.S 3.00m/s, V.S 0.00m/s{aimed}"
    )


def air_cue(time_s: float) -> str:
    """As a Mavic Air 2 writes them, with every frame: no attitude, and a local time."""
    latitude, longitude = degrees(time_s)
    shown = BEGIN + timedelta(hours=2, seconds=time_s)
    return (
        f'<font size="36">SrtCnt : 1, DiffTime : 16ms\n{shown:%Y-%m-%d %H:%M:%S},531,716\n'
        "[iso : 100] [shutter : 1/500.0] [fnum : 280] [ev : 0] [ct : 5500] [color_md : default] [focal_len : 240] "
        f"[latitude: {latitude:.6f}] [longitude: {longitude:.6f}] [altitude: {way(time_s)[2]:.6f}] </font>"
    )


def airdata(path: Path, *, gimbal: bool = True, begin_s: float = -20.0, end_s: float = 40.0) -> Path:
    """The flight as AirData exports it, ten rows a second; its clock is 0 at `begin_s` of the flight."""
    turned = ",gimbal_heading(degrees),gimbal_pitch(degrees),gimbal_roll(degrees)" if gimbal else ""
    rows = [f"time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),isPhoto{turned}"]
    for tenth in range(round((end_s - begin_s) * 10.0)):
        time_s = begin_s + tenth / 10.0
        latitude, longitude = degrees(time_s)
        yaw, pitch, roll = aim(time_s)
        utc = BEGIN + timedelta(seconds=time_s)
        cells = [tenth * 100, f"{utc:%Y-%m-%d %H:%M:%S}", f"{latitude:.12f}", f"{longitude:.12f}"]
        cells += [f"{way(time_s)[2] / FOOT_M:.6f}", 0, *([yaw, pitch, roll] if gimbal else [])]
        rows.append(",".join(map(str, cells)))
    path.write_text("\n".join(rows) + "\n")
    return path


def rtk_tags(row: dict[str, Any]) -> str:
    """What a Phantom 4 RTK would write of a photo's row of `frames`."""
    return (
        f"F/5.6, SS 400, ISO 100, EV 0, GPS ({row['longitude_deg']:.6f}, {row['latitude_deg']:.6f}, 15), "
        f"H {row['above_takeoff_m']:.2f}m, F.PRY (0.0°, 0.0°, 0.0°), "
        f"G.PRY ({row['pitch_deg']:.1f}°, {row['roll_deg']:.1f}°, {row['yaw_deg']:.1f}°)"
    )


def write_pictures(path: Path, pictures: Sequence[Any]) -> Path:
    """A video of pictures, one a second."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(CODECS[0], rate=1)
        stream.height, stream.width, stream.pix_fmt = SMALL.height, SMALL.width, "yuv420p"
        stream.bit_rate = 8_000_000
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())
    return path


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A video of a hundred frames, each of which shows its number."""
    return write_video(tmp_path_factory.mktemp("film") / "DJI_0007.MP4", ticks=TICKS).read_bytes()


@pytest.fixture
def video(film: bytes, tmp_path: Path) -> Path:
    (tmp_path / "card").mkdir()
    path = tmp_path / "card" / "DJI_0007.MP4"
    path.write_bytes(film)
    (tmp_path / "camera.yaml").write_text(camera_yaml(LENS))
    return path


def ingest(place: Path, **keys: Any) -> Recorder:
    keys = {"camera": str(place / "camera.yaml"), "frame_spacing_m": 2.0} | keys
    context = Recorder()
    run(Config(**{key: value for key, value in keys.items() if value is not None}), context)  # type: ignore[arg-type]
    return context


def number(row: dict[str, Any]) -> int:
    """Which frame of the video a row says it is; it must be in the run's images."""
    assert row["image"] == f"run://images/{row['frame_id']}.png"
    name, _, digits = row["frame_id"].rpartition("_")
    assert (name, len(digits)) == ("DJI_0007", 6)
    return int(digits)


def check_place(row: dict[str, Any], time_s: float, within_m: float, within_deg: float) -> None:
    latitude, longitude = degrees(time_s)
    metres = HOME.enu_from_geodetic(
        np.array([row["latitude_deg"], latitude]), np.array([row["longitude_deg"], longitude]), 0.0
    )
    assert np.abs(metres[0, :2] - metres[1, :2]).max() <= within_m
    assert row["above_takeoff_m"] == pytest.approx(way(time_s)[2], abs=0.2 * within_m + 0.006)
    assert (row["yaw_deg"], row["pitch_deg"], row["roll_deg"]) == pytest.approx(aim(time_s), abs=within_deg)


def problems(context: Recorder) -> set[str]:
    return {row["problem"] for row in context.rows("frames")}


# --- subtitles that tell the attitude ---


def test_frames_by_the_way_with_the_gimbal_of_the_subtitles(video: Path, tmp_path: Path) -> None:
    subtitles(video, rtk_cue, 1.0)
    found = ingest(tmp_path, videos=str(video.parent))
    rows = found.rows("frames")
    # 7 frames are 2.1 m; the last subtitle begins with frame 90.
    assert [number(row) for row in rows] == list(range(0, 91, 7))
    for row in rows:
        assert row["usable"], row["problem"]
        check_place(row, number(row) / 10.0, RTK_M, RTK_DEG + 1e-6)
        assert row["time_source"] == "log stamp"
        assert row["pose_source"].startswith("DJI subtitles: SRT + gimbal")
        assert told((found.output("images") / f"{row['frame_id']}.png").read_bytes()) == number(row)
    assert found.known["height_datum"] == "takeoff"
    (camera,) = found.rows("cameras")
    assert (camera["width"], camera["fx"], camera["distortion"][0]) == (WIDTH, 110.0, -0.1)


def test_the_attitude_is_the_optical_axis_in_enu(video: Path, tmp_path: Path) -> None:
    subtitles(video, rtk_cue, 1.0)
    for row in ingest(tmp_path, videos=str(video)).rows("frames"):
        rotation = rotation_from_quaternion(np.array([row[f"q{part}"] for part in "wxyz"]))
        assert np.degrees(gimbal_angles(rotation)) == pytest.approx(aim(number(row) / 10.0), abs=RTK_DEG + 1e-3)
        assert rotation[2, 2] < -0.3  # looks down


@pytest.mark.parametrize(("spacing_m", "frames"), [(0.25, 91), (10.0, 3), (1000.0, 1)])
def test_spacing(video: Path, tmp_path: Path, spacing_m: float, frames: int) -> None:
    subtitles(video, rtk_cue, 1.0)
    rows = ingest(tmp_path, videos=str(video), frame_spacing_m=spacing_m).rows("frames")
    assert len(rows) == frames


def test_a_lens_that_nothing_tells(video: Path, tmp_path: Path) -> None:
    subtitles(video, rtk_cue, 1.0)
    (problem,) = problems(ingest(tmp_path, videos=str(video), camera=None))
    assert "ingest.camera" in problem


def test_a_calibration_of_another_mode(video: Path, tmp_path: Path) -> None:
    subtitles(video, rtk_cue, 1.0)
    (tmp_path / "camera.yaml").write_text(camera_yaml(Camera("brown", 128, 96, 110.0, 110.0, 64.0, 48.0, (0.0,) * 5)))
    (problem,) = problems(ingest(tmp_path, videos=str(video)))
    assert "calibrate in the mode" in problem


def test_two_videos_of_one_card(video: Path, film: bytes, tmp_path: Path) -> None:
    second = video.with_name("DJI_0008.MOV")
    second.write_bytes(film)
    subtitles(video, rtk_cue, 1.0)
    subtitles(second, rtk_cue, 1.0, begin_s=12.0)
    rows = ingest(tmp_path, videos=str(video.parent)).rows("frames")
    assert [row["frame_id"][:8] for row in rows] == ["DJI_0007"] * 13 + ["DJI_0008"] * 13
    check_place(rows[14], 12.7, RTK_M, RTK_DEG + 1e-6)


def test_subtitles_named_as_a_log_too_are_read_once(video: Path, tmp_path: Path) -> None:
    srt = subtitles(video, rtk_cue, 1.0)
    found = ingest(tmp_path, videos=str(video), logs=str(srt))
    assert len(found.rows("frames")) == 13
    assert [row["clock_id"] for row in found.rows("clocks")].count("DJI_0007.SRT") == 1


def test_two_videos_of_one_name(video: Path, film: bytes, tmp_path: Path) -> None:
    (tmp_path / "card" / "101MEDIA").mkdir()
    second = tmp_path / "card" / "101MEDIA" / video.name
    second.write_bytes(film)
    subtitles(video, rtk_cue, 1.0)
    subtitles(second, rtk_cue, 1.0, begin_s=12.0)
    with pytest.raises(InputError, match="E-VIDEO-11") as error:
        ingest(tmp_path, videos=str(video.parent))
    assert str(video) in error.value.where
    assert str(second) in error.value.where


# --- subtitles that do not ---


def test_no_attitude_anywhere(video: Path, tmp_path: Path) -> None:
    subtitles(video, air_cue, 0.1)
    for mount in ({}, {"mount": {"pitch_deg": -90}}):
        found = ingest(tmp_path, videos=str(video), **mount)
        assert found.items == (len(found.rows("frames")), len(found.rows("frames")))
        (problem,) = problems(found)
        assert "DJI subtitles" in problem
        assert "attitude" in problem
        assert "ingest.logs" in problem


def test_the_gimbal_of_a_flight_table_by_the_places_of_the_subtitles(video: Path, tmp_path: Path) -> None:
    subtitles(video, air_cue, 0.1)
    found = ingest(tmp_path, videos=str(video), logs=str(airdata(tmp_path / "flight.csv")))
    rows = found.rows("frames")
    assert len(rows) == 15
    for row in rows:
        assert row["usable"], row["problem"]
        assert row["time_source"] == "log clock"
        assert row["pose_source"].startswith("AirData CSV: AirData + AirData gimbal")
        # The table's rows, and not the subtitles', tell the place; the clock between them is good to 0.03 s here.
        check_place(row, number(row) / 10.0, 0.03 * SPEED_M_S, 0.1)
        assert (row["time"] - BEGIN).total_seconds() == pytest.approx(number(row) / 10.0, abs=0.15)
        assert row["sigma_yaw_deg"] > 0.0
    clock = {row["clock_id"]: row for row in found.rows("clocks")}["images of DJI_0007.SRT"]
    assert clock["source"] == "images"
    assert clock["method"] == "positions of 15 images on AirData; offset to UTC"
    assert clock["offset_s"] == pytest.approx(BEGIN.timestamp(), abs=0.15)
    assert clock["anchors"] == 15
    assert "positions tell the clock" in clock["problem"]


def test_a_mount_and_the_vehicle_of_a_flight_table(video: Path, tmp_path: Path) -> None:
    subtitles(video, air_cue, 0.1)
    table = airdata(tmp_path / "flight.csv").read_text()
    for name, means in (("gimbal_heading", "compass_heading"), ("gimbal_pitch", "pitch"), ("gimbal_roll", "roll")):
        table = table.replace(name, means)
    (tmp_path / "flight.csv").write_text(table)
    found = ingest(tmp_path, videos=str(video), logs=str(tmp_path / "flight.csv"), mount={"pitch_deg": -10})
    for row in found.rows("frames"):
        at = aim(number(row) / 10.0)
        assert (row["yaw_deg"], row["pitch_deg"]) == pytest.approx((at[0], at[1] - 10.0), abs=0.1)


def test_a_flight_table_of_another_day(video: Path, tmp_path: Path) -> None:
    """The rows say what was tried; nothing is guessed."""
    subtitles(video, air_cue, 0.1)
    found = ingest(tmp_path, videos=str(video), logs=str(airdata(tmp_path / "flight.csv", begin_s=100.0, end_s=150.0)))
    (problem,) = problems(found)
    assert "from the track at best" in problem
    assert "flight.csv" in problem


def test_a_flight_table_without_a_gimbal(video: Path, tmp_path: Path) -> None:
    subtitles(video, air_cue, 0.1)
    (problem,) = problems(ingest(tmp_path, videos=str(video), logs=str(airdata(tmp_path / "flight.csv", gimbal=False))))
    assert "attitude" in problem


# --- what stops ---


def test_no_subtitles(video: Path, tmp_path: Path) -> None:
    with pytest.raises(UndeterminedError, match="E-VIDEO-10") as error:
        ingest(tmp_path, videos=str(video))
    assert str(video) in error.value.where
    assert "copy the .SRT" in error.value.hint


@pytest.mark.parametrize("text", ["", "1\n00:00:00,000 --> 00:00:01,000\nhello\n"])
def test_subtitles_that_tell_nothing(video: Path, tmp_path: Path, text: str) -> None:
    video.with_suffix(".SRT").write_text(text)
    with pytest.raises(InputError) as error:
        ingest(tmp_path, videos=str(video))
    assert "DJI_0007.SRT" in error.value.where


def test_subtitles_without_a_fix(video: Path, tmp_path: Path) -> None:
    subtitles(video, lambda _: "[iso : 100] [latitude: 0.000000] [longitude: 0.000000] [altitude: 0.000000]", 0.1)
    with pytest.raises(UndeterminedError, match="nothing says where the images were taken"):
        ingest(tmp_path, videos=str(video))


def test_a_truncated_video(video: Path, tmp_path: Path) -> None:
    subtitles(video, rtk_cue, 1.0)
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    with pytest.raises(InputError, match="E-VIDEO-01") as error:
        ingest(tmp_path, videos=str(video))
    assert str(video) in error.value.where


def test_a_frame_that_cannot_be_decoded_is_a_row(video: Path, tmp_path: Path) -> None:
    """A GOP in the middle of the video is overwritten; the frames before and after it are used."""
    subtitles(video, rtk_cue, 1.0)
    with av.open(str(video)) as container:
        packets = [(p.pos, p.size, p.pts) for p in container.demux(video=0) if p.size]
    data = bytearray(video.read_bytes())
    hurt = sorted(packets, key=lambda packet: packet[2])[24:36]
    for begin, size, _ in hurt:
        data[begin : begin + size] = bytes(size)
    video.write_bytes(data)
    rows = ingest(tmp_path, videos=str(video)).rows("frames")
    assert [number(row) for row in rows] == list(range(0, 91, 7))
    lost = [number(row) for row in rows if not row["usable"]]
    assert {28, 35} <= set(lost) <= {21, 28, 35, 42}
    assert {row["problem"] for row in rows if not row["usable"]} == {
        "the video is damaged here and the image cannot be decoded: copy the video again"
    }


# --- bags whose poses are in another log ---


def shots(count: int = 40) -> Floats:
    """Exposures of a bag's images, s since `BEGIN`."""
    return 0.037 + 0.2 * np.arange(count)


def bag(folder: Path, offset_s: float = 0.0, *, poses: bool = False) -> Path:
    """Images with their calibration, and nothing that says where they were; or poses as well."""
    rows: list[bag_files.Row] = []
    for k, time_s in enumerate(shots().tolist()):
        at_ns = BEGIN_NS + round((time_s + offset_s) * NS)
        info = bag_files.camera_info(
            at_ns, height=HEIGHT, width=WIDTH, k=np.array([110.0, 0, 63, 0, 111, 32.5, 0, 0, 1])
        )
        rows += [
            ("/cam/image_raw", at_ns + bag_files.DELAY_NS, bag_files.image(at_ns, painted(k))),
            ("/cam/camera_info", at_ns + bag_files.DELAY_NS, info),
        ]
        if poses:
            rows.append(("/rig/pose", at_ns + bag_files.DELAY_NS, bag_files.pose(at_ns, x=0.5 * k)))
    return write_folder(folder / "images", rows)


def trajectory(folder: Path, kind: str) -> Path:
    """Poses at 20 Hz, UTC, as TUM or as a CSV of geodetic positions."""
    time_s = np.arange(-1.0, 12.0, 0.05)
    yaw_pitch_roll = aim(time_s)
    utc_s = [f"{BEGIN_NS // NS + np.floor(t):.0f}.{round(t % 1.0 * 1e9) % NS:09d}" for t in np.round(time_s, 3)]
    if kind == "tum":
        q = quaternion_from_rotation(enu_from_cam(*np.radians(yaw_pitch_roll).T))
        poses = np.column_stack([way(time_s), q[:, 1:], q[:, 0]])
        lines = [f"{t} " + " ".join(f"{value:.9f}" for value in row) for t, row in zip(utc_s, poses, strict=True)]
    else:
        latitude, longitude, height = HOME.geodetic_from_enu(way(time_s))
        table = np.column_stack([latitude, longitude, height, yaw_pitch_roll])
        lines = ["time,latitude_deg,longitude_deg,ellipsoidal_m,yaw_deg,pitch_deg,roll_deg"]
        lines += [f"{t}," + ",".join(f"{value:.9f}" for value in row) for t, row in zip(utc_s, table, strict=True)]
    path = folder / f"poses.{kind}"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("kind", ["tum", "csv"])
def test_a_bag_of_images_and_a_trajectory_on_the_same_clock(tmp_path: Path, kind: str) -> None:
    found = ingest(tmp_path, bags=str(bag(tmp_path)), logs=str(trajectory(tmp_path, kind)), camera=None)
    rows = found.rows("frames")
    # Four images are 2.4 m.
    assert [row["frame_id"] for row in rows] == [f"images_{k:06d}" for k in range(0, 40, 4)]
    origin = found.known["origin"]
    for row, k in zip(rows, range(0, 40, 4), strict=True):
        assert row["usable"], row["problem"]
        enu = np.array([row["east_m"], row["north_m"], row["up_m"]])
        if origin is not None:
            frame = LocalFrame(origin["latitude_deg"], origin["longitude_deg"], origin["height_m"])
            enu = HOME.enu_from_ecef(frame.ecef_from_enu(enu))
        assert enu == pytest.approx(way(shots()[k]), abs=2e-3)
        assert (row["yaw_deg"], row["pitch_deg"], row["roll_deg"]) == pytest.approx(aim(shots()[k]), abs=1e-3)
        assert row["time"] == BEGIN + timedelta(seconds=round(shots()[k], 6))
        assert row["image"] == f"run://images/{row['frame_id']}.png"
        assert told((found.output("images") / f"{row['frame_id']}.png").read_bytes()) == k
    assert (origin is None) == (kind == "tum")
    assert found.rows("cameras")[0]["fx"] == 110.0
    (clock,) = (row for row in found.rows("clocks") if row["source"] == "images")
    assert (clock["clock_id"], clock["method"]) == (
        "images of images",
        "said by the files (header stamp); offset to UTC",
    )


def test_whole_seconds_of_header_stamps_are_not_a_coarse_clock(tmp_path: Path) -> None:
    """An image each second, to the second: the stamp is the exposure and not its second's beginning."""
    rows: list[bag_files.Row] = [
        ("/cam", BEGIN_NS + k * NS, bag_files.image(BEGIN_NS + k * NS, painted(k))) for k in range(10)
    ]
    (tmp_path / "camera.yaml").write_text(camera_yaml(LENS))
    found = ingest(tmp_path, bags=str(write_mcap(tmp_path / "cam.mcap", rows)), logs=str(trajectory(tmp_path, "tum")))
    for k, row in enumerate(found.rows("frames")):
        assert (row["east_m"], row["north_m"], row["up_m"]) == pytest.approx(way(float(k)), abs=1e-3)


def test_a_bag_whose_clock_is_off_by_a_stated_offset(tmp_path: Path) -> None:
    images, poses = bag(tmp_path, offset_s=7200.0), trajectory(tmp_path, "tum")
    with pytest.raises(UndeterminedError, match="E-BAG-21") as error:
        ingest(tmp_path, bags=str(images), logs=str(poses), camera=None)
    assert "images 2024-06-01 10:00:00 .. 10:00:07" in error.value.found
    assert "poses.tum 2024-06-01 07:59:59 .. 08:00:11" in error.value.found
    assert "--set ingest.clock_offset_s=-7200" in error.value.hint
    found = ingest(tmp_path, bags=str(images), logs=str(poses), camera=None, clock_offset_s=-7200.0)
    row = found.rows("frames")[3]
    assert (row["east_m"], row["north_m"], row["up_m"]) == pytest.approx(way(shots()[12]), abs=2e-3)
    assert row["time"] == BEGIN + timedelta(seconds=round(shots()[12], 6))


def test_topics_that_a_bag_has_not(tmp_path: Path) -> None:
    images = bag(tmp_path, poses=True)
    with pytest.raises(InputError, match="E-BAG-20") as error:
        ingest(tmp_path, bags=str(images), image_topic="/cam/image", camera=None)
    assert (error.value.found, error.value.expected) == ("/cam/image", "/cam/image_raw")
    with pytest.raises(InputError, match="E-BAG-25") as error:
        ingest(tmp_path, bags=str(images), pose_topic="/rig/poses", camera=None)
    assert (error.value.found, error.value.expected) == ("/rig/poses", "/rig/pose")
    rows = ingest(tmp_path, bags=str(images), pose_topic="/rig/pose", camera=None).rows("frames")
    assert len(rows) == 10
    assert all("nothing says how the camera sits on it" in row["problem"] for row in rows)


def test_a_bag_without_images(tmp_path: Path) -> None:
    rows: list[bag_files.Row] = [("/rig/pose", BEGIN_NS + k * NS, bag_files.pose(BEGIN_NS + k * NS)) for k in range(5)]
    with pytest.raises(InputError, match="E-BAG-24") as error:
        ingest(tmp_path, bags=str(write_mcap(tmp_path / "poses.mcap", rows)), camera=None)
    assert "/rig/pose" in error.value.found
    assert "ingest.logs" in error.value.hint


def test_a_bag_named_twice_is_read_once(tmp_path: Path) -> None:
    images = bag(tmp_path, poses=True)
    found = ingest(tmp_path, bags=str(images), logs=str(images), camera=None, mount={"pitch_deg": 0})
    assert len(found.rows("clocks")) == 1
    assert all(row["usable"] for row in found.rows("frames"))


# --- the command line ---


def workflow(place: Path, **keys: str) -> Path:
    """A workflow of videos, whose paths are relative to it."""
    lines = [f"{key} = {value}" for key, value in {"videos": '"card"', "camera": '"camera.yaml"', **keys}.items()]
    path = place / "workflow.toml"
    path.write_text("\n".join(["[ingest]", *lines, "", "[pair]", "", "[match]", ""]))
    return path


def test_a_video_of_the_example_flight_is_paired_and_matched(small_flight: Path, tmp_path: Path) -> None:
    """A picture a second: the flight's photos, with subtitles of what their tags log."""
    tags = ingest_photos(small_flight / "photos").rows("frames")
    (tmp_path / "card").mkdir()
    pictures = [cv2.imread(str(small_flight / "photos" / f"{row['frame_id']}.JPG")) for row in tags]
    film = write_pictures(tmp_path / "card" / "DJI_0007.MP4", pictures)
    subtitles(film, lambda t: rtk_tags(tags[min(int(t), len(tags) - 1)]), 1.0)
    (tmp_path / "camera.yaml").write_text(camera_yaml(SMALL))
    done = epitransfer("run", workflow(tmp_path, frame_spacing_m="4.5"), "--out", tmp_path / "run", "--jobs", 1)
    assert done.returncode == 0, done.stderr
    assert "exif" not in done.stderr.lower()
    rows = pq.read_table(tmp_path / "run" / "frames.parquet").to_pylist()
    assert [row["frame_id"] for row in rows] == [f"DJI_0007_{k:06d}" for k in range(len(tags))]
    for row, tag, picture in zip(rows, tags, pictures, strict=True):
        image = cv2.imread(str(tmp_path / "run" / row["image"].removeprefix("run://")))
        # Coding costs some grey values; another frame would cost forty.
        assert np.mean(cv2.absdiff(image, picture)) < 8.0
        assert row["latitude_deg"] == pytest.approx(tag["latitude_deg"], abs=5.1e-7)
        assert row["longitude_deg"] == pytest.approx(tag["longitude_deg"], abs=5.1e-7)
        assert row["yaw_deg"] == pytest.approx(tag["yaw_deg"], abs=0.06)
    pairs = pq.read_table(tmp_path / "run" / "pairs.parquet").to_pylist()
    assert sum(pair["selected"] for pair in pairs) >= 2


@pytest.mark.parametrize(
    ("broken", "code", "said"),
    [("no subtitles", 4, "E-VIDEO-10"), ("cut", 3, "E-VIDEO-01"), ("empty subtitles", 3, "DJI_0007.SRT")],
)
def test_what_stops_the_command(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], broken: str, code: int, said: str
) -> None:
    srt = subtitles(video, rtk_cue, 1.0)
    if broken == "no subtitles":
        srt.unlink()
    elif broken == "cut":
        video.write_bytes(video.read_bytes()[:-1000])
    else:
        srt.write_bytes(b"")
    assert command_line(["ingest", str(tmp_path / "run"), "--workflow", str(workflow(tmp_path)), "--jobs", "1"]) == code
    told = capsys.readouterr()
    assert said in told.err
    assert "hint" in told.err
    assert "Traceback" not in told.err
    assert not told.out
    assert not (tmp_path / "run" / "frames.parquet").exists()


def test_rows_without_a_lens_or_attitude_end_with_exit_8(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    subtitles(video, air_cue, 0.1)
    recipe = workflow(tmp_path, frame_spacing_m="2.0")
    given = ["ingest", str(tmp_path / "run"), "--workflow", str(recipe), "--jobs", "1"]
    assert command_line(given) == 8
    assert "name the log that has it in ingest.logs" in capsys.readouterr().err
    table = airdata(tmp_path / "flight.csv")
    assert command_line([*given, "--logs", str(table)]) == 0
    assert "15 of 15 photos usable" in capsys.readouterr().out
    rows = pq.read_table(tmp_path / "run" / "frames.parquet").to_pylist()
    assert {row["time_source"] for row in rows} == {"log clock"}
