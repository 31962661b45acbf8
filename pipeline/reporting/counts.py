"""What was flown and what came out, counted from a run's tables in pieces."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from pipeline.engine.tables import parquet_files
from pipeline.flight import camera_by_frame, cameras_of, column, columns, placements_of
from pipeline.geometry.arrays import AnyArray, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement
from pipeline.reporting.gathered import RunData
from pipeline.reporting.quantiles import Spread

# Edge of the cells that are counted as covered where they hold a point: on earth, and in a room.
CELL_M, ROOM_CELL_M = 2.0, 0.25
_REASON = re.compile(r"(?P<what>\D+?) \S+ (?:(?P<unit>\w+), )?(?P<side>above|below) (?P<limit>\S+)")
_POINT_COLUMNS = ("x", "y", "sigma_x_m", "sigma_y_m", "sigma_z_m", "depth_m", "u", "v", "frame_id")


@dataclass(frozen=True, slots=True)
class PointCounts:
    """The points as a whole.

    Args:
        n: Points.
        area_m2: Area of the cells that hold one, m2.
        sigma_h: One sigma in the plane (root of both variances), m.
        sigma_z: One sigma of the height, m.
        range_m: Depth of the best observation, m.
        above_m: Height of the camera of that observation above the point, m.
        gsd_m: What a pixel spans at that depth, m.
    """

    n: int
    area_m2: float
    sigma_h: Spread
    sigma_z: Spread
    range_m: Spread
    above_m: Spread
    gsd_m: Spread


def pair_rules(run: RunData) -> dict[str, int]:
    """How many candidate pairs each rule rejected, the busiest rule first."""
    reasons = Counter(rule_of(reason) for reason in run.pairs.column("reason").to_pylist() if reason)
    return dict(sorted(reasons.items(), key=lambda item: (-item[1], item[0])))


def rule_of(reason: str) -> str:
    """The rule in a pair's reason without the number it found: "baseline above 16 m" of "baseline 20.1 m, above 16"."""
    found = _REASON.fullmatch(reason)
    return f"{found['what']} {found['side']} {found['limit']} {found['unit'] or ''}".strip() if found else reason


def depth_reasons(run: RunData) -> dict[str, dict[str, int]]:
    """Depths of each method by the reason that masked them; "" are those kept."""
    found: dict[str, Counter[str]] = {}
    for file in parquet_files(run.depths):
        grouped = pq.read_table(file, columns=["method", "reason"], partitioning=None).group_by(["method", "reason"])
        for row in grouped.aggregate([([], "count_all")]).to_pylist():
            found.setdefault(row["method"], Counter())[row["reason"]] += row["count_all"]
    return {method: dict(sorted(reasons.items())) for method, reasons in sorted(found.items())}


def match_counts(run: RunData) -> dict[str, int]:
    """Matches, and those that fit their pair."""
    found = run.relative_poses
    return {
        "matches": int(pc.sum(found.column("n_matches")).as_py() or 0),
        "inliers": int(pc.sum(found.column("n_inliers")).as_py() or 0),
    }


def track(run: RunData) -> dict[str, float | None]:
    """How long and how far the camera went over the usable frames, in the order of their times."""
    usable = run.frames.filter(run.frames.column("usable"))
    times = usable.column("time").cast(pa.int64())
    placed = columns(usable, ("east_m", "north_m", "up_m"))
    if usable.num_rows < 2 or times.null_count:
        return {"duration_s": None, "distance_m": None}
    seconds = np.asarray(times.to_numpy(), np.float64) * 1e-9
    steps = np.linalg.norm(np.diff(placed[np.argsort(seconds, kind="stable")], axis=0), axis=1)
    return {"duration_s": float(seconds.max() - seconds.min()), "distance_m": float(steps.sum())}


def point_counts(run: RunData) -> PointCounts:
    """The points, tile by tile; only one tile and the cells are in memory at a time."""
    cameras = camera_by_frame(run.frames, cameras_of(run.cameras))
    poses = placements_of(run.poses)
    cell = ROOM_CELL_M if run.is_local else CELL_M
    spreads: list[list[Spread]] = [[Spread.of(np.empty(0))] for _ in range(5)]
    cells: set[tuple[int, int]] = set()
    n = 0
    for table in _pieces(run.paths.get("points")):
        n += table.num_rows
        at = np.unique(np.floor(columns(table, ("x", "y")) / cell).astype(np.int64), axis=0)
        cells.update(map(tuple, at.tolist()))
        for into, values in zip(spreads, _values(table, cameras, poses), strict=True):
            into[:] = [reduce(add, (*into, Spread.of(values)))]
    return PointCounts(n, len(cells) * cell**2, *(into[0] for into in spreads))


def _pieces(folder: Path | None) -> Iterator[pa.Table]:
    for file in parquet_files(folder) if folder else []:
        with pq.ParquetFile(file, arrow_extensions_enabled=False) as stored:
            for batch in stored.iter_batches(columns=list(_POINT_COLUMNS)):
                yield pa.Table.from_batches([batch])


def _values(table: pa.Table, cameras: dict[str, Camera], poses: dict[str, Placement]) -> tuple[AnyArray, ...]:
    """Sigma in the plane, sigma of the height, range, height above the point and pixel's span, of each row."""
    sigma = columns(table, ("sigma_x_m", "sigma_y_m", "sigma_z_m"))
    depth = np.asarray(column(table, "depth_m"), np.float64)
    above, gsd = _seen_from(table, depth, cameras, poses)
    return np.hypot(sigma[:, 0], sigma[:, 1]), sigma[:, 2], depth, above, gsd


def _seen_from(
    table: pa.Table, depth: Floats, cameras: dict[str, Camera], poses: dict[str, Placement]
) -> tuple[Floats, Floats]:
    above, gsd = np.full(len(depth), np.nan), np.full(len(depth), np.nan)
    pixels = columns(table, ("u", "v"))
    names, which = np.unique(column(table, "frame_id").astype(str), return_inverse=True)
    for index, name in enumerate(names.tolist()):
        rows = np.flatnonzero(which == index)
        rays = cameras[name].rays(pixels[rows])
        above[rows] = -depth[rows] * (rays @ poses[name].rotation[2])
        gsd[rows] = depth[rows] / cameras[name].focal_px
    return above, gsd


def most_common(table: pa.Table, name: str) -> list[dict[str, Any]]:
    """The values of a text column of `table` and how many rows have each, the commonest first."""
    found = Counter(table.column(name).to_pylist())
    return [{"value": value, "n": n} for value, n in sorted(found.items(), key=lambda item: (-item[1], item[0]))]
