"""SHA-256 of files, folders and JSON values; a file's digest is remembered by its size and time of change."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import fsspec

_BLOCK = 1 << 20


def digest_bytes(data: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def digest_json(value: Any) -> str:
    """SHA-256 of a JSON value in its canonical form (sorted keys, no spaces)."""
    return digest_bytes(json.dumps(value, sort_keys=True, separators=(",", ":"), default=str).encode())


def digest_file(path: Path | str) -> str:
    """SHA-256 of a file's bytes; `path` may be a URL that fsspec knows."""
    state = hashlib.sha256()
    with fsspec.open(str(path), "rb") as stream:
        while block := stream.read(_BLOCK):
            state.update(block)
    return state.hexdigest()


def digest_tree(path: Path) -> str:
    """SHA-256 of a file, or of a folder's files with their relative names."""
    if path.is_file():
        return digest_file(path)
    files = sorted(p for p in path.rglob("*") if p.is_file())
    return digest_json([[p.relative_to(path).as_posix(), digest_file(p)] for p in files])


class FileDigests:
    """Digests of source files, kept beside the run so that an unchanged file is not read again.

    Args:
        store: JSON file that remembers them.
    """

    def __init__(self, store: Path) -> None:
        self._store = store
        try:
            stored = json.loads(store.read_text())
        except (OSError, ValueError):
            stored = None
        entries = stored.items() if isinstance(stored, dict) else ()
        self._known = {path: entry for path, entry in entries if isinstance(entry, list) and len(entry) == 3}

    def of(self, path: Path | str) -> str:
        """The digest of one file; a missing file has the digest "missing"."""
        text = str(path)
        if "://" in text:
            return digest_file(text)
        try:
            status = Path(text).stat()
            stamp = [status.st_size, status.st_mtime_ns]
            known = self._known.get(text)
            if known and known[:2] == stamp:
                return str(known[2])
            value = digest_file(text)
        except (FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError):
            # Who reads it will say what is wrong.
            return "missing"
        self._known[text] = [*stamp, value]
        return value

    def of_all(self, paths: Iterable[Path | str]) -> dict[str, Any]:
        """Count and joint digest of files, by content and path below the folder they share, wherever that is."""
        listed = [str(path) for path in paths]
        folders = {os.path.dirname(text) for text in listed}  # noqa: PTH120 - URLs too
        shared = os.path.commonpath(folders) if folders and not any("://" in text for text in listed) else ""
        entries = sorted([os.path.relpath(text, shared) if shared else text, self.of(text)] for text in listed)
        return {"files": len(entries), "sha256": digest_json(entries)}

    def save(self) -> None:
        """Writes what was learnt, where that is possible: a read-only or full disk only costs the next reader time."""
        # A name of its own: `status` may be asked for while a run goes on.
        temporary = self._store.with_name(f".{self._store.name}.{os.getpid()}.tmp")
        try:
            self._store.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_text(json.dumps(self._known, sort_keys=True))
            temporary.replace(self._store)
        except OSError:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
