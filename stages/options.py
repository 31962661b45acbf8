"""Command-line options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

Set = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override section.key; repeatable.")]
Jobs = Annotated[int | None, typer.Option(min=1, help="Processes; all cores by default.")]
Scheduler = Annotated[str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler to run the shards on.")]
