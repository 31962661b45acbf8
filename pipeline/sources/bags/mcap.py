"""MCAP files: ROS 1 and ROS 2 messages, and Foxglove's schemas in protobuf or JSON."""

from __future__ import annotations

from pipeline.sources.records import FlightLog


def is_format(head: bytes, name: str) -> bool:  # noqa: ARG001 - the magic number says it all
    """Whether this is an MCAP file.

    Args:
        head: Beginning of the file.
        name: Path or URL.
    """
    return head.startswith(b"\x89MCAP0\r\n")


def read(location: str) -> FlightLog:
    """Reads an MCAP file.

    Args:
        location: Path or URL.

    Returns:
        What it holds.

    Raises:
        InputError: It is not there, no MCAP file, or holds no message.
        ResourceError: It may not be read.
    """
    from pipeline.sources.bags.bag import read_bag  # noqa: PLC0415 - heavy

    return read_bag(location)
