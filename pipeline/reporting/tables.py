"""The tables of the report: text in cells, as the page prints them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.reporting.gathered import RunData
from pipeline.reporting.palette import in_order, label
from pipeline.reporting.words import MISSING, number, share, signed

# The paper's rows in the paper's order: metric, words, whether less is better.
METRICS = (
    ("abs_rel", "AbsRel", True),
    ("rmse", "RMSE (m)", True),
    ("rmse_log", "RMSE log", True),
    ("mae", "MAE (m)", True),
    ("sq_rel", "SqRel (m)", True),
    ("delta1", "δ < 1.25", False),
    ("delta2", "δ < 1.25²", False),
    ("delta3", "δ < 1.25³", False),
)


@dataclass(frozen=True, slots=True)
class Table:
    """A table of the report.

    Args:
        caption: What it holds.
        head: Column titles; the first column names the rows.
        rows: Cells, as long as the head.
        note: What to know of it; empty for nothing.
        strong: Which cells to make stand out: (row, column).
        texts: Columns that hold words rather than numbers.
    """

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    strong: frozenset[tuple[int, int]] = frozenset()
    texts: frozenset[int] = frozenset()


def accuracy_tables(metrics: Mapping[str, Any], untrained: frozenset[str]) -> tuple[Table, ...]:
    """The paper's table on the common pixels, and once more on each method's own; with and without control points.

    Args:
        metrics: The object of metrics.json.
        untrained: Methods with random weights.
    """
    without = metrics.get("without_control")
    moved = ", truth moved by the control points" if without else ""
    tables = [*_both(metrics["methods"], untrained, moved)]
    if without:
        tables += _both(without["methods"], untrained, ", truth as it came")
    return tuple(tables)


def _both(methods: Mapping[str, Any], untrained: frozenset[str], what: str) -> Iterator[Table]:
    common = "on the pixels that every method keeps"
    yield _paper_table(methods, "common", f"Depth errors {common}{what}", untrained)
    yield _paper_table(methods, "all", f"Depth errors on the pixels that each method keeps{what}", untrained)


def _paper_table(methods: Mapping[str, Any], which: str, caption: str, untrained: frozenset[str]) -> Table:
    methods = {name: methods[name] for name in in_order(methods)}
    head = ("Metric", *(label(name) + (" (random weights)" if name in untrained else "") for name in methods))
    rows: list[tuple[str, ...]] = []
    strong: set[tuple[int, int]] = set()
    for key, words, less in METRICS:
        values = {name: entry[which][key] for name, entry in methods.items()}
        told = {name: _told(value, key) for name, value in values.items()}
        bounds = {name: ((e.get("interval_95") or {}).get(which) or {}).get(key) for name, e in methods.items()}
        judged = {name: v for name, v in values.items() if v is not None and name not in untrained}
        if len(judged) > 1:
            best = told[(min if less else max)(judged, key=lambda name: judged[name])]
            strong |= {(len(rows), 1 + i) for i, name in enumerate(methods) if name in judged and told[name] == best}
        cells = (told[name] + _bounds(bounds[name], key) for name in methods)
        rows.append((f"{words} {'↓' if less else '↑'}", *cells))
    rows.append(("Pixels", *(number(entry[which]["n"]) for entry in methods.values())))
    if which == "all":
        rows.append(("Kept", *(share(entry["kept_share"]) for entry in methods.values())))
    note = (
        "In brackets: 95 % of the bootstrap over frames. " if any("[" in cell for row in rows for cell in row) else ""
    )
    if untrained & set(methods):
        note += "Columns with random weights show that the network runs; they are compared with nothing."
    return Table(caption, head, tuple(rows), note.strip(), frozenset(strong))


def _told(value: float | None, key: str) -> str:
    return f"{value:.4f}" if value is not None and key.startswith("delta") else number(value)


def _bounds(bounds: Sequence[float] | None, key: str) -> str:
    return f" [{_told(bounds[0], key)}, {_told(bounds[1], key)}]" if bounds else ""


def checkpoint_table(checkpoints: Mapping[str, Any] | None) -> Table | None:
    """Errors at the checkpoints, one row each and the root mean squares."""
    if not checkpoints or not checkpoints["n"]:
        return None
    rows = [
        (one["name"], *(signed(e) for e in one["error_m"]), *(number(s) for s in one["sigma_m"]), number(one["rays"]))
        for one in checkpoints["points"]
    ]
    mean = checkpoints.get("mean_m") or (None, None, None)
    rows.append(("Mean", *(signed(e) for e in mean), "", "", "", ""))
    head = ("Checkpoint", *(f"Error {axis} (m)" for axis in "ENU"), *(f"Sigma {axis} (m)" for axis in "ENU"), "Rays")
    return Table("Errors at the checkpoints", head, tuple(rows), str(checkpoints.get("statement") or ""))


def control_table(control: Mapping[str, Any] | None) -> Table | None:
    """How well the control points meet their pixels before and after the one translation."""
    if not control:
        return None
    rows = [
        (name, number(one["observations"]), number(one["rms_before_px"]), number(one["rms_after_px"]))
        for name, one in control["by_point"].items()
    ]
    rows.append(
        (
            "All",
            number(control["observations"]),
            number(control["rms_before_px"]),
            number(control["rms_after_px"]),
        )
    )
    told = ", ".join(
        f"{axis} {signed(t)} ± {number(s)} m"
        for axis, t, s in zip(("east", "north", "up"), control["translation_m"], control["sigma_m"], strict=True)
    )
    head = ("Control point", "Observations", "RMS before (px)", "RMS after (px)")
    return Table("Control points and the truth", head, tuple(rows), f"The truth was moved by {told}.")


def cloud_table(cloud: Mapping[str, Any] | None) -> Table | None:
    """Accuracy, completeness and F1 of the points at each tolerance."""
    if not cloud:
        return None
    columns = zip(cloud["tolerances_m"], cloud["accuracy"], cloud["completeness"], cloud["f1"], strict=True)
    rows = tuple((f"{t:g} m", share(a), share(c), share(f)) for t, a, c, f in columns)
    note = f"{number(cloud['n_points'])} points against {number(cloud['n_reference'])} of the reference."
    return Table("Points against the reference cloud", ("Tolerance", "Accuracy", "Completeness", "F1"), rows, note)


def m3c2_table(found: Mapping[str, Any] | None) -> Table | None:
    """Distances between the points and the reference along its normals, beside what could be told from zero."""
    if not found:
        return None
    rows = (
        ("Core points (1)", number(found["n"])),
        ("Median distance (m)", signed(found["median_m"])),
        ("Mean distance (m)", signed(found["mean_m"])),
        ("RMS distance (m)", number(found["rms_m"])),
        ("Level of detection at 95 %, median (m)", number(found["lod95_median_m"])),
        ("Within their level of detection", share(found["within_lod_share"])),
    )
    note = "If the covariances are honest and nothing has changed, 95 % lie within their level of detection."
    return Table("Points against the reference, M3C2-EP", ("Measure", "Value"), rows, note)


def frame_table(run: RunData) -> Table | None:
    """Frames that are not used, or used in spite of a problem; and those off the log."""
    told = [
        (row["frame_id"], "yes" if row["usable"] else "no", row["problem"])
        for row in run.frames.select(["frame_id", "usable", "problem"]).to_pylist()
        if row["problem"] or not row["usable"]
    ]
    told += [
        (row["frame_id"], "yes", row["problem"])
        for row in run.poses.select(["frame_id", "problem"]).to_pylist()
        if row["problem"]
    ]
    return Table("Frames with a problem", ("Frame", "Used", "Why"), tuple(told), texts=frozenset({2})) if told else None


def stage_table(records: Mapping[str, Mapping[str, Any]]) -> Table:
    """What each stage did and what it took."""
    rows = tuple(
        (stage, record.get("summary", ""), f"{record['seconds']:.1f}", number(record["peak_memory_mib"]))
        for stage, record in records.items()
    )
    return Table("Stages", ("Stage", "Outcome", "Time (s)", "Peak memory (MiB)"), rows, texts=frozenset({1}))


def configuration_table(records: Mapping[str, Mapping[str, Any]]) -> Table:
    """Every key with its value and where that came from."""
    rows = tuple(
        (f"{stage}.{key}", _plain(entry["value"]), str(entry["from"]))
        for stage, record in records.items()
        for key, entry in record.get("config", {}).items()
    )
    note = "What was set stands out from the defaults."
    strong = frozenset((i, 1) for i, row in enumerate(rows) if row[2] != "default")
    return Table("Configuration", ("Key", "Value", "From"), rows, note, strong, frozenset({1, 2}))


def provenance_table(records: Mapping[str, Mapping[str, Any]]) -> Table:
    """Every output with its digest."""
    rows = tuple(
        (
            name.rstrip("/"),
            f"{stage} {record['version']}",
            number(entry.get("rows")),
            number(entry["bytes"]),
            entry["sha256"],
        )
        for stage, record in records.items()
        for name, entry in record.get("outputs", {}).items()
    )
    return Table(
        "Provenance", ("Output", "Stage and version", "Rows", "Bytes", "SHA-256"), rows, texts=frozenset({1, 4})
    )


def _plain(value: Any) -> str:
    if value is None:
        return MISSING
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return ", ".join(_plain(item) for item in value)
    if isinstance(value, dict):
        return ", ".join(f"{key} {_plain(item)}" for key, item in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)
