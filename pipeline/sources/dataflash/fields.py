"""The messages of a DataFlash log that are read, and the store where the walk over the file leaves their columns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pipeline.geometry.arrays import AnyArray, Floats

_BOOT = ("TimeUS", "TimeMS")
_RECEIVER = ("TimeUS", "T", "I", "Status", "GMS", "GWk", "TimeMS", "Week", "Lat", "Lng", "Alt", "RelAlt", "RAlt")
_ACCURACY = ("TimeUS", "TimeMS", "I", "HAcc", "VAcc", "SMS", "AEl", "Und")
_EVENT = (*_BOOT, "I", "Img")
# Field names of every firmware generation; a format that lacks some is nothing unusual.
WANTED: Mapping[str, tuple[str, ...]] = {
    "GPS": _RECEIVER,
    "GPS2": _RECEIVER,
    "GPA": _ACCURACY,
    "GPA2": _ACCURACY,
    "POS": (*_BOOT, "Lat", "Lng", "Alt", "RelHomeAlt", "RelAlt"),
    "AHR2": (*_BOOT, "Roll", "Pitch", "Yaw", "Alt", "Lat", "Lng", "Q1", "Q2", "Q3", "Q4"),
    "BARO": (*_BOOT, "I", "Alt"),
    "ATT": (*_BOOT, "Roll", "Pitch", "Yaw"),
    "MNT": (*_BOOT, "I", "Roll", "Pitch", "YawB", "YawE"),
    "CAM": _EVENT,
    "TRIG": _EVENT,
}
# Texts are few in a sound log; a damaged one must not fill the memory with them.
TEXTS: Mapping[str, tuple[str, ...]] = {"MSG": ("Message",), "PARM": ("Name", "Value")}
_MOST_TEXTS = 20_000


@dataclass(slots=True)
class Found:
    """What a walk over a log found.

    Args:
        counts: Messages per name, of all names.
        losses: What was lost on the way, one sentence each.
        messages: Texts that the vehicle logged.
        parameters: Values by name.
    """

    counts: Counter[str] = field(default_factory=Counter)
    losses: list[str] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)
    parameters: dict[str, float] = field(default_factory=dict)
    _blocks: dict[str, list[dict[str, tuple[AnyArray, float]]]] = field(default_factory=dict)

    def add(self, name: str, columns: Mapping[str, tuple[AnyArray, float]]) -> None:
        """Keeps a block of a message's fields as they were stored, which takes less than floats do.

        Args:
            name: The message.
            columns: Of each field, (n,) numbers and what to divide them by.
        """
        self._blocks.setdefault(name, []).append(dict(columns))

    def take(self, name: str) -> dict[str, Floats]:
        """The columns of a message, (n,) each, NaN where its format lacked a field; they are given away, not kept.

        Args:
            name: The message.

        Returns:
            Every wanted field that at least one of its formats has; empty when there is no message.
        """
        blocks = self._blocks.pop(name, [])
        out: dict[str, Floats] = {}
        for wanted in WANTED[name]:
            if any(wanted in block for block in blocks):
                out[wanted] = np.concatenate([_column(block, wanted) for block in blocks])
        return out

    def say(self, message: str) -> None:
        """Keeps a text that the vehicle logged."""
        if len(self.messages) < _MOST_TEXTS:
            self.messages.append(message)

    def set(self, name: str, value: float) -> None:
        """Keeps a parameter."""
        if len(self.parameters) < _MOST_TEXTS:
            self.parameters[name] = value


def _column(block: Mapping[str, tuple[AnyArray, float]], wanted: str) -> Floats:
    if wanted not in block:
        length = len(next(iter(block.values()))[0])
        return np.full(length, np.nan)
    numbers, divisor = block[wanted]
    # A damaged float may be a NaN that signals, which numpy would warn of.
    with np.errstate(invalid="ignore"):
        values = np.asarray(numbers, np.float64)
    values = np.where(np.isinf(values), np.nan, values)
    # Divided, not multiplied by 1e-7: the quotient is the float nearest to the decimal number.
    return values / divisor if divisor != 1.0 else values
