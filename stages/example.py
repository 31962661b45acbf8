"""example: a small synthetic flight with its truth, and a workflow that runs it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.engine.executors import usable_cores
from pipeline.simulation.example import write_example
from pipeline.simulation.indoor import write_indoor
from pipeline.simulation.lawn import lawn_frames


def command(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to write; absent or empty.")],
    frames: Annotated[int, typer.Option(help="Number of photos, at least 4.")] = 24,
    seed: Annotated[int, typer.Option(help="Seed of everything random; the same seed gives the same bytes.")] = 7,
    indoor: Annotated[
        bool, typer.Option("--indoor", help="A room with motion capture instead, as a ROS 2 bag.")
    ] = False,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes; all cores by default.")] = None,
) -> None:
    """Writes a synthetic flight: photos with DJI tags, logs, LiDAR tiles, control points, the truth, and workflows.

    Beside it, in DIR/lawn, a second and shorter flight over ground of low texture: a lawn and a wide roof.
    """
    if indoor:
        room = write_indoor(directory, seed, frames)
        typer.echo(f"{directory}: {room.frames} images, {room.sweeps} LiDAR sweeps, {room.returns} returns")
        typer.echo(f"next: epitransfer run {directory / 'workflow.toml'} --out RUN", err=True)
        return
    workers = jobs or usable_cores()
    typer.echo(
        f"rendering {frames} photos, and {lawn_frames(frames)} over a lawn, on {workers} processors, "
        "some three seconds each",
        err=True,
    )
    made = write_example(directory, frames, seed, workers)
    typer.echo(
        f"{made.directory}: {made.frames} photos, {made.lidar_points} LiDAR returns, "
        f"{made.control_observations} control point observations"
    )
    typer.echo(f"{made.directory / 'lawn'}: {made.lawn_frames} photos of low texture, {made.lawn_points} LiDAR returns")
    typer.echo(f"next: epitransfer run {directory / 'workflow.toml'} --out RUN", err=True)
