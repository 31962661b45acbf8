"""Predicted sigma against truth over redraws of both frames' pose error, which all points of a pair share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from oracles import enu_from_gimbal
from scipy.stats import norm, qmc

from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.poses import Pose, PoseSigmas, relative_pose
from pipeline.geometry.transfer import PixelNoise, VirtualView, transfer_with_sigma, variance_at
from pipeline.geometry.triangulation import dlt_depth

DEG = np.pi / 180.0
OWN = PoseSigmas(np.full(3, 0.053), np.array([0.25, 0.08, 0.08]) * DEG)
COMMON = PoseSigmas(np.zeros(3), np.array([0.25, 0.0, 0.0]) * DEG)
FOCAL_PX, WIDTH, HEIGHT, SIGMA_PX = 1120.0, 1600, 1200, 0.5
ABOVE_GROUND_M, BASELINE_M, NEAREST_M, FARTHEST_M = 31.0, 5.0, 15.0, 100.0
ANGLES = np.array([23.0, -20.0, 0.0]) * DEG
DRAWS, POINTS, MAX_RELATIVE_SIGMA = 512, 150, 0.25
WAYS = {"forward": 0.0, "sideways": 90.0}


@dataclass(frozen=True)
class Errors:
    """(draws, points) of one method on one leg.

    Args:
        depth: Found, m.
        sigma: Predicted, m.
        truth: (points,) m.
    """

    depth: Floats
    sigma: Floats
    truth: Floats

    @property
    def kept(self) -> Bools:
        out: Bools = (self.depth > 0.0) & (self.sigma <= MAX_RELATIVE_SIGMA * self.depth)
        return out

    def within(self, sigmas: float) -> float:
        return float(np.mean((np.abs(self.depth - self.truth) < sigmas * self.sigma)[self.kept]))

    def within_in_inverse_depth(self, sigmas: float) -> float:
        error = np.abs(1.0 / self.depth - 1.0 / self.truth)
        return float(np.mean((error < sigmas * self.sigma / self.depth**2)[self.kept]))

    @property
    def median(self) -> float:
        return float(np.median((np.abs(self.depth - self.truth) / self.truth)[self.kept]))


def scene(centres: Floats, rng: np.random.Generator) -> Floats:
    """(POINTS, 3) m ENU: half on the ground, half on things that stand on it, seen by both cameras within range."""
    rotation, found = enu_from_gimbal(*ANGLES), np.zeros((0, 3))
    half = np.array([WIDTH, HEIGHT]) / (2.0 * FOCAL_PX)
    while len(found) < POINTS:
        ray = np.append(rng.uniform(-half, half), 1.0) @ rotation.T
        ground = ABOVE_GROUND_M / -ray[2] if ray[2] < 0.0 else np.inf
        standing = rng.uniform(NEAREST_M, FARTHEST_M) / np.linalg.norm(ray)
        reach = min(ground, standing) if rng.random() < 0.5 else ground
        if reach * np.linalg.norm(ray) > FARTHEST_M:
            continue
        point = centres[0] + reach * ray
        in_src = (point - centres[1]) @ rotation
        if in_src[2] > 0.0 and np.all(np.abs(in_src[:2]) < half * in_src[2]):
            found = np.vstack([found, point])
    return found


def redrawn(leg: str, seed: int) -> dict[str, Errors]:
    """Every method on the same redraws; low-discrepancy normals, so that 512 redraws measure a share to 1.5 %."""
    rng = np.random.default_rng(seed)
    heading = ANGLES[0] + WAYS[leg] * DEG
    centres = np.array([[0.0, 0.0, ABOVE_GROUND_M]] * 2)
    centres[1, :2] = BASELINE_M * np.array([np.sin(heading), np.cos(heading)])
    points, rotation = scene(centres, rng), enu_from_gimbal(*ANGLES)
    ref, src = ((points - centre) @ rotation for centre in centres)
    noise, found = PixelNoise.isotropic(SIGMA_PX, FOCAL_PX), []
    for z in norm.ppf(qmc.Sobol(15, rng=rng).random(DRAWS)):
        common = z[:3] * COMMON.gimbal_rad
        logged = [
            Pose(
                enu_from_gimbal(*(ANGLES + common + own[:3] * OWN.gimbal_rad)),
                centre + own[3:] * OWN.position_m,
                OWN,
                COMMON,
            )
            for centre, own in zip(centres, z[3:].reshape(2, 6), strict=True)
        ]
        pose = relative_pose(*logged)
        jitter = rng.normal(size=(2, 2, POINTS)) * SIGMA_PX / FOCAL_PX
        ref_xy, src_xy = (ref[:, :2] / ref[:, 2:]).T + jitter[0], (src[:, :2] / src[:, 2:]).T + jitter[1]
        rows = []
        for view in VirtualView:
            depths = transfer_with_sigma(ref_xy, src_xy, pose, view, noise)
            rows += [depths.depth_m, np.sqrt(depths.variance_m2)]
        dlt = dlt_depth(ref_xy, src_xy, pose)
        rows += [dlt, np.sqrt(variance_at(ref_xy, src_xy, pose, dlt, noise)[0])]
        found.append(rows)
    columns = np.array(found).transpose(1, 0, 2)
    names = [*(view.value for view in VirtualView), "dlt"]
    return {name: Errors(columns[2 * i], columns[2 * i + 1], ref[:, 2]) for i, name in enumerate(names)}


@pytest.fixture(scope="module")
def legs() -> dict[str, dict[str, Errors]]:
    return {leg: redrawn(leg, 1) for leg in WAYS}


@pytest.mark.slow
@pytest.mark.parametrize("leg", WAYS)
@pytest.mark.parametrize("method", ["adaptive", "dlt"])
def test_sigma_covers_the_truth_as_often_as_it_says(legs: dict[str, dict[str, Errors]], leg: str, method: str) -> None:
    errors = legs[leg][method]
    assert 0.63 < errors.within(1.0) < 0.73
    assert 0.90 < errors.within(2.0) < 0.99
    assert 0.63 < errors.within_in_inverse_depth(1.0) < 0.73
    assert 0.90 < errors.within_in_inverse_depth(2.0) < 0.99
    assert np.mean(errors.kept) > 0.85


@pytest.mark.slow
@pytest.mark.parametrize("leg", WAYS)
def test_adaptive_is_the_most_accurate_on_the_points_that_both_keep(
    legs: dict[str, dict[str, Errors]], leg: str
) -> None:
    adaptive, dlt = legs[leg]["adaptive"], legs[leg]["dlt"]
    both = adaptive.kept & dlt.kept
    relative = [float(np.mean((np.abs(e.depth - e.truth) / e.truth)[both])) for e in (adaptive, dlt)]
    assert relative[0] < relative[1] * (0.95 if leg == "forward" else 0.99)
    assert 0.03 < adaptive.median < 0.06


@pytest.mark.slow
def test_a_lateral_view_keeps_nothing_on_the_sideways_leg(legs: dict[str, dict[str, Errors]]) -> None:
    assert np.mean(legs["sideways"]["lateral"].kept) < 0.001
    assert np.mean(legs["forward"]["lateral"].kept) > 0.1


@pytest.mark.slow
def test_adaptive_keeps_more_than_any_fixed_view(legs: dict[str, dict[str, Errors]]) -> None:
    for leg in WAYS:
        share = {name: float(np.mean(errors.kept)) for name, errors in legs[leg].items()}
        assert share["adaptive"] > max(share["lateral"], share["vertical"]) + 0.05
