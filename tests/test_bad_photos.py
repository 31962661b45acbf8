"""Photos that are none: a row with its reason, or the contract's error that names the file and the remedy."""

import os
import struct
import zlib
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from photo_files import GIMBAL, exif_block, write_photo
from test_ingest import flight, ingest

from pipeline.engine.errors import InputError, ResourceError
from pipeline.sources.photos import read_photo
from stages.ingest import Config, sources


def truncated(path: Path) -> None:
    data = write_photo(path, size=(400, 300)).read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])


def cut_in_the_header(path: Path) -> None:
    path.write_bytes(write_photo(path).read_bytes()[:300])


def bomb(path: Path) -> None:
    """A PNG of 900 megapixels in a few hundred bytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 30000, 30000, 8, 0, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 99)) + chunk(b"IEND", b"")
    )


BAD = {
    "empty": (lambda path: path.touch(), "0 bytes"),
    "text": (lambda path: path.write_text("this is a text, not a photo\n" * 9), "not an image"),
    "truncated": (truncated, "truncated"),
    "header": (cut_in_the_header, "copy it again"),
    "bomb": (bomb, "megapixels"),
    "no_gps": (lambda path: write_photo(path, exif=exif_block(place=None)), "no GPS position"),
    "no_tags": (lambda path: write_photo(path, xmp=None, exif=exif_block(place=None, x920A=None)), "no GPS position"),
    "null_island": (
        lambda path: write_photo(path, exif=exif_block(place={"latitude": 0.0, "longitude": 0.0, "altitude": 5.0})),
        "(0, 0)",
    ),
    "nan": (lambda path: write_photo(path, xmp=dict.fromkeys(GIMBAL, "nan")), "no camera attitude"),
    "no_height": (
        lambda path: write_photo(path, exif=exif_block(gps={5: b"\x00", 6: 0}, place=None)),
        "no GPS position",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_photo_is_a_row_with_its_reason(tmp_path: Path, name: str) -> None:
    write, reason = BAD[name]
    write(flight(tmp_path) / "BAD_0001.JPG")
    found = ingest(tmp_path)
    row = next(row for row in found.rows("frames") if row["frame_id"] == "BAD_0001")
    assert not row["usable"]
    assert reason in row["problem"]
    assert ":" in row["problem"], "a reason has a remedy"
    assert found.items == (4, 1)
    assert "BAD_0001.JPG" in found.warnings[0]


def test_only_bad_photos_still_give_tables(tmp_path: Path) -> None:
    for name, (write, _) in BAD.items():
        write(tmp_path / f"{name}.JPG")
    found = ingest(tmp_path)
    assert found.items == (len(BAD), len(BAD))
    assert found.known["origin"] is None
    assert found.tables["frames"].num_rows == len(BAD)


@pytest.mark.parametrize("make", [lambda _: None, lambda path: path.mkdir(), lambda path: path.touch()])
def test_no_photos_at_all(tmp_path: Path, make: object) -> None:
    folder = tmp_path / "flight"
    make(folder)  # type: ignore[operator]
    with pytest.raises(InputError, match="flight") as caught:
        ingest(folder) if not folder.is_file() else ingest(tmp_path / "flight" / "photos")
    assert caught.value.exit_code == 3
    assert caught.value.hint
    if not folder.is_file():
        with pytest.raises(InputError):
            sources(Config(photos=str(folder)))


def test_two_images_of_one_name(tmp_path: Path) -> None:
    flight(tmp_path / "100MEDIA")
    flight(tmp_path / "101MEDIA")
    with pytest.raises(InputError, match=r"100MEDIA/DJI_0001\.JPG and .*101MEDIA/DJI_0001\.JPG"):
        ingest(tmp_path)


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_no_permission(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = flight(tmp_path / "photos")
    blocked = folder if kind == "folder" else folder / "DJI_0002.JPG"
    if os.geteuid() == 0:
        # The superuser may read everything; the refusal is simulated where it would come from.
        def refuse(self: Path, *_: object, **__: object) -> object:
            if self == blocked:
                raise PermissionError(13, "Permission denied", str(self))
            return original(self, *_, **__)

        name = "iterdir" if kind == "folder" else "open"
        original = getattr(Path, name)
        monkeypatch.setattr(Path, name, refuse)
    else:
        blocked.chmod(0)
    with pytest.raises(ResourceError, match=blocked.name) as caught:
        ingest(folder)
    blocked.chmod(0o700)
    assert caught.value.exit_code == 6


def test_one_photo_alone(tmp_path: Path) -> None:
    found = ingest(flight(tmp_path, count=1) / "DJI_0001.JPG")
    assert found.items == (1, 0)
    assert found.rows("frames")[0]["image"] == "DJI_0001.JPG"


def test_all_photos_from_one_spot(tmp_path: Path) -> None:
    for n in range(3):
        write_photo(tmp_path / f"DJI_000{n}.JPG")
    rows = ingest(tmp_path).rows("frames")
    assert len({(row["east_m"], row["north_m"], row["up_m"]) for row in rows}) == 1


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_bytes_never_raise(tmp_path: Path, data: st.DataObject) -> None:
    """A photo with any of its bytes changed is read or judged."""
    path = tmp_path / "DJI_0001.JPG"
    block = exif_block(maker={"CameraYaw": 1.0, "CameraPitch": -2.0, "CameraRoll": 0.0})
    content = bytearray(write_photo(path, exif=block).read_bytes())
    for _ in range(data.draw(st.integers(1, 12))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    record = read_photo(str(path))
    assert record.frame_id == "DJI_0001"
    assert record.problem or record.camera is not None
