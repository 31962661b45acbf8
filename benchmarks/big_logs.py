"""Big logs for timings: as a survey leaves them, mostly of what nobody reads here."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import CompressionType
from mcap_protobuf.writer import Writer

from pipeline.geometry.arrays import AnyArray, Bytes, Ints
from pipeline.simulation.logs.dataflash import MESSAGES, records

# Messages per second of a log with fast attitude and raw inertial data.
_RATES_HZ = {"IMU": 800, "RATE": 400, "ATT": 100, "POS": 25, "MNT": 10, "GPS": 5, "GPA": 5, "CAM": 1}
# Type, format characters, fields, and the stored bytes after the time.
_NOT_READ = {
    "IMU": (140, "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz", 43),
    "RATE": (141, "Qfffffffffffff", "TimeUS,RDes,R,ROut,PDes,P,POut,YDes,Y,YOut,ADes,A,AOut,AOutSlew", 52),
}
_SECONDS_AT_ONCE = 64
_FIRST_US, _WEEK, _FIRST_GMS = 60_000_000, 2317, 300_000_000
# What grows from second to second, in stored units: 8 m/s to the north.
_GROWS = {
    ("GPS", "GMS"): 1000, ("GPA", "SMS"): 1000, ("CAM", "GPSTime"): 1000, ("CAM", "Img"): 1,
    ("GPS", "Lat"): 719, ("POS", "Lat"): 719, ("CAM", "Lat"): 719,
}  # fmt: skip

# Messages per second of a bag with a camera and a LiDAR, and the sizes of their payloads.
_BAG_HZ = {"/pose": 200, "/fix": 10, "/camera/image": 10, "/lidar/points": 10}
_IMAGE_BYTES, _SWEEP_POINTS, _POINT_BYTES = 500_000, 30_000, 16
_BAG_BEGAN_NS = 1_700_000_000_000_000_000
_FLOAT32 = 7


@dataclass(frozen=True, slots=True)
class _Growing:
    """Numbers of a second that are larger in the next one: where they stand, their values, the step, how stored."""

    starts: Ints
    values: Ints
    step: int
    stored: np.dtype[np.generic]

    def write(self, block: Bytes, seconds: Ints) -> None:
        """Sets them in a block of (s, n) bytes."""
        values = (self.values[None, :] + self.step * seconds[:, None]).astype(self.stored)
        size = self.stored.itemsize
        block[:, self.starts[:, None] + np.arange(size)] = values.view(np.uint8).reshape(*values.shape, size)


def write_dataflash(path: Path, size_bytes: int) -> None:
    """Writes a DataFlash log of at least so many bytes: an hour of flight is about 450 MB.

    Args:
        path: Where.
        size_bytes: How big; some seconds more are written.
    """
    second, growing = _one_second()
    with path.open("wb") as stream:
        stream.write(b"".join(_format(name, *parts[:3]) for name, parts in {**MESSAGES, **_NOT_READ}.items()))
        begun = 0
        while stream.tell() < size_bytes:
            seconds = np.arange(begun, begun + _SECONDS_AT_ONCE)
            block = np.tile(second, (len(seconds), 1))
            for numbers in growing:
                numbers.write(block, seconds)
            stream.write(block.tobytes())
            begun += len(seconds)


def write_mcap(path: Path, size_bytes: int, compression: str = "none") -> None:
    """Writes an MCAP file of at least so many bytes in Foxglove's schemas: images, sweeps, positions and poses.

    Args:
        path: Where.
        size_bytes: How big; up to a second more is written.
        compression: Of its chunks: "none", "lz4" or "zstd".
    """
    with path.open("wb") as stream, Writer(stream, compression=CompressionType[compression.upper()]) as writer:
        messages = _bag_messages()
        while stream.tell() < size_bytes:
            for time_ns, topic, message in islice(messages, sum(_BAG_HZ.values())):
                writer.write_message(topic, message, time_ns, time_ns)


def _bag_messages() -> Iterator[tuple[int, str, Any]]:
    """Messages without end, a second's in the order of time."""
    rng = np.random.default_rng(7)
    sweep = PointCloud(frame_id="lidar", point_stride=_POINT_BYTES, data=rng.bytes(_SWEEP_POINTS * _POINT_BYTES))
    for offset, name in enumerate(("x", "y", "z", "intensity")):
        sweep.fields.add(name=name, offset=4 * offset, type=_FLOAT32)
    pose = PoseInFrame(frame_id="map")
    pose.pose.orientation.w = 1.0
    made: dict[str, Any] = {
        "/pose": pose,
        "/fix": LocationFix(latitude=48.0, longitude=11.0, altitude=520.0, position_covariance_type=2),
        "/camera/image": CompressedImage(frame_id="camera", data=rng.bytes(_IMAGE_BYTES), format="jpeg"),
        "/lidar/points": sweep,
    }
    made["/fix"].position_covariance[:] = [0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.04]
    instants = [(n * 1_000_000_000 // hz, topic) for topic, hz in _BAG_HZ.items() for n in range(hz)]
    begun_ns = _BAG_BEGAN_NS
    while True:
        for after_ns, topic in sorted(instants):
            seconds, nanoseconds = divmod(begun_ns + after_ns, 1_000_000_000)
            made[topic].timestamp.CopyFrom(Timestamp(seconds=seconds, nanos=nanoseconds))
            yield begun_ns + after_ns, topic, made[topic]
        begun_ns += 1_000_000_000


def _format(name: str, kind: int, letters: str, fields: str) -> bytes:
    sizes = {"B": 1, "c": 2, "C": 2, "H": 2, "I": 4, "f": 4, "e": 4, "L": 4, "n": 4, "Q": 8, "N": 16, "Z": 64}
    length = 3 + sum(sizes[letter] for letter in letters)
    texts = (text.encode() for text in (name, letters, fields))
    return struct.pack("<2sBBB4s16s64s", b"\xa3\x95", MESSAGES["FMT"][0], kind, length, *texts)


def _one_second() -> tuple[Bytes, list[_Growing]]:
    """The first second's bytes, messages in order of time, and what grows in them."""
    rng = np.random.default_rng(7)
    messages = []
    for order, (name, rate_hz) in enumerate(_RATES_HZ.items()):
        time_us = _FIRST_US + np.arange(rate_hz) * 1_000_000 // rate_hz + 13 * order
        messages += [(int(row["TimeUS"]), order, name, row) for row in _rows(name, time_us, rng)]
    messages.sort(key=lambda message: message[:2])
    starts = np.cumsum([0, *(row.nbytes for *_, row in messages)])
    at: dict[tuple[str, str], list[tuple[int, int]]] = {}
    stored: dict[tuple[str, str], np.dtype[np.generic]] = {}
    for start, (_, _, name, row) in zip(starts.tolist(), messages, strict=False):
        for field in ("TimeUS", *(known[1] for known in _GROWS if known[0] == name)):
            key = (name if field != "TimeUS" else "", field)
            kind, offset = row.dtype.fields[field][:2]
            at.setdefault(key, []).append((start + offset, int(row[field])))
            stored[key] = kind
    growing = []
    for key, places in at.items():
        where, values = np.array(places, np.int64).T
        growing.append(_Growing(where, values, _GROWS.get(key, 1_000_000), stored[key]))
    return np.frombuffer(b"".join(row.tobytes() for *_, row in messages), np.uint8), growing


def _rows(name: str, time_us: Ints, rng: np.random.Generator) -> AnyArray:
    n = len(time_us)
    gps_ms = _FIRST_GMS + (time_us - _FIRST_US) // 1000
    if name in _NOT_READ:
        kind, _, _, rest = _NOT_READ[name]
        rows = np.zeros(n, [("head", "S2"), ("kind", "u1"), ("TimeUS", "<u8"), ("rest", "u1", rest)])
        rows["head"], rows["kind"], rows["TimeUS"] = b"\xa3\x95", kind, time_us
        rows["rest"] = rng.integers(0, 256, (n, rest))
        return rows
    place = {"Lat": 48.0, "Lng": 11.0, "Alt": 520.0}
    columns = {
        "GPS": {**place, "Status": 3, "GMS": gps_ms, "GWk": _WEEK, "NSats": 17},
        "GPA": {"HAcc": 0.4, "VAcc": 0.6, "SMS": time_us // 1000 - 100, "AEl": 566.0},
        "POS": {**place, "RelHomeAlt": 60.0},
        "ATT": {"Roll": 1.0, "Pitch": -4.0, "Yaw": 2.0},
        "MNT": {"Pitch": -80.0, "YawB": 1.0, "YawE": 3.0},
        "CAM": {**place, "Img": 1, "GPSTime": gps_ms, "GPSWeek": _WEEK},
    }
    return records(name, TimeUS=time_us, **columns[name])
