"""The report: its numbers, its doubts and their thresholds, and a page that needs nothing else."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flights import copied, epitransfer
from hypothesis import given
from hypothesis import strategies as st

from pipeline.engine.runfolder import RunFolder
from pipeline.engine.runner import staleness
from pipeline.reporting.accuracy_plots import figures as accuracy_figures
from pipeline.reporting.calibration_plot import figures as calibration_figures
from pipeline.reporting.counts import rule_of
from pipeline.reporting.distrust import BIN_TIMES, MASKED_SHARE, doubts
from pipeline.reporting.figure import Figure, axis_titles
from pipeline.reporting.gathered import RunData
from pipeline.reporting.numbers import numbers
from pipeline.reporting.page import Section, figure_json, page, sections
from pipeline.reporting.quantiles import Spread
from pipeline.reporting.sensitivity_plots import figures as sensitivity_figures
from pipeline.reporting.tables import (
    accuracy_tables,
    checkpoint_table,
    cloud_table,
    control_table,
    m3c2_table,
)
from pipeline.reporting.verdict import good_lines, headline
from pipeline.reporting.words import number
from pipeline.scoring.checkpoints import REQUIRED
from stages.registry import STAGES
from stages.workflow import kept_configuration

HOSTILE = "</script><script>alert('x')</script><img src=http://evil.example/x onerror=alert(1)>"
PAGE_SCRIPTS = 2


def errors(n: int = 1000, abs_rel: float = 0.02, delta: float = 0.99) -> dict[str, Any]:
    """What metrics.json says of some pixels."""
    return {
        "n": n, "abs_rel": abs_rel, "sq_rel": abs_rel**2, "rmse": 50 * abs_rel, "rmse_log": abs_rel,
        "mae": 40 * abs_rel, "delta1": delta, "delta2": 1.0, "delta3": 1.0,
    }  # fmt: skip


def method(abs_rel: float = 0.02, n_common: int = 1000, n_own: int = 1000) -> dict[str, Any]:
    """What metrics.json says of a method."""
    about = {"abs_rel": [0.9 * abs_rel, 1.1 * abs_rel], "rmse": [45 * abs_rel, 55 * abs_rel]}
    bins = [
        {"from": 0.0, "to": 30.0, "all": errors(500, abs_rel), "common": errors(500, abs_rel)},
        {"from": 30.0, "to": None, "all": errors(500, abs_rel), "common": errors(500, abs_rel)},
    ]
    one = {"frame_id": "A", "n_scored": n_own, "all": errors(n_own, abs_rel), "common": errors(n_common, abs_rel)}
    return {
        "all": errors(n_own, abs_rel), "common": errors(n_common, abs_rel), "kept_share": 0.9,
        "interval_95": {"all": about, "common": about}, "by_range": bins, "by_parallax": bins,
        "coverage": {"image_share": 0.4},
        "per_frame": [{**one, "kept_share": 0.9, "interval_95": {"all": about, "common": about}}],
    }  # fmt: skip


def metrics() -> dict[str, Any]:
    """A whole metrics.json, all of its parts there."""
    methods = {"dlt": method(0.03), "epitransfer": method(0.02), "zoedepth": method(0.001)}
    curve = [{"nominal": p, "observed": p} for p in (0.1, 0.5, 0.9)]
    bins = [{"from": 0.0, "to": 0.01, "n": 500, "predicted": 0.005, "observed": 0.006}]
    calibration = {"n": 1000, "within_1_sigma": 0.68, "within_2_sigma": 0.95}
    points = [{"name": "C1", "error_m": [0.01, -0.02, 0.03], "sigma_m": [0.1, 0.1, 0.2], "rays": 5}]
    return {
        "methods": methods,
        "calibration": {
            "method": "epitransfer", **calibration, "without_pose": {**calibration, "curve": curve}, "curve": curve,
            "by_sigma": bins,
        },
        "map": {"method": "epitransfer", "n": 1000, "rmse_z_m": 0.1, "rmse_h_m": 0.2, "rmse_3d_m": 0.22},
        "control_points": {
            "points": 4, "observations": 20, "rms_before_px": 12.0, "rms_after_px": 1.5,
            "translation_m": [0.1, -0.2, 0.3], "sigma_m": [0.01, 0.01, 0.02],
            "by_point": {"G1": {"observations": 5, "rms_before_px": 12.0, "rms_after_px": 1.5}},
            "left_out": {"row 7": "no such image"},
        },
        "checkpoints": {
            "n": 40, "required": 30, "shortfall": 0, "rmse_h_m": 0.02, "rmse_v_m": 0.03, "rmse_3d_m": 0.036,
            "mean_m": [0.01, -0.02, 0.03], "statement": "Tested to 0.03 m.", "points": points,
        },
        "cloud": {
            "tolerances_m": [0.1, 0.2], "accuracy": [0.5, 0.8], "completeness": [0.3, 0.6], "f1": [0.375, 0.69],
            "n_points": 1000, "n_reference": 5000,
        },
        "m3c2_ep": {
            "n": 100, "median_m": -0.01, "mean_m": 0.0, "rms_m": 0.05, "lod95_median_m": 0.1, "significant_share": 0.05,
            "within_lod_share": 0.95, "radius_m": 0.5, "normals": "reference",
        },
        "without_control": {"methods": methods, "calibration": None, "map": None, "cloud": None},
        "truth": {
            "kind": "tiles", "correspondence": "sparse", "max_range_m": 100.0, "n_matches": 1200,
            "n_with_reference": 1000,
        },
    }  # fmt: skip


def sensitivity() -> dict[str, Any]:
    """A sensitivity.json of two takes."""
    rows = [
        {
            "take": take, "kind": kind, "unit": unit, "injected": value, "method": "epitransfer", "refined": refined,
            "n": 100, "abs_rel": 0.02 + abs(value), "median_rel": 0.01, "kept_share": 0.9, "epipole_inside_share": 0.0,
            "marked": value > 0, "n_pairs": 5,
        }
        for take in ("take 1", "take 2")
        for kind, unit in (("yaw", "deg"), ("translation_along", "m"))
        for value in (-1.0, 0.0, 1.0)
        for refined in (False, True)
    ]  # fmt: skip
    return {"reference": "LiDAR", "method": "epitransfer", "curves": rows}


def gathered(run: Path, *without: str) -> RunData:
    """A finished run as the report reads it, without some of its stages and their folders."""
    outputs = [name for stage in STAGES.values() for name in stage.outputs]
    folder = RunFolder(run)
    paths = {name: folder.output(name) for name in outputs if name not in without}
    records = {name: folder.record(name) for name in STAGES if name not in without}
    return RunData(
        {name: path for name, path in paths.items() if path.exists()},
        {name: record for name, record in records.items() if record is not None},
    )


@pytest.fixture(scope="module")
def small(small_run: Path) -> RunData:
    """The small run, scored."""
    return gathered(small_run)


@pytest.fixture(scope="module")
def told(small: RunData) -> dict[str, Any]:
    """Its numbers."""
    return numbers(small)


@pytest.fixture(scope="module")
def whole(small: RunData, tmp_path_factory: pytest.TempPathFactory) -> RunData:
    """The small run with a metrics.json and a sensitivity.json that have all parts."""
    root = tmp_path_factory.mktemp("whole")
    pixels = small.paths["scores"] / "pixels.parquet"
    for folder, name, value in (("scores", "metrics", metrics()), ("sensitivity", "sensitivity", sensitivity())):
        (root / folder).mkdir()
        (root / folder / f"{name}.json").write_text(json.dumps(value), encoding="utf-8")
    shutil.copy(pixels, root / "scores" / "pixels.parquet")
    places = {name: root / name for name in ("scores", "sensitivity")}
    facts = {**small.records["score"], "facts": {"baselines": {"zoedepth": {"untrained": True}}}}
    return RunData({**small.paths, **places}, {**small.records, "score": facts})


@pytest.fixture(scope="module")
def reported(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the small run with its report."""
    run = copied(small_run, tmp_path_factory.mktemp("reported") / "run")
    done = epitransfer("report", run, "--jobs", 1)
    assert done.returncode == 0, done.stderr
    return run


class _Elements(HTMLParser):
    """Elements of a page, and the texts of its scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[tuple[str, str]] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append((str(dict(attrs).get("type", "")), ""))
        if tag not in {"meta", "br", "img", "link"}:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            kind, text = self.scripts[-1]
            self.scripts[-1] = kind, text + data


# The page


def test_the_page_is_well_formed_and_asks_for_nothing(reported: Path) -> None:
    text = (reported / "report" / "index.html").read_text(encoding="utf-8")
    page_of = _Elements(text)
    assert page_of.open == []
    for tag, attributes in page_of.found:
        assert tag not in {"link", "iframe", "object", "embed", "base"}
        for name in ("src", "href", "srcset", "poster", "data", "action"):
            assert (attributes.get(name) or "#").startswith(("#", "data:")), (tag, attributes)
    style = re.search(r"<style>(.*?)</style>", text, re.DOTALL)
    assert style
    assert not re.search(r"@import|url\(|https?:", style[1])
    policy = next(a["content"] for t, a in page_of.found if a.get("http-equiv") == "Content-Security-Policy")
    assert policy
    assert "default-src 'none'" in policy
    assert "connect-src 'none'" in policy
    own = [script for kind, script in page_of.scripts if not kind][-1]
    assert not re.search(r"https?:|fetch\(|XMLHttpRequest|import\(", own)


def test_anchors_are_unique_and_every_link_has_one(reported: Path) -> None:
    page_of = _Elements((reported / "report" / "index.html").read_text(encoding="utf-8"))
    anchors = [a["id"] for _, a in page_of.found if "id" in a]
    assert len(anchors) == len(set(anchors))
    links = [str(a["href"])[1:] for t, a in page_of.found if t == "a"]
    assert links
    assert set(links) <= set(anchors)


def test_every_figure_is_described_for_those_who_do_not_see_it(reported: Path) -> None:
    page_of = _Elements((reported / "report" / "index.html").read_text(encoding="utf-8"))
    plots = [a for t, a in page_of.found if t == "div" and a.get("class") == "plot"]
    assert len(plots) > 5
    assert all(len(str(a["aria-label"])) > 20 for a in plots)
    tables = [t for t, _ in page_of.found if t == "table"]
    assert len(tables) == len([t for t, _ in page_of.found if t == "caption"])


def _has_unit(title: str) -> bool:
    return re.search(r"\((1|m|m²|px|deg|s|MiB|name|%[^)]*|[^)]*\bm)\)", title) is not None


def test_every_axis_has_a_name_and_a_unit(whole: RunData) -> None:
    parts = sections(whole, numbers(whole))
    shown = [figure for part in parts for figure in part.all_figures]
    assert {"accuracy", "where", "pictures", "uncertainty", "pairs", "sensitivity", "run"} == {p.key for p in parts}
    assert len({figure.key for figure in shown}) == len(shown)
    for figure in shown:
        axes = axis_titles(figure)
        assert axes, figure.key
        for axis, title in axes.items():
            assert _has_unit(title), (figure.key, axis, title)


def test_an_axis_without_a_title_is_found() -> None:
    layout = {"xaxis": {"title": {"text": "Range (m)"}}, "yaxis2": {}, "scene": {"xaxis": {"title": {"text": "E (m)"}}}}
    titles = axis_titles(Figure("k", "t", "c", (), layout))
    assert titles == {
        "xaxis": "Range (m)", "yaxis2": "", "scene.xaxis": "E (m)", "scene.yaxis": "", "scene.zaxis": ""
    }  # fmt: skip
    assert not _has_unit("Range")


@given(st.text())
def test_no_text_ends_a_figure_s_data(text: str) -> None:
    for some in (text, f"</script>{text}", f"<!--<script>{text}"):
        figure = Figure("k", "t", "c", ({"name": some},), {"title": {"text": some}})
        written = figure_json(figure)
        assert not set(written) & {"<", ">", "&"}
        assert json.loads(written)["traces"][0]["name"] == some


def test_hostile_names_stay_text(told: Mapping[str, Any]) -> None:
    figure = Figure("k", HOSTILE, HOSTILE, ({"type": "scatter", "name": HOSTILE},), {"xaxis": {"title": HOSTILE}})
    spoiled = {**told, "title": HOSTILE, "distrust": [{"rule": "x", "rank": "mind", "text": HOSTILE}]}
    page_of = _Elements(page(spoiled, [Section("s", HOSTILE, HOSTILE, figures=(figure,))]))
    assert len(page_of.scripts) == 1 + PAGE_SCRIPTS
    assert not any(tag == "img" for tag, _ in page_of.found)
    kind, data = page_of.scripts[0]
    assert kind == "application/json"
    assert json.loads(data)["traces"][0]["name"] == HOSTILE


# The numbers


def test_the_numbers_are_those_of_the_scores(reported: Path) -> None:
    found = json.loads((reported / "report" / "report.json").read_text(encoding="utf-8"))
    scored = json.loads((reported / "scores" / "metrics.json").read_text(encoding="utf-8"))
    assert found["metrics"] == scored
    for one in found["how_good"]["methods"]:
        assert one["abs_rel"] == scored["methods"][one["method"]]["common"]["abs_rel"]
    manifest = json.loads((reported / "manifest.json").read_text(encoding="utf-8"))["stages"]
    assert found["came_out"]["points"]["n"] == manifest["fuse"]["outputs"]["points"]["rows"]
    assert found["stages"]["match"]["seconds"] == manifest["match"]["seconds"]


def test_what_was_flown_is_what_the_example_says(told: Mapping[str, Any]) -> None:
    flown, came = told["flown"], told["came_out"]
    assert (flown["frames"], flown["usable"]) == (6, 6)
    # The example flies 30 m above its ground, and most of what it sees is ground.
    assert 26.0 < flown["above_ground_m"]["median"] < 33.0
    camera = flown["cameras"][0]
    assert flown["gsd_m"]["median"] == pytest.approx(flown["range_m"]["median"] / camera["fx"], rel=0.02)
    pairs = came["pairs"]
    assert sum(pairs["rejected_by_rule"].values()) == pairs["rejected"]
    for depths in came["depths"].values():
        assert depths["kept"] + sum(depths["masked_by_reason"].values()) == depths["n"]


def test_a_run_without_scores_says_that_nothing_was_compared(small_run: Path) -> None:
    run = gathered(small_run, "score", "scores")
    found = numbers(run)
    assert found["how_good"] is None
    assert found["metrics"] is None
    assert found["distrust"][0]["rule"] == "nothing independent"
    assert found["distrust"][0]["rank"] == "grave"
    parts = sections(run, found)
    assert "accuracy" not in {part.key for part in parts}
    text = page(found, parts)
    assert "Nothing independent was compared" in text
    assert "not compared" in text


def test_the_same_run_gives_the_same_page_whatever_it_took(whole: RunData) -> None:
    slower = {stage: {**record, "seconds": 999.0, "peak_memory_mib": 9.0} for stage, record in whole.records.items()}
    other = RunData(whole.paths, slower)
    one, two = numbers(whole), numbers(other)
    changed = {key for key in one if one[key] != two[key]}
    assert changed == {"stages"}
    parts = list(zip(sections(whole, one), sections(other, two), strict=True))
    assert [a.key for a, b in parts if a != b] == ["run"]
    same = [(a, b) for a, b in parts if a.key != "run"]
    assert page(one, [a for a, _ in same]) == page(two, [b for _, b in same])


def test_a_report_is_stale_when_what_it_tells_changed(reported: Path) -> None:
    folder = RunFolder(reported)
    record = folder.record_path("score")
    kept = record.read_text(encoding="utf-8")

    def status(**changed: Any) -> str:
        record.write_text(json.dumps({**json.loads(kept), **changed}), encoding="utf-8")
        return staleness(STAGES["report"], folder, kept_configuration(folder)).status

    assert status() == "fresh"
    assert status(seconds=1e6) == "fresh"
    assert status(warnings=["beware"]) == "stale"
    assert status(facts={}) == "stale"
    record.write_text(kept, encoding="utf-8")


def test_the_page_s_libraries_wait_until_a_page_is_written() -> None:
    told = "import sys, stages.report; print([m for m in ('plotly', 'jinja2', 'torch') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@given(st.lists(st.floats(1e-4, 1e4), min_size=1, max_size=200), st.sampled_from([0.05, 0.5, 0.95]))
def test_quantiles_of_a_histogram_are_those_of_the_values(values: list[float], share: float) -> None:
    found = (Spread.of(np.array(values[::2])) + Spread.of(np.array(values[1::2]))).quantile(share)
    assert found is not None
    exact = np.quantile(values, share, method="inverted_cdf")
    assert found == pytest.approx(exact, rel=0.006)


@pytest.mark.parametrize(
    ("reason", "rule"),
    [
        ("baseline 20.1 m, above 16", "baseline above 16 m"),
        ("view angle 50 deg, above 45", "view angle above 45 deg"),
        ("epipole margin -1e+03 px, below 50", "epipole margin below 50 px"),
        ("overlap 0.317 below 0.4", "overlap below 0.4"),
        ("something else", "something else"),
    ],
)
def test_rules_are_told_without_what_they_found(reason: str, rule: str) -> None:
    assert rule_of(reason) == rule


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "\N{EN DASH}"), (0.0117, "0.0117"), (12345, "12,345"), (1234.5, "1,234"), (2.0, "2.00"), (100.0, "100")],
)
def test_numbers_read_well(value: float | None, text: str) -> None:
    assert number(value) == text


# Tables and figures


def test_the_table_has_the_paper_s_rows_and_marks_the_best() -> None:
    table = accuracy_tables(metrics(), frozenset({"zoedepth"}))[0]
    assert table.head == ("Metric", "EpiTransfer", "Triangulation (DLT)", "ZoeDepth (random weights)")
    assert [row[0] for row in table.rows] == [
        "AbsRel ↓", "RMSE (m) ↓", "RMSE log ↓", "MAE (m) ↓", "SqRel (m) ↓", "δ < 1.25 ↑", "δ < 1.25² ↑", "δ < 1.25³ ↑",
        "Pixels",
    ]  # fmt: skip
    assert table.rows[0][1] == "0.0200 [0.0180, 0.0220]"
    # Random weights are never the best, however small their error.
    assert (0, 1) in table.strong
    assert not any(column == 3 for _, column in table.strong)
    assert "random weights" in table.note


def test_tables_with_and_without_control_points_stand_beside_each_other() -> None:
    found = metrics()
    assert len(accuracy_tables(found, frozenset())) == 4
    assert len(accuracy_tables({**found, "without_control": None}, frozenset())) == 2
    checked, control, cloud = (
        checkpoint_table(found["checkpoints"]), control_table(found["control_points"]), cloud_table(found["cloud"])
    )  # fmt: skip
    assert checked is not None
    assert checked.rows[0] == ("C1", "+0.010", "-0.020", "+0.030", "0.100", "0.100", "0.200", "5")
    assert control is not None
    assert control.rows[-1] == ("All", "20", "12.0", "1.50")
    assert cloud is not None
    assert cloud.rows[0] == ("0.1 m", "50.0 %", "30.0 %", "37.5 %")
    distances = m3c2_table(found["m3c2_ep"])
    assert distances is not None
    assert distances.rows[1] == ("Median distance (m)", "-0.010")
    for table in (checked, control, cloud, distances):
        assert {len(row) for row in table.rows} == {len(table.head)}
    assert {checkpoint_table(None), control_table(None), cloud_table(None), m3c2_table(None)} == {None}


def test_figures_show_what_was_measured() -> None:
    found = {figure.key: figure for figure in accuracy_figures(metrics(), frozenset({"zoedepth"}))}
    assert set(found) == {"by-range", "by-parallax", "by-frame"}
    lines = [trace for trace in found["by-range"].traces if trace["type"] == "scatter"]
    assert [line["name"] for line in lines] == ["EpiTransfer", "Triangulation (DLT)"]
    assert lines[0]["y"] == [0.02, 0.02]
    assert [figure.key for figure in calibration_figures(metrics())] == ["calibration", "by-sigma"]
    assert calibration_figures({"calibration": {"n": 0}}) == []


def test_sensitivity_is_shown_where_it_was_asked_for() -> None:
    assert sensitivity_figures(None) == []
    yaw, along = sensitivity_figures(sensitivity())
    assert yaw.layout["xaxis"]["title"]["text"] == "Injected yaw error (deg)"
    assert along.layout["xaxis"]["title"]["text"] == "Injected translation along error (m)"
    # Two takes, as injected and refined, and the rings.
    assert len(yaw.traces) == 5
    assert yaw.traces[-1]["x"] == [1.0, 1.0]


# The minute


def test_headline_and_comparison(whole: RunData) -> None:
    found = numbers(whole)
    cards = {card.what: card.value for card in headline(found)}
    assert cards["frames used"] == "6 / 6"
    assert cards["mean relative depth error"] == "2.0 %"
    assert cards["RMSE horizontal"] == "0.0200 m"
    lines = {line.name: line.text for line in good_lines(found)}
    # The random network has the smallest error of all, and no part in any of it.
    assert "ZoeDepth" not in lines
    assert lines["Compared"] == "EpiTransfer beside Triangulation (DLT): better (1,000 common pixels)"
    assert "[0.0180, 0.0220]" in lines["EpiTransfer"]
    assert lines["Checkpoints"].startswith("RMSE horizontal / vertical / 3D 0.0200 / 0.0300 / 0.0360 m at 40")


def sound() -> dict[str, Any]:
    """Numbers that give no rule a cause but those that hold for every run."""
    depths = {"n": 1000, "kept": 1000 - int(1000 * MASKED_SHARE), "masked_by_reason": {"far": int(1000 * MASKED_SHARE)}}
    good = {
        "truth": metrics()["truth"], "published": "epitransfer", "map": None,
        "checkpoints": {"n": REQUIRED}, "calibration": {"within_1_sigma": 0.683, "within_2_sigma": 0.954},
        "methods": [
            {"method": name, "untrained": False, "n_common": 900, "n_own": 1000, "kept_share": 0.9}
            for name in ("epitransfer", "dlt")
        ],
    }  # fmt: skip
    flown = {"frames": 6, "usable": 6, "cameras": [{"camera_id": "c", "source": "calibration file"}]}
    came = {"pairs": {"selected": 20}, "published_method": "epitransfer", "depths": {"epitransfer": depths}}
    return {"flown": flown, "came_out": came, "how_good": good}


def run_of(small: RunData, folder: Path, scored: dict[str, Any] | None = None, **records: Any) -> RunData:
    """The small run's frames with made-up scores and records."""
    (folder / "scores").mkdir(parents=True)
    value = {**metrics(), "control_points": None} if scored is None else scored
    (folder / "scores" / "metrics.json").write_text(json.dumps(value), encoding="utf-8")
    return RunData({"frames": small.paths["frames"], "scores": folder / "scores"}, records)


def test_a_sound_run_has_no_doubt_but_its_lens(small: RunData, tmp_path: Path) -> None:
    assert [doubt.rule for doubt in doubts(run_of(small, tmp_path), sound())] == ["lens"]


@pytest.mark.parametrize(
    ("within", "rank"),
    [
        ((0.683, 0.954), None),
        ((0.59, 0.91), None),
        ((0.60, 0.90), "grave"),
        ((0.57, 0.96), "mind"),
        ((0.77, 0.97), None),
        ((0.80, 0.98), "know"),
    ],
)
def test_sigmas_are_called_wrong_beyond_their_tolerance(
    small: RunData, tmp_path: Path, within: tuple[float, float], rank: str | None
) -> None:
    found = sound()
    found["how_good"]["calibration"] = {"within_1_sigma": within[0], "within_2_sigma": within[1]}
    ranks = [d.as_object()["rank"] for d in doubts(run_of(small, tmp_path), found) if d.rule == "sigmas"]
    assert ranks == ([] if rank is None else [rank])


@pytest.mark.parametrize(("n", "said"), [(0, "No checkpoint"), (1, "1 checkpoint,"), (29, "29 checkpoints,")])
def test_too_few_checkpoints(small: RunData, tmp_path: Path, n: int, said: str) -> None:
    found = sound()
    found["how_good"]["checkpoints"] = {"n": n} if n else None
    texts = [d.text for d in doubts(run_of(small, tmp_path), found) if d.rule == "checkpoints"]
    assert len(texts) == 1
    assert texts[0].startswith(said)


@pytest.mark.parametrize(("times", "n", "named"), [(0.99, 500, False), (1.01, 500, True), (1.01, 99, False)])
def test_the_worst_bin_is_named(small: RunData, tmp_path: Path, times: float, n: int, named: bool) -> None:
    scored = {**metrics(), "control_points": None}
    scored["methods"]["epitransfer"]["by_parallax"][1]["all"] = errors(n, times * BIN_TIMES * 0.02)
    scored["methods"]["epitransfer"]["by_range"] = []
    texts = [d.text for d in doubts(run_of(small, tmp_path, scored), sound()) if d.rule == "by parallax"]
    assert len(texts) == int(named)
    assert not named or texts[0].startswith("Worst at a parallax above 30 deg: AbsRel 0.0303, 1.5 times")


def _changed(path: tuple[Any, ...], value: Any) -> dict[str, Any]:
    found = sound()
    inner: Any = found
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return found


_EXIF = [{"camera_id": "c", "source": "EXIF 35 mm equivalent"}]


@pytest.mark.parametrize(
    ("rule", "changed"),
    [
        ("nothing independent", _changed(("how_good",), None)),
        ("masked", _changed(("came_out", "depths", "epitransfer", "kept"), 699)),
        ("common pixels", _changed(("how_good", "methods", 0, "n_common"), 499)),
        ("random weights", _changed(("how_good", "methods", 1, "untrained"), True)),
        ("frames", _changed(("flown", "usable"), 5)),
        ("camera", _changed(("flown", "cameras"), _EXIF)),
    ],
)
def test_rules_of_numbers(small: RunData, tmp_path: Path, rule: str, changed: dict[str, Any]) -> None:
    assert rule in {doubt.rule for doubt in doubts(run_of(small, tmp_path), changed)}


def _config(**values: Any) -> dict[str, Any]:
    return {"config": {key: {"value": value, "from": "default"} for key, value in values.items()}}


@pytest.mark.parametrize(
    ("rule", "rank", "records"),
    [
        ("warning of refine", "mind", {"refine": {"warnings": ["the flight falls into 2 parts"]}}),
        ("refinement", "mind", {"refine": {**_config(mode="none"), "facts": {"median_epipolar_residual_px": 3.0}}}),
        ("pairs as logged", "know", {"refine": {"facts": {"pairs_not_refined": {"too few": 2}}}}),
        ("pairs as logged", "mind", {"refine": {"facts": {"pairs_not_refined": {"too few": 3}}}}),
        ("failed items", "mind", {"match": {"items": {"total": 9, "failed": 1}}}),
        ("nothing independent", "mind", {"score": {"facts": {"lidar": "the run's own sweeps"}}}),
        ("datum", "mind", {"ingest": {"facts": {"height_datum": "takeoff", "height_datum_why": "as logged"}}}),
        ("datum", "know", {"ingest": {"facts": {"height_datum": "egm96", "height_datum_why": "stated by the user"}}}),
        ("geoid", "know", {"ingest": _config(geoid=-33.0)}),
        ("height above ground", "know", {"pair": {"facts": {"assumed_above_ground_m": 50.0}}}),
        (
            "outdated",
            "grave",
            {"depth": {"outputs": {"depths": {"sha256": "new"}}}, "score": {"parts": {"depths": "old"}}},
        ),
    ],
)
def test_rules_of_records(small: RunData, tmp_path: Path, rule: str, rank: str, records: dict[str, Any]) -> None:
    found = {doubt.rule: doubt for doubt in doubts(run_of(small, tmp_path, **records), sound())}
    assert found[rule].as_object()["rank"] == rank


def test_the_reference_of_few_matches_and_rows_left_out_are_told(small: RunData, tmp_path: Path) -> None:
    scored = metrics()
    scored["truth"] |= {"n_matches": 1000, "n_with_reference": 690}
    found = {doubt.rule for doubt in doubts(run_of(small, tmp_path, scored), sound())}
    assert {"coverage", "control points"} <= found


def test_doubts_come_gravest_first(small: RunData, tmp_path: Path) -> None:
    records = {"refine": {"warnings": ["a", "b"]}, "ingest": _config(geoid=1.0)}
    ranks = [doubt.rank for doubt in doubts(run_of(small, tmp_path, **records), {**sound(), "how_good": None})]
    assert ranks == sorted(ranks, reverse=True)
    assert ranks[0] > ranks[-1]


@pytest.mark.parametrize(("up_m", "told"), [(0.38, True), (0.02, False)])
def test_points_are_delivered_where_the_poses_put_them(small: RunData, tmp_path: Path, up_m: float, told: bool) -> None:
    found = sound()
    found["how_good"]["shift"] = {
        "translation_m": [0.0, 0.0, up_m],
        "sigma_m": [0.01, 0.01, 0.02],
        "checkpoints": None,
        "abs_rel_without": 0.0117,
    }
    texts = [d.text for d in doubts(run_of(small, tmp_path), found) if d.rule == "shifted"]
    assert bool(texts) == told
    if told:
        assert f"{up_m:+.2f} m up" in texts[0]
        assert "refine.control_points" in texts[0]
