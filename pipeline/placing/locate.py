"""Where the sources lie: logs, bags and videos of paths, folders and globs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.engine.errors import InputError
from pipeline.sources.files import find, is_url
from pipeline.sources.logs import BAG_SUFFIXES, LOG_SUFFIXES, is_log_folder
from pipeline.sources.video import VIDEO_SUFFIXES


def listed(names: str | Sequence[str] | None) -> list[str]:
    """What the user names, one by one: one name, several or none."""
    return [] if names is None else [names] if isinstance(names, str) else list(names)


def find_logs(names: str | Sequence[str] | None) -> list[str]:
    """Logs and bags of a path, glob or list of these, sorted and each once.

    A folder that is itself a log (a ROS 2 bag, a COLMAP model) stays one; any other is searched.

    Args:
        names: What the user names; None for nothing.

    Returns:
        Locations.

    Raises:
        InputError: A named path does not exist, or a folder holds no log.
    """
    found: set[str] = set()
    for name in listed(names):
        if is_log_folder(name):
            found.add(name)
            continue
        hits = find(name, (*LOG_SUFFIXES, *BAG_SUFFIXES))
        if not hits:
            raise InputError(
                "E-LOG-02", "no log here", where=name, found="no file of a known kind",
                expected=", ".join((*LOG_SUFFIXES, *BAG_SUFFIXES)),
                hint="name the file itself if it has another ending",
            )  # fmt: skip
        found.update(hits)
    return sorted(found)


def find_videos(names: str | Sequence[str] | None) -> list[str]:
    """Videos of paths, folders or globs, sorted and each once.

    Args:
        names: What the user names; None for nothing.

    Returns:
        Locations.

    Raises:
        InputError: A named path does not exist, or holds no video.
    """
    found: set[str] = set()
    for name in listed(names):
        hits = find(name, VIDEO_SUFFIXES)
        if not hits:
            raise InputError(
                "E-VIDEO-12", "no video here", where=name, found="no file of a known kind",
                expected=", ".join(VIDEO_SUFFIXES), hint="name the drone's videos, with their .SRT beside them",
            )  # fmt: skip
        found.update(hits)
    return sorted(found)


def files_of(locations: Sequence[str]) -> list[str]:
    """The files whose bytes decide: those of a folder that is a log, or the log itself."""
    out: list[str] = []
    for location in locations:
        folder = Path(location)
        inside = not is_url(location) and folder.is_dir()
        out += sorted(str(file) for file in folder.rglob("*") if file.is_file()) if inside else [location]
    return out
