"""The scores of all frames together, as the object of `metrics.json`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from pipeline.scoring.calibration import CalibrationSums, MapSums
from pipeline.scoring.frame_scores import FrameScore
from pipeline.scoring.metrics import MethodSums

# Sums are exact to some 15 digits; what is written is the same on every machine.
_DIGITS = 12


def metrics_object(methods: Sequence[str], scores: Sequence[FrameScore]) -> dict[str, Any]:
    """The object of `metrics.json`.

    Args:
        methods: Names, the published one first.
        scores: One per frame, in order.

    Returns:
        `methods` (per method: all, common, kept_share, per_frame), `calibration` and `map`, both of the published one.
        In `calibration` the same once more `without_pose`: without what the frames' absolute poses do to the reference.
        Where there is no pixel, null.
    """
    return {
        "methods": {
            name: {
                **MethodSums.total(score.sums.methods[m] for score in scores).metrics(),
                "per_frame": [
                    {
                        "frame_id": score.frame_id,
                        "n_scored": score.sums.methods[m].n_scored,
                        **score.sums.methods[m].metrics(),
                    }
                    for score in scores
                ],
            }
            for m, name in enumerate(methods)
        },
        "calibration": {
            "method": methods[0],
            **CalibrationSums.total(score.sums.calibration for score in scores).metrics(),
            "without_pose": CalibrationSums.total(score.sums.calibration_alone for score in scores).metrics(),
        },
        "map": {"method": methods[0], **MapSums.total(score.sums.map for score in scores).metrics()},
    }


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
