"""`epitransfer models`: fetching from a local server, and what is told of what is there."""

from __future__ import annotations

import hashlib
import io
import json
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import huggingface_hub
import pytest
from test_cli import compared, spoken
from weight_server import Served, serving

from pipeline.engine.errors import EpiTransferError, InputError, ResourceError
from pipeline.engine.progress import Reporter
from pipeline.matching.weights import fetching
from pipeline.matching.weights import files as weights
from pipeline.matching.weights.fetching import fetch
from pipeline.matching.weights.known import KnownWeights
from pipeline.monodepth import known as baselines
from pipeline.monodepth import telling
from pipeline.monodepth.known import KnownModel
from pipeline.monodepth.published import RECORD, fetch_model
from stages import models

CONTENT = bytes(range(256)) * 2048  # 512 KiB: several blocks, so that a cut one leaves something
MEMBERS = {"models/small.pth": b"small" * 20_000, "models/large.pth": b"large" * 20_000}


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def zipped(members: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return stream.getvalue()


ARCHIVE = zipped(MEMBERS)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache instead of the user's; nothing in the environment, no proxy for this machine, a plain terminal."""
    folder = tmp_path / "cache"
    monkeypatch.setattr(weights, "cache_folder", lambda: folder)
    monkeypatch.setattr(models, "cache_folder", lambda: folder)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.delenv(weights.VARIABLE, raising=False)
    for name, value in (("NO_PROXY", "127.0.0.1"), ("COLUMNS", "100"), ("NO_COLOR", "1"), ("TERM", "dumb")):
        monkeypatch.setenv(name, value)
    return folder


@pytest.fixture
def server() -> Iterator[Served]:
    with serving({"/net.pt": CONTENT, "/models.zip": ARCHIVE}) as served:
        yield served


@pytest.fixture
def net(server: Served) -> KnownWeights:
    return KnownWeights("xfeat", "xfeat.pt", sha256(CONTENT), len(CONTENT), "Apache-2.0", "us", f"{server.url}/net.pt")


@pytest.fixture
def pair(server: Served) -> list[KnownWeights]:
    """Two files of one archive."""
    return [
        KnownWeights(
            f"raft-{name}", f"raft-{name}.pth", sha256(MEMBERS[f"models/{name}.pth"]), None, "BSD-3-Clause", "us",
            f"{server.url}/models.zip", f"models/{name}.pth", sha256(ARCHIVE),
        )
        for name in ("small", "large")
    ]  # fmt: skip


def fetched(*known: KnownWeights, into: Path) -> list[tuple[str, bool]]:
    return [(entry.path.name, entry.fresh) for entry in fetch(known, into, Reporter(io.StringIO()))]


def refused(kind: type[EpiTransferError], *known: KnownWeights, into: Path) -> EpiTransferError:
    with pytest.raises(kind) as caught:
        fetched(*known, into=into)
    return caught.value


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.exists() else []


# --- fetching ---


def test_a_file_is_fetched_once(net: KnownWeights, server: Served, cache: Path) -> None:
    assert fetched(net, into=cache) == [("xfeat.pt", True)]
    assert (cache / "xfeat.pt").read_bytes() == CONTENT
    assert names(cache) == ["xfeat.pt"]
    assert fetched(net, into=cache) == [("xfeat.pt", False)]
    assert server.asked == [("/net.pt", "")]


def test_a_cut_connection_is_resumed(net: KnownWeights, server: Served, cache: Path) -> None:
    server.cut_after = 300_000
    error = refused(ResourceError, net, into=cache)
    assert (error.code, error.exit_code, error.where) == ("E-WEIGHTS-08", 6, net.url)
    have = (cache / "xfeat.pt.part").stat().st_size
    assert 0 < have <= 300_000
    assert f"{have} bytes are kept, and the same command carries on" in error.found
    assert names(cache) == ["xfeat.pt.part"]
    assert fetched(net, into=cache) == [("xfeat.pt", True)]
    assert server.asked[1:] == [("/net.pt", f"bytes={have}-")]
    assert (cache / "xfeat.pt").read_bytes() == CONTENT
    assert names(cache) == ["xfeat.pt"]


def test_a_server_that_knows_no_ranges_begins_anew(net: KnownWeights, server: Served, cache: Path) -> None:
    server.ranges = False
    cache.mkdir()
    (cache / "xfeat.pt.part").write_bytes(CONTENT[:1000])
    assert fetched(net, into=cache) == [("xfeat.pt", True)]
    assert server.asked == [("/net.pt", "bytes=1000-")]
    assert (cache / "xfeat.pt").read_bytes() == CONTENT


def test_a_whole_part_needs_no_server(net: KnownWeights, server: Served, cache: Path) -> None:
    cache.mkdir()
    (cache / "xfeat.pt.part").write_bytes(CONTENT)
    assert fetched(net, into=cache) == [("xfeat.pt", True)]
    assert server.asked == []


def test_a_part_of_which_there_is_no_rest_begins_anew(net: KnownWeights, server: Served, cache: Path) -> None:
    cache.mkdir()
    (cache / "xfeat.pt.part").write_bytes(b"?" * len(CONTENT))
    assert fetched(net, into=cache) == [("xfeat.pt", True)]
    assert server.asked == [("/net.pt", f"bytes={len(CONTENT)}-"), ("/net.pt", "")]


def test_a_part_of_another_file_is_not_kept(net: KnownWeights, cache: Path) -> None:
    cache.mkdir()
    (cache / "xfeat.pt.part").write_bytes(b"?" * 1000)
    assert refused(InputError, net, into=cache).code == "E-WEIGHTS-02"
    assert names(cache) == []
    assert fetched(net, into=cache) == [("xfeat.pt", True)]


@pytest.mark.parametrize("content", [CONTENT[:-1] + b"?", CONTENT[:-1], CONTENT + b"?", b""])
def test_a_changed_file_is_not_kept(net: KnownWeights, server: Served, cache: Path, content: bytes) -> None:
    server.files["/net.pt"] = content
    error = refused(InputError, net, into=cache)
    assert (error.code, error.exit_code, error.where) == ("E-WEIGHTS-02", 3, net.url)
    assert net.sha256 in error.expected
    if len(content) <= len(CONTENT):
        assert error.found == f"{len(content)} bytes, sha256 {sha256(content)}"
    assert names(cache) == []


def test_a_server_that_never_ends_is_left(net: KnownWeights, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetching, "_MOST_BYTES", 100_000)
    error = refused(InputError, replace(net, size_bytes=None), into=cache)
    assert (error.found, names(cache)) == ("a longer file", [])


def test_what_was_there_is_kept_beside(net: KnownWeights, cache: Path) -> None:
    cache.mkdir()
    (cache / "xfeat.pt").write_bytes(b"my own")
    told = io.StringIO()
    assert [entry.fresh for entry in fetch([net], cache, Reporter(told))] == [True]
    assert (cache / "xfeat.pt.old").read_bytes() == b"my own"
    assert "kept as xfeat.pt.old" in told.getvalue()


def test_an_archive_is_fetched_once_for_its_members(pair: list[KnownWeights], server: Served, cache: Path) -> None:
    assert fetched(*pair, into=cache) == [("raft-small.pth", True), ("raft-large.pth", True)]
    assert server.asked == [("/models.zip", "")]
    assert names(cache) == ["raft-large.pth", "raft-small.pth"]
    assert (cache / "raft-large.pth").read_bytes() == MEMBERS["models/large.pth"]
    assert fetched(*pair, into=cache) == [("raft-small.pth", False), ("raft-large.pth", False)]


def test_an_archive_is_resumed_too(pair: list[KnownWeights], server: Served, cache: Path) -> None:
    server.cut_after = 150_000
    refused(ResourceError, pair[0], into=cache)
    assert names(cache) == ["models.zip.part"]
    have = (cache / "models.zip.part").stat().st_size
    assert 0 < have <= 150_000
    assert fetched(pair[0], into=cache) == [("raft-small.pth", True)]
    assert server.asked[1:] == [("/models.zip", f"bytes={have}-")]


ARCHIVES = {
    "another member": zipped({"models/small.pth": b"other"}),
    "a bigger member": zipped({"models/small.pth": b"0" * 1_000_000}),
    "no such member": zipped({"small.pth": b"x", "../small.pth": b"x"}),
    "no archive": b"<html>gone</html>",
    "half an archive": ARCHIVE[: len(ARCHIVE) // 2],
}


@pytest.mark.parametrize("name", ARCHIVES)
def test_an_archive_without_the_member(name: str, pair: list[KnownWeights], server: Served, cache: Path) -> None:
    content = server.files["/models.zip"] = ARCHIVES[name]
    known = replace(pair[0], archive_sha256=sha256(content), size_bytes=100_000)
    error = refused(InputError, known, into=cache)
    assert (error.code, error.exit_code) == ("E-WEIGHTS-02", 3)
    assert "models/small.pth" in f"{error.found} {error.expected}"
    assert (names(cache.parent), names(cache)) == (["cache"], [])
    server.files["/models.zip"] = ARCHIVE
    assert fetched(*pair, into=cache) == [("raft-small.pth", True), ("raft-large.pth", True)]


@pytest.mark.parametrize("status", [403, 404, 500])
def test_an_address_that_does_not_give_it(net: KnownWeights, server: Served, cache: Path, status: int) -> None:
    server.status = status
    error = refused(InputError, net, into=cache)
    assert (error.code, error.exit_code, error.where) == ("E-WEIGHTS-07", 3, net.url)
    assert f"HTTP {status}" in error.found
    assert f"put xfeat.pt into {cache} by hand" in error.hint
    assert not cache.exists()


def test_nobody_answers(net: KnownWeights, server: Served, cache: Path) -> None:
    with serving({}) as gone:
        url = gone.url
    error = refused(ResourceError, replace(net, url=f"{url}/net.pt"), into=cache)
    assert (error.code, error.exit_code) == ("E-WEIGHTS-08", 6)
    assert "refused" in error.found
    assert f"put xfeat.pt into {cache} by hand" in error.hint


def test_only_safe_addresses_are_asked(net: KnownWeights, server: Served, cache: Path) -> None:
    for url in ("http://192.0.2.1/net.pt", "ftp://127.0.0.2/net.pt", "file:///etc/hostname"):
        error = refused(InputError, replace(net, url=url), into=cache)
        assert (error.code, error.expected) == ("E-WEIGHTS-07", "https")
    server.location = "http://192.0.2.1/net.pt"
    assert refused(InputError, net, into=cache).where == server.location


def test_an_interrupt_leaves_what_was_read(
    net: KnownWeights, server: Served, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[int] = []

    class Stopping:
        def advance(self, items: int) -> None:
            told.append(items)
            if len(told) == 3:  # the first tells what was there before
                raise KeyboardInterrupt

    monkeypatch.setattr(Reporter, "meter", lambda *_: nullcontext(Stopping()))
    with pytest.raises(KeyboardInterrupt):
        fetched(net, into=cache)
    monkeypatch.undo()
    assert (cache / "xfeat.pt.part").stat().st_size == 2 << 16
    assert fetched(net, into=cache) == [("xfeat.pt", True)]
    assert server.asked[1] == ("/net.pt", f"bytes={2 << 16}-")


def test_a_full_disk_is_told_with_the_file(net: KnownWeights, cache: Path) -> None:
    """A limit on the size of files stands for the disk."""
    code = (
        "import resource, sys; from pathlib import Path; from stages import app, models\n"
        "from pipeline.matching.weights.known import KnownWeights\n"
        f"models.KNOWN = (KnownWeights('xfeat', 'xfeat.pt', {net.sha256!r}, None, '', '', {net.url!r}),)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))\n"
        f"sys.exit(app.run(['models', 'fetch', 'xfeat', '--to', {str(cache)!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 6, done.stderr
    assert "E-RES-02" in done.stderr
    assert f"{cache}/xfeat.pt.part" in done.stderr
    assert fetched(net, into=cache) == [("xfeat.pt", True)]


# --- the command line ---


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch, net: KnownWeights, pair: list[KnownWeights]) -> tuple[KnownWeights, ...]:
    """A few known files instead of the real ones."""
    entries = (
        net,
        replace(net, file="xfeat_converted.safetensors", sha256="ab" * 32, url=None, note="converted"),
        *pair,
    )
    for module in (models, weights):
        monkeypatch.setattr(module, "KNOWN", entries)
    return entries


@pytest.mark.usefixtures("known")
def test_list(server: Served, tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert spoken(capsys, "models", "fetch", "raft-large")[0] == 0
    code, out, err = spoken(capsys, "models", "list")
    assert (code, err) == (0, "")
    compared("models_list", out, TMP=tmp_path, URL=server.url)
    code, out, err = spoken(capsys, "models", "list", "--json")
    found = json.loads(out)
    assert found["looked_in"] == [{"folder": str(cache), "origin": "cache"}]
    assert [entry["found"] for entry in found["files"]] == [None, None, None, str(cache / "raft-large.pth")]
    assert found["files"][0]["matchers"] == ["xfeat", "xfeat-star", "xfeat-lighterglue"]
    assert found["files"][2]["member"] == "models/small.pth"
    assert [entry["name"] for entry in found["models"]] == [known.name for known in baselines.KNOWN_MODELS]
    assert {entry["found"] for entry in found["models"]} == {None}


@pytest.mark.usefixtures("known")
def test_fetch(server: Served, tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = spoken(capsys, "models", "fetch", "xfeat", "raft-small.pth")
    assert (code, err) == (0, "")
    assert out == f"{cache}/xfeat.pt: fetched, sha256 verified\n{cache}/raft-small.pth: fetched, sha256 verified\n"
    code, out, err = spoken(capsys, "models", "fetch", "--all", "--to", tmp_path / "there")
    assert code == 0
    assert len(out.splitlines()) == 3
    assert err.endswith(f"state --set match.weights={tmp_path}/there\n")
    code, out, err = spoken(capsys, "models", "fetch", "xfeat")
    assert (code, out, err) == (0, f"{cache}/xfeat.pt: already there, sha256 verified\n", "")
    server.files["/net.pt"] = b"another"
    code, out, err = spoken(capsys, "models", "fetch", "xfeat", "--to", tmp_path / "third")
    assert (code, out) == (3, "")
    compared("models_fetch_differs", err, URL=server.url)


WRONG = {
    "nothing": ("fetch",),
    "both": ("fetch", "xfeat", "--all"),
    "unknown": ("fetch", "sift"),
    "unfetchable": ("fetch", "xfeat_converted.safetensors"),
}


@pytest.mark.usefixtures("known")
@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_wish_is_explained(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = spoken(capsys, "models", *WRONG[name])
    assert (code, out) == (2, "")
    compared(f"error_models_{name}", err, TMP=tmp_path)


@pytest.mark.usefixtures("known", "server")
def test_verify(tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = spoken(capsys, "models", "verify")
    assert (code, out, err) == (0, f"nothing to verify: no known weights in {cache} (cache, absent)\n", "")
    assert spoken(capsys, "models", "fetch", "xfeat", "raft-small")[0] == 0
    code, out, err = spoken(capsys, "models", "verify")
    assert (code, out, err) == (0, f"ok       {cache}/xfeat.pt\nok       {cache}/raft-small.pth\n", "")
    (cache / "xfeat.pt").write_bytes(CONTENT[:1000])
    code, out, err = spoken(capsys, "models", "verify")
    assert (code, out) == (3, f"differs  {cache}/xfeat.pt\nok       {cache}/raft-small.pth\n")
    compared("models_verify_differs", err, TMP=tmp_path)
    code, out, _ = spoken(capsys, "models", "verify", "--json")
    assert code == 3
    assert [(entry["ok"], entry["known_as"]) for entry in json.loads(out)["files"]] == [
        (False, "xfeat.pt"),
        (True, "raft-small.pth"),
    ]


@pytest.mark.usefixtures("known")
def test_verify_named_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine = tmp_path / "mine.pt"
    mine.write_bytes(b"mine")
    code, out, err = spoken(capsys, "models", "verify", f"{mine}#sha256={sha256(b'mine')}")
    assert (code, out, err) == (0, f"ok       {mine}\n", "")
    code, out, err = spoken(capsys, "models", "verify", mine)
    assert code == 3
    assert "E-WEIGHTS-06" in err
    assert sha256(b"mine") in err
    renamed = tmp_path / "renamed.pt"
    renamed.write_bytes(CONTENT)
    assert spoken(capsys, "models", "verify", renamed)[0] == 0
    code, out, err = spoken(capsys, "models", "verify", tmp_path / "nowhere.pt")
    assert (code, out) == (3, "")
    assert "E-WEIGHTS-05" in err


def test_help_of_its_commands(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("list", "fetch", "verify"):
        code, out, err = spoken(capsys, "models", name, "--help")
        assert (code, err) == (0, "")
        assert f"Usage: epitransfer models {name}" in out
    code, out, _ = spoken(capsys, "models", "nosuch")
    assert (code, out) == (2, "")


def test_listing_does_not_load_torch() -> None:
    code = "import sys; from stages.app import run; run(['models', 'list']); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def test_doctor_tells_weights_and_device(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cache.mkdir()
    (cache / "raft-things.pth").write_bytes(b"")
    code, out, err = spoken(capsys, "doctor", "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert told["weights"] == {
        "xfeat": "missing: epitransfer models fetch xfeat",
        "lighterglue": "missing: epitransfer models fetch lighterglue",
        "raft-small/raft-large": str(cache / "raft-things.pth"),
    }
    assert told["torch_device"]
    (cache / "zoedepth-kitti").mkdir()
    (cache / "zoedepth-kitti" / "config.json").write_text("{}")
    assert json.loads(spoken(capsys, "doctor", "--json")[1])["baselines"] == {
        "zoedepth": str(cache / "zoedepth-kitti"),
        "depth-anything-v2": "missing: epitransfer models fetch depth-anything-v2",
    }


# --- the baselines' models ---

COMMIT = "c0ffee" * 6 + "c0ff"
MODEL = {"model.safetensors": CONTENT, "preprocessor_config.json": b'{"do_pad": true}', "config.json": b"{}"}


@dataclass
class Hub:
    """A publisher that sends on to where the files lie, and states the digest of the large one as it does."""

    served: Served
    stated: dict[str, str] = field(default_factory=dict)
    status: int = 302
    asked: list[str] = field(default_factory=list)
    url: str = ""


@contextmanager
def publishing(hub: Hub) -> Iterator[Hub]:
    class Handler(BaseHTTPRequestHandler):
        def do_HEAD(self) -> None:
            self.do_GET()

        def do_GET(self) -> None:
            hub.asked.append(f"{self.command} {self.path}")
            if hub.status != 302:
                self.send_error(hub.status)
                return
            self.send_response(302)
            name = self.path.rpartition("/")[2]
            if name == "model.safetensors":
                for header, value in hub.stated.items():
                    self.send_header(header, value)
            self.send_header("Location", f"{hub.served.url}/{name}")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            """Says nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    hub.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.fixture
def hub() -> Iterator[Hub]:
    with serving({f"/{name}": data for name, data in MODEL.items()}) as served:
        headers = {
            "X-Linked-Etag": f'"{sha256(CONTENT)}"',
            "X-Linked-Size": str(len(CONTENT)),
            "X-Repo-Commit": COMMIT,
        }
        with publishing(Hub(served, headers)) as publisher:
            yield publisher


@pytest.fixture
def zoe(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> KnownModel:
    """The only known model, at a local publisher."""
    model = KnownModel("zoedepth", "us/zoe-tiny", 1, "MIT", "indoor", "tiny", hub.url)
    for module in (baselines, telling):
        monkeypatch.setattr(module, "KNOWN_MODELS", (model,))
    return model


def got(model: KnownModel, into: Path) -> list[tuple[str, bool, bool]]:
    return [(file.path.name, file.fresh, file.stated) for file in fetch_model(model, into, Reporter(io.StringIO()))]


def not_got(kind: type[EpiTransferError], model: KnownModel, into: Path) -> EpiTransferError:
    with pytest.raises(kind) as caught:
        got(model, into)
    return caught.value


def test_a_model_is_fetched_once(zoe: KnownModel, hub: Hub, cache: Path) -> None:
    order = ["model.safetensors", "preprocessor_config.json", "config.json"]
    assert got(zoe, cache) == [(name, True, name == order[0]) for name in order]
    assert {path.name: path.read_bytes() for path in (cache / "zoe-tiny").iterdir() if path.name != RECORD} == MODEL
    assert json.loads((cache / "zoe-tiny" / RECORD).read_text()) == {
        "repository": "us/zoe-tiny",
        "revision": COMMIT,
        "stated": ["model.safetensors"],
        "sha256": {name: sha256(data) for name, data in MODEL.items()},
    }
    of_commit = [f"GET /us/zoe-tiny/resolve/{COMMIT}/{name}" for name in order]
    assert hub.asked == ["HEAD /us/zoe-tiny/resolve/main/model.safetensors", *of_commit]
    assert got(zoe, cache) == [(name, False, name == order[0]) for name in order]
    assert len(hub.asked) == 4


def test_a_models_weights_are_resumed(zoe: KnownModel, hub: Hub, cache: Path) -> None:
    hub.served.cut_after = 300_000
    assert not_got(ResourceError, zoe, cache).code == "E-WEIGHTS-08"
    have = (cache / "zoe-tiny" / "model.safetensors.part").stat().st_size
    assert 0 < have <= 300_000
    assert names(cache / "zoe-tiny") == ["model.safetensors.part"]
    assert len(got(zoe, cache)) == 3
    assert ("/model.safetensors", f"bytes={have}-") in hub.served.asked
    assert (cache / "zoe-tiny" / "model.safetensors").read_bytes() == CONTENT


def test_weights_that_are_not_those_stated_are_not_kept(zoe: KnownModel, hub: Hub, cache: Path) -> None:
    hub.served.files["/model.safetensors"] = CONTENT[:-1] + b"?"
    error = not_got(InputError, zoe, cache)
    assert (error.code, error.expected) == ("E-WEIGHTS-02", f"sha256 {sha256(CONTENT)}")
    assert names(cache / "zoe-tiny") == []


def test_a_publisher_that_states_nothing(zoe: KnownModel, hub: Hub, cache: Path) -> None:
    hub.stated["X-Linked-Etag"] = '"33bc8aab40703678c3ebe94d2dd8f2afff285dd9"'  # a git blob's
    error = not_got(InputError, zoe, cache)
    assert (error.code, error.exit_code) == ("E-WEIGHTS-11", 3)
    assert not cache.exists()
    hub.status = 401
    error = not_got(InputError, zoe, cache)
    assert (error.code, error.found) == ("E-WEIGHTS-07", "HTTP 401 Unauthorized")
    assert f"put model.safetensors into {cache / 'zoe-tiny'} by hand" in error.hint


def test_settings_that_never_end_are_left(
    zoe: KnownModel, hub: Hub, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fetching, "_SMALL_BYTES", 15)
    assert not_got(InputError, zoe, cache).found == "a longer file"
    assert names(cache / "zoe-tiny") == ["model.safetensors"]


def test_nobody_publishes(zoe: KnownModel, cache: Path) -> None:
    with serving({}) as gone:
        url = gone.url
    assert not_got(ResourceError, replace(zoe, publisher=url), cache).code == "E-WEIGHTS-08"
    assert not_got(InputError, replace(zoe, publisher="http://192.0.2.1"), cache).expected == "https"


@pytest.mark.usefixtures("known", "zoe")
def test_commands_know_models(tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = cache / "zoe-tiny"
    code, out, err = spoken(capsys, "models", "fetch", "zoedepth")
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        f"{folder}/model.safetensors: fetched, sha256 verified, as stated by the publisher",
        f"{folder}/preprocessor_config.json: fetched, sha256 recorded",
        f"{folder}/config.json: fetched, sha256 recorded",
    ]
    assert spoken(capsys, "models", "fetch", "us/zoe-tiny")[1].count("already there") == 3
    assert f"zoedepth  (baseline of score: takes {folder}; " in spoken(capsys, "models", "list")[1]
    assert json.loads(spoken(capsys, "models", "list", "--json")[1])["models"][0]["found"] == str(folder)
    code, out, err = spoken(capsys, "models", "fetch", "zoe-tiny", "xfeat", "--to", tmp_path / "there")
    assert code == 0
    assert err.endswith(f"state --set match.weights={tmp_path}/there --set score.models={tmp_path}/there\n")


@pytest.mark.usefixtures("zoe")
def test_models_are_verified(tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = cache / "zoe-tiny"
    assert spoken(capsys, "models", "fetch", "zoedepth")[0] == 0
    assert spoken(capsys, "models", "verify") == (0, f"ok       {folder}\n", "")
    (folder / "config.json").write_text("{ }")
    for named in ((), (folder,), (cache,)):
        code, out, err = spoken(capsys, "models", "verify", *named)
        assert (code, out) == (3, f"differs  {folder}\n")
        assert "E-BASELINE-08" in err
        assert "epitransfer models fetch zoe-tiny" in err
    assert json.loads(spoken(capsys, "models", "verify", "--json")[1])["models"] == [
        {"path": str(folder), "verdict": "differs"}
    ]
    (folder / "model.safetensors").unlink()
    assert "no file" in spoken(capsys, "models", "verify")[2]
    (folder / RECORD).unlink()
    assert spoken(capsys, "models", "verify") == (0, f"unstated {folder}\n", "")
    # A fetch puts right what differs, and keeps what was there.
    assert spoken(capsys, "models", "fetch", "zoedepth")[1].count("fetched") == 3
    assert spoken(capsys, "models", "verify", folder)[:2] == (0, f"ok       {folder}\n")


def test_the_hub_caches_names_are_digests(zoe: KnownModel, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    repository = tmp_path / "hub" / "models--us--zoe-tiny"
    snapshot = repository / "snapshots" / COMMIT
    for folder in (snapshot, repository / "blobs", repository / "refs"):
        folder.mkdir(parents=True)
    (repository / "refs" / "main").write_text(COMMIT)
    (snapshot / "config.json").write_text("{}")
    blob = repository / "blobs" / sha256(CONTENT)
    blob.write_bytes(CONTENT)
    (snapshot / "model.safetensors").symlink_to(blob)
    assert spoken(capsys, "models", "verify") == (0, f"ok       {snapshot}\n", "")
    blob.write_bytes(CONTENT[:-1])
    code, out, err = spoken(capsys, "models", "verify")
    assert (code, out) == (3, f"differs  {snapshot}\n")
    assert "as stated by the publisher" in err
