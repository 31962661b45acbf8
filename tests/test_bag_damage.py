"""Damaged bags: what is whole is read, what was lost is told, and nothing but an InputError comes out."""

import shutil
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_files import (
    BEGAN_NS,
    DELAY_NS,
    NS,
    ROS1,
    ROS2,
    UNINDEXED,
    Row,
    camera_info,
    fix,
    image,
    imu,
    pose,
    tree,
    write_folder,
    write_mcap,
    write_ros1,
)
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from fuzzing import check, mutations_wanted, survives
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader

from pipeline.engine.errors import InputError
from pipeline.sources.bags.bag import read_bag
from pipeline.sources.bags.payloads import read_images
from pipeline.sources.records import FlightLog

N = 40


def at(second: float) -> int:
    return BEGAN_NS + round(second * NS)


def fixes(version: int = 2) -> list[Row]:
    return [("/fix", at(n) + DELAY_NS, fix(at(n), 45.0 + n * 1e-5, version=version)) for n in range(N)]


def seconds(log: FlightLog) -> list[int]:
    check(log)
    (positions,) = log.positions
    return [(t - BEGAN_NS) // NS for t in positions.time_ns.tolist()]


def changed(path: Path, change: Callable[[bytearray], Any]) -> FlightLog:
    data = bytearray(path.read_bytes())
    change(data)
    path.write_bytes(data)
    return read_bag(str(path))


# ROS 1.


def test_a_bag_that_was_cut_off(tmp_path: Path) -> None:
    """As a recorder leaves it whose power went: no index, the header as it was begun."""
    path = write_ros1(tmp_path / "flight.bag", fixes(1), chunk=1000)
    whole = path.read_bytes()
    with AnyReader([path]) as reader:
        chunks = [info.pos for info in reader.readers[0].chunk_infos]
    index = whole.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(whole[:index] + bytes(8) + whole[index + 8 : chunks[-1] + 300])
    log = read_bag(str(path))
    found = seconds(log)
    assert found == list(range(len(found)))
    assert 0.8 * N < len(found) < N
    assert "rosbag reindex" in log.losses[0]
    assert log.counts["/fix"] == len(found)


@pytest.mark.parametrize(("compression", "chunk"), [("none", 1000), ("none", 1 << 20), ("bz2", 1000), ("lz4", 1000)])
def test_a_half_copied_bag(tmp_path: Path, compression: str, chunk: int) -> None:
    path = write_ros1(tmp_path / "flight.bag", fixes(1), compression, chunk)
    with AnyReader([path]) as reader:
        places = sorted((place.datapos, place.datasize) for place in reader.readers[0].chunks.values())
    middle, size = places[len(places) // 2]
    log = changed(path, lambda data: data.__delitem__(slice(middle + size // 2, None)))
    assert 0.2 * N < len(seconds(log)) < 0.7 * N
    assert any("the file ends within a record" in loss for loss in log.losses)


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_a_damaged_chunk_of_a_ros1_bag(tmp_path: Path, compression: str) -> None:
    path = write_ros1(tmp_path / "flight.bag", fixes(1), compression, 1000)
    with AnyReader([path]) as reader:
        place = reader.readers[0].chunks[reader.readers[0].chunk_infos[0].pos]

    def hurt(data: bytearray) -> None:
        data[place.datapos : place.datapos + 40] = bytes(40)

    log = changed(path, hurt)
    found = seconds(log)
    # The first chunk introduces the topic; the index repeats it.
    assert found == list(range(N - len(found), N))
    assert 0.5 * N < len(found) < N
    assert "a damaged chunk" in log.losses[0]


@pytest.mark.parametrize("offset", [0, 3, 8])
def test_a_damaged_record_of_a_ros1_bag_is_jumped_over_with_the_index(tmp_path: Path, offset: int) -> None:
    """The length of its header, or its fields, whose length says where the next record begins."""
    path = write_ros1(tmp_path / "flight.bag", fixes(1), chunk=1000)
    with AnyReader([path]) as reader:
        chunks = [info.pos for info in reader.readers[0].chunk_infos]
    log = changed(path, lambda data: data.__setitem__(chunks[3] + offset, 0x7F))
    assert N - 2 * N // len(chunks) <= len(seconds(log)) < N
    assert "could not be read" in log.losses[0]


def test_ros1_bags_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "flight.bag"
    whole = write_ros1(path, fixes(1)).read_bytes()
    head = struct.unpack_from("<I", whole, 13)[0]
    encrypted = whole[13 + 4 : 13 + 4 + head] + struct.pack("<I", 13) + b"encryptor=aes"
    for data, hint in (
        (b"#ROSBAG V1.2\n" + whole[13:], "rosbag migrate"),
        (whole[:13], "rosbag reindex"),
        (whole[:13] + struct.pack("<I", len(encrypted)) + encrypted + whole[17 + head :], "rosbag decrypt"),
        (whole[:4000], ""),
    ):
        path.write_bytes(data)
        with pytest.raises(InputError) as caught:
            read_bag(str(path))
        assert hint in caught.value.hint
        assert (caught.value.code, caught.value.where) == ("E-BAG-01", str(path))


# MCAP.


@pytest.mark.parametrize("options", [UNINDEXED, {"use_chunking": False}, UNINDEXED | {"use_chunking": False}])
def test_an_mcap_without_an_index(tmp_path: Path, options: dict[str, Any]) -> None:
    path = write_mcap(tmp_path / "flight.mcap", fixes(), chunk=1000, **options)
    log = read_bag(str(path))
    assert seconds(log) == list(range(N))
    assert log.counts == {"/fix": N}
    assert [("no index" in loss) for loss in log.losses] == ([True] if "use_statistics" in options else [])


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_the_beginning_of_a_chunk_that_was_cut_off(tmp_path: Path, compression: str) -> None:
    """One chunk for all, as the Go tools write: its beginning is as good as ever."""
    rows = [("/fix", at(n) + DELAY_NS, fix(at(n), 45.0 + n**2.7 * 1e-7)) for n in range(2000)]
    path = write_mcap(tmp_path / "flight.mcap", rows, compression=compression, chunk=1 << 24)
    log = changed(path, lambda data: data.__delitem__(slice(len(data) // 2, None)))
    found = seconds(log)
    assert found == list(range(len(found)))
    assert 300 < len(found) < 1700


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_a_truncated_mcap(tmp_path: Path, compression: str) -> None:
    path = write_mcap(tmp_path / "flight.mcap", fixes(), compression=compression, chunk=1000)
    log = changed(path, lambda data: data.__delitem__(slice(len(data) // 2, None)))
    found = seconds(log)
    assert found == list(range(len(found)))
    assert 0.2 * N < len(found) < 0.9 * N
    assert "no index (the file has no end: the recording was cut off)" in log.losses[0]
    assert log.counts == {"/fix": len(found)}
    # The library gives up at the same place, with an error.
    with path.open("rb") as stream, pytest.raises(Exception):  # noqa: B017, PT012 - its kind differs
        seen = [message.log_time for _, _, message in make_reader(stream).iter_messages()]
        assert len(seen) == N


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_a_damaged_chunk_of_an_mcap(tmp_path: Path, compression: str) -> None:
    path = write_mcap(tmp_path / "flight.mcap", fixes(), compression=compression, chunk=1000)
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    middle = chunks[len(chunks) // 2]

    def hurt(data: bytearray) -> None:
        data[middle.chunk_start_offset + middle.chunk_length - 30] ^= 0x10

    log = changed(path, hurt)
    lost = N // len(chunks)
    assert N - 2 * lost - 1 <= len(seconds(log)) < N
    assert len(log.losses) == 1
    assert log.losses[0].startswith("a damaged chunk, its messages are lost:")


def test_a_damaged_length_is_jumped_over_with_the_index(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "flight.mcap", fixes(), chunk=1000)
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    log = changed(path, lambda data: data.__setitem__(chunks[3].chunk_start_offset + 6, 0x7F))
    assert N - 2 * N // len(chunks) <= len(seconds(log)) < N
    assert "could not be read" in log.losses[0]


def test_a_damaged_index(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "flight.mcap", fixes(), chunk=1000)
    with path.open("rb") as stream:
        start = make_reader(stream).get_summary().chunk_indexes[-1]
    log = changed(path, lambda data: data.__setitem__(-300, data[-300] ^ 1))
    assert start
    assert seconds(log) == list(range(N))
    assert log.losses == ("no index (its checksum is wrong): the file was read message by message",)


def test_unknown_encodings_and_schemas(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    message = LocationFix(latitude=45.0, longitude=7.0)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for n, (encoding, schema) in enumerate(
            (("cdr", "ros2msg"), ("flatbuffer", "flatbuffer"), ("protobuf", "protobuf"), ("cbor", ""), ("cdr", "x"))
        ):
            kind = "foxglove_msgs/msg/LocationFix" if encoding == "cdr" else "foxglove.LocationFix"
            number = writer.register_schema(kind if encoding != "cbor" else "wifi", schema, b"\xff\xfe")
            channel = writer.register_channel(f"/{n}", encoding, number)
            for time_ns in range(n + 1):
                writer.add_message(channel, time_ns, message.SerializeToString(), time_ns)
        number = writer.register_schema("sensor_msgs/msg/NavSatFix", "ros2msg", b"no definition at all")
        channel = writer.register_channel("/fix", "cdr", number)
        for topic, log_ns, found in fixes()[:3]:
            assert topic == "/fix"
            writer.add_message(channel, log_ns, bytes(ROS2.serialize_cdr(found, found.__msgtype__)), log_ns)
        writer.finish()
    log = read_bag(str(path))
    # A standard type whose definition is unreadable goes by the standard's.
    assert seconds(log) == [0, 1, 2]
    told = {loss.split(" ", 1)[0]: loss for loss in log.losses}
    assert told.keys() == {"/0", "/1", "/2", "/3", "/4"}
    assert "all 2 messages were left out: encoding 'flatbuffer'" in told["/1"]
    assert "all 4 messages were left out: encoding 'cbor'" in told["/3"]
    assert "all 3 messages were left out: schema 'foxglove.LocationFix'" in told["/2"]
    assert "without a definition" in told["/0"]
    assert log.counts == {"/0": 1, "/1": 2, "/2": 3, "/3": 4, "/4": 5, "/fix": 3}


def test_messages_that_are_none(tmp_path: Path) -> None:
    """Bytes of another message, and JSON without the fields of its type."""
    rows = [("/fix", at(n), ("foxglove.LocationFix", content)) for n, content in enumerate((
        {"latitude": 45.0}, [1, 2], {"latitude": "x", "longitude": 3}, None, {"timestamp": {"sec": 1e300, "nsec": 0}},
        {"latitude": 1, "longitude": 2, "altitude": 3, "position_covariance": [], "position_covariance_type": 0,
         "timestamp": {"sec": 10**30, "nsec": 0}},
        {"latitude": 1, "longitude": 2, "altitude": 3, "position_covariance": [], "position_covariance_type": 1},
    ))]  # fmt: skip
    log = read_bag(str(write_mcap(tmp_path / "flight.mcap", rows, "json")))
    check(log)
    assert log.positions[0].latitude_deg.tolist() == [1.0]
    assert log.losses[0].startswith("/fix: 6 of 7 messages could not be decoded:")


def test_payloads_of_a_damaged_bag(tmp_path: Path) -> None:
    rows = [("/image", at(n), image(at(n), np.full((40, 40), n, np.uint8))) for n in range(9)]
    path = write_mcap(tmp_path / "bag.mcap", rows, chunk=2000)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    found = [time_ns for time_ns, _, _ in read_images(str(path), "/image", [at(n) for n in range(9)])]
    assert found == [at(n) for n in range(len(found))]
    assert 2 < len(found) < 7


# ROS 2 folders and SQLite files.


def test_a_db3_without_definitions(tmp_path: Path) -> None:
    """Bags up to ROS 2 Humble have none: the types are the standard's."""
    path = write_folder(tmp_path / "bag", fixes()) / "bag.db3"
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("INSERT INTO topics VALUES (99, '/own', 'my_msgs/msg/Own', 'cdr', '', '')")
    database.close()
    assert seconds(read_bag(str(path))) == list(range(N))
    assert read_bag(str(path)).counts == {"/fix": N, "/own": 0}


def test_a_damaged_db3(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "bag", fixes() * 20) / "bag.db3"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    log = read_bag(str(path))
    assert "the database is damaged" in log.losses[0]
    assert 0 < len(log.positions[0].time_ns) < 20 * N
    path.write_bytes(whole[:3000])
    with pytest.raises(InputError) as caught:
        read_bag(str(path))
    assert (caught.value.code, caught.value.where) == ("E-BAG-01", str(path))


def test_a_journal_beside_a_db3_is_told(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "bag", fixes()) / "bag.db3"
    path.with_name("bag.db3-wal").write_bytes(b"1")
    before = sorted(path.parent.iterdir())
    assert read_bag(str(path)).losses[0].startswith("bag.db3-wal holds messages")
    assert sorted(path.parent.iterdir()) == before


def test_a_db3_with_damaged_definitions(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "bag", fixes()) / "bag.db3"
    with sqlite3.connect(path) as database:
        query = "SELECT rootpage FROM sqlite_master WHERE name = 'message_definitions'"
        (page,), (size,) = database.execute(query).fetchone(), database.execute("PRAGMA page_size").fetchone()
    database.close()

    def hurt(data: bytearray) -> None:
        data[(page - 1) * size : page * size] = b"\xee" * size

    log = changed(path, hurt)
    assert seconds(log) == list(range(N))
    assert "definitions of the message types are damaged" in log.losses[0]


def test_another_database_is_no_bag(tmp_path: Path) -> None:
    path = tmp_path / "survey.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE points (x)")
        database.execute("CREATE TABLE topics (x)")
        database.execute("CREATE VIEW messages AS SELECT x FROM points")
    database.close()
    with pytest.raises(InputError, match="tables points, topics"):
        read_bag(str(path))


def test_folders_in_disorder(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "bag", fixes())
    metadata = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(metadata.replace("bag.db3", "gone.db3"))
    log = read_bag(str(folder))
    assert (seconds(log), "gone.db3" in log.losses[0]) == (list(range(N)), True)
    for broken in ("{", "rosbag2_bagfile_information: 3", "", "a: b", "- 1", "\0"):
        (folder / "metadata.yaml").write_text(broken)
        log = read_bag(str(folder))
        assert (seconds(log), "metadata.yaml is damaged" in log.losses[0]) == (list(range(N)), True), broken
    (folder / "metadata.yaml").write_text(metadata)
    (folder / "bag.db3").write_bytes(b"SQLite format 3\0" + bytes(500))
    with pytest.raises(InputError, match=r"bag\.db3"):
        read_bag(str(folder))
    (folder / "bag.db3").unlink()
    with pytest.raises(InputError, match=r"no \.db3 or \.mcap file"):
        read_bag(str(folder))


def test_a_split_bag_with_one_broken_file(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "bag", fixes(), "mcap")
    shutil.copy(folder / "bag.mcap", folder / "bag_1.mcap")
    (folder / "bag_0.mcap").write_bytes(b"\x89MCAP")
    metadata = (folder / "metadata.yaml").read_text()
    listed = metadata.replace("- bag.mcap\n", "- bag_0.mcap\n  - bag_1.mcap\n")
    assert listed != metadata
    (folder / "metadata.yaml").write_text(listed)
    log = read_bag(str(folder))
    assert seconds(log) == list(range(N))
    assert log.losses[0].startswith("bag_0.mcap cannot be read")


# Nothing at all.


@pytest.mark.parametrize("name", ["flight.bag", "flight.mcap", "flight.db3"])
@pytest.mark.parametrize("data", [b"", b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n", b"SQLite format 3\0", b"#ROSBAG V"])
def test_files_with_nothing_in_them(tmp_path: Path, name: str, data: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"flight\."):
        read_bag(str(path))


def test_bags_without_messages(tmp_path: Path) -> None:
    paths = [write_ros1(tmp_path / "flight.bag", []), write_mcap(tmp_path / "flight.mcap", [])]
    paths.append(write_folder(tmp_path / "folder", []))
    for path in (*paths, tmp_path / "folder/folder.db3"):
        with pytest.raises(InputError, match="no message") as caught:
            read_bag(str(path))
        assert caught.value.where == str(path)
    with pytest.raises(InputError, match="E-FILE-01"):
        read_bag(str(tmp_path / "gone.bag"))


# Mutations.


def mixed() -> list[Row]:
    out: list[Row] = []
    for n in range(6):
        t = at(n)
        out += [
            ("/fix", t, fix(t)),
            ("/imu", t, imu(t)),
            ("/pose", t, pose(t)),
            ("/cam/camera_info", t, camera_info(t)),
        ]
        out += [("/tf", t, tree()), ("/image", t, image(t))]
    return out


def real_rows(path: Path, limit: int) -> list[tuple[Any, int, bytes]]:
    with AnyReader([path]) as reader:
        return [(connection, time_ns, raw) for connection, time_ns, raw in reader.messages()][:limit]


def real_ros1(path: Path, target: Path) -> Path:
    """The messages of a real bag in chunks of a few kB, images cut down to a few rows."""
    from rosbags.rosbag1 import Writer as Writer1  # noqa: PLC0415

    writer = Writer1(target)
    writer.chunk_threshold = 4000
    with writer, AnyReader([path]) as reader:
        connections: dict[str, Any] = {}
        for connection, time_ns, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            if connection.msgtype == "sensor_msgs/msg/Image":
                message.height, message.data = 2, message.data[: 2 * message.step]
            if connection.topic not in connections:
                connections[connection.topic] = writer.add_connection(
                    connection.topic, connection.msgtype, typestore=ROS1
                )
            data = ROS1.serialize_ros1(message, connection.msgtype)
            writer.write(connections[connection.topic], time_ns, data)
    return target


def real_mcap(path: Path, target: Path, limit: int = 300) -> Path:
    """The first messages of a real file."""
    with path.open("rb") as stream, target.open("wb") as out:
        writer = Writer(out, chunk_size=8000)
        writer.start("ros2", "test")
        channels: dict[int, int] = {}
        for schema, channel, message in list(make_reader(stream).iter_messages())[:limit]:
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return target


def fuzzed(data: bytes, path: Path, share: int = 1, seed: int = 0) -> None:
    outcomes = survives(read_bag, data, path, mutations_wanted() // share, seed)
    assert outcomes["whole"] + outcomes["partial"] > 0


@pytest.mark.real
def test_fuzz_a_real_ros1_bag(shared: Path, tmp_path: Path) -> None:
    real = shared / "data/bags/kapture_t265/trimmed_locoffice.bag"
    fuzzed(real_ros1(real, tmp_path / "small.bag").read_bytes(), tmp_path / "flight.bag")
    survives(read_bag, real.read_bytes(), tmp_path / "whole.bag", 4, 1)


@pytest.mark.real
def test_fuzz_a_real_mcap(shared: Path, tmp_path: Path) -> None:
    real = shared / "data/bags/evo/nav2_turtlebot.mcap"
    fuzzed(real_mcap(real, tmp_path / "small.mcap").read_bytes(), tmp_path / "flight.mcap")
    survives(read_bag, real.read_bytes(), tmp_path / "whole.mcap", 4, 1)


def test_fuzz_compressed_and_foreign_containers(tmp_path: Path) -> None:
    for share, path in (
        (4, write_ros1(tmp_path / "bz2.bag", fixes(1), "bz2", 1000)),
        (4, write_mcap(tmp_path / "unchunked.mcap", mixed(), use_chunking=False)),
        (4, write_mcap(tmp_path / "lz4.mcap", mixed(), compression="lz4", chunk=3000, enable_crcs=False)),
        (4, write_mcap(tmp_path / "unindexed.mcap", mixed(), chunk=3000, enable_crcs=False, **UNINDEXED)),
        (2, write_folder(tmp_path / "bag", mixed()) / "bag.db3"),
    ):
        fuzzed(path.read_bytes(), path, share)


def test_fuzz_foxglove(tmp_path: Path) -> None:
    rows: list[Row] = []
    for n in range(12):
        message = LocationFix(latitude=45.0, longitude=7.0, altitude=500.0, position_covariance=[1.0] * 9)
        message.timestamp.FromNanoseconds(at(n))
        rows.append(("/fix", at(n), message))
    stamp = {"sec": at(0) // NS, "nsec": 0}
    texts = [("/fix", at(n), ("foxglove.LocationFix", {
        "timestamp": stamp, "latitude": 45.0, "longitude": 7.0, "altitude": 500.0, "position_covariance": [1.0] * 9,
        "position_covariance_type": 2})) for n in range(12)]  # fmt: skip
    for encoding, content in (("protobuf", rows), ("json", texts)):
        path = write_mcap(tmp_path / f"{encoding}.mcap", content, encoding, enable_crcs=False, chunk=500)
        fuzzed(path.read_bytes(), path, 4)


def test_fuzz_metadata(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "bag", fixes()[:3])

    def read(name: str) -> FlightLog:
        return read_bag(str(Path(name).parent))

    path = folder / "metadata.yaml"
    data = path.read_bytes()
    outcomes = survives(read, data, path, mutations_wanted() // 8)
    assert outcomes["partial"] + outcomes["whole"] == sum(outcomes.values())
