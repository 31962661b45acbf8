"""Twelve pixels of two frames, three methods: every number of metrics.json by hand, in fractions."""

from __future__ import annotations

import math
from collections.abc import Iterable
from fractions import Fraction as F  # noqa: N817 - a hundred fractions are read by their numbers
from typing import Any

import numpy as np
import pytest

from pipeline.lidar.reference import Reference
from pipeline.scoring.depth_rows import AlignedDepths
from pipeline.scoring.frame_scores import FrameScore
from pipeline.scoring.frame_sums import FrameSums, Scored
from pipeline.scoring.summary import metrics_object

NAN = math.nan
METHODS = ("epi", "dlt", "mono")
# The ray down, rays of length 5/4 and level rays, scaled to depth 1.
DOWN, EAST_DOWN, NORTH_DOWN, EAST, NORTH = (0, 0, -1), (0.75, 0, -1), (0, 0.75, -1), (1, 0, 0), (0, 1, 0)
# Pixel: u, v, ray, reference, parallax, depths and sigma of epi, spread and pose sigma of the reference. The image has
# 80 by 60 pixels, so that cells are squares of ten, the first from -0.5 to 9.5.
PIXELS = {
    "a0": (0, 0, DOWN, 10, 0.25, (11, 9, 20), (3, 4, 12)),
    "a1": (9, 9, EAST_DOWN, 20, 0.1, (18, 22, NAN), (2, 0, 0)),
    "a2": (9.5, 0, DOWN, 40, 1.5, (40, 50, 60), (1, 0, 0)),
    "a3": (79.4, 59.4, EAST, 50, 3, (60, 55, 75), (3, 4, 0)),
    "a4": (25, 25, EAST_DOWN, 80, 16, (100, 80, 60), (8, 0, 15)),
    "a5": (29, 21, DOWN, 25, 40, (20, 24, 40), (1, 0, 0)),
    "a6": (45, 45, DOWN, 64, NAN, (NAN, 72, 32), (NAN, 0, 0)),
    "b7": (-0.5, -0.5, NORTH_DOWN, 10, 5, (8, 12, 15), (4, 3, 0)),
    "b8": (79.5, 2, DOWN, 20, 0.75, (32, 20, 30), (6, 0, 8)),
    "b9": (33, 33, NORTH_DOWN, 40, 9, (30, 36, 80), (24, 7, 60)),
    "b10": (33, 34, NORTH, 50, 0.6, (110, 40, NAN), (NAN, 1, 1)),
    "b11": (3, 12, EAST_DOWN, 16, 0, (17, 32, 24), (1, 0, 0)),
}
MASKED = {"epi": {"a5", "a6", "b11"}, "dlt": {"a3"}, "mono": {"a1", "b10"}}
COMMON = ("a0", "a2", "a4", "b7", "b8", "b9")

# By hand, of each pixel a method keeps: |d-g|/g, (d-g)^2/g, (d-g)^2, d/g, |d-g|, and how many of the three deltas hold
# (ratios below 1.25, 1.5625 and 1.953125, and exactly 1.25 does not).
HAND = {
    "epi": {
        "a0": (F(1, 10), F(1, 10), 1, F(11, 10), 1, 3),
        "a1": (F(1, 10), F(1, 5), 4, F(9, 10), 2, 3),
        "a2": (0, 0, 0, F(1), 0, 3),
        "a3": (F(1, 5), 2, 100, F(6, 5), 10, 3),
        "a4": (F(1, 4), 5, 400, F(5, 4), 20, 2),
        "b7": (F(1, 5), F(2, 5), 4, F(4, 5), 2, 2),
        "b8": (F(3, 5), F(36, 5), 144, F(8, 5), 12, 1),
        "b9": (F(1, 4), F(5, 2), 100, F(3, 4), 10, 2),
        "b10": (F(6, 5), 72, 3600, F(11, 5), 60, 0),
    },
    "dlt": {
        "a0": (F(1, 10), F(1, 10), 1, F(9, 10), 1, 3),
        "a1": (F(1, 10), F(1, 5), 4, F(11, 10), 2, 3),
        "a2": (F(1, 4), F(5, 2), 100, F(5, 4), 10, 2),
        "a4": (0, 0, 0, F(1), 0, 3),
        "a5": (F(1, 25), F(1, 25), 1, F(24, 25), 1, 3),
        "a6": (F(1, 8), 1, 64, F(9, 8), 8, 3),
        "b7": (F(1, 5), F(2, 5), 4, F(6, 5), 2, 3),
        "b8": (0, 0, 0, F(1), 0, 3),
        "b9": (F(1, 10), F(2, 5), 16, F(9, 10), 4, 3),
        "b10": (F(1, 5), 2, 100, F(4, 5), 10, 2),
        "b11": (1, 16, 256, F(2), 16, 0),
    },
    "mono": {
        "a0": (1, 10, 100, F(2), 10, 0),
        "a2": (F(1, 2), 10, 400, F(3, 2), 20, 2),
        "a3": (F(1, 2), F(25, 2), 625, F(3, 2), 25, 2),
        "a4": (F(1, 4), 5, 400, F(3, 4), 20, 2),
        "a5": (F(3, 5), 9, 225, F(8, 5), 15, 1),
        "a6": (F(1, 2), 16, 1024, F(1, 2), 32, 0),
        "b7": (F(1, 2), F(5, 2), 25, F(3, 2), 5, 2),
        "b8": (F(1, 2), 5, 100, F(3, 2), 10, 2),
        "b9": (1, 40, 1600, F(2), 40, 0),
        "b11": (F(1, 2), 4, 64, F(3, 2), 8, 2),
    },
}
# Euclidean distances are 10, 25, 40, 50, 100, 25, 64; 12.5, 20, 50, 50, 20.
BY_RANGE = {0: (), 10: ("a0", "b7"), 20: ("a1", "a5", "b8", "b11"), 30: (), 40: ("a2",), 50: ("a3", "b9", "b10"),
            60: ("a6",), 70: (), 80: (), 90: ("a4",)}  # fmt: skip
BY_PARALLAX = {(0, 0.25): ("a1", "b11"), (0.25, 0.5): ("a0",), (0.5, 1): ("b8", "b10"), (1, 2): ("a2",),
               (2, 4): ("a3",), (4, 8): ("b7",), (8, 16): ("b9",), (16, None): ("a4", "a5")}  # fmt: skip
NO_INTERVAL = {"all": None, "common": None}


def frame(name: str) -> FrameScore:
    """What the stage makes of one frame's pixels."""
    names = [pixel for pixel in PIXELS if pixel.startswith(name)]
    u, v, rays, reference, parallax, depths, sigmas = zip(*(PIXELS[pixel] for pixel in names), strict=True)
    n = len(names)
    sigma, spread, pose = np.array(sigmas, float).T
    kept = np.array([[pixel not in MASKED[method] for method in METHODS] for pixel in names])
    nobody = np.full(n, name, object)
    sigma_m = np.column_stack([sigma, np.full((n, 2), NAN)])
    pixels = np.column_stack([u, v]).astype(float)
    lines = AlignedDepths(
        METHODS, nobody, nobody, pixels, np.array(parallax, float), np.array(depths, float), sigma_m, kept
    )
    truth = Reference(np.array(reference, float), spread, np.zeros((n, 2)), np.ones(n, bool))
    scored = Scored(lines, truth, pose, np.array(rays, float), (80, 60))
    return FrameScore(name, n, n, FrameSums.of(scored, 100.0))


def of(method: str, pixels: Iterable[str]) -> dict[str, float | int | None]:
    """The metrics of those of some pixels that a method keeps, from its rows of the table above."""
    rows = [HAND[method][pixel] for pixel in pixels if pixel in HAND[method]]
    n = len(rows)
    names = ("abs_rel", "sq_rel", "rmse", "rmse_log", "mae", "delta1", "delta2", "delta3")
    if not n:
        return {"n": 0} | dict.fromkeys(names)
    relative, square_relative, square, ratio, error, deltas = zip(*rows, strict=True)
    return {
        "n": n,
        "abs_rel": float(F(sum(relative)) / n),
        "sq_rel": float(F(sum(square_relative)) / n),
        "rmse": math.sqrt(F(sum(square), n)),
        "rmse_log": math.sqrt(sum(math.log(r) ** 2 for r in ratio) / n),
        "mae": float(F(sum(error)) / n),
        **{f"delta{k}": float(F(sum(held > 3 - k for held in deltas), n)) for k in (1, 2, 3)},
    }


def both(method: str, pixels: Iterable[str]) -> dict[str, Any]:
    """`all` and `common` of some pixels."""
    listed = list(pixels)
    return {"all": of(method, listed), "common": of(method, [pixel for pixel in listed if pixel in COMMON])}


def same(found: Any, expected: Any, where: str = "") -> None:
    """Both have the same keys and, to 1e-12, the same numbers."""
    if isinstance(expected, dict):
        assert sorted(found) == sorted(expected), where
        for key, value in expected.items():
            same(found[key], value, f"{where}/{key}")
    elif isinstance(expected, list):
        assert len(found) == len(expected), where
        for i, (one, other) in enumerate(zip(found, expected, strict=True)):
            same(one, other, f"{where}[{i}]")
    elif isinstance(expected, float | F):
        assert found == pytest.approx(float(expected), abs=1e-12, rel=1e-12), where
    else:
        assert found == expected, where


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    return metrics_object(METHODS, [frame("a"), frame("b")])


def test_the_published_method_in_closed_form(found: dict[str, Any]) -> None:
    expected = {
        "n": 9,
        "abs_rel": (0.1 + 0.1 + 0 + 0.2 + 0.25 + 0.2 + 0.6 + 0.25 + 1.2) / 9,
        "sq_rel": (0.1 + 0.2 + 0 + 2 + 5 + 0.4 + 7.2 + 2.5 + 72) / 9,
        "rmse": math.sqrt((1 + 4 + 0 + 100 + 400 + 4 + 144 + 100 + 3600) / 9),
        "rmse_log": math.sqrt(
            sum(math.log(x) ** 2 for x in (1.1, 0.9, 1.0, 1.2, 1.25, 0.8, 1.6, 0.75, 2.2)) / 9
        ),
        "mae": 117 / 9,
        "delta1": 4 / 9,
        "delta2": 7 / 9,
        "delta3": 8 / 9,
    }  # fmt: skip
    same(found["methods"]["epi"]["all"], expected)
    assert expected["abs_rel"] == pytest.approx(29 / 90)


@pytest.mark.parametrize(
    ("method", "kept", "kept_a", "kept_b", "covered"),
    [
        # Frame a has pixels in the cells (0, 0) two, (1, 0), (7, 5), (2, 2) two and (4, 4); b in (0, 0), (7, 0), (3, 3)
        # two and (0, 1): nine cells. epi lacks a's (4, 4) and b's (0, 1), dlt a's (7, 5), mono none.
        ("epi", F(9, 12), F(5, 7), F(4, 5), F(7, 9)),
        ("dlt", F(11, 12), F(6, 7), F(5, 5), F(8, 9)),
        ("mono", F(10, 12), F(6, 7), F(4, 5), F(9, 9)),
    ],
)
def test_every_number_of_a_method(
    found: dict[str, Any], method: str, kept: F, kept_a: F, kept_b: F, covered: F
) -> None:
    entry = found["methods"][method]
    # Two frames have no interval; five cells of one frame do, and only mono keeps so many.
    intervals = [row.pop("interval_95") for row in entry["per_frame"]]
    five = intervals[0].pop("all")
    assert (five is not None) == (method == "mono")
    assert intervals == [{"common": None}, NO_INTERVAL]
    a, b = ([pixel for pixel in PIXELS if pixel.startswith(name)] for name in "ab")
    expected = {
        **both(method, PIXELS),
        "kept_share": kept,
        "interval_95": NO_INTERVAL | ({} if method == "epi" else {"difference_95": None}),
        "by_range": [{"from": low, "to": low + 10, **both(method, pixels)} for low, pixels in BY_RANGE.items()],
        "by_parallax": [
            {"from": low, "to": high, **both(method, pixels)} for (low, high), pixels in BY_PARALLAX.items()
        ],
        "coverage": {"image_share": covered},
        "per_frame": [
            {"frame_id": "a", "n_scored": 7, "kept_share": kept_a, **both(method, a)},
            {"frame_id": "b", "n_scored": 5, "kept_share": kept_b, **both(method, b)},
        ],
    }
    same(entry, expected)


def test_the_sigmas(found: dict[str, Any]) -> None:
    # b10 has no sigma. Errors are 1, 2, 0, 10, 20, 2, 12, 10; sigmas with the pose's part 13, 2, 1, 5, 17, 5, 10, 65,
    # without 5, 2, 1, 5, 8, 5, 6, 25. Bounds of the nominal shares: 0.126, 0.253, 0.385, 0.524, 0.674, 0.842, 1.036,
    # 1.282, 1.645, 1.960. The fourth of eight errors, 0.4, lies between 2^(-11/8) and 2^(-10/8), with none above it.
    nominal = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
    robust = (2 ** (-10 / 8) / 0.6744897501960817) ** 2
    with_pose = {
        "method": "epi",
        "n": 8,
        "within_1_sigma": F(5, 8),
        "within_2_sigma": F(8, 8),
        "curve": [
            {"nominal": p, "observed": F(count, 8)}
            for p, count in zip(nominal, (2, 3, 3, 4, 4, 4, 5, 7, 7, 7), strict=True)
        ],
        "mean_square": (F(1, 169) + 1 + 0 + 4 + F(400, 289) + F(4, 25) + F(36, 25) + F(4, 169)) / 8,
        "robust_mean_square": robust,
        "by_sigma": [
            {"from": 0.025, "to": 0.0315, "n": 1, "predicted": F(1, 40), "observed": F(0, 40)},
            {"from": 0.08, "to": 0.1, "n": 1, "predicted": F(5, 60), "observed": F(10, 60)},
            {"from": 0.1, "to": 0.125, "n": 1, "predicted": F(2, 18), "observed": F(2, 18)},
            {"from": 0.16, "to": 0.2, "n": 1, "predicted": F(17, 100), "observed": F(20, 100)},
            {"from": 0.25, "to": 0.315, "n": 1, "predicted": F(10, 32), "observed": F(12, 32)},
            {"from": 0.5, "to": 0.63, "n": 1, "predicted": F(5, 8), "observed": F(2, 8)},
            {
                "from": 1.0,
                "to": None,
                "n": 2,
                "predicted": math.sqrt((F(13, 11) ** 2 + F(65, 30) ** 2) / 2),
                "observed": math.sqrt((F(1, 11) ** 2 + F(10, 30) ** 2) / 2),
            },
        ],
    }
    without = {
        "n": 8,
        "within_1_sigma": F(5, 8),
        "within_2_sigma": F(7, 8),
        "curve": [
            {"nominal": p, "observed": F(count, 8)}
            for p, count in zip(nominal, (1, 2, 2, 4, 4, 4, 5, 5, 5, 5), strict=True)
        ],
        "mean_square": (F(1, 25) + 1 + 0 + 4 + F(25, 4) + F(4, 25) + 4 + F(4, 25)) / 8,
        "robust_mean_square": robust,
        "by_sigma": [
            {"from": 0.025, "to": 0.0315, "n": 1, "predicted": F(1, 40), "observed": F(0, 40)},
            {
                "from": 0.08,
                "to": 0.1,
                "n": 2,
                "predicted": math.sqrt((F(5, 60) ** 2 + F(8, 100) ** 2) / 2),
                "observed": math.sqrt((F(10, 60) ** 2 + F(20, 100) ** 2) / 2),
            },
            {"from": 0.1, "to": 0.125, "n": 1, "predicted": F(2, 18), "observed": F(2, 18)},
            {"from": 0.16, "to": 0.2, "n": 1, "predicted": F(6, 32), "observed": F(12, 32)},
            {"from": 0.4, "to": 0.5, "n": 1, "predicted": F(5, 11), "observed": F(1, 11)},
            {"from": 0.5, "to": 0.63, "n": 1, "predicted": F(5, 8), "observed": F(2, 8)},
            {"from": 0.8, "to": 1.0, "n": 1, "predicted": F(25, 30), "observed": F(10, 30)},
        ],
    }
    same(found["calibration"], {**with_pose, "without_pose": without})


def test_the_map(found: dict[str, Any]) -> None:
    # Errors 1 down, -2 east-down, 0, 10 east, 20 east-down, -2 and -10 north-down, 12 down, 60 north.
    up = 1 + 4 + 0 + 0 + 400 + 4 + 100 + 144 + 0
    level = F(9, 4) + 100 + 225 + F(9, 4) + F(225, 4) + 3600
    expected = {
        "method": "epi",
        "n": 9,
        "rmse_z_m": math.sqrt(F(up, 9)),
        "rmse_h_m": math.sqrt(level / 9),
        "rmse_3d_m": math.sqrt((up + level) / 9),
    }
    same(found["map"], expected)


def test_nothing_else_is_in_it(found: dict[str, Any]) -> None:
    assert sorted(found) == ["calibration", "map", "methods"]
    assert list(found["methods"]) == list(METHODS)
