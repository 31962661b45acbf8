"""Which reader reads a log: by what the file begins with, then by its name."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from pipeline.engine.errors import InputError
from pipeline.sources.files import IMAGE_SUFFIXES, MARK_SUFFIXES, is_url, opened
from pipeline.sources.records import FlightLog

_HEAD_BYTES = 4096


@dataclass(frozen=True, slots=True)
class Format:
    """A log format and the module that reads it, loaded when it is needed: the libraries are heavy.

    Args:
        module: Has `read(location) -> FlightLog` and `is_format(head: bytes, name: str) -> bool`.
        suffixes: Of such files, in lower case; what a folder is searched for.
    """

    module: str
    suffixes: tuple[str, ...]

    def load(self, name: str) -> Callable[..., object]:
        """A function of the module."""
        return cast("Callable[..., object]", getattr(importlib.import_module(self.module), name))


# Binary formats, which have a magic number, before texts.
FORMATS = (
    Format("pipeline.sources.dataflash.reader", (".bin", ".log")),
    Format("pipeline.sources.px4.ulog", (".ulg",)),
    Format("pipeline.sources.bags.mcap", (".mcap",)),
    Format("pipeline.sources.bags.rosbag", (".bag", ".db3")),
    Format("pipeline.sources.mavlink.tlog", (".tlog",)),
    Format("pipeline.sources.dji_logs.encrypted", (".txt",)),
    Format("pipeline.sources.dji_logs.srt", (".srt",)),
    Format("pipeline.sources.dji_logs.csv_log", (".csv",)),
    Format("pipeline.sources.colmap", (".bin", ".txt")),
    Format("pipeline.sources.trajectory", (".tum", ".txt", ".csv")),
)
# Suffixes that say "log" without a look inside: what a folder is searched for.
LOG_SUFFIXES = (".bin", ".log", ".ulg", ".tlog", ".srt", ".tum")
BAG_SUFFIXES = (".bag", ".db3", ".mcap")


# Folders that are one log: what such a folder holds.
_FOLDER_MARKS = ("metadata.yaml", "cameras.bin", "cameras.txt")


def is_log_folder(location: str) -> bool:
    """Whether a location is a folder that is itself a log: a ROS 2 bag, a COLMAP model."""
    return not is_url(location) and any((Path(location) / mark).is_file() for mark in _FOLDER_MARKS)


def knows(location: str) -> bool:
    """Whether any reader takes a file for its own, by its beginning and its name."""
    with opened(location) as stream:
        head = stream.read(_HEAD_BYTES)
    return any(known.load("is_format")(head, location) for known in FORMATS)


def read_log(location: str) -> FlightLog:
    """Reads a log, bag, subtitle file or trajectory.

    Args:
        location: Path or URL; a folder for a ROS 2 bag or a COLMAP model.

    Returns:
        What it holds.

    Raises:
        InputError: It is not there, of no known format, or so damaged that nothing is left.
        ResourceError: It may not be read.
    """
    head = b""
    if is_url(location) or not Path(location).is_dir():
        with opened(location) as stream:
            head = stream.read(_HEAD_BYTES)
    for known in FORMATS:
        if known.load("is_format")(head, location):
            return cast("FlightLog", known.load("read")(location))
    if not head and not (not is_url(location) and Path(location).is_dir()):
        raise InputError(
            "E-LOG-04", "the log is empty", where=location, found="0 bytes", expected="a log",
            hint="copy it again from the vehicle or card",
        )  # fmt: skip
    raise InputError(
        "E-LOG-01",
        "no reader knows this file",
        where=location,
        found=f"begins with {head[:16]!r}" if head else "an empty file or folder",
        expected="ArduPilot .BIN/.log, MAVLink .tlog, PX4 .ulg, ROS .bag/.db3/.mcap, DJI .SRT/.csv, TUM or CSV "
        "trajectory, COLMAP model",
        hint=_elsewhere(location)
        or "check the file, or convert it to a CSV trajectory (docs/conventions.md has its columns)",
    )


def _elsewhere(location: str) -> str:
    """Where a file belongs that is no log by itself; empty for any other."""
    name = location.lower()
    if name.endswith(MARK_SUFFIXES):
        return "exposure marks are read when they lie beside the photos"
    if name.endswith("metadata.yaml"):
        return "name the bag's folder"
    return "images are photos: --photos" if name.endswith(IMAGE_SUFFIXES) else ""
