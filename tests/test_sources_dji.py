"""Every spelling and trap of DJI's tags, on photos built in code."""

import contextlib
import struct
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from photo_files import DJI, GIMBAL, exif_block, write_photo, xmp_packet
from PIL.TiffImagePlugin import IFDRational

from pipeline.engine.errors import InputError
from pipeline.geometry.rotations import enu_from_cam
from pipeline.sources import dji
from pipeline.sources.exif import Exif, read_exif, utc_offset
from pipeline.sources.photos import PhotoRecord, read_photo
from pipeline.sources.xmp import Xmp, read_xmp

SOUTH_EAST = {"latitude": -35.25, "longitude": 149.02, "altitude": 620.0}


def photo(folder: Path, **parts: object) -> PhotoRecord:
    return read_photo(str(write_photo(folder / "DJI_0001.JPG", **parts)))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("tags", "place", "expected"),
    [
        ({"GpsLatitude": "+45.5", "GpsLongitude": "-7.25"}, None, (45.5, -7.25)),
        ({"GpsLatitude": "45.5", "GpsLongitude": "149.02"}, None, (45.5, 149.02)),
        ({"GpsLatitude": "45.5", "GpsLongtitude": "149.02"}, None, (45.5, 149.02)),
        ({"Latitude": "45.5", "Longitude": "149.02"}, None, (45.5, 149.02)),
        # Without signs the hemisphere is EXIF's.
        ({"GpsLatitude": "35.25000001", "GpsLongitude": "149.02000001"}, SOUTH_EAST, (-35.25000001, 149.02000001)),
        ({"GpsLatitude": "35.25", "GpsLongitude": "149.02"}, {**SOUTH_EAST, "longitude": -149.02}, (-35.25, -149.02)),
        # An edited EXIF position wins over the XMP the drone wrote.
        ({"GpsLatitude": "-35.26", "GpsLongitude": "149.02"}, SOUTH_EAST, (-35.25, 149.02)),
        ({"GpsLatitude": "nan", "GpsLongitude": "149.02"}, SOUTH_EAST, (-35.25, 149.02)),
        ({}, SOUTH_EAST, (-35.25, 149.02)),
    ],
)
def test_position(
    tmp_path: Path, tags: dict[str, str], place: dict[str, float] | None, expected: tuple[float, float]
) -> None:
    record = photo(tmp_path, xmp={**GIMBAL, **tags}, exif=exif_block(place=place))
    assert record.position is not None
    assert (record.position.latitude_deg, record.position.longitude_deg) == pytest.approx(expected, abs=1e-9)
    assert not record.problem


def test_an_edited_position_is_noted(tmp_path: Path) -> None:
    record = photo(
        tmp_path, xmp={**GIMBAL, "GpsLatitude": "-35.26", "GpsLongitude": "149.02"}, exif=exif_block(place=SOUTH_EAST)
    )
    assert record.position is not None
    assert record.position.source == "exif position"
    assert "differ by 1110" in record.notes[0]


@pytest.mark.parametrize(
    ("tags", "place", "reason"),
    [
        ({}, None, "no GPS position"),
        ({"GpsLatitude": "0.0", "GpsLongitude": "0.0"}, None, "(0, 0)"),
        ({}, {"latitude": 0.0, "longitude": 0.0, "altitude": 10.0}, "(0, 0)"),
        ({"GpsLatitude": "nan", "GpsLongitude": "nan"}, None, "no GPS position"),
        ({"GpsLatitude": "145.0", "GpsLongitude": "7.0"}, None, "not on earth"),
        ({"GpsStatus": "Invalid"}, SOUTH_EAST, "GpsStatus"),
    ],
)
def test_no_position(tmp_path: Path, tags: dict[str, str], place: dict[str, float] | None, reason: str) -> None:
    record = photo(tmp_path, xmp={**GIMBAL, **tags}, exif=exif_block(place=place))
    assert reason in record.problem


@pytest.mark.parametrize("elements", [False, True])
@pytest.mark.parametrize("prefix", ["drone-dji", "drone", "ns1"])
def test_any_prefix_attributes_and_elements(tmp_path: Path, prefix: str, elements: bool) -> None:
    packet = xmp_packet({**GIMBAL, "GimbalYawDegree": "+33.3"}, prefix=prefix, elements=elements)
    record = photo(tmp_path, xmp=packet)
    assert record.attitude is not None
    assert record.attitude.yaw_deg == 33.3


def test_another_namespace_is_not_djis(tmp_path: Path) -> None:
    packet = xmp_packet(GIMBAL).replace(DJI.encode(), b"http://example.com/other/1.0/")
    assert "no camera attitude" in photo(tmp_path, xmp=packet).problem


def test_gimbal_yaw_and_not_flight_yaw(tmp_path: Path) -> None:
    record = photo(tmp_path, xmp={**GIMBAL, "GimbalYawDegree": "10.0", "FlightYawDegree": "70.0"})
    assert record.attitude == dji.Attitude(10.0, -90.0, 0.0, "xmp gimbal")


def test_missing_gimbal_falls_back_to_the_makernotes_camera(tmp_path: Path) -> None:
    maker = {"CameraYaw": 89.0, "CameraPitch": -75.1, "CameraRoll": 0.0, "Yaw": 87.0, "Pitch": 0.0, "Roll": 4.5}
    record = photo(tmp_path, xmp=None, exif=exif_block(maker=maker))
    assert record.attitude == dji.Attitude(89.0, -75.1, 0.0, "makernotes camera attitude")
    assert not record.problem


def test_an_incomplete_gimbal_is_no_gimbal(tmp_path: Path) -> None:
    tags = {"GimbalYawDegree": "10", "GimbalPitchDegree": "NaN", "GimbalRollDegree": "0"}
    assert "no camera attitude" in photo(tmp_path, xmp=tags).problem


@pytest.mark.parametrize("where", ["xmp", "makernotes"])
def test_only_the_aircrafts_attitude_is_refused(tmp_path: Path, where: str) -> None:
    xmp = {"FlightYawDegree": "44.2", "FlightPitchDegree": "1", "FlightRollDegree": "0"} if where == "xmp" else None
    maker = None if where == "xmp" else {"Yaw": 44.2, "Pitch": 1.0, "Roll": 0.0}
    record = photo(tmp_path, xmp=xmp, exif=exif_block(maker=maker))
    assert record.attitude is None
    assert "only the aircraft's is known (yaw 44.2 deg)" in record.problem


def test_a_gimbal_that_looks_backwards_is_left_alone(tmp_path: Path) -> None:
    """Yaw 170, pitch -30, roll 180 is an upside-down image: its axis and its up are those of the angles as logged."""
    record = photo(tmp_path, xmp={"GimbalYawDegree": "170", "GimbalPitchDegree": "-30", "GimbalRollDegree": "180"})
    assert record.attitude is not None
    angles = np.radians([record.attitude.yaw_deg, record.attitude.pitch_deg, record.attitude.roll_deg])
    backwards, level = enu_from_cam(*angles), enu_from_cam(*np.radians([170.0, -30.0, 0.0]))
    assert backwards[:, 2] == pytest.approx(level[:, 2], abs=1e-12)
    assert backwards[:, :2] == pytest.approx(-level[:, :2], abs=1e-12)
    # The same rotation by its other name.
    assert backwards == pytest.approx(enu_from_cam(*np.radians([-10.0, -150.0, 0.0])), abs=1e-12)


@pytest.mark.parametrize(
    ("yaw", "pitch", "axis", "top", "right"),
    [
        (0.0, -90.0, (0, 0, -1), (0, 1, 0), (1, 0, 0)),
        (90.0, 0.0, (1, 0, 0), (0, 0, 1), (0, -1, 0)),
        (90.0, -90.0, (0, 0, -1), (1, 0, 0), (0, -1, 0)),
        (-90.0, 0.0, (-1, 0, 0), (0, 0, 1), (0, 1, 0)),
    ],
)
def test_what_a_pilot_sees(
    tmp_path: Path, *, yaw: float, pitch: float, axis: tuple[int, ...], top: tuple[int, ...], right: tuple[int, ...]
) -> None:
    tags = {"GimbalYawDegree": f"{yaw:+}", "GimbalPitchDegree": f"{pitch:+}", "GimbalRollDegree": "+0.00"}
    attitude = photo(tmp_path, xmp=tags).attitude
    assert attitude is not None
    rotation = enu_from_cam(*np.radians([attitude.yaw_deg, attitude.pitch_deg, attitude.roll_deg]))
    assert rotation[:, 2] == pytest.approx(axis, abs=1e-12)
    assert -rotation[:, 1] == pytest.approx(top, abs=1e-12)
    assert rotation[:, 0] == pytest.approx(right, abs=1e-12)


@pytest.mark.parametrize("flag", [0, 16, 34, 50])
def test_rtk_flag_and_sigmas(tmp_path: Path, flag: int) -> None:
    tags = {**GIMBAL, "RtkFlag": str(flag), "RtkStdLon": "0.011", "RtkStdLat": "0.012", "RtkStdHgt": "0.021"}
    assert photo(tmp_path, xmp=tags).fix == dji.Fix(flag, 0.011, 0.012, 0.021, None)


def test_heights_keep_their_signs(tmp_path: Path) -> None:
    record = photo(
        tmp_path,
        xmp={**GIMBAL, "RelativeAltitude": "-3.20"},
        exif=exif_block(place={"latitude": 28.0, "longitude": -82.0, "altitude": -5.677}),
    )
    assert (record.absolute_m, record.relative_m) == (-5.677, -3.2)


@pytest.mark.parametrize("where", ["xmp", "exif"])
def test_pictures_turned_by_a_viewer_are_refused(tmp_path: Path, where: str) -> None:
    tool = "Microsoft Windows Photo Viewer 10.0.10240.16384"
    record = photo(
        tmp_path,
        xmp=xmp_packet(GIMBAL, creator=tool if where == "xmp" else ""),
        exif=exif_block(software=tool if where == "exif" else "v01"),
    )
    assert "turn pictures" in record.problem
    assert "use the original" in record.problem


def test_orientation_is_noted_and_not_applied(tmp_path: Path) -> None:
    record = photo(tmp_path, exif=exif_block(orientation=6), size=(80, 60))
    assert (record.width, record.height) == (80, 60)
    assert "orientation 6" in record.notes[0]


@pytest.mark.parametrize(
    ("text", "hours"),
    [("+05:30", 5.5), ("-03:30", -3.5), ("+00:00", 0.0), ("Z", 0.0), ("-08:00", -8.0), ("5:30", None), ("", None)],
)
def test_utc_offset_sign_covers_the_minutes(text: str, hours: float | None) -> None:
    zone = utc_offset(text)
    found = None if zone is None else zone.utcoffset(None).total_seconds() / 3600.0
    assert found == hours


GPS_STAMP = {29: "2024:06:01", 7: (IFDRational(2, 1), IFDRational(42, 1), IFDRational(5, 1))}


@pytest.mark.parametrize(
    ("xmp", "exif", "expected", "source"),
    [
        ({}, {"x9011": "+05:30"}, datetime(2024, 6, 1, 2, 42, 3, tzinfo=UTC), "exif+offset"),
        ({}, {"x9010": "-03:30"}, datetime(2024, 6, 1, 11, 42, 3, tzinfo=UTC), "exif+offset"),
        ({}, {"x9291": "25"}, datetime(2024, 6, 1, 8, 12, 3, 250000, tzinfo=UTC), "exif (zone unknown)"),
        ({}, {"gps": GPS_STAMP}, datetime(2024, 6, 1, 2, 42, 3, tzinfo=UTC), "exif+gps zone"),
        ({}, {"gps": GPS_STAMP, "taken": "no time"}, datetime(2024, 6, 1, 2, 42, 5, tzinfo=UTC), "gps"),
        (
            {"UTCAtExposure": "2021-05-26T15:21:49.073960"},
            {"x9011": "+05:30"},
            datetime(2021, 5, 26, 15, 21, 49, 73960, tzinfo=UTC),
            "utc_at_exposure",
        ),
        ({"UTCAtExposure": "garbage"}, {}, datetime(2024, 6, 1, 8, 12, 3, tzinfo=UTC), "exif (zone unknown)"),
    ],
)
def test_time(tmp_path: Path, xmp: dict[str, str], exif: dict[str, object], expected: datetime, source: str) -> None:
    record = photo(tmp_path, xmp={**GIMBAL, **xmp}, exif=exif_block(**exif))  # type: ignore[arg-type]
    assert (record.time, record.time_source) == (expected, source)


def test_positioning_error_of_exif(tmp_path: Path) -> None:
    assert photo(tmp_path, exif=exif_block(gps={31: IFDRational(21, 10)})).fix.sigma_horizontal_m == 2.1


def test_zero_denominators_are_no_values(tmp_path: Path) -> None:
    block = exif_block(gps={2: (IFDRational(0, 0), IFDRational(0, 0), IFDRational(0, 0)), 6: IFDRational(1, 0)})
    record = photo(tmp_path, exif=block)
    assert "no GPS position" in record.problem
    assert record.absolute_m is None


def test_entities_do_not_expand() -> None:
    bomb = b'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]><x>&b;</x>'
    with pytest.raises(InputError, match="XMP"):
        read_xmp(bomb)


def test_a_damaged_packet_leaves_exif(tmp_path: Path) -> None:
    maker = {"CameraYaw": 1.0, "CameraPitch": -2.0, "CameraRoll": 0.0}
    record = photo(tmp_path, xmp=xmp_packet(GIMBAL)[:200], exif=exif_block(maker=maker))
    assert not record.problem
    assert "XMP packet cannot be read" in record.notes[0]


@given(st.binary(max_size=400))
def test_xmp_of_any_bytes(data: bytes) -> None:
    with contextlib.suppress(InputError):
        assert isinstance(read_xmp(data), Xmp)


@given(st.dictionaries(st.sampled_from(sorted({*GIMBAL, "GpsLatitude", "GpsLongitude", "UTCAtExposure"})), st.text()))
def test_any_tag_text_is_judged(tags: dict[str, str]) -> None:
    """Whatever a tag says, the result is a value or a reason."""
    for read in (dji.position, dji.attitude):
        with contextlib.suppress(dji.Unusable):
            assert read(Exif(), Xmp(tags)).source
    dji.exposure_time(Exif(), Xmp(tags))


def test_a_count_of_thousands_of_millions_ends(tmp_path: Path) -> None:
    """A damaged count of the MakerNotes makes the EXIF library loop for hours."""
    maker = {"CameraYaw": 1.0, "CameraPitch": -2.0, "CameraRoll": 0.0}
    data = write_photo(tmp_path / "DJI_0001.JPG", exif=exif_block(maker=maker)).read_bytes()
    tag = data.index(struct.pack(">H", 0x927C))
    (tmp_path / "DJI_0002.JPG").write_bytes(data[: tag + 4] + b"\xff\xff\xff\xff" + data[tag + 8 :])
    record = read_photo(str(tmp_path / "DJI_0002.JPG"))
    assert "EXIF cannot be read" in record.notes[0]


def test_exif_of_a_photo_without_any() -> None:
    assert read_exif(b"\xff\xd8\xff\xd9") == Exif()
