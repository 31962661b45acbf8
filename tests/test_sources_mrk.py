"""RTK exposure marks: parsing by label, GPS time, and which photo a mark belongs to."""

import contextlib
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.clocks.gps import leap_seconds, utc_from_gps
from pipeline.engine.errors import InputError
from pipeline.sources import dji
from pipeline.sources.exposures import MarkFile, apply, associate, running_number
from pipeline.sources.mrk import Mark, read_marks
from pipeline.sources.photos import PhotoRecord

LINE = (
    "2\t296288.242869\t[2211]\t     3,N\t     0,E\t    75,V\t47.6436873208,Lat\t16.4759271684,Lon\t512.998,Ellh\t"
    "0.014391, 0.013698, 0.029694\t50,Q"
)
BEGAN = datetime(2024, 6, 1, 6, 0, 0, tzinfo=UTC)


def test_a_line() -> None:
    (mark,) = read_marks(LINE.encode())
    expected = datetime(2022, 5, 25, 10, 17, 50, 242869, tzinfo=UTC)
    assert mark == Mark(2, expected, 47.6436873208, 16.4759271684, 512.998, 0.014391, 0.013698, 0.029694, 50)


def test_labels_and_not_places_decide() -> None:
    swapped = LINE.replace("47.6436873208,Lat\t16.4759271684,Lon", "16.4759271684,Lon\t47.6436873208,Lat")
    assert read_marks(swapped.encode()) == read_marks(LINE.encode())


@pytest.mark.parametrize(
    ("found", "instead"),
    [("Lat", "Foo"), ("[2211]", "2211"), ("[2211]", "[9999999]"), ("296288.242869", "1e9"), (", 0.029694", "")],
)
def test_a_damaged_line_is_named(found: str, instead: str) -> None:
    with pytest.raises(InputError, match=r"flight\.MRK:2"):
        read_marks(f"{LINE}\n{LINE.replace(found, instead)}\n".encode(), "flight.MRK")


@given(st.one_of(st.binary(max_size=300), st.text(max_size=200).map(lambda text: (LINE + text).encode())))
def test_any_bytes(data: bytes) -> None:
    with contextlib.suppress(InputError):
        assert read_marks(data)


def test_gps_time() -> None:
    # The 18th leap second came at the end of 2016: the GPS second 18 of 2017 is the first of UTC.
    week, second = divmod((datetime(2017, 1, 1, tzinfo=UTC) - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds(), 604800)
    assert utc_from_gps(int(week), second + 18.0) == datetime(2017, 1, 1, tzinfo=UTC)
    assert leap_seconds(datetime(2016, 12, 31, 23, 59, 59, tzinfo=UTC)) == 17
    # A week that lost its roll-over is in the future of the same day.
    assert utc_from_gps(2211 - 2048, 296288.0) == utc_from_gps(2211, 296288.0)


def mark(index: int, second: float) -> Mark:
    return Mark(index, BEGAN + timedelta(seconds=second), 45.0 + second * 1e-5, 7.0, 300.0, 0.01, 0.012, 0.02, 50)


def photo(index: int, second: float, zone_h: float = 2.0) -> PhotoRecord:
    return PhotoRecord(
        f"/flight/DJI_{index:04d}.JPG", f"DJI_{index:04d}", "0" * 64, 800, 600,
        time=BEGAN + timedelta(hours=zone_h, seconds=int(second)),
        time_source="exif (zone unknown)",
        position=dji.Position(45.0 + second * 1e-5, 7.00001, "exif position"),
        attitude=dji.Attitude(0.0, -90.0, 0.0, "xmp gimbal"),
        absolute_m=340.0,
    )  # fmt: skip


SECONDS = (0.4, 3.1, 5.9, 9.2, 12.0)
MARKS = MarkFile("/flight/flight.MRK", tuple(mark(n, s) for n, s in enumerate(SECONDS, 1)))
PHOTOS = [photo(n, s) for n, s in enumerate(SECONDS, 1)]


@pytest.mark.parametrize(
    ("name", "number"),
    [("DJI_0012", 12), ("DJI_20220525101750_0012_V", 12), ("MAX_0007", 7), ("IMG12", None), ("DJI_20220525", None)],
)
def test_running_number(name: str, number: int | None) -> None:
    assert running_number(name) == number


def test_marks_give_position_height_sigmas_and_time() -> None:
    found = associate(PHOTOS, [MARKS])
    assert found.problems == {}
    assert found.offset_s == {MARKS.location: -7200.0}
    placed = apply(PHOTOS[1], found.of_photo[PHOTOS[1].location])
    assert (placed.time, placed.time_source) == (MARKS.marks[1].time, "mrk")
    assert placed.position == dji.Position(45.0 + 3.1e-5, 7.0, "mrk position")
    assert placed.absolute_m == 300.0
    assert placed.fix == dji.Fix(50, 0.012, 0.01, 0.02)


def test_a_lost_photo_does_not_shift_the_others() -> None:
    found = associate([*PHOTOS[:2], *PHOTOS[3:]], [MARKS])
    assert {location[-8:-4]: m.index for location, m in found.of_photo.items()} == {
        "0001": 1,
        "0002": 2,
        "0004": 4,
        "0005": 5,
    }


def test_shifted_numbers_are_found_out_by_time() -> None:
    """Photos renumbered by one: every photo has a mark, all 3 s off, and a time zone is not 3 s."""
    shifted = [replace(p, frame_id=f"DJI_{n:04d}") for n, p in enumerate(PHOTOS[1:], 1)]
    found = associate(shifted, [MARKS])
    assert not found.of_photo
    assert "-3 s apart" in found.problems[MARKS.location]
    uneven = [*PHOTOS[:4], replace(PHOTOS[4], time=BEGAN + timedelta(hours=2, seconds=20))]
    assert "when the others agree" in associate(uneven, [MARKS]).problems[MARKS.location]


def test_a_stated_clock_offset_stands_in_for_the_zone() -> None:
    late = [replace(p, time=p.time + timedelta(seconds=37)) for p in PHOTOS if p.time]
    assert not associate(late, [MARKS]).of_photo
    assert len(associate(late, [MARKS], clock_offset_s=-7237.0).of_photo) == 5


def test_shifted_numbers_are_found_out_by_place() -> None:
    far = [replace(p, position=dji.Position(45.001, 7.0, "exif position")) for p in PHOTOS]
    assert "numbers are shifted" in associate(far, [MARKS]).problems[MARKS.location]


def test_without_times_counts_must_agree() -> None:
    timeless = [replace(p, time=None, time_source="") for p in PHOTOS]
    assert len(associate(timeless, [MARKS]).of_photo) == 5
    assert "counts must agree" in associate(timeless[:4], [MARKS]).problems[MARKS.location]


def test_marks_of_another_day_are_left_aside() -> None:
    stated = [replace(p, time_source="exif+offset") for p in PHOTOS]
    assert "apart" in associate(stated, [MARKS]).problems[MARKS.location]


def test_marks_of_another_folder_are_left_aside() -> None:
    assert not associate(PHOTOS, [replace(MARKS, location="/other/flight.MRK")]).of_photo


@pytest.mark.real
def test_a_real_file(shared: Path) -> None:
    data = (shared / "data/logs/rtk_mrk/101FTASK_Timestamp.mrk").read_bytes()
    marks = read_marks(data)
    assert len(marks) == 176
    assert {m.quality for m in marks} == {50}
    assert marks[0].time.date().isoformat() == "2022-05-25"
    assert all(a.time < b.time for a, b in pairwise(marks))
