"""Bad input through the command line: exit code, a message that names file and remedy, and whole outputs."""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from flights import copied, epitransfer, is_root, leftovers, outputs
from photo_files import exif_block, write_photo
from test_bad_photos import BAD

from stages.app import run as command_line

Spoken = tuple[int, str, str]


@pytest.fixture
def spoken(capsys: pytest.CaptureFixture[str]) -> Callable[..., Spoken]:
    """Runs a command line in this process: exit code, stdout, stderr; never a traceback."""

    def run(*arguments: object) -> Spoken:
        capsys.readouterr()
        code = command_line([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err, captured.err
        assert "Warning" not in captured.err, captured.err
        assert code in {0, 2, 3, 4, 5, 6, 7, 8}
        assert (captured.out == "") == (code != 0)
        return code, captured.out, captured.err

    return run


def photos_of(small_flight: Path, place: Path) -> Path:
    """The flight's photos, to be changed."""
    return shutil.copytree(small_flight / "photos", place / "photos")


def run_of(photos: Path, run: Path, *more: object) -> tuple[object, ...]:
    """A run of photos alone, with what the example's workflow states."""
    stated = ("ingest.height_datum=navd88", "ingest.geoid=-33.0", "ingest.crs=EPSG:32617+5703")
    given = (part for item in stated for part in ("--set", item))
    return ("run", "--photos", photos, "--out", run, "--jobs", 1, *given, *more)


def frames_of(run: Path) -> dict[str, dict[str, object]]:
    return {row["frame_id"]: row for row in pq.read_table(run / "frames.parquet").to_pylist()}


# --- photos ---


def write_bad(folder: Path, prefix: str = "") -> None:
    for name, (write, _) in BAD.items():
        write(folder / f"{prefix}{name}.JPG")  # type: ignore[no-untyped-call]


def add_bad_photos(photos: Path) -> list[str]:
    """One of each kind, the damaged ones made from a whole photo of the flight."""
    write_bad(photos, "BAD_")
    whole = (photos / "DJI_0001.JPG").read_bytes()
    (photos / "BAD_cut.JPG").write_bytes(whole[: len(whole) // 2])
    (photos / "BAD_zeroed.JPG").write_bytes(whole[: len(whole) // 3] + b"\0" * (len(whole) - len(whole) // 3))
    return sorted(path.stem for path in photos.glob("BAD_*"))


def test_bad_photos_are_rows_and_the_good_ones_go_on(
    small_flight: Path, small_run: Path, tmp_path: Path, spoken: Callable[..., Spoken]
) -> None:
    photos = photos_of(small_flight, tmp_path)
    bad = add_bad_photos(photos)
    run = tmp_path / "run"
    accept = ("--set", "ingest.max_failed_share=0.8")
    code, _, err = spoken(*run_of(photos, run, "--to", "match", *accept))
    assert code == 0, err
    assert "BAD_" in err
    frames = frames_of(run)
    assert {name for name, row in frames.items() if not row["usable"]} == set(bad)
    assert all(frames[name]["problem"] for name in bad)
    pairs = pq.read_table(run / "pairs.parquet").column("pair_id").to_pylist()
    assert pairs == pq.read_table(small_run / "pairs.parquet").column("pair_id").to_pylist()
    assert not any("BAD" in pair for pair in pairs)
    code, _, err = spoken(*run_of(photos, run, "--to", "ingest"))
    assert code == 8, "more than half failed"
    assert "--set ingest.max_failed_share=1" in err
    assert leftovers(run) == []


def test_only_bad_photos(tmp_path: Path, spoken: Callable[..., Spoken]) -> None:
    (tmp_path / "photos").mkdir()
    write_bad(tmp_path / "photos")
    code, _, err = spoken(*run_of(tmp_path / "photos", tmp_path / "run"))
    assert code == 5
    assert "0 usable frames" in err
    assert not any(row["usable"] for row in frames_of(tmp_path / "run").values())


def test_one_photo_alone(small_flight: Path, tmp_path: Path, spoken: Callable[..., Spoken]) -> None:
    code, _, err = spoken(*run_of(small_flight / "photos" / "DJI_0001.JPG", tmp_path / "run"))
    assert code == 5
    assert "E-PAIR-01" in err
    assert "1 usable frame;" in err
    assert "single photo" in err
    assert sorted(path.name for path in (tmp_path / "run").glob("*.parquet")) == [
        f"{name}.parquet" for name in ("cameras", "clocks", "frames", "tracks")
    ]


def test_all_photos_from_one_spot(tmp_path: Path, spoken: Callable[..., Spoken]) -> None:
    (tmp_path / "photos").mkdir()
    for n in range(5):
        write_photo(tmp_path / "photos" / f"DJI_000{n}.JPG", colour=(n, 90, 60))
    code, _, err = spoken(*run_of(tmp_path / "photos", tmp_path / "run"))
    assert code == 5
    assert "E-PAIR-01" in err
    assert "hover" in err


def test_photos_without_texture(small_flight: Path, tmp_path: Path, spoken: Callable[..., Spoken]) -> None:
    """Water or snow: valid photos in which nothing can be matched."""
    (tmp_path / "photos").mkdir()
    for n in range(3):
        place = {"latitude": 37.5 + 5e-5 * n, "longitude": -78.3, "altitude": 150.0}
        write_photo(tmp_path / "photos" / f"DJI_000{n}.JPG", exif=exif_block(place=place), size=(800, 600))
    code, _, err = spoken(*run_of(tmp_path / "photos", tmp_path / "run"))
    assert code == 5
    assert "E-MATCH-01" in err


@pytest.mark.parametrize("place", ["missing", "empty", "a file", "glob without hits"])
def test_no_photos(place: str, tmp_path: Path, spoken: Callable[..., Spoken]) -> None:
    folder = tmp_path / "photos"
    if place == "empty":
        folder.mkdir()
        (folder / "notes.txt").write_text("no photo")
    elif place == "a file":
        folder.write_text("no folder")
    elif place == "glob without hits":
        folder = folder / "*.JPG"
    code, _, err = spoken(*run_of(folder, tmp_path / "run"))
    assert code == (5 if place == "a file" else 3)
    assert "photos" in err
    assert "hint" in err


def test_two_photos_of_the_same_bytes(small_flight: Path, tmp_path: Path, spoken: Callable[..., Spoken]) -> None:
    """A copy in the same folder is a frame of its own, and makes no pair with the original."""
    photos = photos_of(small_flight, tmp_path)
    shutil.copy(photos / "DJI_0002.JPG", photos / "DJI_0002 (1).JPG")
    run = tmp_path / "run"
    assert spoken(*run_of(photos, run, "--to", "pair"))[0] == 0
    pairs = set(pq.read_table(run / "pairs.parquet", filters=[("selected", "=", True)]).column("pair_id").to_pylist())
    assert {"DJI_0002~DJI_0002 (1)", "DJI_0002 (1)~DJI_0002"}.isdisjoint(pairs)
    assert any("(1)" in pair for pair in pairs)


def test_a_photo_that_is_gone_after_ingest(small_flight: Path, tmp_path: Path, spoken: Callable[..., Spoken]) -> None:
    photos = photos_of(small_flight, tmp_path)
    run = tmp_path / "run"
    assert spoken(*run_of(photos, run, "--to", "pair"))[0] == 0
    (photos / "DJI_0003.JPG").unlink()
    code, _, err = spoken("match", run, "--jobs", 1)
    assert code == 3
    assert str(photos / "DJI_0003.JPG") in err
    assert not (run / "matches").exists()
    assert spoken(*run_of(photos, run, "--to", "match"))[0] == 0, "the whole command reads the folder anew"


def test_a_damaged_tile_is_named(
    small_flight: Path, small_run: Path, tmp_path: Path, spoken: Callable[..., Spoken]
) -> None:
    run = copied(small_run, tmp_path / "run")
    before = outputs(run)
    tiles = shutil.copytree(small_flight / "lidar", tmp_path / "lidar")
    tile = min(tiles.glob("*.laz"))
    tile.write_bytes(tile.read_bytes()[:2000])
    code, _, err = spoken("score", run, "--jobs", 1, "--set", f"score.lidar={tiles}")
    assert code == 3
    assert str(tile) in err
    assert outputs(run) == before, "the last good scores stay"


# --- where it is written to ---


@pytest.mark.parametrize("place", ["below a file", "a file", "proc"])
def test_a_run_folder_that_cannot_be_made(
    place: str, small_flight: Path, tmp_path: Path, spoken: Callable[..., Spoken]
) -> None:
    (tmp_path / "file").write_text("kept")
    out = {"below a file": tmp_path / "file" / "run", "a file": tmp_path / "file", "proc": Path("/proc/run")}[place]
    if place == "proc" and not Path("/proc/self").exists():
        pytest.skip("no /proc here")
    code, _, err = spoken("run", small_flight / "workflow.toml", "--out", out)
    assert code == 6
    assert str(out) in err
    assert "--out" in err
    assert (tmp_path / "file").read_text() == "kept"


@contextmanager
def mounted(place: Path, options: str) -> Iterator[Path]:
    """A file system of its own, where this machine lets us make one."""
    place.mkdir()
    if not is_root() or shutil.which("mount") is None:
        pytest.skip("only the superuser may mount")
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(place)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        pytest.skip(f"mounting is not allowed here: {done.stderr.strip()}")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def test_a_read_only_run_folder(
    small_flight: Path, small_run: Path, tmp_path: Path, spoken: Callable[..., Spoken]
) -> None:
    with mounted(tmp_path / "disk", "size=64m") as disk:
        run = copied(small_run, disk / "run")
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        code, _, err = spoken("run", small_flight / "workflow.toml", "--out", run, "--from", "depth")
        assert code == 6
        assert "Read-only file system" in err
        assert str(run) in err
        assert spoken("status", run)[0] == 0, "looking needs no permission to write"
        assert spoken("export", run, "--to", tmp_path / "points.csv")[0] == 0
        assert spoken("export", run, "--to", disk / "points.laz")[0] == 6


def test_no_permission_to_write(small_flight: Path, tmp_path: Path, spoken: Callable[..., Spoken]) -> None:
    if is_root():
        pytest.skip("permission bits do not stop the superuser")
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    code, _, err = spoken("run", small_flight / "workflow.toml", "--out", closed / "run")
    assert code == 6
    assert str(closed) in err


@pytest.mark.slow
@pytest.mark.parametrize("size_k", [40, 600])
def test_a_full_disk_and_then_a_larger_one(
    size_k: int, small_flight: Path, small_run: Path, tmp_path: Path, spoken: Callable[..., Spoken]
) -> None:
    with mounted(tmp_path / "disk", f"size={size_k}k") as disk:
        given = ("run", small_flight / "workflow.toml", "--out", disk / "run", "--jobs", 1)
        code, _, err = spoken(*given)
        assert code == 6
        assert "E-RES-02" in err
        assert "free some space" in err
        assert leftovers(disk / "run") == []
        kept = outputs(disk / "run")
        expected = outputs(small_run)
        assert all(expected[name] == digest for name, digest in kept.items()), "what is there is whole"
        assert len(kept) < len(expected)
        subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
        assert spoken(*given)[0] == 0
        assert outputs(disk / "run") == expected
        assert leftovers(disk / "run") == []


@pytest.mark.slow
@pytest.mark.parametrize(("largest", "jobs"), [(60_000, 2)])
def test_files_that_may_not_grow(largest: int, jobs: int, small_flight: Path, small_run: Path, tmp_path: Path) -> None:
    """A limit on file size stands for a full disk where mounting is not allowed; it meets the workers too."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))

    given = ("run", small_flight / "workflow.toml", "--out", tmp_path / "run", "--jobs", jobs)
    done = epitransfer(*given, prepare=limit)
    assert done.returncode == 6, done.stderr
    assert "Traceback" not in done.stderr
    assert "File too large" in done.stderr
    assert done.stdout == ""
    assert leftovers(tmp_path / "run") == []
    expected = outputs(small_run)
    kept = outputs(tmp_path / "run")
    assert all(expected[name] == digest for name, digest in kept.items())
    done = epitransfer(*given)
    assert done.returncode == 0, done.stderr
    assert outputs(tmp_path / "run") == expected
    assert leftovers(tmp_path / "run") == []


# --- damaged run folders ---

# Table: a stage that reads it, and a key that makes the stage run again.
READERS = {
    "frames.parquet": ("pair", "pair.max_range_m=90"),
    "cameras.parquet": ("pair", "pair.max_range_m=90"),
    "pairs.parquet": ("match", "match.ratio=0.8"),
    "matches/part-00000.parquet": ("depth", "depth.max_range_m=90"),
    "relative_poses.parquet": ("depth", "depth.max_range_m=90"),
    "poses.parquet": ("score", "score.max_range_m=90"),
    "depths/part-00000.parquet": ("score", "score.max_range_m=90"),
}


def flip(path: Path) -> None:
    """Changes bytes of the data, not of the file's size or its footer."""
    data = bytearray(path.read_bytes())
    middle = len(data) // 3
    data[middle : middle + 8] = bytes(byte ^ 0xFF for byte in data[middle : middle + 8])
    path.write_bytes(data)


def other_schema(path: Path) -> None:
    pq.write_table(pa.table({"pair_id": ["a"]}), path)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "text": lambda path: path.write_text("not a table\n" * 50),
    "another schema": other_schema,
    "missing": lambda path: path.unlink(),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("table", READERS)
def test_a_damaged_table_is_named_and_nothing_else_is_touched(
    table: str, damage: str, small_run: Path, tmp_path: Path, spoken: Callable[..., Spoken]
) -> None:
    run = copied(small_run, tmp_path / "run")
    DAMAGES[damage](run / table)
    before = outputs(run)
    stage, key = READERS[table]
    code, _, err = spoken(stage, run, "--jobs", 1, "--set", key)
    assert code == 3
    named = (run / table).parent if damage == "missing" and "/" in table else run / table
    assert str(named) in err
    assert "hint" in err
    assert outputs(run) == before
    assert leftovers(run) == []


@pytest.mark.parametrize("table", [name for name in READERS if name not in {"cameras.parquet", "poses.parquet"}])
def test_changed_bytes_inside_a_table_do_not_pass_for_data(
    table: str, small_run: Path, tmp_path: Path, spoken: Callable[..., Spoken]
) -> None:
    """Neither size nor footer changed: the checksums of the pages tell."""
    run = copied(small_run, tmp_path / "run")
    flip(run / table)
    stage, key = READERS[table]
    code, _, err = spoken(stage, run, "--jobs", 1, "--set", key)
    assert code == 3
    assert str((run / table).parent if "/" in table else run / table) in err


@pytest.mark.parametrize("damage", ["truncated", "missing"])
def test_a_damaged_run_is_mended_by_the_whole_command(
    damage: str, small_flight: Path, small_run: Path, tmp_path: Path, spoken: Callable[..., Spoken]
) -> None:
    run = copied(small_run, tmp_path / "run")
    for table in ("frames.parquet", "matches/part-00000.parquet", "poses.parquet"):
        DAMAGES[damage](run / table)
    code, _, err = spoken("run", small_flight / "workflow.toml", "--out", run, "--jobs", 1)
    assert code == 0, err
    assert outputs(run) == outputs(small_run)


@pytest.mark.parametrize("file", [".stages/match.json", "manifest.json", ".cache/digests.json", "workflow.toml"])
@pytest.mark.parametrize("text", ["", "{\x00", "[1]"])
def test_damaged_bookkeeping_costs_time_not_results(
    file: str, text: str, small_flight: Path, small_run: Path, tmp_path: Path, spoken: Callable[..., Spoken]
) -> None:
    run = copied(small_run, tmp_path / "run")
    (run / file).write_text(text)
    assert spoken("status", run)[0] in {0, 2}
    code, _, err = spoken("run", small_flight / "workflow.toml", "--out", run, "--jobs", 1)
    assert code == 0, err
    assert outputs(run) == outputs(small_run)
    assert set(json.loads((run / "manifest.json").read_text())["stages"]) == set(
        json.loads((small_run / "manifest.json").read_text())["stages"]
    )


def test_points_that_are_damaged_are_not_exported(
    small_run: Path, tmp_path: Path, spoken: Callable[..., Spoken]
) -> None:
    run = copied(small_run, tmp_path / "run")
    tile = min((run / "points").glob("*.parquet"))
    tile.write_bytes(tile.read_bytes()[:-100])
    code, _, err = spoken("export", run, "--to", tmp_path / "points.laz")
    assert code == 3
    assert str(tile) in err
    assert list(tmp_path.glob("points*")) == []


def test_names_that_shells_and_queries_trip_over(
    small_flight: Path, small_run: Path, tmp_path: Path, spoken: Callable[..., Spoken]
) -> None:
    folder = tmp_path / 'Flug 1, Süd\'s "50%" #2'
    folder.mkdir()
    photos = photos_of(small_flight, folder)
    run = folder / "run = [1]"
    assert spoken(*run_of(photos, run, "--to", "match"))[0] == 0
    assert spoken("status", run)[0] == 0
    assert spoken("refine", run)[0] == 0
    names = pq.read_table(run / "relative_poses.parquet").column("pair_id").to_pylist()
    assert set(names) >= set(pq.read_table(small_run / "relative_poses.parquet").column("pair_id").to_pylist())


def test_a_flight_over_water_in_between(
    small_flight: Path, small_run: Path, tmp_path: Path, spoken: Callable[..., Spoken]
) -> None:
    """Pairs without a single match have their row, and count as failed."""
    photos = photos_of(small_flight, tmp_path)
    from PIL import Image  # noqa: PLC0415

    for name in ("DJI_0005.JPG", "DJI_0006.JPG"):
        with Image.open(photos / name) as image:
            exif, xmp, size = image.getexif(), image.info["xmp"], image.size
        Image.fromarray(np.full((size[1], size[0], 3), 90, np.uint8)).save(photos / name, exif=exif, xmp=xmp)
    run = tmp_path / "run"
    code, _, err = spoken(*run_of(photos, run, "--to", "depth", "--set", "match.max_failed_share=1.0"))
    assert code == 0, err
    poses = {row["pair_id"]: row for row in pq.read_table(run / "relative_poses.parquet").to_pylist()}
    pairs = pq.read_table(run / "pairs.parquet", filters=[("selected", "=", True)]).column("pair_id").to_pylist()
    assert list(poses) == pairs
    blank = [row for name, row in poses.items() if "DJI_0005" in name or "DJI_0006" in name]
    assert blank
    assert all(row["n_matches"] == 0 and row["rms_before_px"] is None and row["problem"] for row in blank)
