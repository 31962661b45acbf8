"""Command-line options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

from pipeline.engine.config import Sections

Set = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override section.key; repeatable.")]
Jobs = Annotated[int | None, typer.Option(min=1, help="Processes; all cores by default.")]
Device = Annotated[
    str | None, typer.Option(metavar="DEVICE", help="What networks run on: auto, cpu, cuda, mps (match.device).")
]
Scheduler = Annotated[str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler to run the shards on.")]


def on_device(device: str | None) -> Sections:
    """The configuration that `--device` stands for."""
    return {} if device is None else {"match": {"device": device}}
