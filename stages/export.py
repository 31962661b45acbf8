"""`epitransfer export`: a run's points in another format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder whose points to export.")],
    to: Annotated[
        Path, typer.Option("--to", metavar="FILE", help="File to write; .laz, .las, .ply, .gpkg, .csv or .parquet.")
    ],
) -> None:
    """Write the points of a run as LAZ, LAS, PLY, GeoPackage, CSV or one Parquet file: same CRS, uncertainties kept."""
    # The formats' libraries are heavy, and `--help` should not wait for them.
    from pipeline.points.exporters import export_points  # noqa: PLC0415

    count = export_points(run / "points", to)
    typer.echo(f"{to}: {count} points")
