"""The README's pictures, drawn from a run of the example: python docs/pictures.py RUN FOLDER."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pyarrow.compute as pc
import pyarrow.dataset as ds
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from pipeline.engine.runfolder import RunFolder
from pipeline.engine.tables import read_table
from pipeline.flight import column
from pipeline.matching.images import read_colour
from pipeline.points.geoparquet import PointDataset

FRAME, METHOD = "DJI_0011", "epitransfer"


def main(run: Path, target: Path) -> None:
    """Draws depth and sigma over a photo, and the fused points from above."""
    mpl.use("Agg")
    folder = RunFolder(run)
    figure, axes = plt.subplots(1, 3, figsize=(15, 4.6), width_ratios=(4, 4, 3.2), layout="constrained")
    _overlays(folder, axes[0], axes[1])
    _plan(folder, axes[2])
    figure.savefig(target / "example.png", dpi=90)
    print(target / "example.png")


def _overlays(folder: RunFolder, depth_axes: Axes, sigma_axes: Axes) -> None:
    depths = ds.dataset(folder.output("depths"), format="parquet").to_table(
        filter=(pc.field("frame_id") == FRAME) & (pc.field("method") == METHOD) & pc.field("kept")
    )
    frames = read_table(folder.output("frames"), "frames")
    image = frames.filter(pc.equal(frames.column("frame_id"), FRAME)).column("image")[0].as_py()
    root = (folder.record("ingest") or {})["facts"]["photo_root"]
    picture = read_colour(f"{root}/{image}")
    u, v, depth, sigma = (column(depths, name) for name in ("u", "v", "depth_m", "sigma_depth_m"))
    percent = 100.0 * sigma / depth
    for axes, values, label, limits in (
        (depth_axes, depth, "depth (m)", (20, 100)),
        (sigma_axes, percent, "predicted sigma (% of depth)", (0.0, float(np.quantile(percent, 0.98)))),
    ):
        axes.imshow(picture.mean(axis=2), cmap="gray", vmin=0, vmax=330)
        dots = axes.scatter(u, v, c=values, s=2.5, cmap="turbo", vmin=limits[0], vmax=limits[1], linewidths=0)
        axes.set(xticks=[], yticks=[], title=label)
        axes.figure.colorbar(dots, ax=axes, shrink=0.82, label=label)


def _plan(folder: RunFolder, axes: Axes) -> None:
    dataset = PointDataset(folder.output("points"))
    tables = list(dataset.tables())
    x, y, z = (np.concatenate([column(table, name) for table in tables]) for name in "xyz")
    corner = np.floor(np.array([x.min(), y.min()]))
    order = np.argsort(z)
    low, high = np.percentile(z, [1, 99])
    dots = axes.scatter(
        (x - corner[0])[order], (y - corner[1])[order], c=z[order], s=0.6, cmap="viridis", vmin=low, vmax=high
    )
    axes.set(
        aspect="equal",
        xlabel=f"easting - {corner[0]:.0f} (m)",
        ylabel=f"northing - {corner[1]:.0f} (m)",
        title=f"{len(x):,} fused points",
    )
    axes.figure.colorbar(dots, ax=axes, shrink=0.82, label="height above NAVD 88 (m)")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
