"""Every number of the report as one object: what `report.json` holds and what the page is written from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.reporting.counts import (
    depth_reasons,
    match_counts,
    most_common,
    pair_rules,
    point_counts,
    track,
)
from pipeline.reporting.distrust import doubts
from pipeline.reporting.gathered import RunData
from pipeline.reporting.quality import quality

# Digits of what is counted here; scores keep those of metrics.json.
_DIGITS = 6


def numbers(run: RunData, title: str | None = None) -> dict[str, Any]:
    """The object of `report.json`.

    Args:
        run: The run.
        title: The report's; None for the flight's date.

    Returns:
        `flown`, `came_out`, `how_good`, `distrust` (the minute), `metrics` and `sensitivity` as their stages wrote
        them, and `stages`: configuration, outputs and what each took. Without scores `metrics` is null.
    """
    counted = {"flown": _flown(run), "came_out": _came_out(run)}
    points = point_counts(run)
    sigma = {"sigma_h_m": points.sigma_h, "sigma_z_m": points.sigma_z}
    counted["came_out"]["points"] = {
        "n": points.n,
        "area_m2": points.area_m2,
        "per_m2": points.n / points.area_m2 if points.area_m2 else None,
        **{name: {"median": s.quantile(0.5), "p95": s.quantile(0.95)} for name, s in sigma.items()},
    }
    seen = {"range_m": points.range_m, "above_ground_m": points.above_m, "gsd_m": points.gsd_m}
    counted["flown"] |= {
        name: {"p05": s.quantile(0.05), "median": s.quantile(0.5), "p95": s.quantile(0.95)} for name, s in seen.items()
    }
    date = counted["flown"]["date"]
    named = title or (f"Flight of {date}" if date else "Flight without a date")
    found: dict[str, Any] = {"schema": 1, "title": named, **rounded(counted), "how_good": quality(run)}
    found["distrust"] = [doubt.as_object() for doubt in doubts(run, found)]
    return {**found, "metrics": run.metrics, "sensitivity": run.sensitivities, "stages": _stages(run.records)}


def _flown(run: RunData) -> dict[str, Any]:
    facts = run.facts("ingest")
    usable = run.frames.filter(run.frames.column("usable"))
    used = set(usable.column("camera_id").to_pylist())
    first = (run.frames.column("time").drop_null().to_pylist() or [None])[0]
    return {
        "frames": run.frames.num_rows,
        "usable": usable.num_rows,
        "date": first.date().isoformat() if first else None,
        **track(run),
        "cameras": [
            {name: row[name] for name in ("camera_id", "model", "width", "height", "fx", "fy", "source")}
            for row in run.cameras.to_pylist()
            if row["camera_id"] in used
        ],
        "pose_sources": most_common(usable, "pose_source"),
        "world": facts.get("world"),
        "origin": facts.get("origin"),
        "height_datum": facts.get("height_datum"),
        "height_datum_why": facts.get("height_datum_why"),
        "crs": run.facts("fuse").get("crs"),
        "crs_heights": run.facts("fuse").get("heights"),
    }


def _came_out(run: RunData) -> dict[str, Any]:
    reasons = depth_reasons(run)
    published = (run.setting("depth", "methods") or [None])[0]
    selected = run.pairs.column("selected").to_pylist().count(True)
    refine = run.facts("refine")
    return {
        "pairs": {"selected": selected, "rejected": run.pairs.num_rows - selected, "rejected_by_rule": pair_rules(run)},
        **match_counts(run),
        "epipolar_residual_px": {
            "as_logged": refine.get("median_epipolar_residual_px"),
            "used": refine.get("median_epipolar_residual_after_px"),
        },
        "published_method": published,
        "depths": {
            method: {
                "n": sum(by_reason.values()),
                "kept": by_reason.get("", 0),
                "masked_by_reason": {reason: n for reason, n in by_reason.items() if reason},
            }
            for method, by_reason in reasons.items()
        },
    }


def _stages(records: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    wanted = ("version", "summary", "seconds", "peak_memory_mib", "items", "warnings", "config", "outputs", "facts")
    return {stage: {name: record.get(name) for name in wanted} for stage, record in records.items()}


def rounded(value: Any) -> Any:
    """Floats to as many digits as are worth telling."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value
