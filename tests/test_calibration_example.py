"""The predicted sigma on matches of a rendered flight, over redraws of its pose error; the benchmarks' arithmetic."""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from calibration import MEDIAN_SQUARE, Outcome, PairTruth, groups, limits_of, outcomes, pairs_with_truth, turned
from colmap_side import MODEL, parameters
from example_truth import Scored, clipped, scored
from flight_truth import LEGS, FlightTruth, reprojection_errors, sampled
from measured import measured

from pipeline.engine.config import load_workflow, parse_overrides, resolve
from pipeline.engine.runfolder import RunFolder
from pipeline.engine.tables import read_table
from pipeline.flight import poses_of, selected_pairs
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Pose, PoseSigmas
from pipeline.geometry.rotations import enu_from_cam, rotation_from_vector
from pipeline.simulation.example import write_example
from pipeline.simulation.flight import SIDEWAYS
from pipeline.simulation.render import CAMERA, scene_depth
from pipeline.simulation.site import Site
from stages.registry import MODELS
from stages.workflow import chosen_stages, execute

FRAMES, SEED, REDRAWS, PER_PAIR = 7, 7, 200, 60
# Points of a share: the band, five on either side of a Gaussian's.
ONE_SIGMA, TWO_SIGMA, BAND = 0.683, 0.954, 0.05


@dataclass(frozen=True)
class Flight:
    example: Path
    run: Path

    @property
    def truth(self) -> FlightTruth:
        return FlightTruth.of(self.example)


@dataclass(frozen=True)
class Redrawn:
    pairs: list[PairTruth]
    found: dict[str, Outcome]

    def rows(self, leg: str) -> np.ndarray:
        return groups(self.pairs)[f"{leg} leg, all pairs"][self.found["DLT"].pair]


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    folder = tmp_path_factory.mktemp("calibration")
    example, run = folder / "example", folder / "run"
    write_example(example, FRAMES, SEED, 1, CAMERA.scaled(640, 480))
    # As logged: what the plane and the sigmas are worth shows where poses are wrong.
    logged = ("test", {"refine": {"mode": "none"}})
    configuration = resolve([("workflow", load_workflow(example / "workflow.toml", MODELS)), logged], MODELS)
    execute(RunFolder(run), configuration, chosen_stages(configuration, None, "depth"), jobs=1)
    return Flight(example, run)


@pytest.fixture(scope="module")
def redrawn(flight: Flight) -> Redrawn:
    pairs = pairs_with_truth(flight.run, flight.truth, PER_PAIR)
    pairs = [pair for pair in pairs if pair.leg in LEGS]
    logged = poses_of(read_table(flight.run / "frames.parquet", "frames"))
    return Redrawn(pairs, outcomes(pairs, flight.truth, logged, limits_of(flight.run), REDRAWS))


@pytest.fixture(scope="module")
def beside_truth(flight: Flight) -> tuple[Scored, np.ndarray]:
    pairs = selected_pairs(read_table(flight.run / "pairs.parquet", "pairs"))
    found = scored(flight.run, flight.truth, pairs)
    legs = np.array([flight.truth.leg(pair.ref, pair.src) for pair in pairs])
    return found, legs[found.group]


# --- the sigma, and what the methods are worth, on a rendered flight


@pytest.mark.slow
@pytest.mark.parametrize("leg", LEGS)
@pytest.mark.parametrize("method", ["adaptive", "DLT"])
def test_kept_depths_lie_within_their_sigma_as_often_as_it_says(redrawn: Redrawn, leg: str, method: str) -> None:
    outcome, rows = redrawn.found[method], redrawn.rows(leg)
    assert np.mean(outcome.kept[:, rows]) > 0.5
    assert outcome.within(1.0, rows)[0] == pytest.approx(ONE_SIGMA, abs=BAND)
    assert outcome.within(2.0, rows)[0] == pytest.approx(TWO_SIGMA, abs=BAND)


@pytest.mark.slow
@pytest.mark.parametrize("leg", LEGS)
def test_a_sigma_a_quarter_off_would_be_noticed(redrawn: Redrawn, leg: str) -> None:
    outcome, rows = redrawn.found["adaptive"], redrawn.rows(leg)
    assert outcome.within(0.75, rows)[0] < ONE_SIGMA - BAND
    assert outcome.within(1.25, rows)[0] > ONE_SIGMA + BAND
    assert outcome.within(1.0, rows)[1] < BAND / 2.0


@pytest.mark.slow
def test_adaptive_is_ahead_of_dlt_over_the_redraws(redrawn: Redrawn) -> None:
    common = redrawn.found["adaptive"].kept & redrawn.found["DLT"].kept
    for leg, share in zip(LEGS, (0.9, 0.98), strict=True):
        adaptive, dlt = (redrawn.found[name].abs_rel(redrawn.rows(leg), common) for name in ("adaptive", "DLT"))
        assert 0.01 < adaptive < share * dlt


@pytest.mark.slow
def test_the_lateral_view_fails_sideways_and_is_not_published(beside_truth: tuple[Scored, np.ndarray]) -> None:
    found, leg = beside_truth
    sideways = found.where(leg == SIDEWAYS)
    assert len(sideways.truth) > 500
    assert np.mean(sideways.kept["epitransfer-lateral"]) < 0.001
    assert np.mean(sideways.kept["epitransfer"]) > 0.9
    wrong = np.abs(clipped(sideways.depth["epitransfer-lateral"]) / sideways.truth - 1.0)
    assert np.mean(wrong) > 0.4
    assert np.mean(np.abs(sideways.depth["epitransfer"] / sideways.truth - 1.0)[sideways.kept["epitransfer"]]) < 0.1


@pytest.mark.slow
def test_matches_lie_where_the_truth_puts_them_within_their_covariance(redrawn: Redrawn) -> None:
    error = np.linalg.norm(np.concatenate([pair.error_px for pair in redrawn.pairs]), axis=1)
    assert np.median(error) < 0.1
    assert np.mean(error > 3.0) < 0.01
    # Patches reach over outlines and bent surfaces, so that the largest errors are larger than Gaussian ones.
    squares = np.concatenate([pair.squares for pair in redrawn.pairs])
    assert 0.6 * MEDIAN_SQUARE < np.median(squares) < 1.9 * MEDIAN_SQUARE
    assert np.mean(squares > 25.0) < 0.05


# --- the truth


def test_the_map_between_its_pixels_is_the_scene(flight: Flight) -> None:
    truth, site = flight.truth, Site.seeded(SEED)
    camera = CAMERA.scaled(640, 480)
    pixels = np.random.default_rng(3).uniform((0.0, 0.0), (639.0, 479.0), (3000, 2))
    pose = truth.poses["DJI_0002"]
    exact = scene_depth(site, camera, pose.rotation, pose.centre, pixels)
    found = truth.depths("DJI_0002", pixels)
    has = np.isfinite(found)
    assert np.mean(has) > 0.5
    assert not np.any(has & ~np.isfinite(exact))
    assert np.quantile(np.abs(found[has] / exact[has] - 1.0), 0.99) < 2e-3


def test_a_plane_is_sampled_exactly_and_outlines_sky_and_outside_are_dropped() -> None:
    u, v = np.meshgrid(np.arange(8.0), np.arange(6.0))
    plane = 1.0 / (0.02 + 0.0003 * u + 0.0002 * v)
    at = np.array([[2.25, 3.5], [0.0, 0.0], [7.0, 5.0], [6.9, 4.1]])
    np.testing.assert_allclose(sampled(plane, at), 1.0 / (0.02 + at @ [0.0003, 0.0002]), rtol=1e-12)
    assert np.isnan(sampled(plane, np.array([[-0.1, 2.0], [7.1, 2.0], [2.0, 5.1], [np.nan, 1.0]]))).all()
    plane[:, 4:] *= 1.2
    plane[0] = np.inf
    np.testing.assert_array_equal(
        np.isnan(sampled(plane, np.array([[3.5, 2.5], [2.5, 2.5], [4.5, 2.5], [1.5, 0.5], [1.5, 1.5]]))),
        [True, False, False, True, False],
    )


def test_legs_and_neighbours(flight: Flight) -> None:
    truth = flight.truth
    assert truth.leg("DJI_0001", "DJI_0003") == "forward"
    assert truth.leg("DJI_0006", "DJI_0007") == "sideways"
    assert truth.leg("DJI_0001", "DJI_0007") == "between"
    assert truth.neighbours("DJI_0002", "DJI_0001")
    assert not truth.neighbours("DJI_0003", "DJI_0001")
    assert not truth.neighbours("DJI_0004", "DJI_0005"), "the last of one leg and the first of the next"
    assert truth.along_axis("DJI_0002", "DJI_0001") > 0.85
    assert truth.along_axis("DJI_0007", "DJI_0006") < 0.2


def test_a_true_match_has_no_reprojection_error(flight: Flight) -> None:
    ref, src = (flight.truth.poses[name] for name in ("DJI_0002", "DJI_0001"))
    camera = Camera("pinhole", 640, 480, 450.0, 450.0, 320.0, 240.0)
    world = ref.centre + ref.rotation @ [1.0, 2.0, 40.0]
    ref_px, src_px = (camera.project((world - pose.centre) @ pose.rotation) for pose in (ref, src))
    error = reprojection_errors(ref_px[None], src_px[None] + (3.0, -4.0), np.array([40.0]), camera, ref=ref, src=src)
    np.testing.assert_allclose(error, [[3.0, -4.0]], atol=1e-9)


def test_an_example_without_truth_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="epitransfer example"):
        FlightTruth.of(tmp_path)


def test_a_method_that_was_not_run_is_named(flight: Flight, tmp_path: Path) -> None:
    run = tmp_path / "run"
    given = load_workflow(flight.example / "workflow.toml", MODELS)
    overrides = parse_overrides(['depth.methods=["epitransfer"]', "match.max_features=800"], MODELS)
    configuration = resolve([("workflow", given), ("test", overrides)], MODELS)
    execute(RunFolder(run), configuration, chosen_stages(configuration, None, "depth"), jobs=1)
    with pytest.raises(ValueError, match="no depths by epitransfer-lateral, epitransfer-vertical, dlt"):
        scored(run, flight.truth, selected_pairs(read_table(run / "pairs.parquet", "pairs")))


# --- redraws, COLMAP's conventions, the stopwatch


def test_a_redrawn_attitude_turns_about_the_axes_that_frames_names() -> None:
    rotation, turn = enu_from_cam(0.5, -0.35, 0.02), np.array([2e-5, -1e-5, 3e-5])
    axes = Pose(rotation, np.zeros(3), *[PoseSigmas(np.zeros(3), np.zeros(3))] * 2).error_axes
    np.testing.assert_allclose(turned(rotation, turn), rotation_from_vector(axes @ turn) @ rotation, atol=1e-8)


def test_a_share_and_its_error_count_kept_depths_only() -> None:
    error = np.array([[0.5, 3.0, 9.0], [1.5, -0.5, 9.0]])
    kept = np.array([[True, True, False], [True, True, False]])
    outcome = Outcome(error, np.ones((2, 3)), np.full(3, 10.0), kept, np.arange(3), np.zeros(3, bool))
    assert outcome.within(1.0, np.ones(3, bool)) == (0.5, 0.0)
    assert outcome.within(2.0, np.ones(3, bool))[0] == 0.75
    assert outcome.within(2.0, np.ones(3, bool))[1] == pytest.approx(np.sqrt(0.5) / 4.0)
    assert outcome.abs_rel(np.ones(3, bool), kept) == pytest.approx(0.1375)


def test_colmap_gets_the_same_camera() -> None:
    camera = Camera(
        "brown", 1600, 1200, 1121.0, 1119.0, 803.0, 595.0, (-0.03, 0.01, 4e-4, -3e-4, 0.002, 0.01, -0.02, 0.003)
    )
    peer = pycolmap.Camera(model=MODEL, width=1600, height=1200, params=parameters(camera))
    points = np.random.default_rng(5).uniform((-0.6, -0.45, 1.0), (0.6, 0.45, 1.0), (50, 3))
    np.testing.assert_allclose(np.asarray(peer.img_from_cam(points)), camera.project(points) + 0.5, atol=1e-9)
    with pytest.raises(ValueError, match="fisheye"):
        parameters(Camera("fisheye", 8, 6, 5.0, 5.0, 4.0, 3.0, (0.0, 0.0, 0.0, 0.0)))


_WORK = """
import subprocess, sys, time
if len(sys.argv) == 1:
    subprocess.run([sys.executable, sys.argv[0], "child"], check=True)
else:
    held = b"x" * 100_000_000
    start = time.process_time()
    while time.process_time() - start < 0.6: pass
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc")
def test_the_stopwatch_sees_what_children_use(tmp_path: Path) -> None:
    script = tmp_path / "work.py"
    script.write_text(_WORK)
    cost = measured([sys.executable, script], tmp_path / "log")
    assert 100.0 < cost.memory_mib < 200.0
    assert 0.4 < cost.cpu_s < 2.0
    assert cost.wall_s >= cost.cpu_s - 0.2


def test_a_command_that_fails_is_told_with_its_last_words(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=r"ended with 3:\n(.|\n)*gone"):
        measured([sys.executable, "-c", "print('gone'); raise SystemExit(3)"], tmp_path / "log")
