"""Which file is a log, what a folder of them gives, and what is said of the others."""

from __future__ import annotations

from pathlib import Path

import pytest
from flights import epitransfer

from pipeline.engine.errors import InputError
from pipeline.placing.locate import find_logs, find_videos
from pipeline.sources.logs import knows, read_log


@pytest.mark.parametrize(
    ("name", "data", "code", "told"),
    [
        ("a.BIN", b"", "E-LOG-04", "copy it again"),
        ("a.BIN", b"this is a text", "E-LOG-01", "begins with"),
        ("a.MRK", b"1 2", "E-LOG-01", "beside the photos"),
        ("metadata.yaml", b"a: 1", "E-LOG-01", "name the bag's folder"),
        ("a.jpg", b"\xff\xd8\xff", "E-LOG-01", "--photos"),
    ],
)
def test_what_is_no_log(tmp_path: Path, name: str, data: bytes, code: str, told: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError) as error:
        read_log(str(tmp_path / name))
    assert error.value.code == code
    assert told in str(error.value)


def test_what_is_found(tmp_path: Path) -> None:
    for name in ("a.BIN", "b.tlog", "c.jpg", "d.mcap", "bag/metadata.yaml", "bag/x.db3"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    found = find_logs([str(tmp_path), str(tmp_path / "bag")])
    assert [Path(name).name for name in found] == ["a.BIN", "b.tlog", "bag", "x.db3", "d.mcap"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="E-LOG-02"):
        find_logs(str(tmp_path / "empty"))
    with pytest.raises(InputError, match="E-VIDEO-12"):
        find_videos([str(tmp_path)])


def test_a_folder_with_a_broken_log_gives_the_others(small_flight: Path, tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "flight.BIN").write_bytes((small_flight / "logs" / "flight.BIN").read_bytes())
    (tmp_path / "logs" / "broken.tlog").write_bytes(b"")
    arguments = (
        "ingest",
        tmp_path / "run",
        "--photos",
        small_flight / "bare",
        "--camera",
        small_flight / "camera.yaml",
    )
    done = epitransfer(*arguments, "--logs", tmp_path / "logs", "--jobs", 1)
    assert done.returncode == 0, done.stderr
    assert "broken.tlog is left out" in done.stderr
    assert "5 placed by logs" in done.stdout
    named = epitransfer(*arguments, "--logs", tmp_path / "logs" / "broken.tlog", "--jobs", 1)
    assert named.returncode == 3
    assert "broken.tlog" in named.stderr


def test_a_log_that_places_nothing_is_told(small_flight: Path, tmp_path: Path, shared: Path) -> None:
    other = shared / "data" / "logs" / "px4_ulg" / "foxglove" / "test_ulog.ulg"
    done = epitransfer(
        "ingest", tmp_path / "run", "--photos", small_flight / "bare", "--camera", small_flight / "camera.yaml",
        "--logs", small_flight / "logs" / "flight.BIN", "--logs", other, "--jobs", 1,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "test_ulog.ulg is not used: it placed no image" in done.stderr


@pytest.mark.real
def test_every_real_log_is_known(shared: Path) -> None:
    files = [
        file
        for folder in ("logs", "bags")
        for file in (shared / "data" / folder).rglob("*")
        if file.is_file() and file.name != "SOURCE.md" and "rtk_mrk" not in file.parts and file.stat().st_size > 2
    ]
    assert len(files) > 18
    assert [file.name for file in files if not knows(str(file))] == []
