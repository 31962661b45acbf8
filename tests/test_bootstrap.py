"""Intervals of the metrics: against drawing pixels by the frame in a loop, and whether they hold the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from pipeline.lidar.reference import Reference
from pipeline.scoring.bootstrap import DRAWS, LEAST_CLUSTERS, counts_of_draws, difference, intervals
from pipeline.scoring.depth_rows import AlignedDepths
from pipeline.scoring.frame_scores import FrameScore
from pipeline.scoring.frame_sums import FrameSums, Scored
from pipeline.scoring.metrics import DepthSums, GroupedSums
from pipeline.scoring.summary import metrics_object

Pixels = tuple[np.ndarray, np.ndarray]


def flight(rng: np.random.Generator, frames: int, pixels: int, common: float = 0.05, own: float = 0.03) -> list[Pixels]:
    """Depths and references of frames, whose pixels share an error of the frame and have one of their own."""
    out = []
    for _ in range(frames):
        reference = rng.uniform(20.0, 80.0, pixels)
        error = rng.normal(0.0, common) + rng.normal(0.0, own, pixels)
        out.append((reference * (1.0 + error), reference))
    return out


def sums(frames: Sequence[Pixels]) -> GroupedSums:
    return GroupedSums.stacked(DepthSums.of(d, g) for d, g in frames)


def plain(d: np.ndarray, g: np.ndarray) -> list[float]:
    """The metrics of pixels, by their definitions."""
    e, ratio = np.abs(d - g), np.maximum(d / g, g / d)
    return [
        np.mean(e / g), np.mean(e**2 / g), np.sqrt(np.mean(e**2)), np.sqrt(np.mean((np.log(d) - np.log(g)) ** 2)),
        np.mean(e), *(np.mean(ratio < 1.25**k) for k in (1, 2, 3)),
    ]  # fmt: skip


def in_a_loop(frames: Sequence[Pixels]) -> np.ndarray:
    """(2000, 8) the metrics of all the pixels of each draw."""
    out = []
    for counts in counts_of_draws(len(frames)).astype(int):
        drawn = [frame for frame, count in zip(frames, counts, strict=True) for _ in range(count)]
        out.append(plain(*(np.concatenate(part) for part in zip(*drawn, strict=True))))
    return np.array(out)


def test_draws_have_as_many_clusters_as_there_are() -> None:
    counts = counts_of_draws(22)
    assert counts.shape == (DRAWS, 22)
    assert np.all(counts.sum(axis=1) == 22)
    np.testing.assert_array_equal(counts, counts_of_draws(22))
    # Each cluster is in a draw once on average, and not in it in (1 - 1/22)^22 of all.
    assert np.all(np.abs(counts.mean(axis=0) - 1.0) < 0.1)
    assert abs(np.mean(counts == 0) - (1 - 1 / 22) ** 22) < 0.01


def test_sums_do_what_drawing_pixels_by_the_frame_does() -> None:
    rng = np.random.default_rng(3)
    frames = [part for n in (3, 1, 9, 5, 2, 14, 7) for part in flight(rng, 1, n, 0.2, 0.2)]
    expected = np.quantile(in_a_loop(frames), (0.025, 0.975), axis=0).T
    found = intervals(sums(frames))
    assert found is not None
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)
    assert np.all(found[:5, 0] < found[:5, 1])


def test_a_difference_is_taken_draw_by_draw() -> None:
    rng = np.random.default_rng(4)
    frames = flight(rng, 12, 30, common=0.2)
    other = [(d + 0.01 * g + rng.normal(0.0, 0.001, len(g)) * g, g) for d, g in frames]
    expected = np.quantile(in_a_loop(other) - in_a_loop(frames), (0.025, 0.975), axis=0).T
    found, alone = difference(sums(other), sums(frames)), intervals(sums(frames))
    assert found is not None
    assert alone is not None
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-14)
    # What the frames do to both alike is not in it.
    assert 0.0 < found[0, 1] - found[0, 0] < 0.35 * (alone[0, 1] - alone[0, 0])


@pytest.mark.parametrize("full", [0, 1, LEAST_CLUSTERS - 1, LEAST_CLUSTERS])
def test_too_few_clusters_have_no_interval_and_empty_ones_do_not_count(full: int) -> None:
    nothing = (np.empty(0), np.empty(0))
    frames = flight(np.random.default_rng(5), full, 6)
    found = intervals(sums([nothing, *frames, nothing, nothing]))
    alone = intervals(sums(frames))
    if full < LEAST_CLUSTERS:
        assert found is alone is None
        assert difference(sums(frames), sums(frames)) is None
    else:
        assert found is not None
        assert alone is not None
        np.testing.assert_array_equal(found, alone)
        assert np.isfinite(found).all()
        np.testing.assert_array_equal(difference(sums(frames), sums(frames)), np.zeros((8, 2)))


def holds(bounds: np.ndarray | None, truth: float) -> bool:
    assert bounds is not None
    return bool(bounds[0, 0] <= truth <= bounds[0, 1])


def test_intervals_over_frames_hold_the_truth() -> None:
    rng = np.random.default_rng(6)
    truth = math.sqrt(2.0 / math.pi) * math.hypot(0.05, 0.03)
    held = [holds(intervals(sums(flight(rng, 20, 40))), truth) for _ in range(300)]
    # 0.95 at best; percentile intervals of 20 clusters are some 3 % of cases short of it.
    assert 0.90 <= np.mean(held) <= 0.98


def test_intervals_over_pixels_do_not() -> None:
    rng = np.random.default_rng(7)
    truth = math.sqrt(2.0 / math.pi) * math.hypot(0.05, 0.03)
    held = []
    for _ in range(60):
        d, g = (np.concatenate(part) for part in zip(*flight(rng, 20, 20), strict=True))
        held.append(holds(intervals(GroupedSums.of(d, g, np.arange(len(d)), len(d))), truth))
    assert 0.2 <= np.mean(held) <= 0.75


def scored(rng: np.random.Generator, name: str, n: int) -> FrameScore:
    """A frame with an error of its own that a second method has once more, and a little on top."""
    ((depth, reference),) = flight(rng, 1, n)
    depths = np.column_stack([depth, reference + 1.3 * (depth - reference)])
    pixels, nobody = rng.uniform((0.0, 0.0), (399.0, 299.0), (n, 2)), np.full(n, name, object)
    lines = AlignedDepths(
        ("one", "two"), nobody, nobody, pixels, np.ones(n), depths, 0.05 * depths, np.ones((n, 2), np.bool_)
    )
    truth = Reference(reference, np.full(n, 0.1), np.zeros((n, 2)), np.ones(n, np.bool_))
    sums = FrameSums.of(Scored(lines, truth, np.zeros(n), np.tile([0.0, 0.0, -1.0], (n, 1)), (400, 300)), 100.0)
    return FrameScore(name, n, n, sums)


def test_what_metrics_json_tells_of_it() -> None:
    rng = np.random.default_rng(8)
    scores = [scored(rng, f"f{i}", 200) for i in range(10)]
    found = metrics_object(("one", "two"), scores)["methods"]
    for entry in found.values():
        assert entry["interval_95"]["all"] == entry["interval_95"]["common"]
        for row in (entry, *entry["per_frame"]):
            for name, (low, high) in row["interval_95"]["all"].items():
                assert low <= row["all"][name] <= high
    assert "difference_95" not in found["one"]["interval_95"]
    # Two is worse by three tenths of one's error: the difference is above nothing, and surer than either.
    low, high = found["two"]["interval_95"]["difference_95"]["abs_rel"]
    worse = found["two"]["common"]["abs_rel"] - found["one"]["common"]["abs_rel"]
    alone = found["one"]["interval_95"]["common"]["abs_rel"]
    assert 0.0 < low < worse < high
    assert high - low == pytest.approx(0.3 * (alone[1] - alone[0]), rel=1e-6)


def test_a_frames_interval_is_over_cells_of_the_image() -> None:
    rng = np.random.default_rng(9)
    frame = scored(rng, "f", 3000)
    lone = intervals(GroupedSums.of(*flight(rng, 1, 3000)[0], np.arange(3000) % 48, 48))
    assert frame.sums.grid[0].n_cells == frame.sums.grid[0].n_covered == 48
    found = frame.sums.grid[0].kept
    assert found is not None
    assert lone is not None
    # Here pixels of a cell have nothing in common: it is as long as one over any 48 groups.
    assert 0.4 < (found[0, 1] - found[0, 0]) / (lone[0, 1] - lone[0, 0]) < 2.5
