"""Curves of relative error against injected error, per take, and what they say in a line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.geometry.arrays import Bools, Singles
from pipeline.sensitivity.injected import NOTHING, UNITS, Injection
from pipeline.sensitivity.pair_errors import REFINED, PairErrors
from pipeline.sensitivity.references import LIDAR

# Beside the run's own depths there is no error to double.
_OWN_THRESHOLD = 0.05

Row = dict[str, Any]


def curve_rows(
    take: str,
    pairs: Sequence[PairErrors],
    values: Mapping[str, Sequence[float]],
    cases: Sequence[Injection],
    methods: Sequence[str],
) -> Iterator[Row]:
    """The rows of a take's curves, as in the table `curves`.

    Args:
        take: Its name.
        pairs: The errors of its pairs.
        values: Injected errors by kind.
        cases: Those the pairs were tried with.
        methods: In the pairs' order.
    """
    case_of = {case: c for c, case in enumerate(cases)}
    relative = np.concatenate([pair.relative for pair in pairs], axis=-1)
    kept = np.concatenate([pair.kept for pair in pairs], axis=-1)
    inside = np.stack([pair.epipole_inside for pair in pairs])
    for kind, some in values.items():
        for value in some:
            c = case_of[Injection(kind, value) if value else NOTHING]
            for m, method in enumerate(methods):
                for r, refined in enumerate(REFINED):
                    yield {
                        "take": take,
                        "kind": kind,
                        "unit": UNITS[kind],
                        "injected": value,
                        "method": method,
                        "refined": refined,
                        **_means(relative[c, r, m], kept[c, r, m]),
                        "epipole_inside_share": float(inside[:, c].mean()),
                        "marked": bool(inside[:, c].any()),
                        "n_pairs": len(pairs),
                    }


def _means(relative: Singles, kept: Bools) -> Row:
    counted = np.isfinite(relative)
    some = relative[counted].astype(np.float64)
    n = len(some)
    return {
        "n": n,
        "abs_rel": float(some.mean()) if n else None,
        "median_rel": float(np.median(some)) if n else None,
        "kept_share": float(kept[counted].mean()) if n else None,
    }


def withstood(rows: Sequence[Row], method: str, reference: str) -> dict[str, Any]:
    """At which error of each kind the flight's AbsRel is twice that of no error; 0.05 beside the run's own depths.

    Args:
        rows: Of all takes.
        method: The published one.
        reference: What the depths are compared with.

    Returns:
        `abs_rel` of no error, `threshold`, and `by_kind`: `unit`, the `largest` error tried, and `injected` and
        `refined`, each the smaller of both sides, linear between the errors tried; null where none of these is enough.
    """
    own = [row for row in rows if row["method"] == method and row["n"]]
    kinds = list(dict.fromkeys(row["kind"] for row in own))
    curves = {(kind, refined): _whole(own, kind, refined) for kind in kinds for refined in REFINED}
    zero = curves[kinds[0], False][0.0]
    threshold = 2.0 * zero if reference == LIDAR else _OWN_THRESHOLD
    return {
        "abs_rel": zero,
        "threshold": threshold,
        "by_kind": {
            kind: {
                "unit": UNITS[kind],
                "largest": max(curves[kind, False]),
                "injected": _reached(curves[kind, False], threshold),
                "refined": _reached(curves[kind, True], threshold),
            }
            for kind in kinds
        },
    }


def _whole(rows: Sequence[Row], kind: str, refined: bool) -> dict[float, float]:
    """AbsRel of all takes together, by injected error."""
    sums: dict[float, tuple[float, int]] = {}
    for row in rows:
        if (row["kind"], row["refined"]) == (kind, refined):
            total, n = sums.get(row["injected"], (0.0, 0))
            sums[row["injected"]] = total + row["abs_rel"] * row["n"], n + row["n"]
    return {value: total / n for value, (total, n) in sums.items()}


def _reached(curve: Mapping[float, float], threshold: float) -> float | None:
    """The least error, to either side, at which a curve is above a threshold."""
    found = []
    for side in (1.0, -1.0):
        tried = sorted(value * side for value in curve if value * side >= 0.0)
        for near, far in pairwise(tried):
            low, high = curve[near * side], curve[far * side]
            if high >= threshold:
                found.append(near if low >= threshold else near + (far - near) * (threshold - low) / (high - low))
                break
    return min(found, default=None)


def sentence(method: str, found: Mapping[str, Any]) -> str:
    """What is withstood, in a line for people."""
    parts = [
        f"{kind.replace('_', ' ')} {_told(entry, 'injected')} (refined {_told(entry, 'refined')})"
        for kind, entry in found["by_kind"].items()
    ]
    return f"AbsRel {method} {found['abs_rel']:.4f} becomes {found['threshold']:.4f} by " + ", ".join(parts)


def _told(entry: Mapping[str, Any], which: str) -> str:
    value = entry[which]
    return f"over {entry['largest']:g} {entry['unit']}" if value is None else f"{value:.2g} {entry['unit']}"
