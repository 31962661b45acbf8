"""`epitransfer export`: a run's points in another format, or its poses as a COLMAP model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.engine.runfolder import RunFolder


def command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder whose points to export.")],
    to: Annotated[
        Path,
        typer.Option(
            "--to",
            metavar="FILE",
            help="File to write; .laz, .las, .ply, .gpkg, .csv or .parquet; or a folder .colmap for the poses.",
        ),
    ],
) -> None:
    """Write the points of a run as LAZ, LAS, PLY, GeoPackage, CSV or one Parquet file: same CRS, uncertainties kept.

    Or its cameras and poses as a COLMAP model, in the flight's east-north-up frame.
    """
    # The formats' libraries are heavy, and `--help` should not wait for them.
    from pipeline.points.colmap_export import SUFFIX, export_colmap  # noqa: PLC0415
    from pipeline.points.exporters import export_points  # noqa: PLC0415

    if to.suffix.lower() == SUFFIX:
        _warn_of_stale(RunFolder(run), "refine", "poses")
        typer.echo(f"{to}: {export_colmap(run, to)} images")
        return
    _warn_of_stale(RunFolder(run), "fuse", "points")
    count = export_points(run / "points", to)
    typer.echo(f"{to}: {count} points")


def _warn_of_stale(folder: RunFolder, stage: str, made: str) -> None:
    """Says so when a run would make other points or poses now; a folder with tables alone says nothing of it."""
    from stages.workflow import kept_configuration, states  # noqa: PLC0415

    if not folder.workflow.exists():
        return
    state = states(folder, kept_configuration(folder)).get(stage)
    if state is not None and state.status != "fresh":
        typer.echo(
            f"warning: the {made} are of an earlier run ({state.because}); epitransfer run makes them anew", err=True
        )
