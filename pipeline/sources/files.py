"""Finding and opening source files: folders, globs, lists and fsspec URLs, through one function each."""

from __future__ import annotations

import errno
import glob
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, cast

import fsspec

from pipeline.engine.errors import InputError, ResourceError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".tif", ".tiff", ".png")
MARK_SUFFIXES = (".mrk",)
_MAGIC = "*?["


def is_url(location: str) -> bool:
    """Whether a location is an fsspec URL rather than a path of this machine."""
    return "://" in location


@contextmanager
def opened(location: str) -> Iterator[BinaryIO]:
    """Opens a source for reading: a path, or any URL fsspec knows.

    Args:
        location: Path or URL.

    Raises:
        InputError: It is not there, or not a file.
        ResourceError: Permission is missing, or the machine or network fails.
    """
    try:
        if is_url(location):
            with fsspec.open(location, "rb") as stream:
                yield cast("BinaryIO", stream)
        else:
            with Path(location).open("rb") as stream:
                yield stream
    except OSError as error:
        raise explained(location, error) from error


def explained(location: str, error: OSError) -> InputError | ResourceError:
    """The error a user meets when a source cannot be opened or listed."""
    found = error.strerror or str(error) or type(error).__name__
    if isinstance(error, FileNotFoundError | IsADirectoryError | NotADirectoryError):
        return InputError("E-FILE-01", "a source is missing", where=location, found=found, hint="check the path")
    if isinstance(error, PermissionError) or error.errno in (errno.EACCES, errno.EPERM):
        return ResourceError(
            "E-FILE-02",
            "no permission to read a source",
            where=location,
            found=found,
            hint="chmod u+r, or another user",
        )
    return ResourceError(
        "E-FILE-03", "a source cannot be read", where=location, found=found, hint="check disk or network"
    )


def find_images(photos: str | Sequence[str]) -> list[str]:
    """The images of a path, folder (searched to the bottom), glob, URL, or list of these, sorted and each once.

    Args:
        photos: What the user names.

    Returns:
        Locations, sorted.

    Raises:
        InputError: A named path does not exist, or there is no image at all.
        ResourceError: A folder may not be read.
    """
    named = [photos] if isinstance(photos, str) else list(photos)
    found = sorted({location for name in named for location in find(name, IMAGE_SUFFIXES)})
    if not found:
        raise InputError(
            "E-PHOTOS-01",
            "no photos",
            where=", ".join(named) or "ingest.photos",
            found="no file ends in " + ", ".join(IMAGE_SUFFIXES),
            expected="a folder, glob or list of photos",
            hint="check ingest.photos (--photos DIR)",
        )
    return found


def find(name: str, suffixes: Sequence[str]) -> list[str]:
    """Files of a path, folder, glob or URL with one of the suffixes; a file that is named itself needs no suffix.

    Hidden files are left out: file managers leave "._DJI_0001.JPG" beside photos.
    """
    if is_url(name):
        return _find_remote(name, suffixes)
    path = Path(name)
    try:
        if path.is_dir():
            return [str(file) for file in _walk(path) if _wanted(file.relative_to(path).parts, suffixes)]
        if path.exists():
            return [name]
        if any(mark in name for mark in _MAGIC):
            hits = [Path(hit) for hit in glob.glob(name, recursive=True)]  # noqa: PTH207 - absolute patterns
            return [str(hit) for hit in hits if hit.is_file() and _wanted(hit.parts[-1:], suffixes)]
    except OSError as error:
        raise explained(name, error) from error
    raise InputError(
        "E-FILE-01", "a source is missing", where=name, found="no such file or folder", hint="check the path"
    )


def beside(locations: Sequence[str], suffixes: Sequence[str]) -> list[str]:
    """Files with one of the suffixes in the folders of these files, sorted."""
    folders = sorted({parent(location) for location in locations})
    found: set[str] = set()
    for folder in folders:
        if is_url(folder):
            found.update(_find_remote(folder, suffixes))
        else:
            listed = _listed(Path(folder))
            found.update(str(file) for file in listed if _wanted((file.name,), suffixes) and file.is_file())
    return sorted(found)


def parent(location: str) -> str:
    """The folder of a location."""
    if is_url(location):
        scheme, _, rest = location.partition("://")
        return f"{scheme}://{PurePosixPath(rest).parent}"
    return str(Path(location).absolute().parent)


def stem(location: str) -> str:
    """File name without its last suffix."""
    return PurePosixPath(location).stem if is_url(location) else Path(location).stem


def common_root(locations: Sequence[str]) -> str:
    """The deepest folder that holds all locations; empty when they share none (mixed URLs and paths)."""
    split = [_parts(parent(location)) for location in locations]
    root: list[str] = []
    for level in zip(*split, strict=False):
        if len(set(level)) > 1:
            break
        root.append(level[0])
    if not root or (is_url(locations[0]) and len(root) < 2):
        return ""
    return f"{root[0]}://{'/'.join(root[1:])}" if is_url(locations[0]) else str(Path(*root))


def relative_to(location: str, root: str) -> str:
    """A location relative to the photo root, with forward slashes; with "../" where it is not below it."""
    if not root:
        return location
    if is_url(location):
        return location.removeprefix(root).lstrip("/")
    return Path(os.path.relpath(location, root)).as_posix()


def _parts(folder: str) -> tuple[str, ...]:
    if is_url(folder):
        scheme, _, rest = folder.partition("://")
        return (scheme, *rest.split("/"))
    return Path(folder).parts


def _wanted(parts: Sequence[str], suffixes: Sequence[str]) -> bool:
    return parts[-1].lower().endswith(tuple(suffixes)) and not any(part.startswith(".") for part in parts)


def _walk(folder: Path) -> Iterator[Path]:
    """Files below a folder. Unlike Path.rglob it says so when a folder may not be read."""
    for entry in _listed(folder):
        if entry.is_dir() and not entry.is_symlink():
            if not entry.name.startswith("."):
                yield from _walk(entry)
        elif entry.is_file():
            yield entry


def _listed(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError as error:
        raise explained(str(folder), error) from error


def _find_remote(name: str, suffixes: Sequence[str]) -> list[str]:
    try:
        system, path = cast("tuple[Any, str]", fsspec.core.url_to_fs(name))
        if any(mark in path for mark in _MAGIC):
            hits = [str(hit) for hit in system.glob(path)]
        elif system.isdir(path):
            hits = [str(hit) for hit in system.find(path)]
        else:
            hits = [path] if system.exists(path) else []
            return [name] if hits else _missing(name)
    except (ImportError, ValueError) as error:
        raise InputError(
            "E-FILE-04",
            "a URL of a kind that cannot be opened",
            where=name,
            found=str(error),
            hint="install the fsspec driver of its scheme (pip install s3fs, gcsfs, adlfs)",
        ) from error
    except OSError as error:
        raise explained(name, error) from error
    return [str(system.unstrip_protocol(hit)) for hit in hits if _wanted((PurePosixPath(hit).name,), suffixes)]


def _missing(name: str) -> list[str]:
    raise InputError(
        "E-FILE-01", "a source is missing", where=name, found="no such file or folder", hint="check the URL"
    )


@contextmanager
def local_copy(location: str) -> Iterator[Path]:
    """A source as a file of this machine, for libraries that map or seek: itself, or a copy that is gone afterwards.

    Args:
        location: Path or URL.

    Raises:
        InputError: It is not there, or not a file.
        ResourceError: Permission is missing, the disk is full, or the machine or network fails.
    """
    if not is_url(location):
        try:
            with Path(location).open("rb"):
                pass
        except OSError as error:
            raise explained(location, error) from error
        yield Path(location)
        return
    with tempfile.TemporaryDirectory(prefix="epitransfer.") as folder:
        copy = Path(folder) / PurePosixPath(location).name
        with opened(location) as stream, copy.open("wb") as target:
            shutil.copyfileobj(stream, target, 1 << 20)
        yield copy
