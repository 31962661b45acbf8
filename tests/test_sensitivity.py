"""Errors injected into poses: closed forms, takes, what refinement undoes and what not, and the stage."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from flights import copied, epitransfer
from pydantic import ValidationError
from refinement_scenes import NONE, OWN, Errors, logged, matched, matches_of, named, placement, seen_points, straight

from pipeline.depthing import Limits, MatchedRays
from pipeline.engine.errors import InputError
from pipeline.flight import PairRow
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement, Pose
from pipeline.geometry.transfer import VirtualView
from pipeline.refinement.logged import as_logged
from pipeline.refinement.matched import Matched
from pipeline.sensitivity.curves import curve_rows, withstood
from pipeline.sensitivity.injected import ACROSS, ALONG, UNITS, UP, Injection, injections, with_error
from pipeline.sensitivity.pair_errors import PairErrors, PosedPair, Ways, depths, epipole_inside, pair_errors
from pipeline.sensitivity.references import LIDAR, Reference
from pipeline.sensitivity.references import OWN as OWN_DEPTHS
from pipeline.sensitivity.takes import spread, takes_of
from schemas import CURVES
from stages.registry import ON_REQUEST
from stages.sensitivity import Config

CAMERA = Camera("pinhole", 1200, 900, 1000.0, 1000.0, 599.5, 449.5)
PAIR = named("ref", "src")
METHODS = ("epitransfer", "dlt")
BASELINE_M = 4.0


def ways(max_range_m: float = 200.0) -> Ways:
    return Ways(METHODS, VirtualView.ADAPTIVE, 1.0, Limits(0.5, max_range_m, 4.0), max_range_m)


def posed(ref: Placement, src: Placement, camera: Camera = CAMERA) -> PosedPair:
    both = (Pose(at.rotation, at.centre, OWN, NONE) for at in (ref, src))
    return PosedPair(PAIR, *both, camera, camera)


def sideways() -> PosedPair:
    """Both look north, level, src to the right."""
    return posed(placement((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), placement((0.0, 0.0, 0.0), (BASELINE_M, 0.0, 0.0)))


def exact(pair: PosedPair, ref_px: Floats, depth_m: Floats) -> tuple[Matched, MatchedRays]:
    """Matches without noise of points at depths of ref pixels, and the same as rays."""
    points = pair.ref_camera.rays(ref_px) * depth_m[:, None] @ pair.ref.rotation.T + pair.ref.centre
    src_px = pair.src_camera.project((points - pair.src.centre) @ pair.src.rotation)
    noise = np.tile([0.04, 0.0, 0.04], (len(ref_px), 1))
    cameras = {"ref": pair.ref_camera, "src": pair.src_camera}
    rays = MatchedRays.of(ref_px, src_px, pair.ref_camera, pair.src_camera, noise)
    return matched(PAIR, ref_px, src_px, noise, cameras), rays


def found_depths(pair: PosedPair, case: Injection, method: str, ref_px: Floats, depth_m: Floats) -> Floats:
    matches, rays = exact(pair, ref_px, depth_m)
    return depths(method, rays, as_logged(pair.off_by(case), matches), pair.src_camera, ways())[0]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("error_deg", [-1.0, -0.2, 0.2, 1.0])
def test_a_yaw_error_turns_the_src_ray_by_as_much(method: str, error_deg: float) -> None:
    rng = np.random.default_rng(0)
    # On the level line through the image, where a yaw error keeps both rays in one plane.
    ref_px = np.column_stack([rng.uniform(100.0, 1100.0, 50), np.full(50, CAMERA.cy)])
    depth = rng.uniform(20.0, 60.0, 50)
    tangent = CAMERA.rays(ref_px)[:, 0]
    bearing = np.arctan2(tangent * depth - BASELINE_M, depth) + np.radians(error_deg)
    expected = BASELINE_M / (tangent - np.tan(bearing))
    found = found_depths(sideways(), Injection("yaw", error_deg), method, ref_px, depth)
    behind = expected <= 0.0
    assert np.allclose(
        found[~behind], np.minimum(expected[~behind], 200.0 / np.hypot(1.0, tangent[~behind])), rtol=1e-9
    )
    # The error in parallax is what yaw is wrong by: to the right the rays open, and depths grow.
    assert np.all(np.sign(found - depth) == np.sign(error_deg))
    # Rays that part meet nowhere, and count as the range.
    assert np.allclose(found[behind], 200.0 / np.hypot(1.0, tangent[behind]), rtol=1e-12)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("share", [-0.25, -0.1, 0.1, 0.25])
@pytest.mark.parametrize("way", ["forward", "sideways"])
def test_a_longer_baseline_scales_all_depths(method: str, share: float, way: str) -> None:
    truth = straight(2, way)
    pair = posed(truth["f01"], truth["f00"])
    length = float(np.linalg.norm(pair.src.centre - pair.ref.centre))
    rng = np.random.default_rng(1)
    ref_px, depth = rng.uniform((50.0, 500.0), (1150.0, 850.0), (60, 2)), rng.uniform(15.0, 60.0, 60)
    none, longer = (
        found_depths(pair, Injection(ALONG, value), method, ref_px, depth) for value in (0.0, share * length)
    )
    assert np.allclose(none, depth, rtol=1e-6)
    assert np.allclose(longer / none, 1.0 + share, rtol=1e-6)


def test_up_and_down_are_alike_where_the_scene_is() -> None:
    rng = np.random.default_rng(2)
    across, aside = rng.uniform(50.0, 1150.0, 80), rng.uniform(20.0, 430.0, 80)
    depth = rng.uniform(15.0, 60.0, 80)
    ref_px = np.concatenate([np.column_stack([across, CAMERA.cy + side * aside]) for side in (1.0, -1.0)])
    depth = np.concatenate([depth, depth])
    matches, rays = exact(sideways(), ref_px, depth)
    values = {UP: (-0.5, 0.0, 0.5), "pitch": (-1.0, 0.0, 1.0), "roll": (-1.0, 0.0, 1.0), "yaw": (-1.0, 0.0, 1.0)}
    cases = injections(values)
    errors = pair_errors(sideways(), matches, rays, depth, ways(), cases)
    rows = [row for row in curve_rows("take 1", [errors], values, cases, METHODS) if not row["refined"]]
    for kind in values:
        for method in METHODS:
            low, zero, high = (row["abs_rel"] for row in rows if (row["kind"], row["method"]) == (kind, method))
            assert zero < 1e-6
            assert min(low, high) > 1e-3
            # Yaw opens the rays or closes them, and is not alike.
            assert (low == pytest.approx(high, rel=1e-4)) == (kind != "yaw")


def test_axes_are_the_baseline_and_the_level_across_it() -> None:
    ref, src = placement((0.0, -20.0, 0.0), (1.0, 2.0, 30.0)), placement((0.0, -20.0, 0.0), (1.0, 5.0, 34.0))
    pair = posed(ref, src)
    shift = {
        kind: with_error(pair.ref, pair.src, Injection(kind, 2.0)).centre - src.centre for kind in (ALONG, ACROSS, UP)
    }
    assert np.allclose(shift[ALONG], (0.0, 1.2, 1.6))
    assert np.allclose(shift[ACROSS], (2.0, 0.0, 0.0))
    assert np.allclose(shift[UP], (0.0, 0.0, 2.0))
    yawed = with_error(pair.ref, pair.src, Injection("yaw", 90.0)).rotation
    assert np.allclose(yawed, placement((90.0, -20.0, 0.0), (0.0, 0.0, 0.0)).rotation)
    pitched = with_error(pair.ref, pair.src, Injection("pitch", -70.0)).rotation
    assert np.allclose(pitched, placement((0.0, -90.0, 0.0), (0.0, 0.0, 0.0)).rotation)


@pytest.mark.parametrize(
    ("case", "inside"),
    [
        (Injection(ALONG, 0.0), False),
        # Src then stands 5 m ahead of ref and 4 m aside: 39 deg off the axis, and the image ends at 31.
        (Injection(ACROSS, 5.0), False),
        # 27 deg.
        (Injection(ACROSS, 8.0), True),
        (Injection(ACROSS, -8.0), True),
        (Injection(UP, 8.0), False),
        # Src turned towards ref by a right angle has it in its own image, and ref does not see src.
        (Injection("yaw", -90.0), True),
        (Injection("yaw", -30.0), False),
        (Injection("roll", 60.0), False),
    ],
)  # fmt: skip
def test_epipoles_in_either_image_are_marked(case: Injection, inside: bool) -> None:
    assert epipole_inside(sideways().off_by(case), PAIR) is inside


def test_marks_and_shares_of_a_take() -> None:
    cases = injections({UP: (-1.0, 0.0, 1.0)})
    assert [case.value for case in cases] == [0.0, -1.0, 1.0]
    relative = np.zeros((3, 2, 2, 4), np.float32)
    relative[1, 0, 0] = (0.1, 0.2, 0.6, np.nan)
    kept = np.ones((3, 2, 2, 4), np.bool_)
    kept[1, 0, 0] = (True, False, False, False)
    pairs = [PairErrors(relative, kept, np.array(inside)) for inside in ([False, False, True], [False, False, False])]
    rows = list(curve_rows("take 3", pairs, {UP: (-1.0, 0.0, 1.0)}, cases, METHODS))
    CURVES.from_rows(rows)
    assert len(rows) == 12
    first = rows[0]
    assert (first["injected"], first["method"], first["refined"], first["n"], first["n_pairs"]) == (
        -1.0,
        "epitransfer",
        False,
        6,
        2,
    )
    assert (first["abs_rel"], first["median_rel"], first["kept_share"]) == pytest.approx((0.3, 0.2, 1.0 / 3.0))
    assert [row["marked"] for row in rows] == [False] * 8 + [True] * 4
    assert rows[-1]["epipole_inside_share"] == 0.5


def test_what_is_withstood_lies_between_the_errors_tried() -> None:
    rows: list[dict[str, Any]] = []
    for take, weight in (("take 1", 3), ("take 2", 1)):
        for value, plain in ((-2.0, 0.05), (-1.0, 0.03), (0.0, 0.01), (1.0, 0.01), (2.0, 0.04)):
            for refined in (False, True):
                # The second take is worse all along: the mean is that of the first plus 0.01.
                abs_rel = (0.01 if refined else plain) + (0.04 if take == "take 2" else 0.0)
                rows.append({"take": take, "kind": "yaw", "injected": value, "method": "dlt", "refined": refined,
                             "abs_rel": abs_rel, "n": 100 * weight})  # fmt: skip
    found = withstood(rows, "dlt", LIDAR)
    assert (found["abs_rel"], found["threshold"]) == pytest.approx((0.02, 0.04))
    assert found["by_kind"]["yaw"] == {"unit": "deg", "largest": 2.0, "injected": pytest.approx(1.0), "refined": None}
    assert withstood(rows, "dlt", OWN_DEPTHS)["by_kind"]["yaw"]["injected"] == pytest.approx(1.5)


@pytest.mark.parametrize("way", ["forward", "sideways"])
def test_refinement_undoes_turns_and_not_the_length(way: str) -> None:
    truth = straight(2, way, seed=3)
    rng = np.random.default_rng(4)
    pair = PairRow(PAIR.pair_id, "f01", "f00")
    found = matches_of(truth, pair, rng, seen_points(truth["f01"], rng, 400))
    log = logged(truth, Errors.none(2), OWN, NONE)
    camera = Camera("brown", 1600, 1200, 1120.0, 1122.0, 803.0, 596.0, (-0.06, 0.01, 0.0005, -0.0003, 0.0))
    both = PosedPair(pair, log["f01"], log["f00"], camera, camera)
    noise = np.tile([0.04, 0.0, 0.04], (len(found), 1))
    rays = MatchedRays.of(found.ref_px, found.src_px, camera, camera, noise)
    reference, _ = depths("epitransfer", rays, as_logged(both.off_by(Injection(ALONG, 0.0)), found), camera, ways())
    values = dict.fromkeys((ALONG, "yaw", "pitch", "roll"), (-1.0, 0.0, 1.0))
    cases = injections(values)
    errors = pair_errors(both, found, rays, reference, ways(), cases)
    curve = {
        (row["kind"], row["injected"], row["refined"]): row["abs_rel"]
        for row in curve_rows("take 1", [errors], values, cases, METHODS)
        if row["method"] == "epitransfer"
    }
    left = curve["yaw", 0.0, True]
    assert curve["yaw", 0.0, False] == 0.0
    assert 0.0 < left < 0.02
    for value in (-1.0, 1.0):
        for kind in ("yaw", "pitch", "roll"):
            assert curve[kind, value, True] < max(2.0 * left, 0.15 * curve[kind, value, False])
            assert curve[kind, value, False] > 0.03
        # A metre of some five: the matches say nothing of it.
        assert 0.15 < curve[ALONG, value, False] < 0.25
        assert 0.9 < curve[ALONG, value, True] / curve[ALONG, value, False] < 1.1


# --- takes ---


def flown(way: list[tuple[float, float, float]]) -> dict[str, Placement]:
    return {f"f{i:02d}": placement((0.0, -30.0, 0.0), at) for i, at in enumerate(way)}


def neighbours(frames: dict[str, Placement]) -> list[PairRow]:
    names = list(frames)
    return [named(names[i], names[i - 1]) for i in range(1, len(names))]


def every(frames: dict[str, Placement], seconds: float = 2.0) -> dict[str, float]:
    return {name: seconds * i for i, name in enumerate(frames)}


def lawnmower() -> dict[str, Placement]:
    """North along x = 0, one step east, back south: six frames each way, wandering a little."""
    rng = np.random.default_rng(5)
    way = [(0.0, 5.0 * i, 30.0) for i in range(6)] + [(5.0, 25.0 - 5.0 * i, 30.0) for i in range(6)]
    return flown([tuple(np.array(at) + rng.normal(0.0, 0.5, 3)) for at in way])


def test_takes_end_at_turns() -> None:
    frames = lawnmower()
    takes = takes_of(frames, every(frames), neighbours(frames))
    assert [(take.name, take.frames[0], take.frames[-1]) for take in takes] == [
        ("take 1", "f00", "f05"),
        ("take 2", "f06", "f11"),
    ]
    assert [len(take.pairs) for take in takes] == [5, 5]
    north, south = (np.radians(take.heading_deg or 0.0) for take in takes)
    assert np.cos(north) > 0.95
    assert np.cos(south) < -0.95


def test_takes_end_at_gaps_of_time_and_of_way() -> None:
    straight_on = flown([(0.0, 5.0 * i, 30.0) for i in range(10)])
    pairs = neighbours(straight_on)
    times = every(straight_on)
    assert [len(take.pairs) for take in takes_of(straight_on, times, pairs)] == [9]
    late = {name: time + (30.0 if name >= "f04" else 0.0) for name, time in times.items()}
    assert [take.frames[0] for take in takes_of(straight_on, late, pairs)] == ["f00", "f04"]
    far = flown([(0.0, 5.0 * i + (40.0 if i >= 7 else 0.0), 30.0) for i in range(10)])
    unknown = dict.fromkeys(far, float("nan"))
    assert [take.frames[0] for take in takes_of(far, unknown, pairs)] == ["f00", "f07"]


def test_frames_are_in_the_order_of_their_times() -> None:
    frames = lawnmower()
    shuffled = {name: frames[name] for name in sorted(frames, key=lambda name: int(name[1:]) * 7 % 12)}
    assert takes_of(shuffled, every(frames), neighbours(frames)) == takes_of(frames, every(frames), neighbours(frames))


def test_hovering_and_climbing_are_no_turns() -> None:
    rng = np.random.default_rng(6)
    way = [(0.0, 5.0 * i, 30.0) for i in range(5)]
    way += [tuple(np.array((0.0, 20.0, 30.0)) + rng.normal(0.0, 0.1, 3)) for _ in range(3)]
    way += [(0.0, 20.0 + 5.0 * i, 30.0 + 2.0 * i) for i in range(1, 6)]
    frames = flown(way)
    assert len(takes_of(frames, every(frames), neighbours(frames))) == 1


def test_a_flight_without_a_stretch_is_one_take() -> None:
    # To and fro: every step is a turn, and each pair spans one.
    frames = flown([(0.0, 5.0 * (i % 2), 30.0) for i in range(6)])
    spanning = [named("f02", "f00"), named("f05", "f01")]
    (take,) = takes_of(frames, every(frames), spanning)
    assert (len(take.frames), take.pairs) == (6, tuple(spanning))


@pytest.mark.parametrize(
    ("count", "most", "rows"), [(5, 10, [0, 1, 2, 3, 4]), (9, 3, [0, 4, 8]), (7, 1, [0]), (0, 3, [])]
)
def test_spread(count: int, most: int, rows: list[int]) -> None:
    assert spread(count, most).tolist() == rows


# --- the stage ---

FEW = (
    "--set", "sensitivity.translation_m=[-0.5,0,0.5]", "--set", "sensitivity.yaw_deg=[-1,0,1]",
    "--set", "sensitivity.pitch_deg=[-1,0,1]", "--set", "sensitivity.roll_deg=[-1,0,1]",
    "--set", "sensitivity.max_pairs_per_take=2",
)  # fmt: skip


def told(run: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run / "sensitivity" / "sensitivity.json").read_text())
    return found


@pytest.mark.slow
def test_the_stage_beside_scores(small_run: Path, tmp_path: Path) -> None:
    written = []
    for jobs in (1, 2):
        run = copied(small_run, tmp_path / f"run{jobs}")
        done = epitransfer("sensitivity", run, "--jobs", jobs, *FEW)
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith("AbsRel epitransfer 0.")
        written.append([(run / "sensitivity" / name).read_bytes() for name in ("curves.parquet", "sensitivity.json")])
    assert written[0] == written[1]
    table = pq.read_table(run / "sensitivity" / "curves.parquet")
    CURVES.check(table)
    found = told(run)
    assert found["reference"] == LIDAR
    first, second = found["takes"]
    assert first["n_pairs_tried"] == 2 < first["n_pairs"]
    assert second["n_pairs_tried"] == second["n_pairs"] == 1
    # Six kinds, three errors, four methods, with and without refinement.
    assert [row["kind"] for row in found["curves"][::24]] == [*UNITS, *UNITS]
    assert found["curves"] == [
        {key: pytest.approx(value, rel=1e-9) if isinstance(value, float) else value for key, value in row.items()}
        for row in table.to_pylist()
    ]
    # Without an error the score is the run's own. Of the second take's only pair all pixels are taken; the run's sigmas
    # are those of its refinement, and weight the view a little otherwise.
    pixels = pq.read_table(run / "scores" / "pixels.parquet").to_pandas()
    for method in METHODS:
        (row,) = (
            row
            for row in found["curves"]
            if (row["take"], row["kind"], row["injected"], row["method"], row["refined"])
            == ("take 2", "yaw", 0.0, method, False)
        )
        kept = pixels[(pixels["method"] == method) & pixels["kept"] & (pixels["frame_id"] == second["last_frame_id"])]
        kept = kept[kept["pair_id"].str.endswith(second["first_frame_id"])]
        expected = ((kept["depth_m"] - kept["reference_m"]).abs() / kept["reference_m"]).mean()
        assert row["n"] == pytest.approx(len(kept), rel=0.02)
        assert row["abs_rel"] == pytest.approx(expected, rel=0.02)
        assert row["kept_share"] == 1.0


@pytest.mark.slow
def test_without_scores_the_run_is_its_own_reference(small_run: Path, tmp_path: Path) -> None:
    run = copied(small_run, tmp_path / "run")
    shutil.rmtree(run / "scores")
    (run / ".stages" / "score.json").unlink()
    for name, *more in (("refine", "--set", "refine.mode=none"), ("depth",)):
        done = epitransfer(name, run, "--jobs", 2, *more)
        assert done.returncode == 0, done.stderr
    done = epitransfer("sensitivity", run, "--jobs", 1, "--json", *FEW)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert answer["facts"]["reference"] == OWN_DEPTHS
    rows = [row for row in told(run)["curves"] if row["method"] == "epitransfer" and not row["refined"]]
    # Poses and sigmas are as logged in this mode, so that no error is the run itself.
    assert all(row["abs_rel"] < 1e-9 and row["kept_share"] == 1.0 for row in rows if row["injected"] == 0.0)
    assert all(row["abs_rel"] > 1e-3 for row in rows if row["injected"] and row["kind"] in {ALONG, "pitch", "roll"})


@pytest.mark.parametrize(
    ("metrics", "kind"),
    [
        ({"truth": {"correspondence": "sparse"}}, LIDAR),
        # As scores were before they told.
        ({}, LIDAR),
        ({"truth": {"correspondence": "dense"}}, OWN_DEPTHS),
    ],
)
def test_scores_at_other_pixels_are_no_reference(metrics: dict[str, Any], kind: str, tmp_path: Path) -> None:
    (tmp_path / "pixels.parquet").touch()
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    assert Reference.of(tmp_path, tmp_path / "depths", "dlt").kind == kind


def test_damaged_scores_are_told(tmp_path: Path) -> None:
    (tmp_path / "pixels.parquet").touch()
    (tmp_path / "metrics.json").write_text('{"truth": {"corr')
    with pytest.raises(InputError, match=r"E-SENS-02(.|\n)*metrics\.json"):
        Reference.of(tmp_path, tmp_path / "depths", "dlt")


def test_references_are_found_by_their_pixels(tmp_path: Path) -> None:
    reference = Reference(LIDAR, tmp_path, "pixels", "reference_m", pc.scalar(True))
    rows = pa.table({"u": [5.0, 1.0, 1.0, 7.25], "v": [2.0, 9.0, 3.0, 0.0], "reference_m": [1.0, 2.0, 3.0, 4.0]})
    wanted = np.array([[1.0, 3.0], [7.25, 0.0], [1.0, 4.0], [5.0, 2.0], [9.0, 9.0], [0.0, 0.0], [1.0, 9.0]])
    found = reference.at(rows, wanted)
    assert np.array_equal(found, [3.0, 4.0, np.nan, 1.0, np.nan, np.nan, 2.0], equal_nan=True)
    assert np.isnan(reference.at(rows.slice(0, 0), wanted)).all()


def test_a_run_does_it_only_where_asked(small_run: Path) -> None:
    assert "sensitivity" in ON_REQUEST
    assert not (small_run / "sensitivity").exists()


@pytest.mark.parametrize("values", [(-1.0, 0.0, 2.0), (-1.0, 1.0, 2.0, -2.0), (0.0, 1.0, 2.0)])
def test_errors_are_symmetric_about_none(values: tuple[float, ...]) -> None:
    with pytest.raises(ValidationError, match="symmetric about 0"):
        Config(yaw_deg=values)
