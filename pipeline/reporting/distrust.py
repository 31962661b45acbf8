"""What to distrust: plain sentences that follow from a run's numbers, the gravest first.

Each rule is a function from the run and its numbers to sentences; its threshold is a constant beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pipeline.engine.progress import counted
from pipeline.reporting.gathered import RunData
from pipeline.reporting.palette import label
from pipeline.reporting.words import number
from pipeline.reporting.words import share as percent
from pipeline.scoring.checkpoints import REQUIRED

# Ranks.
GRAVE, MIND, KNOW = 3, 2, 1
RANKS = {GRAVE: "Grave", MIND: "Mind", KNOW: "Know"}
# Shares of a Gaussian error within one and two sigmas.
WITHIN = {1: 0.6827, 2: 0.9545}
# How far the observed shares may be off before the sigmas are called wrong.
WITHIN_TOLERANCE = {1: 0.10, 2: 0.05}
# A bin whose error is this many times that of all pixels, and holds this many, is named.
BIN_TIMES, BIN_LEAST = 1.5, 100
# Share of depths masked, of matches without a reference, of pixels outside the common ones that is told.
MASKED_SHARE, UNSEEN_SHARE, UNCOMMON_SHARE = 0.3, 0.3, 0.5
# A shift is told beyond this, and beyond so many of its sigmas.
_SHIFT_M, _SHIFT_SIGMAS = 0.05, 3.0

Numbers = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Doubt:
    """A reason for distrust.

    Args:
        rule: Which rule said it.
        rank: GRAVE, MIND or KNOW.
        text: The sentence.
    """

    rule: str
    rank: int
    text: str

    def as_object(self) -> dict[str, Any]:
        """As report.json has it."""
        return {**asdict(self), "rank": RANKS[self.rank].lower()}


def doubts(run: RunData, numbers: Numbers) -> list[Doubt]:
    """All doubts, the gravest first, those of one rank in the order of the rules.

    Args:
        run: The run.
        numbers: `flown`, `came_out` and `how_good` as report.json has them.
    """
    found = [doubt for rule in RULES for doubt in rule(run, numbers)]
    return sorted(found, key=lambda doubt: -doubt.rank)


def _outdated(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    """Outputs made from other tables than those that lie beside them."""
    del numbers
    made = {
        name.rstrip("/"): entry["sha256"]
        for record in run.records.values()
        for name, entry in record.get("outputs", {}).items()
    }
    for stage, record in run.records.items():
        parts = record.get("parts", {})
        if changed := sorted(name for name in made if parts.get(name, made[name]) not in {made[name], "missing"}):
            told = f"{stage} was made from other {', '.join(changed)} than those in the folder: run {stage} again"
            yield Doubt("outdated", GRAVE, told)


def _nothing_independent(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    good = numbers["how_good"]
    if good is None:
        text = (
            "Nothing independent was compared: no LiDAR, no checkpoints. Every accuracy here is the run's own opinion"
        )
        yield Doubt("nothing independent", GRAVE, text)
    elif run.facts("score").get("lidar") == "the run's own sweeps" or (good["truth"] or {}).get("kind") == "sweeps":
        text = (
            "The LiDAR sweeps of the flight itself were the reference: they are placed with the same logged poses, so "
            "an error of these does not show"
        )
        yield Doubt("nothing independent", MIND, text)


def _sigmas(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    del run
    calibration = (numbers["how_good"] or {}).get("calibration") or {}
    shares = {k: calibration.get(f"within_{k}_sigma") for k in (1, 2)}
    one, two = shares[1], shares[2]
    if one is None or two is None:
        return
    told = (
        f"{percent(one)} of the errors lie within one sigma and {percent(two)} within two, where 68 % and 95 % should"
    )
    if two < WITHIN[2] - WITHIN_TOLERANCE[2]:
        yield Doubt("sigmas", GRAVE, f"The sigmas are too small: {told}")
    elif one < WITHIN[1] - WITHIN_TOLERANCE[1]:
        text = (
            "errors that all frames share (position, boresight) do not average out, so one flight is one draw of them"
        )
        yield Doubt("sigmas", MIND, f"{told}: {text}")
    elif one > WITHIN[1] + WITHIN_TOLERANCE[1]:
        yield Doubt("sigmas", KNOW, f"The sigmas are on the safe side: {told}")


def _checkpoints(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    del run
    if numbers["how_good"] is None:
        return
    checked = numbers["how_good"].get("checkpoints") or {"n": 0}
    if not checked["n"]:
        text = "No checkpoint was measured: LiDAR tells depth along the rays, not whether the map as a whole is shifted"
        yield Doubt("checkpoints", MIND, text)
    elif checked["n"] < REQUIRED:
        text = f"{counted(checked['n'], 'checkpoint')}, where ASPRS asks for {REQUIRED} before an accuracy is stated"
        yield Doubt("checkpoints", MIND, text)


def _shifted(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    """Points are delivered where the poses put them: what control points say is used to score, not to move them."""
    del run
    shift = (numbers["how_good"] or {}).get("shift")
    if not shift:
        return
    far, sigma = math.hypot(*shift["translation_m"]), math.hypot(*shift["sigma_m"])
    if far > max(_SHIFT_SIGMAS * sigma, _SHIFT_M):
        east, north, up = shift["translation_m"]
        text = (
            f"The points lie {number(far)} m off the control points ({east:+.2f} m east, {north:+.2f} m north, "
            f"{up:+.2f} m up); depths were scored with this taken out, the points are delivered with it: "
            "refine.control_points moves them"
        )
        yield Doubt("shifted", MIND, text)


def _left_out(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    del numbers
    left = ((run.metrics or {}).get("control_points") or {}).get("left_out") or {}
    for name, why in list(left.items())[:1]:
        text = f"{counted(len(left), 'row')} of the control points left out by score, {name} among them: {why}"
        yield Doubt("control points", KNOW, text)


def _refinement(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    mode, facts = run.setting("refine", "mode"), run.facts("refine")
    if mode == "none":
        residual = facts.get("median_epipolar_residual_px")
        told = "" if residual is None else f"; the matches miss their epipolar lines by {residual:.2f} px"
        yield Doubt("refinement", MIND, f"Poses are used as logged{told}: refine.mode = flight corrects them")
    reasons = {**facts.get("pairs_not_refined", {}), **facts.get("pairs_set_aside", {})}
    selected = numbers["came_out"]["pairs"]["selected"]
    for why, n in sorted(reasons.items(), key=lambda item: -item[1]):
        rank = MIND if n > 0.1 * selected else KNOW
        yield Doubt("pairs as logged", rank, f"{counted(n, 'pair')} of {selected} not refined: {why}")


def _warnings(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    """What stages told while they ran; what comes of poses before what comes of sources."""
    del numbers
    for stage in ("score", "sensitivity", "fuse", "depth", "refine", "match", "pair", "ingest"):
        for text in run.records.get(stage, {}).get("warnings", []):
            yield Doubt(f"warning of {stage}", MIND, text[:1].upper() + text[1:])


def _problems(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    """Frames that are used in spite of a problem, and those that are not used."""
    flown = numbers["flown"]
    if lost := flown["frames"] - flown["usable"]:
        yield Doubt(
            "frames", KNOW, f"{lost} of {counted(flown['frames'], 'frame')} not usable: the table of frames says why"
        )
    told = [
        (row["frame_id"], row["problem"])
        for row in run.frames.select(["frame_id", "usable", "problem"]).to_pylist()
        if row["usable"] and row["problem"]
    ]
    if told:
        text = f"{counted(len(told), 'frame')} used in spite of a problem, {told[0][0]} among them: {told[0][1]}"
        yield Doubt("frames", MIND, text)


def _failed(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    del numbers
    for stage, record in run.records.items():
        items = record.get("items") or {}
        if stage != "ingest" and items.get("failed"):
            yield Doubt("failed items", MIND, f"{items['failed']} of {items['total']} items of {stage} failed")


def _masked(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    del run
    came = numbers["came_out"]
    depths = came["depths"].get(came["published_method"])
    if not depths or not depths["n"]:
        return
    share = (depths["n"] - depths["kept"]) / depths["n"]
    if share > MASKED_SHARE:
        why, n = max(depths["masked_by_reason"].items(), key=lambda item: item[1])
        rank = MIND if share > 2 * MASKED_SHARE else KNOW
        yield Doubt("masked", rank, f"{percent(share)} of the depths are masked, most ({n:,}) because: {why}")


def _bins(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    """Where errors are worst, by range and by parallax."""
    good = numbers["how_good"]
    entry = ((run.metrics or {}).get("methods") or {}).get(good and good["published"])
    if not entry or entry["all"]["abs_rel"] is None:
        return
    whole = entry["all"]["abs_rel"]
    for key, unit, what in (("by_range", "m", "range"), ("by_parallax", "deg", "parallax")):
        full = [b for b in entry.get(key) or [] if b["all"]["n"] >= BIN_LEAST]
        if full and (worst := max(full, key=lambda b: b["all"]["abs_rel"]))["all"]["abs_rel"] > BIN_TIMES * whole:
            found = worst["all"]["abs_rel"]
            times = f"AbsRel {found:.3g}, {found / whole:.1f} times that of all pixels"
            yield Doubt(f"by {what}", MIND, f"Worst at a {what} {_span(worst, unit)}: {times}")


def _span(found: Mapping[str, Any], unit: str) -> str:
    if found["to"] is None:
        return f"above {found['from']:g} {unit}"
    return f"of {found['from']:g} to {found['to']:g} {unit}"


def _few_common(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    """Comparisons that rest on a part of the pixels."""
    del run
    good = numbers["how_good"]
    if good is None:
        return
    methods = [m for m in good["methods"] if not m["untrained"]]
    published = next((m for m in methods if m["method"] == good["published"]), None)
    if len(methods) > 1 and published and published["n_common"] < (1.0 - UNCOMMON_SHARE) * published["n_own"]:
        fewest = min(methods, key=lambda m: m["kept_share"] or 0.0)
        text = (
            f"Methods are compared on the {published['n_common']:,} pixels that all of them keep, of "
            f"{published['n_own']:,}: {label(fewest['method'])} masks most; read each method's own pixels beside them"
        )
        yield Doubt("common pixels", MIND, text)


def _coverage(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    truth = (run.metrics or {}).get("truth") or {}
    facts = run.facts("score")
    matches = truth.get("n_matches", facts.get("matches"))
    met = truth.get("n_with_reference", facts.get("matches_with_reference"))
    if numbers["how_good"] is None or not matches or met is None:
        return
    if (unseen := 1.0 - met / matches) > UNSEEN_SHARE:
        text = f"{percent(unseen)} of the matches have no reference (out of range, hidden or off the LiDAR)"
        yield Doubt("coverage", KNOW, text)


def _datum(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    """What was stated or assumed about heights rather than read."""
    facts = run.facts("ingest")
    datum, why = facts.get("height_datum"), facts.get("height_datum_why")
    if run.is_local:
        return
    if datum in {"takeoff", "local", "unknown"}:
        yield Doubt("datum", MIND, f"Heights are from {datum} ({why}): they tie to no national height system")
    elif why == "stated by the user":
        yield Doubt(
            "datum", KNOW, f"That logged heights are {datum} was stated by the user; nothing in the files says so"
        )
    geoid = run.setting("ingest", "geoid")
    if isinstance(geoid, int | float):
        yield Doubt("geoid", KNOW, f"The geoid is one number for the whole flight, {geoid:g} m, as stated")
    if "assumed_above_ground_m" in run.facts("pair"):
        height = run.facts("pair")["assumed_above_ground_m"]
        yield Doubt(
            "height above ground", KNOW, f"Pairs were chosen for an assumed height above ground of {height:g} m"
        )
    del numbers


def _lens(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    del run
    for camera in numbers["flown"]["cameras"]:
        if camera["source"].startswith("EXIF"):
            text = f"{camera['camera_id']}: focal length from {camera['source']}, distortion unknown"
            yield Doubt("camera", MIND, text)
    yield Doubt(
        "lens",
        KNOW,
        "Errors of the lens calibration are in no sigma: they bend the ground smoothly and look like nothing else",
    )


def _random(run: RunData, numbers: Numbers) -> Iterator[Doubt]:
    del run
    for method in (numbers["how_good"] or {}).get("methods", []):
        if method["untrained"]:
            yield Doubt(
                "random weights",
                KNOW,
                f"{label(method['method'])} ran with random weights: its column says nothing of that method",
            )


RULES: Sequence[Callable[[RunData, Numbers], Iterator[Doubt]]] = (
    _outdated,
    _nothing_independent,
    _sigmas,
    _warnings,
    _refinement,
    _problems,
    _failed,
    _bins,
    _few_common,
    _checkpoints,
    _shifted,
    _masked,
    _coverage,
    _datum,
    _lens,
    _left_out,
    _random,
)
