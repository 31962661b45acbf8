"""Fetching weights: resumed where a connection was cut, kept only if the digest is right."""

from __future__ import annotations

import hashlib
import re
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from urllib.parse import urljoin, urlsplit

import requests

from pipeline.engine.digests import digest_file
from pipeline.engine.errors import InputError, ResourceError
from pipeline.engine.progress import Reporter
from pipeline.matching.weights.known import KnownWeights

_BLOCK = 1 << 16
_CONNECT_S, _READ_S = 15.0, 60.0
# Far above any known file: a server that never ends must not fill the disk.
_MOST_BYTES = 1 << 29
# Far above any file of settings.
_SMALL_BYTES = 1 << 20
_LOCAL = ("localhost", "127.0.0.1", "::1")


@dataclass(frozen=True, slots=True)
class Fetched:
    """A file of weights that lies in its folder, its digest verified.

    Args:
        known: Which.
        path: Where.
        fresh: Whether it had to be fetched.
    """

    known: KnownWeights
    path: Path
    fresh: bool


@dataclass(frozen=True, slots=True)
class Stated:
    """What a publisher states of a file.

    Args:
        sha256: Its digest.
        size_bytes: Its size, where it is stated.
        revision: The commit that the address stands for; "" where it is not stated.
    """

    sha256: str
    size_bytes: int | None
    revision: str


@dataclass(frozen=True, slots=True)
class _Download:
    url: str
    part: Path
    sha256: str
    most_bytes: int
    wanted: str


def fetch(wanted: Sequence[KnownWeights], folder: Path, reporter: Reporter) -> Iterator[Fetched]:
    """Fetches files that are not yet in a folder; an archive that several are in only once.

    What an interrupt leaves, NAME.part, is carried on with next time. A file that was there with another content is
    kept as NAME.old.

    Args:
        wanted: Files that have an address.
        folder: Where to put them; made if it does not exist.
        reporter: Shows the progress.

    Yields:
        Each file, in the order of their addresses.

    Raises:
        InputError: The address has no such file, or another than the known one.
        ResourceError: The address cannot be reached, or the connection was cut.
    """
    if folder.exists() and not folder.is_dir():
        raise ResourceError("E-WEIGHTS-09", "not a folder", where=str(folder), hint="give a folder: --to FOLDER")
    missing: dict[str, list[KnownWeights]] = {}
    for known in wanted:
        path = folder / known.file
        if path.is_file() and digest_file(path) == known.sha256:
            yield Fetched(known, path, fresh=False)
        elif known.url:
            missing.setdefault(known.url, []).append(known)
    for url, files in missing.items():
        yield from _fetch_address(url, files, folder, reporter)


def stated_of(url: str, path: Path) -> Stated:
    """What the Hugging Face hub states of a file it holds in its large file storage, in the headers of its address.

    Args:
        url: The address.
        path: Where the file is to be.

    Raises:
        InputError: There is no such file, or its digest is not stated.
        ResourceError: The address cannot be reached.

    Source: huggingface_hub, constants (X-Linked-Etag, X-Linked-Size, X-Repo-Commit).
    """
    download = _Download(url, path.with_name(f"{path.name}.part"), "", _MOST_BYTES, path.name)
    hooks = {"response": _refuse_insecure_redirect}
    headers = {"Accept-Encoding": "identity"}
    with _network(download):
        last = requests.head(url, headers=headers, hooks=hooks, allow_redirects=True, timeout=(_CONNECT_S, _READ_S))
    # The hub sends on to where the file lies, and states the digest as it does.
    answers = (*last.history, last)
    for answer in answers:
        digest = re.fullmatch('(?:W/)?"?([0-9a-f]{64})"?', answer.headers.get("X-Linked-Etag", ""))
        if digest:
            size = answer.headers.get("X-Linked-Size", "")
            return Stated(digest[1], int(size) if size.isdecimal() else None, answer.headers.get("X-Repo-Commit", ""))
    if not answers[0].ok:
        raise _not_given(download, answers[0])
    raise InputError(
        "E-WEIGHTS-11",
        "the publisher states no digest of the file, which is not fetched without",
        where=url,
        expected="a header X-Linked-Etag with a SHA-256",
        hint=_by_hand(download),
    )


def fetch_small(url: str, path: Path) -> bytes:
    """The content of a small file, which is not written.

    Args:
        url: The address.
        path: Where it is to be.

    Raises:
        InputError: There is no such file, or it is too long for one of settings.
        ResourceError: The address cannot be reached.
    """
    download = _Download(url, path.with_name(f"{path.name}.part"), "", _SMALL_BYTES, path.name)
    data = b""
    with _network(download), _answer(download, 0) as answer:
        for block in answer.iter_content(_BLOCK):
            data += block
            if len(data) > _SMALL_BYTES:
                raise _differs(download, "a longer file", f"at most {_SMALL_BYTES} bytes")
    return data


def _fetch_address(url: str, files: list[KnownWeights], folder: Path, reporter: Reporter) -> Iterator[Fetched]:
    first = files[0]
    name = Path(urlsplit(url).path).name if first.member else first.file
    download = _Download(
        url,
        folder / f"{name}.part",
        (first.archive_sha256 or "") if first.member else first.sha256,
        _MOST_BYTES if first.member else first.size_bytes or _MOST_BYTES,
        ", ".join(f"its {known.member}" if known.member else known.file for known in files),
    )
    _download(download, name, reporter)
    for known in files:
        path = folder / known.file
        source = _extracted(download, known) if known.member else download.part
        if path.exists():
            path.replace(path.with_name(f"{path.name}.old"))
            reporter.say(f"{path} had another content and is kept as {path.name}.old")
        source.replace(path)
        yield Fetched(known, path, fresh=True)
    download.part.unlink(missing_ok=True)


def _download(download: _Download, name: str, reporter: Reporter) -> None:
    """Makes `download.part` the whole file, its digest verified."""
    part = download.part
    have = part.stat().st_size if part.is_file() else 0
    if not (have and digest_file(part) == download.sha256):
        with _network(download):
            _receive(download, have, name, reporter)
    found = digest_file(part)
    if found != download.sha256:
        size = part.stat().st_size
        part.unlink()
        raise _differs(download, f"{size} bytes, sha256 {found}", f"sha256 {download.sha256}")


def _receive(download: _Download, have: int, name: str, reporter: Reporter) -> None:
    with _answer(download, have) as answer:
        # A server that knows no ranges, and one for whom the rest is none, begins anew.
        resumed = answer.status_code == requests.codes.partial_content
        have = have if resumed else 0
        rest = int(answer.headers.get("Content-Length") or 0)
        with reporter.meter("models", f"KiB of {name}", (have + rest) >> 10) as meter, _written(download.part) as path:
            meter.advance(have >> 10)
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("ab" if resumed else "wb") as stream:
                for block in answer.iter_content(_BLOCK):
                    stream.write(block)
                    have += len(block)
                    if have > download.most_bytes:
                        break
                    meter.advance(len(block) >> 10)
    if have > download.most_bytes:
        download.part.unlink()
        raise _differs(download, "a longer file", f"at most {download.most_bytes} bytes, sha256 {download.sha256}")


@contextmanager
def _answer(download: _Download, have: int) -> Iterator[requests.Response]:
    headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={have}-"} if have else {})
    hooks = {"response": _refuse_insecure_redirect}
    with requests.get(download.url, headers=headers, hooks=hooks, stream=True, timeout=(_CONNECT_S, _READ_S)) as answer:
        matched = answer.headers.get("Content-Range", "").startswith(f"bytes {have}-")
        if answer.status_code == requests.codes.ok or (
            answer.status_code == requests.codes.partial_content and matched
        ):
            yield answer
            return
    if have and answer.status_code in {requests.codes.requested_range_not_satisfiable, requests.codes.partial_content}:
        with _answer(download, 0) as again:
            yield again
        return
    raise _not_given(download, answer)


def _not_given(download: _Download, answer: requests.Response) -> InputError:
    return InputError(
        "E-WEIGHTS-07",
        "the address does not give the file",
        where=download.url,
        found=f"HTTP {answer.status_code} {answer.reason}",
        hint=_by_hand(download),
    )


def _refuse_insecure_redirect(answer: requests.Response, **_: object) -> None:
    if answer.is_redirect:
        _refuse_insecure(urljoin(answer.url, answer.headers["Location"]))


def _refuse_insecure(url: str) -> None:
    parts = urlsplit(url)
    if parts.scheme != "https" and parts.hostname not in _LOCAL:
        raise InputError("E-WEIGHTS-07", "only https is fetched from", where=url, found=parts.scheme, expected="https")


@contextmanager
def _network(download: _Download) -> Iterator[None]:
    """Explains what the network does; a `requests` error is an OSError, too, and must not pass for one of the disk."""
    try:
        _refuse_insecure(download.url)
        yield
    except requests.RequestException as error:
        have = download.part.stat().st_size if download.part.is_file() else 0
        kept = f"; {have} bytes are kept, and the same command carries on" if have else ""
        late = isinstance(error, requests.Timeout)
        cause = re.search(r"Caused by (.*)\)$", str(error))
        raise ResourceError(
            "E-WEIGHTS-08",
            "the address does not answer in time" if late else "the network fails",
            where=download.url,
            found=(cause[1] if cause else f"{type(error).__name__}: {error}")[:200] + kept,
            hint=_by_hand(download),
        ) from error


@contextmanager
def _written(path: Path) -> Iterator[Path]:
    """Lets an error of the disk tell the file."""
    try:
        yield path
    except OSError as error:
        if isinstance(error, requests.RequestException) or error.filename:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def _by_hand(download: _Download) -> str:
    return f"check the connection; or fetch it elsewhere and put {download.wanted} into {download.part.parent} by hand"


def _differs(download: _Download, found: str, expected: str) -> InputError:
    return InputError(
        "E-WEIGHTS-02",
        "the address gives another file than the known one; it was not kept",
        where=download.url,
        found=found,
        expected=expected,
        hint="try again; if it stays so, the publisher has changed the file, or something between changes it",
    )


def _extracted(download: _Download, known: KnownWeights) -> Path:
    """One member of an archive, beside it; its name is ours, never the archive's."""
    path = download.part.with_name(f"{known.file}.part")
    most = known.size_bytes or _MOST_BYTES
    try:
        with (
            _written(path),
            zipfile.ZipFile(download.part) as archive,
            archive.open(str(known.member)) as member,
            path.open("wb") as stream,
        ):
            found = _copied(member, stream, most)
    except (zipfile.BadZipFile, KeyError, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        _forget(path, download.part)
        raise _differs(download, f"{type(error).__name__}: {error}", f"an archive with {known.member}") from error
    if found != known.sha256:
        _forget(path, download.part)
        raise _differs(download, f"{known.member} with sha256 {found}", f"sha256 {known.sha256}")
    return path


def _copied(source: IO[bytes], target: IO[bytes], most_bytes: int) -> str:
    """Copies at most one byte more than allowed; returns the digest of what was copied."""
    state, left = hashlib.sha256(), most_bytes + 1
    while block := source.read(min(_BLOCK, left)):
        state.update(block)
        target.write(block)
        left -= len(block)
    return state.hexdigest()


def _forget(*paths: Path) -> None:
    for path in paths:
        path.unlink(missing_ok=True)
