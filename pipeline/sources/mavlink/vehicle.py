"""One vehicle out of a telemetry log: its autopilot among those heard, one boot of it, and its other components."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.sources.mavlink.clock import BootClock, boot_clock, restarts, time_base
from pipeline.sources.mavlink.frames import Rows, Sender, Telemetry
from pipeline.sources.records import NS_PER_MS, TimeBase

_POSITION = "GLOBAL_POSITION_INT"
# The autopilot's messages that tell its time since boot.
_TIMED = (_POSITION, "ATTITUDE", "ATTITUDE_QUATERNION", "SYSTEM_TIME")
_NO_AUTOPILOT = 8
# MAV_TYPE of what is no vehicle that carries a camera: antenna tracker, ground station, onboard controller, gimbal,
# ADS-B, camera, charging station, FLARM, servo, remote ID, battery, parachute, log, OSD, IMU, GPS, winch, lamp,
# gripper.
_NO_VEHICLE = (5, 6, 18, 26, 27, 30, 31, 32, 33, 34, 36, 37, 38, 39, 40, 41, 42, 44, 48)
_STRAY_NS = 5_000_000_000
# A component's clock is taken for the autopilot's when the two agree this well, by arrivals; the median of few
# arrivals says less.
_SAME_CLOCK_NS, _SAME_CLOCK_FEW_NS, _FEW = 100_000_000, 1_000_000_000, 100


@dataclass(frozen=True, slots=True)
class Vehicle:
    """The vehicle that a log is read for.

    Args:
        sender: System and component of its autopilot.
        autopilot: MAV_AUTOPILOT, -1 where it was never told.
        kind: MAV_TYPE, -1 where it was never told.
        clock: The boot that is read.
        base: What ties that boot to UTC.
        telemetry: The whole log.
        others: Other autopilots in the log.
        losses: What was left out in choosing.
    """

    sender: Sender
    autopilot: int
    kind: int
    clock: BootClock
    base: TimeBase
    telemetry: Telemetry
    others: tuple[Sender, ...]
    losses: tuple[str, ...]

    def take_own(self, name: str) -> Rows | None:
        """A message of the autopilot during this boot, out of the log, whose memory it leaves; None without one."""
        return _during(self.clock, self.telemetry.rows.pop((name, self.sender), None))

    def take_parts(self, name: str, device: str = "") -> Iterator[tuple[str, bool, Rows]]:
        """A message of the vehicle's components during this boot, apart for each component and device; as `take_own`.

        Args:
            name: The message.
            device: Field that numbers the devices of one component, where they share the message.

        Yields:
            Label of the stream, whether the autopilot itself sent it, and the rows.
        """
        groups: dict[tuple[int, int], Rows] = {}
        senders = [sender for message, sender in self.telemetry.rows if message == name]
        for sender in senders:
            if sender[0] != self.sender[0] or sender in self.others:
                continue
            here = _during(self.clock, self.telemetry.rows.pop((name, sender)))
            if here is None:
                continue
            numbers = np.unique(here[device]).tolist() if device else [0]
            for number in numbers:
                groups[sender[1], number] = here[here[device] == number] if len(numbers) > 1 else here
        several = len(groups) > 1
        for component, number in sorted(groups):
            which = f"[{component}.{number}]" if device else f"[{component}]"
            label = name + which if several else name
            yield label, component == self.sender[1], groups.pop((component, number))

    def clock_shift_ns(self, rows: Rows) -> int:
        """The autopilot's clock since boot minus that of another component, which starts on its own; 0 when the same.

        Args:
            rows: The component's messages with "time_boot_ms".
        """
        own_ns = rows["time_boot_ms"].astype(np.int64) * NS_PER_MS
        shift_ns = int(np.median(self.clock.of_arrival(rows) - own_ns))
        return shift_ns if abs(shift_ns) > (_SAME_CLOCK_FEW_NS if len(rows) < _FEW else _SAME_CLOCK_NS) else 0


def find_vehicle(telemetry: Telemetry) -> Vehicle | None:
    """The vehicle with the most positions, and of that the boot with the most positions.

    Args:
        telemetry: The log.

    Returns:
        The vehicle; None where no autopilot tells its time.
    """
    autopilots = _autopilots(telemetry)
    if not any((_POSITION, sender) in telemetry.rows for sender in autopilots):
        autopilots |= {sender: (-1, -1) for name, sender in telemetry.rows if name in _TIMED}
    # Ties go to the lowest number.
    ranked = sorted(autopilots, key=lambda sender: (-len(_timed(telemetry, sender, _POSITION)), sender))
    for sender in ranked:
        timed = np.concatenate([_timed(telemetry, sender, name) for name in _TIMED])
        timed = timed[np.argsort(timed["at"], kind="stable")]
        span, restarted = _boot(timed, _timed(telemetry, sender, _POSITION))
        clock = boot_clock(timed, span)
        if clock is None:
            continue
        others = tuple(other for other in autopilots if other != sender)
        system_time = _during(clock, telemetry.rows.get(("SYSTEM_TIME", sender)))
        base = time_base(clock, system_time, _during(clock, telemetry.rows.get(("GPS_RAW_INT", sender))))
        losses = (*_left_out(telemetry, others), *restarted, *_strays(timed, clock))
        autopilot, kind = autopilots[sender]
        return Vehicle(sender, autopilot, kind, clock, base, telemetry, others, losses)
    return None


def _autopilots(telemetry: Telemetry) -> dict[Sender, tuple[int, int]]:
    """Who sends an autopilot's heartbeat, with its MAV_AUTOPILOT and MAV_TYPE."""
    found = {}
    for (name, sender), rows in sorted(telemetry.rows.items(), key=lambda item: item[0]):
        if name != "HEARTBEAT":
            continue
        flying = rows[(rows["autopilot"] != _NO_AUTOPILOT) & ~np.isin(rows["type"], _NO_VEHICLE)]
        if len(flying):
            found[sender] = (int(flying["autopilot"][-1]), int(flying["type"][-1]))
    return found


def _timed(telemetry: Telemetry, sender: Sender, name: str) -> Rows:
    """Place, stamp and time since boot of a sender's messages; of positions only those that are somewhere."""
    columns = [("at", np.int64), ("stamp", np.int64), ("time_boot_ms", np.int64)]
    rows = telemetry.rows.get((name, sender))
    out = np.zeros(0 if rows is None else len(rows), columns)
    if rows is None:
        return out
    for column, _ in columns:
        out[column] = rows[column]
    return out[(rows["lat"] != 0) | (rows["lon"] != 0)] if name == _POSITION else out


def _boot(timed: Rows, positions: Rows) -> tuple[tuple[int, int], list[str]]:
    """Span of the boot with the most positions, and what is lost with the others."""
    begins = restarts(timed["at"], timed["stamp"], timed["time_boot_ms"])
    edges = [0, *begins.tolist(), np.iinfo(np.int64).max]
    counts, _ = np.histogram(np.searchsorted(begins, positions["at"], side="right"), np.arange(len(edges)) - 0.5)
    if not counts.any():
        counts, _ = np.histogram(np.searchsorted(begins, timed["at"], side="right"), np.arange(len(edges)) - 0.5)
    best = int(np.argmax(counts))
    span = (int(edges[best]), int(edges[best + 1]))
    if not len(begins):
        return span, []
    lost = int(counts.sum() - counts[best])
    times = "once" if len(begins) == 1 else f"{len(begins)} times"
    return span, [f"the autopilot restarted {times}: {lost} positions of its other boots were left out"]


def _strays(timed: Rows, clock: BootClock) -> list[str]:
    """Messages amid the boot that tell quite another time: a few of another boot, too few to be told apart."""
    here = clock.during(timed)
    if len(here) == len(clock.at):
        return []
    expected = np.interp(here["at"], clock.at, clock.boot_ns)
    strays = int(np.count_nonzero(np.abs(here["time_boot_ms"] * NS_PER_MS - expected) > _STRAY_NS))
    return [f"{strays} messages of another boot of the autopilot were left out"] if strays else []


def _left_out(telemetry: Telemetry, others: tuple[Sender, ...]) -> list[str]:
    """One sentence for each other autopilot."""
    told = []
    for system, component in sorted(others):
        counts = {name: len(rows) for (name, sender), rows in telemetry.rows.items() if sender == (system, component)}
        listed = ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
        told.append(f"another autopilot, system {system} component {component}, was left out: {listed}")
    return told


def _during(clock: BootClock, rows: Rows | None) -> Rows | None:
    if rows is None:
        return None
    rows = clock.during(rows)
    return rows if len(rows) else None
