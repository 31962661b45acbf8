"""Big logs for timings: as a survey leaves them, mostly of what nobody reads here."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

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
