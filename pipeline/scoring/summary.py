"""The scores of all frames together, as the object of `metrics.json`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from pipeline.scoring.binned import BinnedSums
from pipeline.scoring.bootstrap import by_name, difference, intervals
from pipeline.scoring.calibration import CalibrationSums, MapSums
from pipeline.scoring.frame_scores import FrameScore
from pipeline.scoring.frame_sums import GridSums
from pipeline.scoring.metrics import GroupedSums, MethodSums

# Sums are exact to some 15 digits; what is written is the same on every machine.
_DIGITS = 12


def metrics_object(methods: Sequence[str], scores: Sequence[FrameScore]) -> dict[str, Any]:
    """The object of `metrics.json`.

    Args:
        methods: Names, the published one first.
        scores: One per frame, in order; at least one.

    Returns:
        `methods`, `calibration` and `map`, both of the published one. In `calibration` the same once more
        `without_pose`: without what the frames' absolute poses do to the reference. Where there is no pixel, null.

        Of each method: `all`, `common` and `kept_share`; `interval_95` of the metrics, frames drawn anew, and in that
        of every other method than the published one `difference_95`, of its AbsRel less the published one's on the
        common pixels; `by_range` (m), `by_parallax` (deg); `coverage`, the share of the images' cells with a reference
        in which it keeps a pixel; `per_frame`, whose intervals are of the image's cells drawn anew.
    """
    published = GroupedSums.stacked(score.sums.methods[0].common for score in scores)
    return {
        "methods": {name: _method(scores, m, published) for m, name in enumerate(methods)},
        "calibration": {
            "method": methods[0],
            **CalibrationSums.total(score.sums.calibration for score in scores).metrics(),
            "without_pose": CalibrationSums.total(score.sums.calibration_alone for score in scores).metrics(),
        },
        "map": {"method": methods[0], **MapSums.total(score.sums.map for score in scores).metrics()},
    }


def _method(scores: Sequence[FrameScore], m: int, published: GroupedSums) -> dict[str, Any]:
    sums = [score.sums.methods[m] for score in scores]
    kept, common = (GroupedSums.stacked(getattr(one, which) for one in sums) for which in ("kept", "common"))
    bounds: dict[str, Any] = {"all": by_name(intervals(kept)), "common": by_name(intervals(common))}
    if m:
        apart = by_name(difference(common, published))
        bounds["difference_95"] = None if apart is None else {"abs_rel": apart["abs_rel"]}
    cells = sum(score.sums.grid[m].n_cells for score in scores)
    covered = sum(score.sums.grid[m].n_covered for score in scores)
    return {
        **MethodSums.total(sums).metrics(),
        "interval_95": bounds,
        "by_range": BinnedSums.total(score.sums.by_range[m] for score in scores).metrics(),
        "by_parallax": BinnedSums.total(score.sums.by_parallax[m] for score in scores).metrics(),
        "coverage": {"image_share": covered / cells if cells else None},
        "per_frame": [_frame(score.frame_id, score.sums.methods[m], score.sums.grid[m]) for score in scores],
    }


def _frame(frame_id: str, sums: MethodSums, grid: GridSums) -> dict[str, Any]:
    bounds = {"all": by_name(grid.kept), "common": by_name(grid.common)}
    return {"frame_id": frame_id, "n_scored": sums.n_scored, **sums.metrics(), "interval_95": bounds}


def to_json(value: dict[str, Any]) -> str:
    """JSON with sorted keys and 12 significant digits, so that equal scores are equal bytes."""
    return json.dumps(_rounded(value), indent=1, sort_keys=True, allow_nan=False) + "\n"


def sentence(metrics: dict[str, Any]) -> str:
    """The scores in a line for people: each method on the pixels it keeps, the published one first."""
    published = metrics["calibration"]["method"]
    names = [published, *(name for name in metrics["methods"] if name != published)]
    return "AbsRel " + ", ".join(f"{name} {_kept(metrics['methods'][name])}" for name in names)


def _kept(entry: dict[str, Any]) -> str:
    scores = entry["all"]
    if not scores["n"]:
        return "keeps nothing"
    return f"{scores['abs_rel']:.4f} ({scores['n']:,} pixels, {100.0 * entry['kept_share']:.0f} %)"


def _rounded(value: object) -> object:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value
