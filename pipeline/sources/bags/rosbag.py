"""ROS 1 bags, and ROS 2 bags in SQLite files or folders."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from pipeline.sources.files import is_url
from pipeline.sources.records import FlightLog


def is_format(head: bytes, name: str) -> bool:
    """Whether this is a ROS bag.

    Args:
        head: Beginning of the file, empty for a folder.
        name: Path or URL.
    """
    if head.startswith(b"SQLite format 3\x00"):
        return PurePosixPath(name).suffix.lower() == ".db3"
    if not head and not is_url(name):
        return (Path(name) / "metadata.yaml").is_file()
    return head.startswith(b"#ROSBAG V")


def read(location: str) -> FlightLog:
    """Reads a ROS bag.

    Args:
        location: Path or URL; the folder of a ROS 2 bag.

    Returns:
        What it holds.

    Raises:
        InputError: It is not there, no bag, or holds no message.
        ResourceError: It may not be read.
    """
    from pipeline.sources.bags.bag import read_bag  # noqa: PLC0415 - heavy

    return read_bag(location)
