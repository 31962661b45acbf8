"""How good: the headline of the scores, with what they were measured against."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.reporting.gathered import RunData
from pipeline.reporting.palette import in_order


def untrained(run: RunData) -> frozenset[str]:
    """Methods whose network had random weights, so that their columns say nothing about them."""
    found: set[str] = set()
    for record in run.records.values():
        baselines = record.get("facts", {}).get("baselines") or {}
        found |= {name for name, told in baselines.items() if isinstance(told, dict) and told.get("untrained")}
    return frozenset(found)


def quality(run: RunData) -> dict[str, Any] | None:
    """The headline, None of a run that was never scored.

    Returns:
        `truth`, `published`, `methods` (name, untrained, share kept, AbsRel and RMSE on the pixels all methods keep
        with their 95 % intervals), `map`, `checkpoints` and `calibration`; parts that metrics.json lacks are None.
        Where control points moved the truth, `checkpoints` are those without that move, for points are delivered
        without it; `shift` tells the move, the checkpoints with it, and AbsRel without.
    """
    metrics = run.metrics
    if metrics is None:
        return None
    random = untrained(run)
    calibration = metrics.get("calibration") or {}
    return {
        "truth": metrics.get("truth"),
        "published": calibration.get("method") or next(iter(metrics["methods"]), None),
        "methods": [_method(name, metrics["methods"][name], name in random) for name in in_order(metrics["methods"])],
        "map": metrics.get("map"),
        "checkpoints": (metrics.get("without_control") or {}).get("checkpoints") or metrics.get("checkpoints"),
        "shift": _shift(metrics),
        "calibration": {
            name: calibration.get(name) for name in ("n", "within_1_sigma", "within_2_sigma", "without_pose")
        },
    }


def _shift(metrics: Mapping[str, Any]) -> dict[str, Any] | None:
    """What control points moved the truth by, and what that changes."""
    control, without = metrics.get("control_points"), metrics.get("without_control")
    if not control or not without:
        return None
    published = (metrics.get("calibration") or {}).get("method")
    entry = without["methods"].get(published) if published else None
    return {
        "translation_m": control["translation_m"],
        "sigma_m": control["sigma_m"],
        "checkpoints": metrics.get("checkpoints"),
        "abs_rel_without": entry["common"]["abs_rel"] if entry else None,
    }


def _method(name: str, entry: Mapping[str, Any], random: bool) -> dict[str, Any]:
    common, own = entry["common"], entry["all"]
    interval = (entry.get("interval_95") or {}).get("common") or {}
    return {
        "method": name,
        "untrained": random,
        "n_common": common["n"],
        "n_own": own["n"],
        "kept_share": entry["kept_share"],
        "abs_rel": common["abs_rel"],
        "abs_rel_95": interval.get("abs_rel"),
        "rmse_m": common["rmse"],
        "rmse_m_95": interval.get("rmse"),
        "abs_rel_own": own["abs_rel"],
        "rmse_own_m": own["rmse"],
    }
