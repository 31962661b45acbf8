"""The containers of ROS 2 bags: SQLite files, and folders of SQLite or MCAP files with a metadata.yaml."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from pipeline.engine.errors import InputError
from pipeline.sources.bags.container import Bag, DamagedError, Message, Topic, Wanted, log_time_ns, unreadable, zstd
from pipeline.sources.bags.mcap_file import McapFile

MAGIC = b"SQLite format 3\x00"
METADATA = "metadata.yaml"
_MAX_METADATA_BYTES = 4 << 20


class Db3File(Bag):
    """A SQLite file of a ROS 2 bag.

    Args:
        path: The file.
        where: Its name, for messages.

    Raises:
        InputError: Not such a file.

    Source: rosbag2_storage_sqlite3 (ros2/rosbag2), schema versions 1 to 4.
    """

    def __init__(self, path: Path, where: str) -> None:
        super().__init__("ROS 2 bag (SQLite)")
        self._path = path
        self._topics: dict[int, Topic] = {}
        journal = path.with_name(path.name + "-wal")
        if journal.is_file() and journal.stat().st_size:
            self.losses.append(f"{journal.name} holds messages that were not yet written into the database")
        try:
            with closing(self._connected()) as database:
                self._read_topics(database)
        except sqlite3.Error as error:
            raise unreadable(where, str(error), "a ROS 2 bag with the tables topics and messages") from error

    def messages(self, wanted: Wanted) -> Iterator[Message]:
        """As `Bag.messages`."""
        numbers = {number for number, topic in self._topics.items() if wanted(topic)}
        strangers = 0
        try:
            with closing(self._connected()) as database:
                counted = self._count(database)
                # What cannot be counted at once is counted row by row, wanted or not.
                asked = numbers if counted else set(self._topics)
                places = ",".join("?" * len(asked))
                query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({places})"  # noqa: S608
                rows = database.execute(query, sorted(asked))
                for number, log_ns, data in rows:
                    if not isinstance(log_ns, int) or not isinstance(data, bytes):
                        strangers += 1
                        continue
                    if not counted:
                        self.saw(self._topics[number], log_time_ns(log_ns))
                    if number in numbers:
                        yield self._topics[number], log_time_ns(log_ns), data
        except sqlite3.Error as error:
            self.losses.append(f"{self._path.name}: the database is damaged, the messages after it are lost: {error}")
        if strangers:
            self.losses.append(f"{self._path.name}: {strangers} rows are no messages")

    def _connected(self) -> sqlite3.Connection:
        # Immutable: nothing is written beside a user's recording, not even a lock.
        database = sqlite3.connect(f"{self._path.absolute().as_uri()}?immutable=1", uri=True)
        database.text_factory = lambda raw: raw.decode("utf-8", "replace")
        database.execute("PRAGMA trusted_schema=OFF")
        database.execute("PRAGMA cell_size_check=ON")
        # Else SQLite refuses a file that was cut off, whole as its beginning may be.
        database.execute("PRAGMA writable_schema=ON")
        return database

    def _read_topics(self, database: sqlite3.Connection) -> None:
        tables = {
            name
            for name, sql in database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'")
            if str(sql).upper().startswith("CREATE TABLE")
        }
        if not {"topics", "messages"} <= tables:
            raise sqlite3.DatabaseError(f"tables {', '.join(sorted(map(str, tables))) or 'none'}")
        schemas = self._schemas(database) if "message_definitions" in tables else {}
        for number, name, kind, encoding in database.execute("SELECT id, name, type, serialization_format FROM topics"):
            schema_encoding, text = schemas.get(str(kind), ("", ""))
            topic = Topic(str(name), str(kind), str(encoding), schema_encoding, text.encode())
            if isinstance(number, int):
                self._topics[number] = topic
                self.known(topic)

    def _schemas(self, database: sqlite3.Connection) -> dict[str, tuple[str, str]]:
        """Encoding and text of the types' definitions; standard types do without."""
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        try:
            return {str(kind): (str(encoding), str(text)) for kind, encoding, text in database.execute(query)}
        except sqlite3.Error as error:
            self.losses.append(f"{self._path.name}: the definitions of the message types are damaged: {error}")
            return {}

    def _count(self, database: sqlite3.Connection) -> bool:
        """Counts all messages, or none where the database is damaged."""
        query = "SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages GROUP BY topic_id"
        try:
            rows = database.execute(query).fetchall()
        except sqlite3.Error:
            return False
        strangers = 0
        for number, count, first, last in rows:
            topic = self._topics.get(number)
            if topic is None:
                strangers += count
                continue
            self.counted[topic.name] += count
            if isinstance(first, int) and isinstance(last, int):
                self.spans(log_time_ns(first), log_time_ns(last))
        if strangers:
            self.losses.append(f"{strangers} messages of topics that the bag does not describe")
        return True


class Rosbag2Folder(Bag):
    """A ROS 2 bag folder.

    Args:
        folder: Has a metadata.yaml, and the files that it names.
        stack: Closes files and removes temporary ones when reading is over.

    Raises:
        InputError: No file of the bag is there.

    Source: rosbag2_storage (ros2/rosbag2), metadata versions 1 to 9.
    """

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        super().__init__("ROS 2 bag")
        self._folder = folder
        self._stack = stack
        metadata = self._metadata()
        self._mode = str(metadata.get("compression_mode") or "").lower()
        if metadata.get("ros_distro"):
            self.facts["ros_distro"] = str(metadata["ros_distro"])
        self._files = self._named(metadata)
        if not self._files:
            raise unreadable(str(folder), "no .db3 or .mcap file", f"the files that {METADATA} names")

    def messages(self, wanted: Wanted) -> Iterator[Message]:
        """As `Bag.messages`."""
        compressions: set[str] = {"zstd"} if self._mode in {"file", "message"} else set()
        damaged = 0
        for path in self._files:
            part = self._opened(path)
            if part is None:
                continue
            for topic, log_ns, data in part.messages(wanted):
                try:
                    yield topic, log_ns, zstd(data) if self._mode == "message" else data
                except DamagedError:
                    damaged += 1
            compressions.update(part.facts.pop("compression", ()))
            self._take(path, part)
        self.facts["compression"] = sorted(compressions) or ["none"]
        if damaged:
            self.losses.append(f"{damaged} messages could not be decompressed")

    def _take(self, path: Path, part: Bag) -> None:
        self.facts = part.facts | self.facts
        self.losses += [f"{path.name}: {loss.removeprefix(path.name + ': ')}" for loss in part.losses]
        self.types = part.types | self.types
        for name, count in part.counted.items():
            self.counted[name] += count
        if part.span_ns is not None:
            self.spans(*part.span_ns)

    def _metadata(self) -> dict[str, Any]:
        try:
            with (self._folder / METADATA).open("rb") as stream:
                content = yaml.safe_load(stream.read(_MAX_METADATA_BYTES))
            found = content["rosbag2_bagfile_information"]
            if isinstance(found, dict):
                return found
            reason = "not a mapping"
        except (yaml.YAMLError, UnicodeDecodeError, RecursionError, KeyError, TypeError, ValueError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        self.losses.append(f"{METADATA} is damaged ({reason}): the files of the folder were read as they are")
        return {}

    def _named(self, metadata: dict[str, Any]) -> list[Path]:
        listed = metadata.get("relative_file_paths")
        names = [PurePath(str(name)).name for name in listed] if isinstance(listed, list) else []
        found = [self._folder / name for name in names if (self._folder / name).is_file()]
        missing = [name for name in names if not (self._folder / name).is_file()]
        if missing:
            self.losses.append(f"files that {METADATA} names are missing: {', '.join(missing)}")
        return found or sorted(
            path for path in self._folder.iterdir() if path.name.endswith((".db3", ".mcap", ".db3.zstd", ".mcap.zstd"))
        )

    def _opened(self, path: Path) -> Bag | None:
        """The container of one file; None where it is damaged, which is told."""
        try:
            if path.suffix == ".zstd":
                path = self._unpacked(path)
            if path.suffix == ".mcap":
                return McapFile(self._stack.enter_context(path.open("rb")), str(path))
            return Db3File(path, str(path))
        except (InputError, DamagedError) as error:
            found = error.found if isinstance(error, InputError) else str(error)
            if len(self._files) == 1:
                raise unreadable(str(self._folder), f"{path.name}: {found}", "a ROS 2 bag") from error
            self.losses.append(f"{path.name} cannot be read: {found}")
            return None

    def _unpacked(self, path: Path) -> Path:
        """A file that the recorder compressed as a whole, as a temporary one."""
        import zstandard  # noqa: PLC0415 - only where it is needed

        target = Path(self._stack.enter_context(TemporaryDirectory(prefix="epitransfer."))) / path.stem
        try:
            with path.open("rb") as stream, target.open("wb") as out:
                shutil.copyfileobj(zstandard.ZstdDecompressor().stream_reader(stream), out, 1 << 20)
        except zstandard.ZstdError as error:
            raise DamagedError(f"zstd: {error}") from error
        return target
