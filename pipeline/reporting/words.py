"""Numbers as the report writes them."""

from __future__ import annotations

from collections.abc import Sequence

MISSING = "\N{EN DASH}"


def number(value: float | None, digits: int = 3) -> str:
    """A number for people: significant digits without an exponent where that is short; a dash for none."""
    if value is None:
        return MISSING
    if isinstance(value, int):
        return f"{value:,}"
    text = f"{value:#.{digits}g}".rstrip(".")
    return f"{value:,.0f}" if abs(value) >= 10**digits else text


def share(value: float | None) -> str:
    """A share in percent."""
    return MISSING if value is None else f"{100.0 * value:.1f} %"


def interval(bounds: Sequence[float] | None) -> str:
    """A 95 % interval in brackets; nothing for none."""
    return "" if not bounds else f" [{number(bounds[0])}, {number(bounds[1])}]"


def signed(value: float | None) -> str:
    """An error in metres with its sign."""
    return MISSING if value is None else f"{value:+.3f}"
