"""Flight CSVs of DJI drones: AirData exports, DatCon's, and those of flight record converters."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Ints
from pipeline.sources.dji_logs.columns import Place, Turn
from pipeline.sources.dji_logs.streams import attitudes, positions
from pipeline.sources.dji_logs.table import Table, read_table, recognised
from pipeline.sources.files import opened
from pipeline.sources.records import NS_PER_S, NS_PER_US, Attitudes, Events, FlightLog, Nanoseconds, Positions, TimeBase
from pipeline.sources.streams import TRIGGER_SIGMA_S, in_order

# A moment further from what most agree on is damaged, or from before the first fix. Late ones do no harm, since the
# earliest arrivals count; early ones do.
_LATE_US = 2e6
_EARLY_US = 0.3e6
_LONGEST_S = 1e7
_HEIGHT_NOTE = (
    "heights above sea level are DJI's (take-off elevation plus barometer, or the receiver's); which datum they are "
    "above is not stated"
)


def is_format(head: bytes, name: str) -> bool:  # noqa: ARG001 - the readers' common signature
    """Whether the header row has the columns of a known program."""
    return recognised(head.decode("utf-8", "replace"))


def read(location: str) -> FlightLog:
    """Reads a flight CSV; units and meaning come from its header.

    Args:
        location: Path or URL.

    Returns:
        Positions, vehicle and gimbal attitude (both against north-east-down) and photos, on the clock of the flight
        (ns since its start); tied to UTC where the file has it.

    Raises:
        InputError: It is not there, of no known program, or without one readable row.
        ResourceError: It may not be read.

    Source: see `pipeline.sources.dji_logs.columns`.
    """
    with opened(location) as stream:
        table = read_table(location, stream)
    losses = [*table.losses]
    if table.short:
        losses.append(f"{table.short} of {table.rows} rows are cut off")
    time_ns, rows = _clock(table, losses)
    if not len(rows):
        raise InputError(
            "E-DJI-03", "the flight CSV has no readable row", where=location, found=f"{table.rows} rows",
            expected="one row per instant, with its time", hint="export it again",
        )  # fmt: skip
    facts: dict[str, Any] = {}
    places = enumerate(table.layout.places)
    tracks = [p for i, place in places if (p := _positions(table, i, place, time_ns, rows, losses)) is not None]
    if any(np.isfinite(p.amsl_m).any() for p in tracks):
        facts["height_note"] = _HEIGHT_NOTE
    turns = enumerate(table.layout.turns)
    turned = [a for i, turn in turns if (a := _attitudes(table, i, turn, time_ns, rows, facts)) is not None]
    events = _photos(table, time_ns, rows)
    if not tracks:
        losses.append("no row holds a position")
    return FlightLog(
        location=location, kind=table.layout.kind,
        counts={"rows": table.rows, "photos": sum(len(e.time_ns) for e in events)},
        time_base=_time_base(table, time_ns[0]),
        positions=tuple(tracks), attitudes=tuple(turned), events=events, losses=tuple(losses), facts=facts,
    )  # fmt: skip


def _clock(table: Table, losses: list[str]) -> tuple[Nanoseconds, Ints]:
    """(n,) times in order, and (n,) the rows they are of."""
    time_s = table.column("time_s")
    timed = np.isfinite(time_s) & (np.abs(time_s) < _LONGEST_S)
    rows = np.flatnonzero(timed)
    if len(rows) < len(time_s):
        losses.append(f"{len(time_s) - len(rows)} of {table.rows} rows have no readable time")
    time_ns = np.rint(time_s[rows] * NS_PER_S).astype(np.int64)
    ordered = in_order(time_ns)
    if not ordered.all():
        losses.append(f"{np.count_nonzero(~ordered)} of {len(ordered)} rows run backwards in time and were left out")
    return time_ns[ordered], rows[ordered]


def _positions(
    table: Table, i: int, place: Place, time_ns: Nanoseconds, rows: Ints, losses: list[str]
) -> Positions | None:
    names = ("amsl", "above_home", "barometric")
    made = positions(
        place.stream, time_ns, table.column(f"position {i} latitude")[rows],
        table.column(f"position {i} longitude")[rows],
        {f"{name}_m": table.column(f"position {i} {name}")[rows] for name in names},
        np.zeros(len(rows), np.int64), losses,
        item=f"rows of {place.stream}", fused=place.fused, held=table.layout.held,
    )  # fmt: skip
    return None if made is None else made[0]


def _attitudes(
    table: Table, i: int, turn: Turn, time_ns: Nanoseconds, rows: Ints, facts: dict[str, Any]
) -> Attitudes | None:
    angles = np.stack([table.column(f"attitude {i} {axis}")[rows] for axis in ("yaw", "pitch", "roll")], axis=1)
    if turn.of == "gimbal" and f"attitude {i} roll" not in table.columns and np.isfinite(angles[:, 1]).any():
        angles[:, 2] = 0.0
        facts["gimbal_roll_note"] = "the file has no gimbal roll; it is taken as 0"
    return attitudes(turn.stream, turn.of, time_ns, angles, np.zeros(len(rows), np.int64), held=False)


def _photos(table: Table, time_ns: Nanoseconds, rows: Ints) -> tuple[Events, ...]:
    """Where the flag rises. The instant is known to a row's step, and the camera's delay is not in the file."""
    flag = table.column("photo")[rows] == 1.0
    rises = np.flatnonzero(flag & ~np.concatenate(([False], flag[:-1])))
    if not len(rises):
        return ()
    step_s = float(np.median(np.diff(time_ns))) / NS_PER_S if len(time_ns) > 1 else 0.0
    sigma_s = max(step_s / np.sqrt(12.0), TRIGGER_SIGMA_S)
    return (Events("isPhoto", time_ns[rises], np.full(len(rises), -1, np.int64), feedback=False, sigma_s=sigma_s),)


def _time_base(table: Table, start_ns: np.int64) -> TimeBase:
    """The flight's clock, tied to UTC at the rows in which the moment changes."""
    if not table.stated:
        told = table.first_moment
        return TimeBase("boot", problem=f"local time without zone: {told}" if told else "no date in the file")
    time_s = np.frombuffer(table.changed_s, np.float64)
    utc_us = np.frombuffer(table.changed_us, np.float64)
    # The first moment did not change in its row, it was only first seen there.
    later = slice(1, None) if len(time_s) > 1 else slice(None)
    time_s, utc_us = time_s[later], utc_us[later]
    usable = np.isfinite(time_s) & (np.abs(time_s) < _LONGEST_S) & (time_s * NS_PER_S >= start_ns)
    offset_us = utc_us - time_s * 1e6
    if usable.any():
        early_us = offset_us - np.median(offset_us[usable])
        usable &= (early_us <= _EARLY_US) & (early_us >= -_LATE_US)
    lost = len(time_s) - int(np.count_nonzero(usable))
    time_s, utc_us = time_s[usable], utc_us[usable]
    order = np.argsort(time_s, kind="stable")
    return TimeBase(
        "boot", np.rint(time_s[order] * NS_PER_S).astype(np.int64), np.rint(utc_us[order]).astype(np.int64) * NS_PER_US,
        late=bool(np.all(utc_us % 1e6 == 0.0)),
        source="rows in which the UTC second changes",
        problem=f"{lost} moments of UTC disagree with the others and were left out" if lost else "",
    )  # fmt: skip
