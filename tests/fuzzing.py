"""Mutations of real files for the readers: truncated anywhere, bits flipped, pieces cut, doubled, zeroed or swapped.

A few hundred per reader run with the tests; `make fuzz` sets EPITRANSFER_FUZZ=10000.
"""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.sources.records import FlightLog

SLOWEST_S = 10.0


def mutations_wanted(default: int = 150) -> int:
    """How many mutations to try."""
    return int(os.environ.get("EPITRANSFER_FUZZ", default))


def mutations(data: bytes, count: int, seed: int = 0) -> Iterator[bytes]:
    """Damaged copies of a file's bytes, the same for the same seed."""
    for index in range(count):
        rng = random.Random(seed * 1_000_003 + index)  # noqa: S311 - damage, not secrets
        out = bytearray(data)
        for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
            _damage(out, rng)
        yield bytes(out)


def _damage(out: bytearray, rng: random.Random) -> None:
    size = len(out)
    if not size:
        return
    at, length = rng.randrange(size), rng.choice((1, 2, 4, 8, 64, 1024))
    kind = rng.randrange(8)
    if kind == 0:
        del out[at:]
    elif kind in {1, 2, 3}:
        out[at] ^= 1 << rng.randrange(8)
    elif kind == 4:
        out[at : at + length] = bytes(rng.randrange(256) for _ in range(min(length, size - at)))
    elif kind == 5:
        del out[at : at + length]
    elif kind == 6:
        out[at:at] = out[at : at + length]
    else:
        out[at : at + length] = rng.choice((b"\0", b"\xff")) * min(length, size - at)


def survives(read: Callable[[str], FlightLog], data: bytes, path: Path, count: int, seed: int = 0) -> dict[str, int]:
    """Reads every mutation: the outcome is a log or an InputError that names the file, and comes soon.

    Args:
        read: A reader.
        data: A real file, or a part of it that is a file itself.
        path: Where mutations are written; its suffix matters.
        count: How many.
        seed: Of the mutations.

    Returns:
        How many were read whole, read with losses, and refused.
    """
    outcomes = {"whole": 0, "partial": 0, "refused": 0}
    for number, mutated in enumerate(mutations(data, count, seed)):
        path.write_bytes(mutated)
        began = time.monotonic()
        outcomes[_outcome(read, path, number)] += 1
        took = time.monotonic() - began
        assert took < SLOWEST_S, f"mutation {number} took {took:.1f} s"
    return outcomes


def _outcome(read: Callable[[str], FlightLog], path: Path, number: int) -> str:
    try:
        log = read(str(path))
    except InputError as error:
        where = error.where
    else:
        check(log)
        return "partial" if log.losses else "whole"
    assert str(path) in where, f"mutation {number}: the error names no file: {where}"
    return "refused"


def check(log: FlightLog) -> None:
    """What every reader promises of its records."""
    assert log.kind
    for stream in (*log.positions, *log.attitudes, *log.events, *log.poses):
        n = len(stream.time_ns)
        assert stream.time_ns.dtype == np.int64
        assert np.all(np.diff(stream.time_ns) >= 0), stream.stream
        for name in stream.__slots__:
            value = getattr(stream, name)
            if isinstance(value, np.ndarray) and n:
                assert len(value) == n, (stream.stream, name)
    for stream in log.positions:
        assert np.all(np.abs(stream.latitude_deg) <= 90.0)
        assert np.all(np.abs(stream.longitude_deg) <= 180.0)
    for stream in (*log.attitudes, *log.poses):
        assert np.allclose(np.linalg.norm(stream.q_wxyz, axis=-1), 1.0, atol=1e-6)
    assert len(log.time_base.anchor_log_ns) == len(log.time_base.anchor_utc_ns)
