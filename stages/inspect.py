"""inspect: what a photo folder, log, bag, tile, table or run folder holds."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import typer


def command(
    source: Annotated[
        list[str], typer.Argument(metavar="SOURCE...", help="Photos, logs, bags, .mrk, .laz, .parquet, a run.")
    ],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Tell what sources hold: counts, time span, clock, poses, camera, heights, problems."""
    # The formats' libraries are heavy, and `--help` should not wait for them.
    from pipeline.inspection import describe  # noqa: PLC0415

    found = [item for name in source for item in describe(name)]
    if as_json:
        typer.echo(json.dumps({"sources": found}, allow_nan=False))
        return
    for item in found:
        typer.echo("\n".join(lines(item)))


def lines(item: Mapping[str, Any]) -> Iterator[str]:
    """One described source as text, a line per fact that is known."""
    yield f"{item['kind']}: {item['source']}"
    for key, value in item.items():
        if key in {"kind", "source"} or value in ("", [], {}):
            continue
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            yield f"  {key}"
            yield from (f"    {_text(entry)}" for entry in value)
        else:
            yield f"  {key:<20}{_text(value)}"


def _text(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_text(part)}" for key, part in value.items())
    if isinstance(value, list):
        numeric = len(value) == 2 and all(isinstance(part, float) or _is_time(part) for part in value)
        return (" .. " if numeric else ", ").join(_text(part) for part in value)
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _is_time(value: object) -> bool:
    return isinstance(value, str) and value[4:5] == "-"
