"""`epitransfer export`: a run's points in another format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.engine.runfolder import RunFolder


def command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder whose points to export.")],
    to: Annotated[
        Path, typer.Option("--to", metavar="FILE", help="File to write; .laz, .las, .ply, .gpkg, .csv or .parquet.")
    ],
) -> None:
    """Write the points of a run as LAZ, LAS, PLY, GeoPackage, CSV or one Parquet file: same CRS, uncertainties kept."""
    # The formats' libraries are heavy, and `--help` should not wait for them.
    from pipeline.points.exporters import export_points  # noqa: PLC0415

    _warn_of_stale(RunFolder(run))
    count = export_points(run / "points", to)
    typer.echo(f"{to}: {count} points")


def _warn_of_stale(folder: RunFolder) -> None:
    """Says so when a run would make other points now; a folder with points alone says nothing of it."""
    from stages.workflow import kept_configuration, states  # noqa: PLC0415

    if not folder.workflow.exists():
        return
    state = states(folder, kept_configuration(folder)).get("fuse")
    if state is not None and state.status != "fresh":
        typer.echo(
            f"warning: the points are of an earlier run ({state.because}); epitransfer run makes them anew", err=True
        )
