"""Any bag, opened by what it is, and read as a flight log."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from pipeline.sources.bags import mcap_file, rosbag1_file, rosbag2_files
from pipeline.sources.bags.container import Bag, Raw, Topic, unreadable
from pipeline.sources.bags.decoders import ENCODINGS, Decoder, UndecodableError, decoder
from pipeline.sources.bags.flight_log import flight_log
from pipeline.sources.bags.messages import BagMessages, is_wanted
from pipeline.sources.files import explained, is_url, local_copy
from pipeline.sources.records import FlightLog

# What a message that is not of its type, or not of this type's usual form, makes of its reader.
MISFITS = (AttributeError, TypeError, ValueError, OverflowError, IndexError)


@contextmanager
def open_bag(location: str) -> Iterator[Bag]:
    """Opens a bag.

    Args:
        location: Path or URL of a .bag, .db3 or .mcap file, or the folder of a ROS 2 bag.

    Raises:
        InputError: It is not there, or no bag.
        ResourceError: It may not be read, or the disk or network fails.
    """
    with ExitStack() as stack:
        try:
            if not is_url(location) and Path(location).is_dir():
                yield rosbag2_files.Rosbag2Folder(Path(location), stack)
                return
            path = stack.enter_context(local_copy(location))
            yield _container(path, stack.enter_context(path.open("rb")), location)
        except OSError as error:
            raise explained(location, error) from error


def _container(path: Path, stream: BinaryIO, location: str) -> Bag:
    head = stream.read(16)
    if head.startswith(mcap_file.MAGIC):
        return mcap_file.McapFile(stream, location)
    if head.startswith(rosbag1_file.MAGIC):
        return rosbag1_file.Rosbag1(stream, location)
    if head == rosbag2_files.MAGIC:
        return rosbag2_files.Db3File(path, location)
    raise unreadable(location, f"begins with {head!r}", "a .bag, .db3 or .mcap file")


@dataclass(slots=True)
class _Decoding:
    """Decodes wanted topics, and remembers what could not be decoded."""

    decoders: dict[Topic, Decoder] = field(default_factory=dict)
    unknown: dict[str, str] = field(default_factory=dict)
    failed: dict[str, tuple[int, str]] = field(default_factory=dict)

    def wants(self, topic: Topic) -> bool:
        if not is_wanted(topic):
            if topic.encoding not in ENCODINGS:
                self.unknown[topic.name] = f"encoding {topic.encoding!r}, which is not known"
            return False
        try:
            self.decoders[topic] = decoder(topic)
        except UndecodableError as error:
            self.unknown[topic.name] = str(error)
            return False
        return True

    def add(self, to: BagMessages, topic: Topic, log_ns: int, data: Raw) -> None:
        try:
            to.add(topic, log_ns, self.decoders[topic](data))
        except MISFITS as error:
            count, first = self.failed.get(topic.name, (0, str(error)))
            self.failed[topic.name] = count + 1, first

    def losses(self, bag: Bag) -> list[str]:
        out = [
            f"{name} ({bag.types.get(name) or 'no type'}): all {bag.counted[name]} messages were left out: {why}"
            for name, why in self.unknown.items()
        ]
        out += [
            f"{name}: {count} of {bag.counted[name]} messages could not be decoded: {why[:200]}"
            for name, (count, why) in self.failed.items()
        ]
        return out


def read_bag(location: str) -> FlightLog:
    """Reads a bag of any kind.

    Args:
        location: As `open_bag`.

    Returns:
        What it holds; images and points are read later, by `payloads`.

    Raises:
        InputError: It is not there, no bag, or holds no message.
        ResourceError: It may not be read, or the disk or network fails.
    """
    decoding, messages = _Decoding(), BagMessages()
    with open_bag(location) as bag:
        for topic, log_ns, data in bag.messages(decoding.wants):
            decoding.add(messages, topic, log_ns, data)
    if not bag.counted.total():
        raise unreadable(location, "; ".join(bag.losses) or "no message", "a bag with messages")
    return flight_log(messages, bag, location, decoding.losses(bag))
