"""Weights: where they are found, what is checked before they are loaded, and that nothing in them is executed."""

from __future__ import annotations

import hashlib
import os
import pickle
import random
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch

from pipeline.engine.errors import InputError, MissingPartError
from pipeline.matching.weights import files as weights
from pipeline.matching.weights.files import (
    FoundWeights,
    find_weights,
    identified,
    load_state,
    strict_load,
    weight_files,
    weight_places,
    wrong_network,
)
from pipeline.matching.weights.known import KNOWN, NETWORKS_OF, KnownWeights, matchers_of

BY_FILE = {known.file: known for known in KNOWN}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache instead of the user's, and nothing in the environment."""
    monkeypatch.setattr(weights, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.delenv(weights.VARIABLE, raising=False)
    return tmp_path / "cache"


def put(path: Path, data: bytes = b"x") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def saved(path: Path, value: Any) -> FoundWeights:
    """A file as torch.save writes it, with its digest stated."""
    torch.save(value, path)
    return stated(path)


def stated(path: Path) -> FoundWeights:
    return FoundWeights(path, "xfeat", hashlib.sha256(path.read_bytes()).hexdigest(), None)


# --- the registry ---


def test_known_files_are_fit_to_be_checked_and_fetched() -> None:
    assert len(BY_FILE) == len(KNOWN)
    assert len({known.sha256 for known in KNOWN}) == len(KNOWN)
    for known in KNOWN:
        assert re.fullmatch(r"[0-9a-f]{64}", known.sha256), known.file
        assert known.licence in {"Apache-2.0", "BSD-3-Clause"}
        assert known.source
        assert Path(known.file).name == known.file
        assert known.url is None or known.url.startswith("https://")
        assert (known.member is None) == (known.archive_sha256 is None)
        assert matchers_of(known.network)
    assert {network for needs in NETWORKS_OF.values() for group in needs for network in group} == {
        known.network for known in KNOWN
    }
    # Each network can be had from its publishers.
    assert {known.network for known in KNOWN if known.url} == {known.network for known in KNOWN}


# --- finding ---


def test_places_are_searched_in_order(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = [tmp_path / "stated", tmp_path / "named", tmp_path / "first", tmp_path / "second", cache]
    monkeypatch.setenv(weights.VARIABLE, os.pathsep.join(["", str(folders[2]), str(folders[3])]))
    configured = (str(folders[0]), str(folders[1]))
    assert [place.path for place in weight_places(configured)] == folders
    # A later place is asked only when all before it have nothing, whatever the preference within a place.
    for folder in folders[:2]:
        folder.mkdir()
    for folder, file in zip(reversed(folders), ["xfeat.pt", "xfeat_kornia.safetensors"] * 3, strict=False):
        path = put(folder / file)
        assert find_weights("xfeat", configured).path == path
        assert find_weights("xfeat", configured).sha256 == BY_FILE[file].sha256


def test_within_a_place_the_preferred_file_is_taken(cache: Path) -> None:
    put(cache / "xfeat_kornia.safetensors")
    assert find_weights("xfeat").known is BY_FILE["xfeat_kornia.safetensors"]
    put(cache / "xfeat.pt")
    assert find_weights("xfeat").known is BY_FILE["xfeat.pt"]


def test_of_alternative_networks_the_preferred_is_taken(cache: Path) -> None:
    (alternatives,) = NETWORKS_OF["raft"]
    put(cache / "raft-things.pth")
    assert find_weights(alternatives).network == "raft-large"
    put(cache / "raft-small.pth")
    assert find_weights(alternatives).network == "raft-small"
    assert find_weights("raft-large").network == "raft-large"


def test_what_is_missing_names_places_files_and_the_command(tmp_path: Path, cache: Path) -> None:
    with pytest.raises(MissingPartError) as caught:
        find_weights("xfeat", str(tmp_path))
    error = caught.value
    assert (error.code, error.exit_code) == ("E-WEIGHTS-01", 7)
    assert str(tmp_path) in error.found
    assert f"{cache} (cache, absent)" in error.found
    assert error.expected == "xfeat.pt or xfeat_kornia.safetensors"
    assert error.hint.startswith("epitransfer models fetch xfeat;")
    assert "--set match.weights=FOLDER" in error.hint
    with pytest.raises(MissingPartError, match=r"raft-small or raft-large"):
        find_weights(("raft-small", "raft-large"))


def test_a_network_without_an_address_tells_where_to_put_its_file(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unfetchable = tuple(replace(known, url=None) for known in KNOWN)
    monkeypatch.setattr(weights, "KNOWN", unfetchable)
    with pytest.raises(MissingPartError) as caught:
        find_weights("lighterglue")
    assert caught.value.hint.startswith(f"put xfeat-lighterglue.pt into {cache};")


@pytest.mark.parametrize("name", ["nowhere", "nowhere/xfeat.pt", "nowhere.pt#sha256=" + "0" * 64])
def test_a_named_place_that_does_not_exist(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError) as caught:
        find_weights("xfeat", str(tmp_path / name))
    assert (caught.value.code, caught.value.exit_code) == ("E-WEIGHTS-05", 3)
    assert str(tmp_path / "nowhere") in caught.value.found


def test_a_stated_digest_that_is_none(tmp_path: Path) -> None:
    for digest in ("", "12", "g" * 64, "0" * 63):
        with pytest.raises(InputError, match="E-WEIGHTS-05"):
            find_weights("xfeat", f"{put(tmp_path / 'a.pt')}#sha256={digest}")


def test_a_named_file_serves_the_network_its_name_tells(tmp_path: Path, cache: Path) -> None:
    glue, feat = put(tmp_path / "my-LighterGlue-xfeat.pt"), put(tmp_path / "my-xfeat.pt", b"y")
    digest = "ab" * 32
    configured = (f"{glue}#sha256={digest.upper()}", f"{feat}#sha256={digest}")
    assert find_weights("xfeat", configured) == FoundWeights(feat, "xfeat", digest, None)
    assert find_weights("lighterglue", configured) == FoundWeights(glue, "lighterglue", digest, None)
    # A RAFT's name need not tell its size; a name that tells nothing serves what is asked for.
    raft, mine = put(tmp_path / "raft-mine.pth"), put(tmp_path / "mine.pth", b"z")
    of_raft = f"{raft}#sha256={digest}"
    assert find_weights(("raft-small", "raft-large"), of_raft) == FoundWeights(raft, "", digest, None)
    assert find_weights("xfeat", f"{mine}#sha256={digest}") == FoundWeights(mine, "xfeat", digest, None)
    # One that is for another network is passed by, even where nobody knows what it is.
    in_cache = put(cache / "xfeat.pt")
    assert find_weights("xfeat", (of_raft, str(raft))).path == in_cache


def test_a_known_name_is_held_to_its_digest_unless_another_is_stated(tmp_path: Path) -> None:
    path = put(tmp_path / "xfeat.pt")
    assert find_weights("xfeat", str(path)).sha256 == BY_FILE["xfeat.pt"].sha256
    own = find_weights("xfeat", f"{path}#sha256={'0' * 64}")
    assert (own.sha256, own.known, own.network) == ("0" * 64, None, "xfeat")


def test_the_files_that_decide(tmp_path: Path, cache: Path) -> None:
    needs = NETWORKS_OF["xfeat-lighterglue"]
    assert weight_files(needs) == []
    assert weight_files(needs, str(tmp_path / "nowhere")) == []
    feat = put(cache / "xfeat.pt")
    glue = put(tmp_path / "glue" / "xfeat-lighterglue.pt")
    assert weight_files(needs) == [feat]
    assert weight_files(needs, str(glue)) == [feat, glue]
    assert weight_files(needs, (str(glue.parent),)) == [feat, glue]


# --- checking and loading ---


def test_named_tensors_are_loaded_as_they_are(tmp_path: Path) -> None:
    tensors = {"a.weight": torch.arange(6.0).reshape(2, 3), "n": torch.tensor(3)}
    for found in (saved(tmp_path / "a.pt", tensors), saved(tmp_path / "b.pth", torch.nn.Linear(2, 3).state_dict())):
        assert all(isinstance(value, torch.Tensor) for value in load_state(found).values())
    safetensors.torch.save_file(tensors, tmp_path / "a.safetensors")
    for path in (tmp_path / "a.pt", tmp_path / "a.safetensors"):
        state = load_state(stated(path))
        assert set(state) == set(tensors)
        assert all(torch.equal(state[name], tensors[name]) for name in tensors)


@pytest.mark.parametrize(
    ("data", "message"), [(b"x" * 99, "truncated"), (b"x" * 100, "not what they"), (b"x" * 101, "not what they")]
)
def test_a_changed_file_is_told_from_a_truncated_one(tmp_path: Path, data: bytes, message: str) -> None:
    known = KnownWeights("xfeat", "xfeat.pt", "0" * 64, 100, "Apache-2.0", "us", "https://localhost/x")
    path = put(tmp_path / "xfeat.pt", data)
    with pytest.raises(InputError, match=message) as caught:
        load_state(FoundWeights(path, "xfeat", known.sha256, known))
    digest = hashlib.sha256(data).hexdigest()
    assert (caught.value.code, caught.value.exit_code) == ("E-WEIGHTS-02", 3)
    assert caught.value.found == f"{len(data)} bytes, sha256 {digest}"
    assert caught.value.expected == f"100 bytes, sha256 {'0' * 64}"
    assert "epitransfer models fetch xfeat" in caught.value.hint
    # What is cut short is nobody's own file.
    own = f"match.weights={path}#sha256={digest}"
    assert (own in caught.value.hint) == (message != "truncated")


def test_an_unknown_file_tells_the_very_words_that_let_it_in(tmp_path: Path) -> None:
    torch.save({"a": torch.ones(2)}, tmp_path / "mine.pt")
    with pytest.raises(InputError, match="E-WEIGHTS-06") as caught:
        find_weights("xfeat", str(tmp_path / "mine.pt"))
    with pytest.raises(InputError, match="E-WEIGHTS-06"):
        load_state(FoundWeights(tmp_path / "mine.pt", "xfeat", "", None))
    assert weight_files(["xfeat"], str(tmp_path / "mine.pt")) == [tmp_path / "mine.pt"]
    (value,) = re.findall(r"--set match\.weights=(\S+)", caught.value.hint)
    assert torch.equal(load_state(find_weights("xfeat", value))["a"], torch.ones(2))


def test_a_known_file_under_another_name_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = saved(tmp_path / "renamed.pt", {"a": torch.ones(2)})
    known = KnownWeights("xfeat", "xfeat.pt", found.sha256, None, "Apache-2.0", "us")
    monkeypatch.setattr(weights, "KNOWN", (known,))
    assert identified(found.path) == FoundWeights(found.path, "xfeat", known.sha256, known)
    assert set(load_state(find_weights("xfeat", str(found.path)))) == {"a"}


class _Maker:
    """A pickle of it makes a file when it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return (open, (str(self.path), "w"))


@pytest.mark.parametrize("legacy", [False, True])
def test_code_in_a_file_is_never_executed(tmp_path: Path, *, legacy: bool) -> None:
    made = tmp_path / "made"
    value = {"a": torch.ones(2), "b": _Maker(made)}
    torch.save(value, tmp_path / "a.pt", _use_new_zipfile_serialization=not legacy)
    with pytest.raises(InputError, match="not executed") as caught:
        load_state(stated(tmp_path / "a.pt"))
    assert (caught.value.code, caught.value.exit_code) == ("E-WEIGHTS-03", 3)
    assert "io.open" in caught.value.found
    assert not made.exists()
    # The file is a real trap: without our care it would have gone off.
    torch.load(tmp_path / "a.pt", weights_only=False)
    assert made.exists()


def test_a_bare_pickle_is_not_executed_either(tmp_path: Path) -> None:
    made = tmp_path / "made"
    with pytest.raises(InputError, match="E-WEIGHTS-03"):
        load_state(stated(put(tmp_path / "a.pt", pickle.dumps(_Maker(made)))))
    assert not made.exists()


@pytest.mark.parametrize(
    "value",
    [[torch.ones(2)], torch.ones(2), {}, {"state_dict": {"a": torch.ones(2)}}, {1: torch.ones(2)}, {"epoch": 3}],
    ids=["list", "tensor", "empty", "nested", "number as name", "number as value"],
)
def test_what_is_no_flat_dict_of_tensors(tmp_path: Path, value: Any) -> None:
    with pytest.raises(InputError, match="E-WEIGHTS-03"):
        load_state(saved(tmp_path / "a.pt", value))


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
@pytest.mark.parametrize("data", [b"", b"PK\x03\x04", b"<html>no such page</html>", b"\xff" * 300, b"\x80\x02." * 9])
def test_a_file_of_something_else(tmp_path: Path, suffix: str, data: bytes) -> None:
    with pytest.raises(InputError, match="E-WEIGHTS-03"):
        load_state(stated(put(tmp_path / f"a{suffix}", data)))


@pytest.mark.parametrize("kind", ["zip", "legacy", "safetensors"])
def test_a_damaged_file_is_refused_or_read_but_never_a_bug(tmp_path: Path, kind: str) -> None:
    """With its own digest stated, damage reaches the readers."""
    tensors = {f"layer.{number}": torch.rand(5, 4) for number in range(4)}
    path = tmp_path / ("a.safetensors" if kind == "safetensors" else "a.pt")
    if kind == "safetensors":
        safetensors.torch.save_file(tensors, path)
    else:
        torch.save(tensors, path, _use_new_zipfile_serialization=kind == "zip")
    whole, draw, refused = path.read_bytes(), random.Random(7), []  # noqa: S311 - damage, no secret
    for _ in range(200):
        data = bytearray(whole[: draw.randrange(len(whole))] if draw.random() < 0.3 else whole)
        for _ in range(draw.randrange(1, 4) if data else 0):
            data[draw.randrange(len(data))] = draw.randrange(256)
        path.write_bytes(data)
        try:
            load_state(stated(path))
        except InputError as error:
            refused.append(error.code)
    assert set(refused) == {"E-WEIGHTS-03"}
    assert len(refused) > 60


def test_a_file_that_is_gone(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="E-WEIGHTS-05"):
        load_state(FoundWeights(tmp_path / "gone.pt", "xfeat", "0" * 64, None))


def test_another_networks_tensors(tmp_path: Path) -> None:
    module, found = torch.nn.Linear(2, 3), FoundWeights(tmp_path / "a.pt", "xfeat", "", None)
    before = module.weight.detach().clone()
    good = {"weight": torch.ones(3, 2), "bias": torch.zeros(3)}
    cases = {
        "missing: bias": {"weight": torch.ones(3, 2)},
        "unexpected: more": {**good, "more": torch.ones(1)},
        "of another shape: weight": {**good, "weight": torch.ones(2, 2)},
        "missing: weight, bias; unexpected: a0, a1, a2 and 2 more": {f"a{i}": torch.ones(1) for i in range(5)},
    }
    for told, state in cases.items():
        with pytest.raises(InputError, match="E-WEIGHTS-04") as caught:
            strict_load(module, state, found)
        assert caught.value.found == told
        assert "xfeat" in caught.value.message
        assert torch.equal(module.weight, before)
    strict_load(module, good, found)
    assert torch.equal(module.weight, good["weight"])
    assert wrong_network(found, "RAFT", ["a", "b", "c", "d"]).found == "a; b; c"


# --- the real ones ---


@pytest.mark.real
@pytest.mark.parametrize(
    ("file", "tensors"),
    [("xfeat_kornia.safetensors", 122), ("xfeat_lighterglue_L3_kornia.safetensors", 73), ("raft-small.pth", 106)],
)
def test_real_weights_are_known_and_load(shared: Path, file: str, tensors: int) -> None:
    found = find_weights(BY_FILE[file].network, str(shared / "weights"))
    assert found.known is BY_FILE[file]
    assert found.path.stat().st_size == found.known.size_bytes
    assert len(load_state(found)) == tensors


@pytest.mark.real
def test_real_weights_cut_short_or_changed_are_not_loaded(shared: Path, tmp_path: Path) -> None:
    whole = (shared / "weights" / "raft-small.pth").read_bytes()
    changed = bytearray(whole)
    changed[len(whole) // 2] ^= 1
    for data, message in ((whole[:-1], "truncated"), (bytes(changed), "not what they should be")):
        put(tmp_path / "raft-small.pth", data)
        with pytest.raises(InputError, match=message):
            load_state(find_weights("raft-small", str(tmp_path)))
