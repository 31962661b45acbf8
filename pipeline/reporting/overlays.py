"""Depths of every method on the photos of a few frames, side by side, and where they are off.

Source: the paper's figure of depths of all methods on the outdoor images, with their errors beside them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.engine.errors import InputError
from pipeline.engine.tables import dataset, explained
from pipeline.flight import camera_by_frame, cameras_of, column, columns
from pipeline.geometry.arrays import Bytes, Floats
from pipeline.matching.images import read_colour
from pipeline.reporting.figure import Figure, OverlayRow
from pipeline.reporting.gathered import RunData
from pipeline.reporting.painting import backdrop, painted, small
from pipeline.reporting.palette import label
from pipeline.reporting.panels import colour_bar, panel, panel_width_px
from pipeline.reporting.scales import DEPTH, SIGNED, coloured
from pipeline.scoring.lines import frames_in

SHOWN = 6
"""Frames that are shown."""

_DLT = "dlt"
_ROWS = ("frame_id", "method", "u", "v", "depth_m", "sigma_depth_m")
# What a colour bar spans: most of the values, not the few that are far off.
_DEPTH_SHARES = (2.0, 98.0)
_ERROR_SHARE = 90.0


@dataclass(frozen=True, slots=True)
class _Dots:
    """Kept depths of one method in one frame, the surest last.

    Args:
        pixels: (n, 2) u, v, px.
        depth_m: (n,).
        reference_m: (n,), NaN where there is none.
    """

    pixels: Floats
    depth_m: Floats
    reference_m: Floats

    @staticmethod
    def of(table: pa.Table) -> _Dots:
        sigma = np.asarray(column(table, "sigma_depth_m"), np.float64)
        order = np.argsort(-np.nan_to_num(sigma, nan=np.inf), kind="stable")
        reference = (
            np.asarray(column(table, "reference_m"), np.float64)
            if "reference_m" in table.column_names
            else np.full(table.num_rows, np.nan)
        )
        return _Dots(
            columns(table, ("u", "v"))[order], np.asarray(column(table, "depth_m"), np.float64)[order], reference[order]
        )

    @staticmethod
    def none() -> _Dots:
        """No depths."""
        return _Dots(np.empty((0, 2)), np.empty(0), np.empty(0))

    @property
    def error_percent(self) -> Floats:
        """(n,) signed relative error."""
        out: Floats = 100.0 * (self.depth_m / self.reference_m - 1.0)
        return out


@dataclass(frozen=True, slots=True)
class _Sheet:
    """What a frame's panels share.

    Args:
        frame_id: The frame.
        full: Width and height of its photo, px.
        ground: The picture that is painted on.
        width_px: About how wide a panel is on the page.
    """

    frame_id: str
    full: tuple[int, int]
    ground: Bytes
    width_px: float


def rows(run: RunData) -> list[OverlayRow]:
    """Some frames with the depths of every method, and the errors of the published one and of triangulation.

    Args:
        run: The run.

    Returns:
        One row per frame, in the order of flight; none if the run has no depths.

    Raises:
        InputError: A table cannot be read.
    """
    chosen = chosen_frames(run)
    if not chosen:
        return []
    depths, scored = _depths(run, list(chosen)), _scored(run, list(chosen))
    # Learned methods stand among the scored depths alone.
    shown = {frame_id: {**scored.get(frame_id, {}), **depths.get(frame_id, {})} for frame_id in chosen}
    published = _published(run)
    methods = sorted(
        {name for of_frame in shown.values() for name in of_frame},
        key=lambda name: (name != published, name != _DLT, name.startswith(published), name),
    )
    judged = [name for name in methods if name in (published, _DLT) and any(name in one for one in scored.values())]
    cameras = camera_by_frame(run.frames, cameras_of(run.cameras))
    found = []
    for frame_id, why in chosen.items():
        full, photo = (cameras[frame_id].width, cameras[frame_id].height), _photo(run, frame_id)
        width_px = panel_width_px(1 + len(methods) + len(judged))
        sheet = _Sheet(frame_id, full, backdrop(photo, full), width_px)
        dots = {name: shown[frame_id].get(name, _Dots.none()) for name in methods}
        errors = {name: scored.get(frame_id, {}).get(name, _Dots.none()) for name in judged}
        span, limit = (
            _depth_range(dots.get(published, _Dots.none()), list(dots.values())),
            _error_limit(list(errors.values())),
        )
        panels = (
            _photo_panel(sheet, photo),
            *(_depth_panel(sheet, name, of_method, span) for name, of_method in dots.items()),
            *(_error_panel(sheet, name, of_method, limit) for name, of_method in errors.items()),
        )
        found.append(OverlayRow(frame_id, why, panels))
    return found


def chosen_frames(run: RunData) -> dict[str, str]:
    """The frames that are shown, in the order of flight, and why.

    Args:
        run: The run.

    Returns:
        frame_id and reason: where there are scores the worst, the median and the best by AbsRel of the published
        method, and others spread evenly over the flight.
    """
    folder = run.paths.get("depths")
    if folder is None:
        return {}
    with_depths = frames_in(folder)
    ordered = [name for name in run.poses.column("frame_id").to_pylist() if name in with_depths]
    reasons = _extremes(run, ordered)
    count = min(SHOWN, len(ordered))
    for place in np.linspace(0, len(ordered) - 1, count).round().astype(np.int64):
        # The nearest that is not shown yet, the earlier of two.
        free = sorted((abs(i - place), i) for i, name in enumerate(ordered) if name not in reasons)
        if len(reasons) < count and free:
            reasons[ordered[free[0][1]]] = "one of several spread evenly over the flight"
    return {name: reasons[name] for name in ordered if name in reasons}


def _extremes(run: RunData, ordered: Sequence[str]) -> dict[str, str]:
    if run.metrics is None:
        return {}
    per_frame = run.metrics["methods"].get(_published(run), {}).get("per_frame", [])
    error = {row["frame_id"]: row["all"]["abs_rel"] for row in per_frame if row["all"]["n"]}
    ranked = sorted((name for name in ordered if name in error), key=lambda name: error[name])
    found: dict[str, str] = {}
    for place, words in ((-1, "largest"), (0, "smallest"), (len(ranked) // 2, "median")):
        if ranked and ranked[place] not in found:
            found[ranked[place]] = f"{words} AbsRel of all frames, {error[ranked[place]]:.4f}"
    return found


def _published(run: RunData) -> str:
    """The method whose points are published."""
    methods = run.setting("depth", "methods")
    return str(methods[0]) if methods else "epitransfer"


def _photo(run: RunData, frame_id: str) -> Bytes | None:
    """The photo at the size of a picture; None if it is not there any more."""
    try:
        return small(read_colour(run.images[frame_id]))
    except InputError:
        return None


def _depths(run: RunData, frames: Sequence[str]) -> dict[str, dict[str, _Dots]]:
    """By frame and method: what `depths` keeps."""
    return _by_frame(run.depths, "depths", frames, _ROWS)


def _scored(run: RunData, frames: Sequence[str]) -> dict[str, dict[str, _Dots]]:
    """By frame and method: what was scored; learned methods stand here alone."""
    path = run.scores / "pixels.parquet" if run.scores is not None else None
    return _by_frame(path, "pixels", frames, (*_ROWS, "reference_m")) if path is not None and path.exists() else {}


def _by_frame(path: Path, name: str, frames: Sequence[str], wanted: Sequence[str]) -> dict[str, dict[str, _Dots]]:
    kept = pc.field("kept") & pc.field("depth_m").is_valid() & pc.field("frame_id").isin(list(frames))
    with explained(path, name):
        table = dataset(path).to_table(columns=list(wanted), filter=kept)
    found: dict[str, dict[str, _Dots]] = {}
    frame, method = (np.asarray(column(table, key), object) for key in ("frame_id", "method"))
    for frame_id in frames:
        here = np.flatnonzero(frame == frame_id)
        for key in sorted(set(method[here])):
            found.setdefault(frame_id, {})[key] = _Dots.of(table.take(here[method[here] == key]))
    return found


def _depth_range(published: _Dots, others: Sequence[_Dots]) -> tuple[float, float]:
    """What the colours of a row span: the published depths, or all where there are none."""
    values = published.depth_m if len(published.depth_m) else np.concatenate([dots.depth_m for dots in others])
    if not len(values):
        return 0.0, 1.0
    low, high = np.percentile(values, _DEPTH_SHARES)
    return float(low), float(max(high, low + 1e-3))


def _error_limit(judged: Sequence[_Dots]) -> float:
    """Where the colours of errors end, %: a round number, and wide enough for most."""
    errors = np.concatenate([np.empty(0), *(np.abs(dots.error_percent) for dots in judged)])
    if not len(errors):
        return 1.0
    wanted = max(float(np.percentile(errors, _ERROR_SHARE)), 1e-3)
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(decade * next(step for step in (1.0, 2.0, 3.0, 5.0, 10.0) if step * decade >= wanted * (1.0 - 1e-9)))


def _photo_panel(sheet: _Sheet, photo: Bytes | None) -> Figure:
    if photo is None:
        return _panel(sheet, "photo", "Photo", "Not found where it was; plain grey instead.", sheet.ground)
    return _panel(sheet, "photo", "Photo", f"{sheet.frame_id} as taken.", photo)


def _depth_panel(sheet: _Sheet, method: str, dots: _Dots, span: tuple[float, float]) -> Figure:
    picture = painted(sheet.ground, sheet.full, dots.pixels, coloured(dots.depth_m, *span, DEPTH))
    caption = f"{len(dots.depth_m):,} depths."
    return _panel(sheet, method, label(method), caption, picture, colour_bar("depth (m)", *span, DEPTH))


def _error_panel(sheet: _Sheet, method: str, dots: _Dots, limit: float) -> Figure:
    # The largest errors last, so that none of them hides.
    order = np.argsort(np.abs(dots.error_percent), kind="stable")
    colours = coloured(dots.error_percent[order], -limit, limit, SIGNED)
    picture = painted(sheet.ground, sheet.full, dots.pixels[order], colours)
    caption = f"{len(order):,} pixels; red is too far."
    bar = colour_bar("error (%)", -limit, limit, SIGNED)
    return _panel(sheet, f"{method}-error", f"Error of {label(method)}", caption, picture, bar)


def _panel(
    sheet: _Sheet, name: str, title: str, caption: str, picture: Bytes, bar: Mapping[str, Any] | None = None
) -> Figure:
    return panel(f"overlay-{sheet.frame_id}-{name}", title, caption, picture, sheet.full, sheet.width_px, bar)
