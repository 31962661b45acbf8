"""What refinement found, as facts for the manifest and as a line for people."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.engine.progress import counted
from pipeline.refinement.flight.flight import Found, RefinedFlight
from pipeline.refinement.rows import FLIGHT, NONE, RefinedPair
from pipeline.refinement.surveyed import control_facts

# An unknown of which the images leave less than half of what the log left open is worth a word.
_TOLD = 0.5
_WORDS = {
    "boresight_yaw_rad": ("boresight yaw", "deg"),
    "boresight_pitch_rad": ("boresight pitch", "deg"),
    "boresight_roll_rad": ("boresight roll", "deg"),
    "clock_s": ("clock", "s"),
    "lever_forward_m": ("lever arm forward", "m"),
    "lever_right_m": ("lever arm right", "m"),
    "lever_down_m": ("lever arm down", "m"),
    "focal": ("focal length, share", "1"),
    "k1": ("k1", "1"),
    "k2": ("k2", "1"),
}


def facts_of(pairs: Sequence[RefinedPair], flight: RefinedFlight | None) -> dict[str, Any]:
    """Figures for the manifest.

    Args:
        pairs: Every pair.
        flight: The flight, where it was refined as a whole.
    """
    seen = [pair for pair in pairs if pair.before.n]
    reasons = Counter(pair.problem for pair in pairs if pair.mode == NONE and pair.problem)
    out: dict[str, Any] = {
        "median_epipolar_residual_px": _median([pair.before.median_px for pair in seen]),
        "median_epipolar_residual_after_px": _median([pair.after.median_px for pair in seen]),
        "share_of_pairs_refined": round(sum(pair.mode != NONE for pair in seen) / max(len(pairs), 1), 4),
        "pairs_not_refined": dict(sorted(reasons.items())),
    }
    if flight is not None:
        out["shared_errors"] = dict(_named(flight.found))
        out["lens_as_given"] = list(flight.lens_as_given)
        out["parts"] = flight.parts
        out["settled"] = flight.settled
        out["frames_refined"] = sum(frame.refined for frame in flight.frames.values())
        out["frames_as_logged"] = [name for name, frame in flight.frames.items() if not frame.refined]
        out["pairs_set_aside"] = dict(sorted(Counter(flight.set_aside.values()).items()))
        out["frames_off_the_log"] = {name: frame.problem for name, frame in flight.frames.items() if frame.problem}
        out["information_divided_by"] = round(flight.scatter, 3)
        if flight.control:
            out["control_points"] = control_facts(flight.control)
    return out


def sentence(pairs: str, mode: str, facts: Mapping[str, Any]) -> str:
    """The line for people.

    Args:
        pairs: How many, in words.
        mode: The configured one.
        facts: As `facts_of` has them.
    """
    before, after = facts["median_epipolar_residual_px"], facts["median_epipolar_residual_after_px"]
    if before is None:
        return f"{pairs}, none with a match that agrees with its pose"
    if mode == NONE:
        return f"{pairs}, median epipolar residual under the logged poses {before:.2f} px"
    said = f"{pairs}, median epipolar residual {before:.2f} px as logged, {after:.2f} px refined"
    if control := facts.get("control_points"):
        said += f"; control points {_px(control['rms_before_px'])} as logged, {_px(control['rms_after_px'])} refined"
    if mode != FLIGHT:
        return f"{said} ({facts['share_of_pairs_refined']:.0%} of the pairs; the others stay as logged)"
    told = [
        f"{name} {f['correction']:+.3g} ± {f['sigma']:.2g} {f['unit']}"
        for name, f in facts["shared_errors"].items()
        if f["sigma"] < _TOLD * f["prior_sigma"]
    ]
    return f"{said}; corrects {', '.join(told)}" if told else said


def warnings_of(facts: Mapping[str, Any]) -> list[str]:
    """What to distrust of a refined flight.

    Args:
        facts: As `facts_of` has them.
    """
    told = []
    if not facts.get("settled", True):
        told.append(
            "the flight's poses still moved by more than a hundredth of a sigma when the steps were used up: hold them "
            "against --set refine.mode=pair before you rely on them"
        )
    if facts.get("parts", 0) > 1:
        told.append(
            f"the flight falls into {facts['parts']} parts that no pair ties together, so they may lie as far from one "
            "another as the log is off; a larger pair.baseline_m or a smaller pair.min_overlap lets more pairs in"
        )
    if left := facts.get("frames_as_logged"):
        told.append(f"{counted(len(left), 'frame')} held by no match, {left[0]} among them: as logged")
    if off := facts.get("frames_off_the_log"):
        name, why = next(iter(off.items()))
        told.append(f"{counted(len(off), 'frame')} off the log, {name} among them: {why}")
    if lens := facts.get("lens_as_given"):
        told.append(f"of the lens {', '.join(lens)} stay as given: the images do not determine them, or not credibly")
    return told


def _named(found: Sequence[Found]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Figures by names for people; where several cameras have a parameter each, they are counted."""
    seen: Counter[str] = Counter()
    for one in found:
        seen[one.name] += 1
        words = _WORDS[one.name][0]
        yield (words if seen[one.name] == 1 else f"{words}, camera {seen[one.name]}"), _figures(one)


def _px(rms: float | None) -> str:
    return "out of sight" if rms is None else f"{rms:.2f} px"


def _figures(found: Found) -> dict[str, Any]:
    unit = _WORDS[found.name][1]
    scale = np.degrees(1.0) if unit == "deg" else 1.0
    values = {"correction": found.value, "sigma": found.sigma, "prior_sigma": found.prior_sigma}
    return {"unit": unit, **{name: float(f"{value * scale:.6g}") for name, value in values.items()}}


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(float(np.median(known)), 4) if known else None
