"""The README's results, from runs: python docs/results.py README NAME=RUN...

Each RUN's `scores/metrics.json` becomes a table in the layout of the paper's two (metrics as rows, methods as columns)
on the pixels that all methods keep; together they replace what stands between the README's two marks.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

BEGIN, END = "<!-- results: written by `make results` -->", "<!-- end of results -->"
# As the paper calls them, in its order; the fixed views stand beside where a run has them.
COLUMNS = {
    "epitransfer": "EpiTransfer (adaptive)",
    "epitransfer-lateral": "fixed lateral view",
    "epitransfer-vertical": "fixed vertical view",
    "dlt": "Triangulation (DLT)",
    "zoedepth": "ZoeDepth",
    "depth-anything-v2": "Depth Anything V2",
}
ROWS = {
    "abs_rel": "AbsRel ↓",
    "rmse": "RMSE (m) ↓",
    "rmse_log": "RMSE log ↓",
    "mae": "MAE (m) ↓",
    "sq_rel": "SqRel (m) ↓",
    "delta1": "δ < 1.25 ↑",
    "delta2": "δ < 1.25² ↑",
    "delta3": "δ < 1.25³ ↑",
}


def main(readme: Path, runs: dict[str, Path]) -> None:
    """Writes the tables into the README."""
    text = readme.read_text(encoding="utf-8")
    head, rest = text.split(BEGIN)
    _, tail = rest.split(END)
    parts = [table(name, run) for name, run in runs.items()]
    readme.write_text(head + BEGIN + "\n\n" + "\n\n".join(parts) + "\n\n" + END + tail, encoding="utf-8")
    print(readme)


def table(name: str, run: Path) -> str:
    """One run's table, with what it rests on."""
    metrics = json.loads((run / "scores" / "metrics.json").read_text(encoding="utf-8"))
    facts = json.loads((run / "manifest.json").read_text(encoding="utf-8"))["stages"]["score"]["facts"]
    untrained = {method for method, told in facts.get("baselines", {}).items() if told["untrained"]}
    # Networks with random weights prove a path and are no result.
    methods = [method for method in COLUMNS if method in metrics["methods"] and method not in untrained]
    common = {method: metrics["methods"][method]["common"] for method in methods}
    n = common[methods[0]]["n"]
    lines = [
        f"| {name}, {n:,} pixels | " + " | ".join(COLUMNS[method] for method in methods) + " |",
        "|---" * (len(methods) + 1) + "|",
        *(f"| {said} | " + " | ".join(_cell(common[method][key]) for method in methods) + " |"
          for key, said in ROWS.items()),
        "| pixels kept | " + " | ".join(f"{metrics['methods'][method]['kept_share']:.1%}" for method in methods) + " |",
    ]  # fmt: skip
    return "\n".join([*lines, "", _said(metrics, common[methods[0]])])


def _cell(value: float) -> str:
    return f"{value:.4f}" if value < 10.0 else f"{value:.2f}"


def _said(metrics: dict[str, Any], published: dict[str, Any]) -> str:
    low, high = (metrics["methods"]["epitransfer"]["interval_95"]["common"] or {}).get("abs_rel") or (None, None)
    said = [f"AbsRel {published['abs_rel']:.4f}" + ("" if low is None else f", 95 % interval {low:.4f} to {high:.4f}")]
    control = metrics["control_points"]
    if control is not None:
        without = metrics["without_control"]["methods"]["epitransfer"]["common"]["abs_rel"]
        said.append(
            f"control points before and after their one translation {control['rms_before_px']:.1f} and "
            f"{control['rms_after_px']:.2f} px RMS; without it AbsRel {without:.4f}"
        )
        plain = metrics["without_control"]["checkpoints"]
        if plain is not None:
            said.append(
                f"as delivered RMSE_H {plain['rmse_h_m']:.2f}, RMSE_V {plain['rmse_v_m']:.2f} m at "
                f"{plain['n']} checkpoints (30 asked for)"
            )
    calibration = metrics["calibration"]
    said.append(
        f"{calibration['within_1_sigma']:.0%} of errors within one predicted sigma, "
        f"{calibration['within_2_sigma']:.0%} within two"
    )
    return "; ".join(said) + "."


if __name__ == "__main__":
    if len(sys.argv) < 3 or not all("=" in given for given in sys.argv[2:]):
        sys.exit(__doc__)
    main(Path(sys.argv[1]), {name: Path(run) for name, run in (given.split("=", 1) for given in sys.argv[2:])})
