"""The minute: a run's numbers as a headline and four short lists of plain sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.engine.progress import counted
from pipeline.reporting.distrust import RANKS, WITHIN
from pipeline.reporting.palette import label
from pipeline.reporting.words import MISSING, interval, number, share
from pipeline.scoring.checkpoints import REQUIRED

Numbers = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Card:
    """A number of the headline strip.

    Args:
        value: With its unit.
        what: What it is.
        detail: In small letters.
    """

    value: str
    what: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a list: a name and what is said under it; of doubts the name is the rank."""

    name: str
    text: str


def headline(numbers: Numbers) -> list[Card]:
    """The five numbers to look at first."""
    flown, came, good = numbers["flown"], numbers["came_out"], numbers["how_good"]
    points = came["points"]
    cards = [
        Card(f"{flown['usable']} / {flown['frames']}", "frames used", f"{_area(points['area_m2'])} covered"),
        Card(
            number(points["n"]),
            "points",
            f"{number(points['per_m2'], 2)} per m², sigma height {_m(points['sigma_z_m'])}",
        ),
    ]
    if good is None:
        return [*cards, Card("not compared", "accuracy", "no independent reference")]
    own = _published(good)
    cards.append(
        Card(
            _percent(own["abs_rel_own"]),
            "mean relative depth error",
            f"RMSE {number(own['rmse_own_m'])} m · {number(own['n_own'])} pixels",
        )
    )
    checked, at_map = good.get("checkpoints"), good.get("map")
    if checked and checked["n"]:
        detail = f"vertical {number(checked['rmse_v_m'])} m · {checked['n']} of {REQUIRED} checkpoints"
        cards.append(Card(f"{number(checked['rmse_h_m'])} m", "RMSE horizontal", detail))
    elif at_map and at_map["rmse_z_m"] is not None:
        detail = f"horizontal {number(at_map['rmse_h_m'])} m · against the reference along the rays"
        cards.append(Card(f"{number(at_map['rmse_z_m'])} m", "RMSE height on the map", detail))
    one = good["calibration"]["within_1_sigma"]
    two = good["calibration"]["within_2_sigma"]
    cards.append(
        Card(share(one), "of errors within one sigma", f"68 % expected; within two {share(two)}, 95 % expected")
    )
    return cards


def _percent(value: float | None) -> str:
    """A small share, with its significant digits."""
    return MISSING if value is None else f"{number(100.0 * value, 2)} %"


def flown_lines(numbers: Numbers) -> Iterator[Line]:
    """What was flown."""
    flown = numbers["flown"]
    yield Line(
        "Frames", f"{flown['usable']} of {flown['frames']} used" + (f", {flown['date']}" if flown["date"] else "")
    )
    if flown["distance_m"] is not None:
        yield Line("Flight", f"{number(flown['distance_m'])} m of path in {_duration(flown['duration_s'])}")
    above, gsd, reach = flown["above_ground_m"], flown["gsd_m"], flown["range_m"]
    if above["median"] is not None:
        yield Line("Height above what it saw", f"{number(above['median'])} m ({_from_to(above)} m)")
    if gsd["median"] is not None:
        text = f"{number(100.0 * gsd['median'])} cm per pixel at {number(reach['median'])} m, the median range"
        yield Line("Ground sampling", text)
    for camera in flown["cameras"]:
        size = f"{camera['width']} x {camera['height']}, {camera['model']}, f = {camera['fx']:.0f} px"
        yield Line("Camera", f"{camera['camera_id']}: {size}; from {camera['source']}")
    sources = "; ".join(f"{one['value']} ({one['n']})" for one in flown["pose_sources"][:3])
    yield Line("Poses from", sources or MISSING)
    if flown["crs"]:
        yield Line("Delivered in", flown["crs"])
    if flown["height_datum"]:
        yield Line("Heights", f"logged as {flown['height_datum']} ({flown['height_datum_why']})")


def out_lines(numbers: Numbers) -> Iterator[Line]:
    """What came out."""
    came = numbers["came_out"]
    pairs, points = came["pairs"], came["points"]
    yield Line("Pairs", f"{pairs['selected']} selected, {pairs['rejected']} rejected, each with its rule")
    yield Line("Matches", f"{came['inliers']:,} of {came['matches']:,} agree with the geometry")
    residual = came["epipolar_residual_px"]
    if residual["as_logged"] is not None:
        used = "" if residual["used"] is None else f", {residual['used']:.2f} px with the poses used"
        yield Line("Epipolar residual", f"{residual['as_logged']:.2f} px as logged{used} (median of the pairs)")
    depths = came["depths"].get(came["published_method"])
    if depths:
        kept = share(depths["kept"] / depths["n"] if depths["n"] else None)
        yield Line("Depths", f"{depths['kept']:,} of {depths['n']:,} kept ({kept}), {label(came['published_method'])}")
    yield Line("Points", f"{points['n']:,} over {_area(points['area_m2'])}, {number(points['per_m2'], 2)} per m²")
    wide = f"95 % of the points below {_m(points['sigma_h_m'], 'p95')} and {_m(points['sigma_z_m'], 'p95')}"
    yield Line("Sigma", f"{_m(points['sigma_h_m'])} in the plane, {_m(points['sigma_z_m'])} in height (median); {wide}")


def good_lines(numbers: Numbers) -> Iterator[Line]:
    """How good it is, and beside whom."""
    good = numbers["how_good"]
    if good is None:
        yield Line("Not known", "Nothing independent was compared; the sigmas above are the run's own prediction.")
        return
    yield from _truth_line(good)
    for method in good["methods"]:
        if not method["untrained"]:
            text = (
                f"AbsRel {number(method['abs_rel'])}{interval(method['abs_rel_95'])}, RMSE {number(method['rmse_m'])} m"
            )
            yield Line(label(method["method"]), f"{text}{interval(method['rmse_m_95'])}")
    yield from _shift_line(good)
    yield from _comparison(good)
    if (at := good.get("map")) and at["rmse_z_m"] is not None:
        whole = f", {number(at['rmse_3d_m'])} m in space" if at.get("rmse_3d_m") is not None else ""
        yield Line(
            "On the map", f"RMSE {number(at['rmse_h_m'])} m in the plane, {number(at['rmse_z_m'])} m in height{whole}"
        )
    checked = good.get("checkpoints")
    if checked and checked["n"]:
        short = f"; {checked['shortfall']} short of {checked['required']}" if checked["shortfall"] else ""
        yield Line("Checkpoints", f"{_rmse(checked)} at {checked['n']}, as delivered{short}")
    else:
        yield Line("Checkpoints", f"none of the {REQUIRED} that ASPRS asks for")
    shares = good["calibration"]
    if shares["within_1_sigma"] is not None:
        told = f"{share(shares['within_1_sigma'])} within one sigma, {share(shares['within_2_sigma'])} within two"
        yield Line("Sigmas", f"{told} ({share(WITHIN[1])} and {share(WITHIN[2])} expected)")


def _rmse(checked: Mapping[str, Any]) -> str:
    rmse = " / ".join(number(checked[name]) for name in ("rmse_h_m", "rmse_v_m", "rmse_3d_m"))
    return f"RMSE horizontal / vertical / 3D {rmse} m"


def _shift_line(good: Mapping[str, Any]) -> Iterator[Line]:
    """What the depths' figures owe to control points."""
    shift = good.get("shift")
    if not shift:
        return
    text = f"the truth was moved by {number(math.hypot(*shift['translation_m']))} m before depths were compared"
    if shift["abs_rel_without"] is not None:
        text += f"; without it AbsRel {number(shift['abs_rel_without'])}"
    if (checked := shift["checkpoints"]) and checked["n"]:
        text += f"; with it checkpoints have {_rmse(checked)}, each by the others"
    yield Line("Control points", text)


def _truth_line(good: Mapping[str, Any]) -> Iterator[Line]:
    truth = good["truth"]
    if truth:
        met = f"{number(truth['n_with_reference'])} of {number(truth['n_matches'])} matches with a reference"
        kind = {"tiles": "LiDAR tiles", "sweeps": "the flight's own LiDAR sweeps"}.get(truth["kind"], truth["kind"])
        yield Line("Against", f"{kind} up to {truth['max_range_m']:g} m, {truth['correspondence']}; {met}")


def _comparison(good: Mapping[str, Any]) -> Iterator[Line]:
    """Whether the intervals tell the published method from the next best."""
    own = _published(good)
    others = [m for m in good["methods"] if m is not own and not m["untrained"] and m["abs_rel"] is not None]
    if own["abs_rel"] is None or not others:
        return
    rival = min(others, key=lambda m: m["abs_rel"])
    mine, theirs = own["abs_rel_95"], rival["abs_rel_95"]
    if not mine or not theirs or (mine[0] <= theirs[1] and theirs[0] <= mine[1]):
        verdict = (
            "not told apart by the frames of this flight" if mine and theirs else "no intervals to tell them apart"
        )
    else:
        verdict = "better" if own["abs_rel"] < rival["abs_rel"] else "worse"
    said = f"{label(own['method'])} beside {label(rival['method'])}: {verdict}"
    yield Line("Compared", f"{said} ({number(own['n_common'])} common pixels)")


def doubt_lines(numbers: Numbers) -> list[Line]:
    """What to distrust, the gravest first."""
    words = {name.lower(): name for name in RANKS.values()}
    return [Line(words[doubt["rank"]], doubt["text"]) for doubt in numbers["distrust"]]


def _published(good: Mapping[str, Any]) -> Mapping[str, Any]:
    methods: Sequence[Mapping[str, Any]] = good["methods"]
    return next((m for m in methods if m["method"] == good["published"]), methods[0])


def _m(values: Mapping[str, float | None], which: str = "median") -> str:
    value = values[which]
    return MISSING if value is None else f"{number(value)} m"


def _from_to(values: Mapping[str, float | None]) -> str:
    return f"{number(values['p05'])} to {number(values['p95'])}"


def _area(area_m2: float) -> str:
    return f"{number(area_m2 / 1e4, 2)} ha" if area_m2 >= 1000.0 else f"{number(area_m2)} m²"


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{number(seconds)} s"
    minutes = seconds / 60.0
    return counted(round(minutes), "minute")
