"""Depth metrics against scikit-learn, calibration on errors of known sigma, and all sums over any split into shards."""

import math

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn import metrics as learned

from pipeline.engine.errors import InputError
from pipeline.scoring.binned import range_edges_m
from pipeline.scoring.calibration import NOMINAL, CalibrationSums, MapSums
from pipeline.scoring.depth_rows import align
from pipeline.scoring.metrics import DepthSums, GroupedSums, MethodSums, usable
from pipeline.scoring.summary import to_json
from schemas import DEPTHS

depths = st.lists(st.tuples(st.floats(0.5, 200.0), st.floats(0.5, 200.0)), min_size=1, max_size=40)


def test_by_hand() -> None:
    found = DepthSums.of(np.array([11.0, 18.0, 60.0]), np.array([10.0, 20.0, 30.0])).metrics()
    # errors 1, -2, 30; relative 0.1, 0.1, 1; ratios 1.1, 1.111, 2
    expected = {
        "n": 3,
        "abs_rel": 1.2 / 3,
        "sq_rel": (1 / 10 + 4 / 20 + 900 / 30) / 3,
        "rmse": math.sqrt((1 + 4 + 900) / 3),
        "rmse_log": math.sqrt((math.log(1.1) ** 2 + math.log(0.9) ** 2 + math.log(2.0) ** 2) / 3),
        "mae": 33 / 3,
        "delta1": 2 / 3,
        "delta2": 2 / 3,
        "delta3": 2 / 3,
    }
    assert found == pytest.approx(expected, abs=1e-12, rel=1e-12)


def test_delta_is_strict_and_two_sided() -> None:
    found = DepthSums.of(np.array([12.5, 8.0, 12.499, 15.63]), np.full(4, 10.0)).metrics()
    assert found["delta1"] == 0.25
    assert found["delta2"] == 0.75
    assert found["delta3"] == 1.0


@given(depths)
@settings(max_examples=60, deadline=None)
def test_against_scikit_learn(pairs: list[tuple[float, float]]) -> None:
    d, g = (np.array(x) for x in zip(*pairs, strict=True))
    found = DepthSums.of(d, g).metrics()
    expected = {
        "abs_rel": learned.mean_absolute_percentage_error(g, d),
        # A weighted mean is over the sum of its weights, SqRel over the pixels.
        "sq_rel": learned.mean_squared_error(g, d, sample_weight=1.0 / g) * np.mean(1.0 / g),
        "rmse": learned.root_mean_squared_error(g, d),
        "rmse_log": learned.root_mean_squared_error(np.log(g), np.log(d)),
        "mae": learned.mean_absolute_error(g, d),
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-9, abs=1e-12)
    for k in (1, 2, 3):
        assert found[f"delta{k}"] == sum(max(a / b, b / a) < 1.25**k for a, b in pairs) / len(pairs)


@given(depths, st.integers(1, 5))
@settings(max_examples=40, deadline=None)
def test_groups_are_sets_of_their_own(pairs: list[tuple[float, float]], count: int) -> None:
    d, g = (np.array(x) for x in zip(*pairs, strict=True))
    # One more group than there are, whose pixels are in none.
    group = np.arange(len(d)) % (count + 1) - 1
    found = GroupedSums.of(d, g, group, count)
    alone = GroupedSums.stacked(DepthSums.of(d[group == k], g[group == k]) for k in range(count))
    np.testing.assert_array_equal(found.n, alone.n)
    np.testing.assert_allclose(found.sums, alone.sums, rtol=1e-13)
    np.testing.assert_array_equal(GroupedSums.total([found, alone]).n, 2 * found.n)
    for row, k in zip(found.metrics(), range(count), strict=True):
        whole = DepthSums.of(d[group == k], g[group == k]).metrics()
        assert row["n"] == whole["n"]
        assert row.keys() == whole.keys()
        assert [x for x in row.values() if x is not None] == pytest.approx(
            [x for x in whole.values() if x is not None], rel=1e-12
        )


@given(depths, st.integers(1, 7))
@settings(max_examples=40, deadline=None)
def test_parts_add_up_to_the_whole(pairs: list[tuple[float, float]], size: int) -> None:
    d, g = (np.array(x) for x in zip(*pairs, strict=True))
    parts = [DepthSums.of(d[i : i + size], g[i : i + size]) for i in range(0, len(d), size)]
    whole = DepthSums.of(d, g)
    assert DepthSums.total(parts).n == whole.n
    np.testing.assert_allclose(DepthSums.total(parts).sums, whole.sums, rtol=1e-14)
    np.testing.assert_array_equal(DepthSums.total(parts[::-1]).sums, DepthSums.total(parts).sums)


def test_no_pixel_is_null_not_zero() -> None:
    nothing = MethodSums.of(np.empty(0), np.empty(0), np.empty(0, bool), np.empty(0, bool)).metrics()
    assert nothing["kept_share"] is None
    assert nothing["all"] == dict.fromkeys(nothing["all"], None) | {"n": 0}
    assert DepthSums.total([]).metrics()["rmse"] is None


def test_kept_and_common_are_different_pixels() -> None:
    depth, reference = np.array([10.0, 22.0, 33.0, np.nan]), np.array([10.0, 20.0, 30.0, 40.0])
    kept, common = np.array([True, True, False, False]), np.array([True, False, False, False])
    found = MethodSums.of(depth, reference, kept, common).metrics()
    assert found["kept_share"] == 0.5
    assert found["all"]["abs_rel"] == pytest.approx(0.05)
    assert found["common"] == MethodSums.of(depth[:1], reference[:1], kept[:1], common[:1]).metrics()["all"]


def test_a_depth_that_is_none_is_never_kept() -> None:
    assert usable(np.array([1.0, np.nan, np.inf, 0.0, -1.0, 2.0]), np.array([True] * 5 + [False])).tolist() == [
        True, False, False, False, False, False,
    ]  # fmt: skip


def test_calibration_counts_the_reference_spread() -> None:
    depth, reference = np.array([10.0, 10.0, 10.0, 10.0]), np.array([10.9, 11.9, 12.4, 11.0])
    sigma = np.array([1.0, 1.0, 1.0, np.nan])
    alone, with_spread = (
        CalibrationSums.of(depth, sigma, reference, np.full(4, spread)).metrics() for spread in (0.0, 0.75)
    )
    assert (alone["n"], alone["within_1_sigma"], alone["within_2_sigma"]) == (3, 1 / 3, 2 / 3)
    assert (with_spread["n"], with_spread["within_1_sigma"], with_spread["within_2_sigma"]) == (3, 1 / 3, 1.0)


def test_gaussian_errors_are_found_calibrated() -> None:
    rng = np.random.default_rng(1)
    reference = rng.uniform(20.0, 90.0, 200_000)
    sigma, spread = reference * np.exp(rng.uniform(-4.5, -2.5, 200_000)), np.full(200_000, 0.4)
    depth = reference + rng.normal(0.0, np.hypot(sigma, spread))
    found = CalibrationSums.of(depth, sigma, reference, spread).metrics()
    assert 0.678 < found["within_1_sigma"] < 0.688
    assert 0.952 < found["within_2_sigma"] < 0.957
    assert [point["nominal"] for point in found["curve"]] == list(NOMINAL)
    assert all(abs(point["observed"] - point["nominal"]) < 0.005 for point in found["curve"])
    assert 0.98 < found["mean_square"] < 1.02
    assert 0.98 < found["robust_mean_square"] < 1.02
    # At either end of the sigmas that there are, bins hold those whose depths came out too short, or too long.
    inside = [one for one in found["by_sigma"] if one["n"] > 5000 and one["to"] < 0.07]
    assert len(inside) > 5
    assert all(0.97 < one["observed"] / one["predicted"] < 1.03 for one in inside)
    # Outliers carry the mean square away, the median not; sigmas of half the size make four of both.
    depth[:2000] *= 3.0
    found = CalibrationSums.of(depth, sigma / 2, reference, spread / 2).metrics()
    assert found["mean_square"] > 40.0
    assert 3.9 < found["robust_mean_square"] < 4.3


def test_the_median_lies_within_its_bin_as_the_logarithm_goes() -> None:
    # In sigmas: one below, four between 2^0 and 2^(1/8), three above; half of eight is 3/4 into that bin.
    z = np.array([0.5, 1.01, 1.02, 1.03, 1.04, 2.0, 3.0, 4.0])
    found = CalibrationSums.of(10.0 + z, np.ones(8), np.full(8, 10.0), np.zeros(8)).metrics()
    assert found["robust_mean_square"] == pytest.approx((2.0 ** (3 / 32) / 0.6744897501960817) ** 2, rel=1e-12)


@pytest.mark.parametrize(
    ("largest", "edges"),
    [
        (100.0, [10.0 * k for k in range(11)]),
        (8.0, [1.0 * k for k in range(9)]),
        (45.0, [5.0 * k for k in range(10)]),
        (12.5, [0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 12.5]),
        (0.3, [0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3]),
        (101.0, [0.0, 20.0, 40.0, 60.0, 80.0, 100.0, 101.0]),
    ],
)
def test_range_bins_suit_the_largest_range(largest: float, edges: list[float]) -> None:
    assert range_edges_m(largest) == pytest.approx(edges, rel=1e-14)


@given(st.floats(0.01, 1e5))
def test_there_are_at_most_ten_range_bins(largest: float) -> None:
    edges = np.array(range_edges_m(largest))
    assert 4 <= len(edges) <= 11
    assert (edges[0], edges[-1]) == (0.0, largest)
    assert np.all(np.diff(edges) > 0.0)


def test_map_error_splits_along_the_ray() -> None:
    rays = np.array([[0.6, 0.0, -0.8], [0.0, 1.0, 0.0]])
    found = MapSums.of(np.array([12.0, 7.0]), np.array([10.0, 10.0]), rays).metrics()
    expected = {
        "n": 2,
        "rmse_z_m": math.sqrt(1.6**2 / 2),
        "rmse_h_m": math.sqrt((1.2**2 + 9.0) / 2),
        "rmse_3d_m": math.sqrt((4.0 + 9.0) / 2),
    }
    assert found == pytest.approx(expected, rel=1e-14)


def depth_rows(rows: list[tuple[str, float, str, float | None, bool]]) -> pa.Table:
    return DEPTHS.from_rows(
        {"pair_id": pair, "frame_id": pair.split("~")[0], "u": u, "v": 2 * u, "src_u": u, "src_v": u, "method": method,
         "depth_m": depth,
         "sigma_depth_m": None if depth is None else 0.1 * depth, "parallax_deg": 1.0, "kept": kept, "reason": ""}
        for pair, u, method, depth, kept in rows
    )  # fmt: skip


def test_methods_are_brought_beside_each_other() -> None:
    table = depth_rows(
        [
            ("a~b", 5.0, "m", 1.0, True), ("a~b", 3.0, "m", 2.0, True), ("c~a", 5.0, "k", 7.0, False),
            ("a~b", 5.0, "k", 3.0, True), ("a~b", 3.0, "k", None, True), ("c~a", 5.0, "m", 8.0, True),
        ]
    )  # fmt: skip
    found = align(table, ("m", "k"))
    lines = {(p, u): i for i, (p, u) in enumerate(zip(found.pair_id, found.pixels[:, 0], strict=True))}
    assert list(lines) == [("a~b", 5.0), ("a~b", 3.0), ("c~a", 5.0)]
    np.testing.assert_array_equal(found.depth_m, [[1.0, 3.0], [2.0, np.nan], [8.0, 7.0]])
    np.testing.assert_array_equal(found.kept, [[True, True], [True, False], [True, False]])
    assert found.frame_id.tolist() == ["a", "a", "c"]


def test_the_same_pixel_twice_in_a_pair_stays_two_matches() -> None:
    found = align(depth_rows([("a~b", 5.0, m, d, True) for m in "mk" for d in (1.0, 2.0)]), ("m", "k"))
    np.testing.assert_array_equal(found.depth_m, [[1.0, 1.0], [2.0, 2.0]])


def test_a_method_without_a_pair_keeps_nothing_of_it() -> None:
    found = align(depth_rows([("a~b", 5.0, "m", 1.0, True), ("c~a", 5.0, "k", 1.0, True)]), ("m", "k"))
    assert found.kept.sum(axis=1).tolist() == [1, 1]


@pytest.mark.parametrize(
    "rows",
    [
        [("a~b", 5.0, "m", 1.0, True), ("a~b", 6.0, "k", 1.0, True)],
        [("a~b", 5.0, "m", 1.0, True), ("a~b", 6.0, "m", 1.0, True), ("a~b", 5.0, "k", 1.0, True)],
    ],
)
def test_methods_on_other_pixels_are_refused(rows: list[tuple[str, float, str, float | None, bool]]) -> None:
    with pytest.raises(InputError, match=r"E-SCORE-01.*same pixels"):
        align(depth_rows(rows), ("m", "k"))


def test_no_rows_align_to_no_lines() -> None:
    assert align(DEPTHS.empty(), ("m",)).depth_m.shape == (0, 1)


def test_json_is_rounded_and_sorted() -> None:
    assert to_json({"b": [0.1 + 0.2, None], "a": 1}) == '{\n "a": 1,\n "b": [\n  0.3,\n  null\n ]\n}\n'
