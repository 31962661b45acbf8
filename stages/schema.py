"""schema: the tables of a run folder, column by column."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from pipeline.engine.errors import UsageError
from schemas import TABLES, TableSchema


def command(
    table: Annotated[str | None, typer.Argument(help="One table; all when left out.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Shows type, unit, frame and meaning of every column."""
    if table is not None and table not in TABLES:
        raise UsageError("E-SCHEMA-01", f"no table {table}", expected=", ".join(TABLES))
    chosen = [TABLES[table]] if table else list(TABLES.values())
    if as_json:
        typer.echo(json.dumps({schema.name: _described(schema) for schema in chosen}))
        return
    for schema in chosen:
        typer.echo(f"{schema.name} (version {schema.version}): {schema.meaning}")
        for column in schema.columns:
            unit = f" [{column.unit}]" if column.unit else ""
            frame = f" ({column.frame})" if column.frame else ""
            typer.echo(f"  {column.name:<20}{column.type!s:<24}{column.meaning}{unit}{frame}")
        typer.echo("")


def _described(schema: TableSchema) -> dict[str, object]:
    columns = [
        {
            "name": column.name,
            "type": str(column.type),
            "unit": column.unit,
            "frame": column.frame,
            "nullable": column.nullable,
            "meaning": column.meaning,
        }
        for column in schema.columns
    ]
    return {"version": schema.version, "meaning": schema.meaning, "columns": columns}
