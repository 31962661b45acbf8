"""Matchers through the command line: without weights, with bad ones, on a device that is not there, and rerun."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from flights import copied, epitransfer, leftovers, outputs
from PIL import Image
from safetensors.torch import load_file, save_file
from test_bad_input_cli import photos_of, run_of
from test_cli import spoken

NETWORKS = ("xfeat", "xfeat-star", "xfeat-lighterglue", "raft")
Said = tuple[int, str, str]


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user without weights; the folder where they would be fetched to."""
    monkeypatch.delenv("EPITRANSFER_WEIGHTS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def say(capsys: pytest.CaptureFixture[str]) -> Callable[..., Said]:
    """Runs a command line in this process: exit code, stdout, stderr; never a traceback."""

    def run(*arguments: object) -> Said:
        code, out, err = spoken(capsys, *arguments)
        assert "Traceback" not in err, err
        return code, out, err

    return run


@pytest.fixture(scope="module")
def paired(small_flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flight ingested and paired; not to be changed."""
    run = tmp_path_factory.mktemp("paired") / "run"
    done = epitransfer("run", small_flight / "workflow.toml", "--out", run, "--jobs", 1, "--to", "pair")
    assert done.returncode == 0, done.stderr
    return run


@pytest.fixture
def weights(shared: Path, tmp_path: Path) -> Path:
    """A folder of the real weights, to be changed."""
    return shutil.copytree(shared / "weights", tmp_path / "weights", copy_function=shutil.copyfile)


def set_to(**values: object) -> list[str]:
    """Options that set keys of match."""
    return [part for key, value in values.items() for part in ("--set", f"match.{key}={value}")]


def run_set(small_flight: Path, run: Path, *more: object, **values: object) -> list[object]:
    return ["run", small_flight / "workflow.toml", "--out", run, "--jobs", 1, *more, *set_to(**values)]


def statuses(say: Callable[..., Said], run: Path) -> dict[str, str]:
    code, out, _ = say("status", run, "--json")
    assert code == 0
    return {name: row["status"] for name, row in json.loads(out)["stages"].items()}


def inliers(run: Path) -> dict[str, int]:
    """Of each pair that has matches."""
    table = pq.read_table(run / "matches", columns=["pair_id", "inlier"])
    grouped = table.group_by("pair_id").aggregate([("inlier", "sum")])
    return {row["pair_id"]: row["inlier_sum"] for row in grouped.to_pylist()}


# --- no weights ---


@pytest.mark.parametrize("name", NETWORKS)
def test_without_weights_a_run_ends_before_its_long_stages_and_names_the_remedy(
    name: str, small_flight: Path, tmp_path: Path, home: Path, say: Callable[..., Said]
) -> None:
    run = tmp_path / "run"
    code, out, err = say(*run_set(small_flight, run, matcher=name))
    assert (code, out) == (7, "")
    assert "E-WEIGHTS-01" in err
    assert f"epitransfer models fetch {'raft-small' if name == 'raft' else 'xfeat'}" in err
    assert "match.weights=FOLDER" in err
    assert str(home) in err
    # Nothing but ingest has run; no other matcher has stepped in.
    assert not (run / "matches").exists()
    assert not (run / "pairs.parquet").exists()
    assert leftovers(run) == []
    found = statuses(say, run)
    assert found.pop("ingest") == "fresh"
    assert set(found.values()) == {"missing"}


def test_without_weights_the_matches_of_another_matcher_stay_its_own(
    small_flight: Path, paired: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    run = copied(paired, tmp_path / "run")
    assert say(*run_set(small_flight, run, "--to", "match"))[0] == 0
    before = outputs(run)
    assert "matches/part-00000.parquet" in before
    code, _, err = say(*run_set(small_flight, run, matcher="xfeat"))
    assert code == 7
    assert "epitransfer models fetch xfeat" in err
    assert outputs(run) == before
    assert leftovers(run) == []
    # They do not pass for those of xfeat.
    assert statuses(say, run)["match"] == "stale"
    assert say(*run_set(small_flight, run, "--to", "match"))[0] == 0
    assert statuses(say, run)["match"] == "fresh"


# --- weights that are none ---


class _Code:
    """A pickle that makes a folder when it is loaded without care."""

    def __init__(self, place: Path) -> None:
        self.place = place

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.place),)


def stated(path: Path) -> str:
    return f"{path}#sha256={hashlib.sha256(path.read_bytes()).hexdigest()}"


@pytest.mark.parametrize(("name", "jobs"), [("xfeat", 1), ("raft", 1), ("xfeat", 2)])
def test_a_truncated_file_is_named_with_the_remedy(
    name: str, jobs: int, paired: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    run = copied(paired, tmp_path / "run")
    file = tmp_path / "weights" / ("xfeat.pt" if name == "xfeat" else "raft-small.pth")
    file.parent.mkdir()
    file.write_bytes(b"PK\x03\x04" + bytes(1000))
    code, _, err = say("match", run, "--jobs", jobs, *set_to(matcher=name, weights=file.parent))
    assert code == 3
    assert "E-WEIGHTS-02" in err
    assert "truncated" in err
    assert str(file) in err
    assert f"epitransfer models fetch {name}" in err
    assert not (run / "matches").exists()
    assert leftovers(run) == []


@pytest.mark.parametrize("name", NETWORKS)
def test_code_in_a_file_of_weights_is_not_executed(
    name: str, paired: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    run, file, executed = copied(paired, tmp_path / "run"), tmp_path / "mine.pth", tmp_path / "executed"
    torch.save({"weight": _Code(executed)}, file)
    code, _, err = say("match", run, "--jobs", 1, *set_to(matcher=name, weights=stated(file)))
    assert code == 3
    assert "E-WEIGHTS-03" in err
    assert "executed" in err
    assert str(file) in err
    assert "hint" in err
    assert not executed.exists()
    # As a plain pickle it is not even looked at; by another program it would be executed.
    file.write_bytes(pickle.dumps({"weight": _Code(executed)}))
    code, _, err = say("match", run, "--jobs", 1, *set_to(matcher=name, weights=stated(file)))
    assert code == 3
    assert str(file) in err
    assert not executed.exists()
    pickle.loads(file.read_bytes())  # noqa: S301
    assert executed.exists()


@pytest.mark.parametrize("name", NETWORKS)
def test_weights_of_another_network_are_told(name: str, paired: Path, tmp_path: Path, say: Callable[..., Said]) -> None:
    run, file = copied(paired, tmp_path / "run"), tmp_path / "mine.pth"
    torch.save({"backbone.conv.weight": torch.zeros(4, 4)}, file)
    code, _, err = say("match", run, "--jobs", 1, *set_to(matcher=name, weights=stated(file)))
    assert code == 3
    assert "E-WEIGHTS-04" in err
    assert "hint" in err
    assert "backbone.conv.weight" in err or "missing: " in err
    assert not (run / "matches").exists()
    assert str(file) in err


def test_a_file_of_unknown_origin_needs_its_digest(paired: Path, tmp_path: Path, say: Callable[..., Said]) -> None:
    run, file = copied(paired, tmp_path / "run"), tmp_path / "mine.pth"
    torch.save({"backbone.conv.weight": torch.zeros(4, 4)}, file)
    code, _, err = say("match", run, "--jobs", 1, *set_to(matcher="xfeat", weights=file))
    assert code == 3
    assert "E-WEIGHTS-06" in err
    assert f"--set match.weights={stated(file)}" in err
    code, _, err = say("match", run, "--jobs", 1, *set_to(matcher="xfeat", weights=f"{file}#sha256={'0' * 64}"))
    assert code == 3
    assert "E-WEIGHTS-02" in err


# --- devices and names ---


@pytest.mark.real
def test_a_device_that_is_not_there(
    small_flight: Path, paired: Path, weights: Path, tmp_path: Path, say: Callable[..., Said],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    run = copied(paired, tmp_path / "run")
    given = run_set(small_flight, run, "--to", "match", "--device", "cuda", weights=weights)
    code, _, err = say(*given, *set_to(matcher="xfeat"))
    assert code == 6
    assert "E-DEVICE-02" in err
    assert "cuda" in err
    assert '"cpu"' in err
    assert not (run / "matches").exists()
    # Who needs no network needs no device.
    assert say(*given, *set_to(matcher="sift"))[0] == 0


def test_an_unknown_matcher_is_told_the_known_ones(
    small_flight: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    code, _, err = say(*run_set(small_flight, tmp_path / "run", matcher="superglue"))
    assert code == 2
    assert "match.matcher" in err
    assert "xfeat-lighterglue" in err
    assert not (tmp_path / "run").exists()


# --- runs ---


def blackened(small_flight: Path, place: Path) -> Path:
    """The flight's last four photos, the last of them black."""
    photos = photos_of(small_flight, place)
    for name in ("DJI_0001.JPG", "DJI_0002.JPG"):
        (photos / name).unlink()
    with Image.open(photos / "DJI_0006.JPG") as image:
        exif, xmp, size = image.getexif(), image.info["xmp"], image.size
    Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8)).save(photos / "DJI_0006.JPG", exif=exif, xmp=xmp)
    return photos


def check_black_pairs(photos: Path, run: Path, say: Callable[..., Said], **values: object) -> None:
    given = run_of(photos, run, "--to", "fuse", *set_to(max_failed_share=1.0, **values))
    code, _, err = say(*given)
    assert code == 0, err
    found = inliers(run)
    pairs = pq.read_table(run / "pairs.parquet", filters=[("selected", "=", True)]).column("pair_id").to_pylist()
    blind = [pair for pair in pairs if "DJI_0006" in pair]
    assert len(blind) >= 2
    assert len(pairs) > len(blind)
    assert all(found.get(pair, 0) == 0 for pair in blind)
    assert all(found[pair] > 50 for pair in pairs if pair not in blind)
    depths = pq.read_table(run / "depths", columns=["pair_id"]).column("pair_id").unique().to_pylist()
    assert set(depths).isdisjoint(blind)
    assert sum(pq.read_metadata(file).num_rows for file in (run / "points").glob("*.parquet")) > 50
    code, _, err = say(*given)
    assert code == 0
    assert err.count("up to date") == 6


def test_a_black_photo_has_no_dense_inliers_and_the_others_lead_to_points(
    small_flight: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    """Needs no weights."""
    check_black_pairs(blackened(small_flight, tmp_path), tmp_path / "run", say, matcher="dis", max_features=500)


@pytest.mark.real
@pytest.mark.parametrize("name", ["xfeat", "xfeat-star", "xfeat-lighterglue"])
def test_a_black_photo_has_no_inliers_by_a_network(
    name: str, small_flight: Path, weights: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    check_black_pairs(
        blackened(small_flight, tmp_path), tmp_path / "run", say, matcher=name, max_features=500, weights=weights
    )


@pytest.mark.real
@pytest.mark.slow
def test_a_network_s_matches_are_the_same_bytes_with_more_jobs(
    small_flight: Path, paired: Path, weights: Path, tmp_path: Path
) -> None:
    digests = []
    for jobs in (1, 2):
        run = copied(paired, tmp_path / f"run{jobs}")
        given = ["run", small_flight / "workflow.toml", "--out", run, "--to", "match", "--jobs", jobs]
        done = epitransfer(*given, *set_to(matcher="xfeat", weights=weights, max_features=1000))
        assert done.returncode == 0, done.stderr
        digests.append({name: of for name, of in outputs(run).items() if name.startswith("matches/")})
        assert leftovers(run) == []
    assert digests[0]
    assert digests[0] == digests[1]
    assert min(inliers(tmp_path / "run1").values()) > 50


@pytest.mark.real
def test_weights_count_by_their_content_not_by_their_place(
    small_flight: Path, paired: Path, weights: Path, tmp_path: Path, say: Callable[..., Said],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    run = copied(paired, tmp_path / "run")

    def again(**values: object) -> tuple[str, str]:
        code, _, err = say(*run_set(small_flight, run, "--to", "match", matcher="xfeat", max_features=300, **values))
        assert code == 0, err
        return next(line for line in err.splitlines() if line.startswith("match ")), outputs(run)[
            "matches/part-00000.parquet"
        ]

    first, made = again(weights=weights)
    assert "up to date" not in first
    assert "up to date" in again(weights=weights)[0]
    elsewhere = weights.rename(tmp_path / "elsewhere")
    assert "up to date" in again(weights=elsewhere)[0]
    assert statuses(say, run)["match"] == "fresh"
    monkeypatch.setenv("EPITRANSFER_WEIGHTS", str(elsewhere))
    assert "up to date" in again()[0]
    # Another file: one number of one layer is changed.
    state = load_file(elsewhere / "xfeat_kornia.safetensors")
    state["block1.0.layer.0.weight"] *= 1.5
    other = tmp_path / "xfeat-mine.safetensors"
    save_file(state, other)
    line, changed = again(weights=stated(other))
    assert "up to date" not in line
    assert changed != made
    # Without any, it can still be told that what is there was made from others.
    monkeypatch.delenv("EPITRANSFER_WEIGHTS")
    other.unlink()
    assert statuses(say, run)["match"] == "stale"
    monkeypatch.setenv("EPITRANSFER_WEIGHTS", str(elsewhere))
    line, back = again()
    assert "up to date" not in line
    assert back == made
