"""A flight refined as a whole: its algebra against dense numpy, its minimum, its sigmas over redraws, and bad input."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from pixel_noise import matrices
from refinement_scenes import (
    CAMERA,
    COMMON,
    DEG,
    EVERY_S,
    NONE,
    OWN,
    WAYS,
    Errors,
    chained,
    log_of,
    logged,
    matches_by_pair,
    named,
    nees,
    off,
    placement,
    refined_flight,
    relative_off,
    robust_cost,
    straight,
)
from scipy.optimize import least_squares
from scipy.stats import chi2

from pipeline.flight import PairRow
from pipeline.geometry.arrays import Floats
from pipeline.geometry.poses import (
    Placement,
    PoseSigmas,
    common_covariance,
    joint_covariance,
    own_covariance,
    relative_jacobian,
    relative_placement,
)
from pipeline.geometry.rotations import gimbal_error_axes, vector_from_rotation
from pipeline.refinement.flight.elimination import eliminated, inverse_depths
from pipeline.refinement.flight.flight import Found, RefinedFlight, refine_flight
from pipeline.refinement.flight.graph import Graph
from pipeline.refinement.flight.shared import level_axes, shared_unknowns, velocities
from pipeline.refinement.flight.stars import Stars, stars_by_ref, stars_of
from pipeline.refinement.logged import Log
from pipeline.refinement.matched import Matched
from pipeline.refinement.near import together
from pipeline.refinement.scatter import SHARED_PX

FIVE_SIGMAS = float(chi2.isf(5.7e-7, 6))
CONSUMER = PoseSigmas(np.array([1.5, 1.5, 3.0]), np.array([2.5, 1.5, 1.0]) * DEG)
Edit = Callable[[list[Matched], np.random.Generator], list[Matched]]


@dataclass(frozen=True)
class Flight:
    """A flight with its truth, and what refinement made of it."""

    truth: dict[str, Placement]
    errors: Errors
    log: Log
    found: RefinedFlight

    def absolute(self) -> list[float]:
        """How far every frame is off, in squared sigmas."""
        return [
            nees(off(self.found.frames[n].placed, at), self.found.frames[n].covariance) for n, at in self.truth.items()
        ]

    def relative(self, pairs: Sequence[PairRow] = ()) -> list[float]:
        """The same of every pair's relative pose."""
        out = []
        for pair in pairs or self.log.pairs.values():
            ref, src = (self.found.frames[name].placed for name in (pair.ref, pair.src))
            jacobian = relative_jacobian(ref, src)
            covariance = jacobian @ self.found.errors.joint(pair.ref, pair.src) @ jacobian.T
            out.append(nees(relative_off((ref, src), (self.truth[pair.ref], self.truth[pair.src])), covariance))
        return out

    def shared(self, name: str) -> Found:
        return next(found for found in self.found.found if found.name == name)

    def problems(self) -> dict[str, str]:
        return {name: frame.problem for name, frame in self.found.frames.items() if frame.problem}


def flight(
    seed: int,
    frames: int = 5,
    way: str = "forward",
    *,
    count: int = 60,
    own: PoseSigmas = OWN,
    common: PoseSigmas = COMMON,
    truth: dict[str, Placement] | None = None,
    pairs: Sequence[PairRow] = (),
    plant: Callable[[Errors], None] | None = None,
    times: Mapping[str, float] | None = None,
    edit: Edit | None = None,
    turned_px: float = 0.0,
) -> Flight:
    """A redraw of everything, refined.

    Args:
        plant: Changes the log's errors.
        edit: Changes the matches.
        turned_px: What all rays of a frame are turned by, one sigma; no match shows it.
    """
    rng = np.random.default_rng([seed, 1])
    truth = truth or straight(frames, way, seed=seed)
    pairs = pairs or chained(list(truth))
    errors = Errors.drawn(rng, len(truth), own, common)
    if plant is not None:
        plant(errors)
    log = log_of(logged(truth, errors, own, common), pairs, times)
    turns = rng.normal(0.0, turned_px / CAMERA.focal_px, (len(truth), 3))
    seen_by = {
        name: at.moved(np.concatenate([turn, np.zeros(3)]))
        for (name, at), turn in zip(truth.items(), turns, strict=True)
    }
    found = matches_by_pair(seen_by, pairs, rng, count)
    return Flight(truth, errors, log, refined_flight(log, edit(found, rng) if edit else found))


def mean_band(values: Sequence[float]) -> tuple[float, float]:
    """Mean and its standard error; values of one flight have much in common, so of flights' means."""
    return float(np.mean(values)), float(np.std(values) / np.sqrt(len(values)))


# --- the graph ---


def filled(rng: np.random.Generator) -> tuple[Graph, Floats, Floats, dict[int, slice]]:
    """A graph of four unknowns, and the same as H and g of x^T H x / 2 + g . x."""
    sizes = {0: 6, 1: 6, 2: 3, 7: 4}
    ends = np.cumsum(list(sizes.values()))
    at = {key: slice(int(end) - size, int(end)) for (key, size), end in zip(sizes.items(), ends, strict=True)}
    units = {key: 10.0 ** rng.uniform(-3.0, 2.0, size) for key, size in sizes.items()}
    graph, h, g = Graph(units), np.zeros((19, 19)), np.zeros(19)
    for keys, rows in (((0,), 6), ((1, 0), 5), ((7, 2), 7), ((2,), 3), ((1, 2), 4), ((1,), 6)):
        blocks, right = [(key, rng.normal(size=(rows, sizes[key]))) for key in keys], rng.normal(size=rows)
        graph.add_rows(blocks, right)
        whole = np.zeros((rows, 19))
        for key, block in blocks:
            whole[:, at[key]] = block
        h, g = h + whole.T @ whole, g - whole.T @ right
    # Turns and shifts, as far apart in size as those of a star factor, and of less than full rank.
    root = rng.normal(size=(7, 12)) * np.tile([1e4] * 3 + [30.0] * 3, 2)
    information, gradient = root.T @ root, root.T @ rng.normal(size=7)
    graph.add_quadratic([1, 0], [6, 6], information, gradient)
    order = np.r_[np.arange(19)[at[1]], np.arange(19)[at[0]]]
    h[np.ix_(order, order)] += information
    g[order] += gradient
    return graph, h, g, at


@pytest.mark.parametrize("seed", range(5))
def test_a_graph_s_solution_and_covariances_are_those_of_the_whole_matrix(seed: int) -> None:
    graph, h, g, at = filled(np.random.default_rng(seed))
    minimum, covariances, covariance = graph.minimum(), graph.covariances(), np.linalg.inv(h)
    expected = -covariance @ g
    assert list(minimum) == list(at)
    for key, part in at.items():
        np.testing.assert_allclose(minimum[key], expected[part], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(covariances.of(key), covariance[part, part], rtol=1e-5, atol=1e-9)
    couples = np.array([(7, 0), (0, 1), (0, 0), (1, 0), (2, 7), (7, 7), (0, 2)])
    for (one, other), block in zip(couples, covariances.couples(couples), strict=True):
        np.testing.assert_allclose(block, covariance[at[one], at[other]], rtol=1e-5, atol=1e-9)


def test_a_quadratic_that_says_nothing_is_left_out() -> None:
    graph = Graph({0: np.array([1.0, 100.0])})
    graph.add_rows([(0, np.eye(2))], np.array([1.0, 2.0]))
    graph.add_quadratic([0], [2], np.zeros((2, 2)), np.zeros(2))
    np.testing.assert_allclose(graph.minimum()[0], (1.0, 2.0))


# --- stars ---


def small(seed: int = 0, frames: int = 3, count: int = 12) -> tuple[Stars, list[Placement], list[Matched]]:
    """The stars of the last frame, and placements that are a little off."""
    rng, truth = np.random.default_rng(seed), straight(frames, seed=seed)
    ref = list(truth)[-1]
    found = matches_by_pair(truth, [named(ref, src) for src in list(truth)[:-1]], rng, count)
    stars = stars_of(found, {name: i for i, name in enumerate(truth)})
    off_by = rng.normal(size=(frames, 6)) * ([2e-4] * 3 + [0.01] * 3)
    names = list(truth)
    return stars, [truth[names[i]].moved(off_by[i]) for i in stars.frames], found


def test_stars_are_pixels_of_ref_with_all_their_matches() -> None:
    stars, _, found = small(1, 4, 30)
    assert list(stars.frames) == [3, 0, 1, 2]
    assert len(stars.xy) == sum(len(some) for some in found)
    for place, some in enumerate(found, 1):
        rows = np.flatnonzero(stars.of == place)
        for row in rows:
            at = int(np.flatnonzero(np.all(some.ref_px == stars.ref_px[stars.star[row]], axis=1))[0])
            np.testing.assert_array_equal(stars.src_px[row], some.src_px[at])
            np.testing.assert_array_equal(stars.xy[row], some.rays.src[at, :2])
            np.testing.assert_array_equal(stars.ray[stars.star[row]], some.rays.ref[at])
            root, covariance = stars.root[row], matrices(some.rays.noise[at : at + 1])[0]
            np.testing.assert_allclose(root.T @ root @ covariance, np.eye(2), atol=1e-9)


def test_stars_are_thinned_evenly_and_those_of_most_frames_stay() -> None:
    rng, truth = np.random.default_rng(2), straight(4, "sideways", 9.0)
    found = matches_by_pair(truth, [named("f03", src) for src in ("f00", "f01", "f02")], rng, 900)
    number = {name: i for i, name in enumerate(truth)}
    every, some = stars_of(found, number, 10_000), stars_of(found, number, 200)
    assert len(some.ray) == 200
    assert np.bincount(some.star).mean() > np.bincount(every.star).mean() + 0.1
    cells = [np.unique((stars.ref_px // 200.0).astype(int), axis=0).shape[0] for stars in (every, some)]
    assert cells[1] > 0.9 * cells[0]
    assert len(stars_by_ref([found[0].without_matches(), found[1]], number)) == 1
    assert stars_by_ref([found[0].without_matches()], number) == []


def whitened(stars: Stars, at: Sequence[Placement], rho: Floats) -> Floats:
    """(m, 2) residuals, point by point."""
    out = []
    for star, of, xy, root in zip(stars.star, stars.of, stars.xy, stars.root, strict=True):
        point = at[0].centre + at[0].rotation @ stars.ray[star] / rho[star]
        in_src = at[of].rotation.T @ (point - at[of].centre)
        out.append(root @ (in_src[:2] / in_src[2] - xy))
    return np.array(out)


@pytest.mark.parametrize("scale", [200.0, 3.0])
@pytest.mark.parametrize("seed", range(3))
def test_eliminated_depths_leave_the_schur_complement_of_numerical_derivatives(seed: int, scale: float) -> None:
    stars, at, _ = small(seed)
    k, rho = len(at), inverse_depths(stars, at, None, scale)
    step = np.concatenate([np.tile([1e-7] * 3 + [1e-5] * 3, k), 1e-6 * rho])

    def residual(change: Floats) -> Floats:
        moved = [placed.moved(one) for placed, one in zip(at, change[: 6 * k].reshape(k, 6), strict=True)]
        return whitened(stars, moved, rho + change[6 * k :]).ravel()

    columns = [(residual(s * e) - residual(-s * e)) / (2.0 * s) for s, e in zip(step, np.eye(len(step)), strict=True)]
    now, jacobian = residual(np.zeros(len(step))), np.stack(columns, axis=1)
    weight = np.repeat(1.0 / (1.0 + np.sum(now.reshape(-1, 2) ** 2, axis=1) / scale**2), 2)
    h, g = jacobian.T @ (weight[:, None] * jacobian), jacobian.T @ (weight * now)
    poses, depths = slice(0, 6 * k), slice(6 * k, None)
    across = np.linalg.solve(h[depths, depths], np.column_stack([h[depths, poses], g[depths]])).T
    found = eliminated(stars, at, rho, scale)
    size = np.sqrt(np.diag(h)[poses])
    expected = h[poses, poses] - across[:-1] @ h[depths, poses]
    np.testing.assert_allclose(found.information / np.outer(size, size), expected / np.outer(size, size), atol=1e-6)
    expected_gradient = g[poses] - across[-1] @ h[depths, poses]
    np.testing.assert_allclose(found.gradient / size, expected_gradient / size, atol=1e-4)
    # Scale, place and turn of the whole are not seen.
    assert np.sum(np.linalg.eigvalsh(found.information / np.outer(size, size)) < 1e-6) == 7


@pytest.mark.parametrize("scale", [200.0, 3.0])
def test_inverse_depths_are_the_minimum_with_the_poses_fixed(scale: float) -> None:
    stars, at, _ = small(4, 4, 20)
    rho = inverse_depths(stars, at, inverse_depths(stars, at, None, scale), scale)
    best = robust_cost(whitened(stars, at, rho), scale)
    for i in range(len(rho)):
        for factor in (0.998, 1.002):
            other = rho.copy()
            other[i] *= factor
            assert robust_cost(whitened(stars, at, other), scale) > best - 1e-9


# --- what all frames get wrong alike ---


def test_velocities_of_a_steady_flight() -> None:
    t = 100.0 + 2.0 * np.arange(7)
    x = np.outer(t, (3.0, -1.0, 0.2)) + 5.0
    for order in (np.arange(7), np.random.default_rng(0).permutation(7)):
        found, rest = velocities(x[order], t[order])
        np.testing.assert_allclose(found, np.tile((3.0, -1.0, 0.2), (7, 1)), atol=1e-9)
        np.testing.assert_allclose(rest, 0.0, atol=1e-9)


def test_velocities_end_at_gaps_and_are_zero_where_nothing_is_known() -> None:
    t = np.array([0.0, 2.0, 4.0, 60.0, 62.0, 64.0, 200.0, np.nan])
    x = np.zeros((8, 3))
    x[:3, 0], x[3:6, 0], x[6:, 0] = t[:3], -3.0 * t[3:6], 1000.0
    found, _ = velocities(x, t)
    np.testing.assert_allclose(found[:, 0], [1.0, 1.0, 1.0, -3.0, -3.0, -3.0, 0.0, 0.0], atol=1e-9)
    found, rest = velocities(x, np.full(8, np.nan))
    assert not found.any()
    assert not rest.any()


def test_frames_of_one_instant_have_finite_velocities() -> None:
    x = np.random.default_rng(0).normal(size=(5, 3))
    for t in ([5.0] * 5, [0.0, 2.0, 2.0, 4.0, 6.0]):
        found, rest = velocities(x, np.array(t))
        assert np.all(np.isfinite(found))
        assert np.all(np.isfinite(rest))
        assert np.abs(found).max() < 10.0


def test_what_the_log_leaves_room_for() -> None:
    truth = straight(6)
    times = EVERY_S * np.arange(6.0)
    poses = list(logged(truth, Errors.none(6)).values())
    shared = shared_unknowns(poses, times)
    room = dict(zip(shared.names, shared.sigma, strict=True))
    np.testing.assert_allclose([room[f"boresight_{n}_rad"] for n in ("yaw", "pitch", "roll")], COMMON.gimbal_rad)
    # Seven tenths of 0.26 m of a level position, at two and a half metres a second.
    assert 0.065 < room["clock_s"] < 0.08
    assert 0.07 < room["lever_down_m"] < 0.085
    # All together are what the log says of a whole position.
    together = shared.bias_sigma_m**2 + np.mean(np.sum((shared.effect[:, 3:] * shared.sigma) ** 2, axis=2), axis=0)
    np.testing.assert_allclose(together, COMMON.position_m**2, rtol=1e-9)
    for i, pose in enumerate(poses):
        np.testing.assert_allclose(shared.effect[i, :3, :3], gimbal_error_axes(pose.rotation))
        np.testing.assert_allclose(np.linalg.norm(shared.effect[i, 3:, 4:], axis=0), 1.0)
    slow = PoseSigmas(np.full(3, 5.0), COMMON.gimbal_rad)
    wide = shared_unknowns(list(logged(truth, Errors.none(6), OWN, slow).values()), times)
    assert dict(zip(wide.names, wide.sigma, strict=True))["clock_s"] == 0.2


def test_a_log_of_centimetres_leaves_none_for_a_clock() -> None:
    rtk = PoseSigmas(np.array([0.015, 0.015, 0.03]), OWN.gimbal_rad)
    poses = list(logged(straight(6), Errors.none(6), rtk, NONE).values())
    shared = shared_unknowns(poses, EVERY_S * np.arange(6.0))
    room = dict(zip(shared.names, shared.sigma, strict=True))
    assert "boresight_yaw_rad" not in room
    assert room["clock_s"] * 2.5 < 0.02
    assert room["lever_forward_m"] == pytest.approx(0.3 * 0.015)


def test_without_times_there_is_no_clock_and_one_bias() -> None:
    poses = list(logged(straight(4), Errors.none(4)).values())
    shared = shared_unknowns(poses, np.full(4, np.nan))
    assert "clock_s" not in shared.names
    assert len(shared.knot_s) == 2
    assert not shared.before.any()
    assert not shared.share.any()


def test_knots_span_the_flight_and_hold() -> None:
    poses = list(logged(straight(5), Errors.none(5)).values())
    times = np.array([1000.0, 1090.0, np.nan, 1150.0, 1240.0])
    shared = shared_unknowns(poses, times)
    assert (shared.knot_s[0], shared.knot_s[-1]) == (1000.0, 1240.0)
    steps = np.diff(shared.knot_s)
    assert np.all(steps <= 60.0 + 1e-9)
    np.testing.assert_allclose(shared.holds, np.exp(-steps / 3600.0))
    at = (1.0 - shared.share) * shared.knot_s[shared.before] + shared.share * shared.knot_s[shared.before + 1]
    known = np.isfinite(times)
    np.testing.assert_allclose(at[known], times[known])


def test_level_axes_of_a_camera_looking_anywhere() -> None:
    for angles in ((0.0, -90.0, 0.0), (0.0, -20.0, 0.0), (0.0, 10.0, 0.0)):
        axes = level_axes(placement(angles, (0.0, 0.0, 0.0)).rotation)
        np.testing.assert_allclose(axes, np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), atol=1e-12)


# --- the minimum ---


def oracle(log: Log, sets: Sequence[Stars]) -> tuple[Floats, Floats]:
    """(n, 6) corrections of the logged poses and the constant unknowns, by bundle adjustment with explicit depths."""
    poses = list(log.poses.values())
    shared = shared_unknowns(poses, np.array(list(log.time_s.values())))
    n, c = len(poses), len(shared.sigma)
    assert not shared.share.any(), "all frames at the first knot: one bias"
    white = [np.linalg.inv(np.linalg.cholesky(own_covariance(pose))) for pose in poses]
    start = [
        inverse_depths(stars, [Placement(poses[i].rotation, poses[i].centre) for i in stars.frames], None, 3.0)
        for stars in sets
    ]
    sizes = np.cumsum([0, *map(len, start)])

    def rows(x: Floats) -> Floats:
        change, constant, bias = x[: 6 * n].reshape(n, 6), x[6 * n : 6 * n + c], x[6 * n + c : 6 * n + c + 3]
        placed = [Placement(pose.rotation, pose.centre).moved(one) for pose, one in zip(poses, change, strict=True)]
        out = [constant / shared.sigma, bias / shared.bias_sigma_m]
        for i in range(n):
            explained = shared.effect[i] @ constant + np.concatenate([np.zeros(3), bias])
            out.append(white[i] @ (change[i] - explained))
        rho = np.exp(np.clip(x[6 * n + c + 3 :], -14.0, 3.0))
        for i, stars in enumerate(sets):
            r = whitened(stars, [placed[f] for f in stars.frames], rho[sizes[i] : sizes[i + 1]])
            size = np.maximum(np.linalg.norm(r, axis=1), 1e-9)
            out.append((r * (3.0 * np.sqrt(np.log1p(size**2 / 9.0)) / size)[:, None]).ravel())
        return np.concatenate(out)

    x0 = np.concatenate([np.zeros(6 * n + c + 3), np.log(np.concatenate(start))])
    found = least_squares(rows, x0, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12, max_nfev=60).x
    return found[: 6 * n].reshape(n, 6), found[6 * n : 6 * n + c]


@pytest.mark.parametrize("way", WAYS)
def test_the_flight_is_the_minimum_that_bundle_adjustment_finds(way: str) -> None:
    rng, truth = np.random.default_rng(3), straight(3, way, seed=3)
    pairs = chained(list(truth))
    log = log_of(logged(truth, Errors.drawn(rng, 3)), pairs, dict.fromkeys(truth, float("nan")))
    matches = matches_by_pair(truth, pairs, rng, 15)
    sets = stars_by_ref(matches, {name: i for i, name in enumerate(truth)})
    found = refine_flight(log, sets, together(tuple(truth), pairs))
    expected, constant = oracle(log, sets)
    for i, (name, pose) in enumerate(log.poses.items()):
        frame = found.frames[name]
        away = off(frame.placed, Placement(pose.rotation, pose.centre).moved(expected[i]))
        # Without the turn that no match shows.
        own = frame.covariance - np.diag([(SHARED_PX / CAMERA.focal_px) ** 2] * 3 + [0.0] * 3)
        assert np.sqrt(nees(away, own)) < 0.1
    for one, value in zip(found.found, constant, strict=True):
        assert abs(one.value - value) < 0.05 * one.sigma


# --- sigmas over redraws ---

DRAWS = 200


@pytest.fixture(scope="module")
def redrawn() -> list[Flight]:
    """Half forward, half sideways, with the turn that no match shows: the model is the one the covariances are of."""
    return [flight(seed, 4, ("forward", "sideways")[seed % 2], count=45, turned_px=SHARED_PX) for seed in range(DRAWS)]


@pytest.mark.slow
def test_frames_are_off_as_their_covariances_say(redrawn: list[Flight]) -> None:
    assert not any(it.problems() for it in redrawn)
    mean, error = mean_band([float(np.mean(it.absolute())) for it in redrawn])
    # A lever arm and a clock are allowed for that this log does not have.
    assert 4.3 - 3.5 * error < mean < 6.0 + 3.5 * error
    assert error < 0.35
    assert max(max(it.absolute()) for it in redrawn) < FIVE_SIGMAS


@pytest.mark.slow
def test_pairs_of_a_flight_are_off_as_their_covariances_say(redrawn: list[Flight]) -> None:
    mean, error = mean_band([float(np.mean(it.relative())) for it in redrawn])
    assert 5.0 - 3.5 * error < mean < 6.0 + 3.5 * error
    assert error < 0.2
    assert max(max(it.relative()) for it in redrawn) < FIVE_SIGMAS


@pytest.mark.slow
@pytest.mark.parametrize("name", ["yaw", "pitch", "roll"])
def test_the_boresight_is_off_as_its_sigma_says(redrawn: list[Flight], name: str) -> None:
    axis = ("yaw", "pitch", "roll").index(name)
    found = [(it.shared(f"boresight_{name}_rad"), it.errors.common[axis]) for it in redrawn]
    square = np.mean([((one.value + planted) / one.sigma) ** 2 for one, planted in found])
    # 200 draws measure a mean square to 10 %.
    assert 0.65 < square < 1.35
    assert all(one.sigma <= one.prior_sigma * (1.0 + 1e-9) for one, _ in found)


@pytest.mark.slow
def test_a_flight_is_better_than_its_log(redrawn: list[Flight]) -> None:
    def turn(it: Flight, placed: Callable[[str], Placement]) -> float:
        pairs = it.log.pairs.values()
        return float(
            np.mean(
                [
                    np.linalg.norm(relative_off((placed(p.ref), placed(p.src)), (it.truth[p.ref], it.truth[p.src]))[:3])
                    for p in pairs
                ]
            )
        )

    before = np.mean([turn(it, lambda n, it=it: it.log.poses[n]) for it in redrawn[:40]])  # type: ignore[misc]
    after = np.mean([turn(it, lambda n, it=it: it.found.frames[n].placed) for it in redrawn[:40]])  # type: ignore[misc]
    assert 0.2 * DEG < before < 0.5 * DEG
    assert after < 0.03 * before


# --- planted errors ---


def there_and_back(seed: int) -> tuple[dict[str, Placement], list[PairRow], dict[str, float], Floats]:
    """Out and back beside it with a camera that looks the same way: what moves with the velocity turns its sign."""
    rng = np.random.default_rng([seed, 6])
    along, n = np.array([0.0, 5.0, 0.0]), 5
    steps = [*range(n), *(n - 1.5 - i for i in range(n))]
    truth = {
        f"f{i:02d}": placement(
            np.array([23.0, -60.0, 0.0]) + rng.normal(0.0, 1.0, 3), along * s + (3.0 * (i >= n), 0.0, 31.0)
        )
        for i, s in enumerate(steps)
    }
    velocity = np.array([along / EVERY_S * (1.0 if i < n else -1.0) for i in range(2 * n)])
    times = {name: 1.7e9 + EVERY_S * i + 30.0 * (i >= n) for i, name in enumerate(truth)}
    names = list(truth)
    pairs = [
        named(names[i], names[j])
        for i in range(2 * n)
        for j in range(i)
        if np.linalg.norm(truth[names[i]].centre - truth[names[j]].centre) < 8.0
    ]
    return truth, pairs, times, velocity


def planted(seed: int, common: Sequence[float], clock_s: float) -> Flight:
    """With a bias of the receiver that drifts over an hour, as the model has it."""
    truth, pairs, times, velocity = there_and_back(seed)
    rng, t = np.random.default_rng([seed, 8]), np.array(list(times.values()))
    # From minute to minute; between, it is a straight line.
    knots = np.linspace(t[0], t[-1], max(2, int(np.ceil((t[-1] - t[0]) / 60.0)) + 1))
    walk = [rng.normal(size=3)]
    for holds in np.exp(-np.diff(knots) / 3600.0):
        walk.append(holds * walk[-1] + np.sqrt(1.0 - holds**2) * rng.normal(size=3))
    bias = np.stack([np.interp(t, knots, axis) for axis in np.array(walk).T], axis=1)

    def plant(errors: Errors) -> None:
        errors.common[:] = np.append(np.array(common) * DEG, np.zeros(3))
        errors.own[:, 3:] += clock_s * velocity + bias * CONSUMER.position_m

    return flight(seed, count=40, common=CONSUMER, truth=truth, pairs=pairs, times=times, plant=plant)


BORESIGHTS = ("boresight_yaw_rad", "boresight_pitch_rad", "boresight_roll_rad")


@pytest.mark.parametrize(
    ("common", "clock_s"), [((1.0, 0.7, -0.5), 0.2), ((-1.0, 0.0, 0.0), 0.0), ((0.0, 0.0, 0.0), -0.2)]
)
def test_planted_boresight_and_clock_are_found(common: Sequence[float], clock_s: float) -> None:
    it = planted(0, common, clock_s)
    for name, deg in zip(BORESIGHTS, common, strict=True):
        found = it.shared(name)
        assert abs(found.value + deg * DEG) < 3.0 * found.sigma
        # Roll about the line of flight is seen by the second line beside it alone.
        assert found.sigma < (0.9 if name.startswith("boresight_roll") else 0.5) * found.prior_sigma
    clock = it.shared("clock_s")
    assert abs(clock.value + clock_s) < 3.0 * clock.sigma
    assert clock.sigma < 0.25 * clock.prior_sigma
    assert not it.problems()


@pytest.mark.slow
def test_planted_values_are_off_as_their_sigmas_say() -> None:
    """Drawn as the priors say: the mean of 30 squares is between 0.45 and 1.8 but for one in a hundred."""
    squares: dict[str, list[float]] = {}
    for seed in range(30):
        rng = np.random.default_rng([seed, 9])
        common, clock_s = rng.normal(size=3) * CONSUMER.gimbal_rad, float(rng.normal(0.0, 0.2))
        it = planted(seed, np.degrees(common).tolist(), clock_s)
        for name, value in (*zip(BORESIGHTS, common, strict=True), ("clock_s", clock_s)):
            found = it.shared(name)
            squares.setdefault(name, []).append(((found.value + value) / found.sigma) ** 2)
    assert len(squares) == 4
    for name, values in squares.items():
        assert 0.45 < np.mean(values) < 1.8, name


# --- bad input ---


@pytest.mark.parametrize("way", WAYS)
def test_a_position_that_jumps_is_told_and_recovered(way: str) -> None:
    def jump(errors: Errors) -> None:
        errors.own[2, 3:] += (30.0, 0.0, 0.0)

    it = flight(0, 6, way, plant=jump)
    assert list(it.problems()) == ["f02"]
    assert "the logged position is" in it.problems()["f02"]
    assert max(it.absolute()) < FIVE_SIGMAS
    assert max(it.relative()) < FIVE_SIGMAS
    shift = off(it.found.frames["f02"].placed, it.truth["f02"])[3:]
    assert np.linalg.norm(shift) < 1.0
    sigma = np.sqrt(np.trace(it.found.frames["f02"].covariance[3:, 3:]))
    assert sigma < 1.0
    # The others are where they would have been without it.
    calm = flight(0, 6, way)
    for name in ("f00", "f01", "f04", "f05"):
        away = off(it.found.frames[name].placed, calm.found.frames[name].placed)
        assert np.sqrt(nees(away, calm.found.frames[name].covariance)) < 1.0


def test_an_attitude_that_jumps_is_told_and_recovered() -> None:
    def jump(errors: Errors) -> None:
        errors.own[3, 0] += 20.0 * DEG

    it = flight(1, 6, plant=jump)
    assert list(it.problems()) == ["f03"]
    assert "the logged attitude is" in it.problems()["f03"]
    assert max(it.absolute()) < FIVE_SIGMAS
    assert max(it.relative()) < FIVE_SIGMAS


def assert_as_logged(it: Flight, names: Sequence[str]) -> None:
    """Where the log put them, and no surer than it says; less sure by what the model allows for: a clock, a lever."""
    for name in names:
        frame, pose = it.found.frames[name], it.log.poses[name]
        assert not frame.refined
        np.testing.assert_allclose(frame.placed.rotation, pose.rotation, atol=1e-9)
        np.testing.assert_allclose(frame.placed.centre, pose.centre, atol=1e-6)
        whole = own_covariance(pose) + common_covariance(pose, pose)
        left = np.linalg.eigvals(np.linalg.solve(whole, frame.covariance)).real
        assert left.min() > 1.0 - 1e-6
        assert left.max() < 2.5


def test_a_flight_without_a_match_stays_as_logged() -> None:
    it = flight(0, edit=lambda found, _: [some.without_matches() for some in found])
    assert_as_logged(it, list(it.truth))
    joint, log = it.found.errors.joint("f01", "f00"), joint_covariance(it.log.poses["f01"], it.log.poses["f00"])
    left = np.linalg.eigvals(np.linalg.solve(log, joint)).real
    assert left.min() > 1.0 - 1e-6
    assert it.found.scatter == 1.0


def test_a_flight_of_one_frame_and_of_none() -> None:
    one = flight(0, 1)
    assert_as_logged(one, ["f00"])
    log = log_of(logged(straight(3), Errors.none(3)), [])
    assert set(refine_flight(log, [], []).frames) == {"f00", "f01", "f02"}


def test_two_blocks_are_refined_and_hold_together_by_the_log() -> None:
    near, far = straight(3, seed=1), straight(3, seed=2)
    truth = {
        **near,
        **{f"g{n[1:]}": replace(at, centre=at.centre + np.array([300.0, 0.0, 0.0])) for n, at in far.items()},
    }
    pairs = [*chained(list(truth)[:3]), *chained(list(truth)[3:])]
    it = flight(3, truth=truth, pairs=pairs)
    assert max(it.absolute()) < FIVE_SIGMAS
    assert max(it.relative()) < FIVE_SIGMAS
    assert all(frame.refined for frame in it.found.frames.values())
    with pytest.raises(KeyError):
        it.found.errors.between("f00", "g00")


def test_a_frame_nobody_sees_stays_and_the_others_do_not_mind() -> None:
    it = flight(
        2, 6, edit=lambda found, _: [s.without_matches() if "f03" in (s.pair.ref, s.pair.src) else s for s in found]
    )
    assert not it.found.frames["f03"].refined
    assert max(it.absolute()) < FIVE_SIGMAS
    assert np.trace(it.found.frames["f03"].covariance[:3, :3]) > 2.0 * np.trace(
        it.found.frames["f02"].covariance[:3, :3]
    )


def first_few(count: int, frame: str) -> Edit:
    """Of pairs with a frame only so many matches."""

    def few(some: Matched) -> Matched:
        rays = some.rays.some(np.arange(min(count, len(some))))
        return replace(some, ref_px=some.ref_px[:count], src_px=some.src_px[:count], rays=rays)

    return lambda found, _: [few(some) if frame in (some.pair.ref, some.pair.src) else some for some in found]


@pytest.mark.parametrize("count", [1, 3, 6])
def test_a_frame_of_few_matches_is_as_sure_as_they_make_it(count: int) -> None:
    it = flight(4, 6, edit=first_few(count, "f03"))
    assert max(it.absolute()) < FIVE_SIGMAS
    assert max(it.relative()) < FIVE_SIGMAS
    turns = {name: np.trace(frame.covariance[:3, :3]) for name, frame in it.found.frames.items()}
    assert turns["f03"] > turns["f01"]


def shifted(share: float, reach_px: float, frames: Sequence[str] = ()) -> Edit:
    """A share of the matches, of pairs with these frames or of all, is off by anything up to a reach."""

    def edit(found: list[Matched], rng: np.random.Generator) -> list[Matched]:
        out = []
        for some in found:
            hit = not frames or bool({some.pair.ref, some.pair.src} & set(frames))
            wrong = (rng.random(len(some)) < share) & hit
            src_px = some.src_px + wrong[:, None] * rng.uniform(-reach_px, reach_px, some.src_px.shape)
            out.append(replace(some, src_px=src_px, rays=replace(some.rays, src=CAMERA.rays(src_px))))
        return out

    return edit


@pytest.mark.parametrize(("way", "seed"), [("forward", 0), ("forward", 3), ("sideways", 6)])
def test_over_water_few_matches_at_random_do_no_harm(way: str, seed: int) -> None:
    def edit(found: list[Matched], rng: np.random.Generator) -> list[Matched]:
        return shifted(1.0, 30.0, ["f03"])(first_few(8, "f03")(found, rng), rng)

    it = flight(seed, 6, way, edit=edit)
    others = [pair for pair in it.log.pairs.values() if "f03" not in (pair.ref, pair.src)]
    assert max(it.relative(others)) < FIVE_SIGMAS
    # What random matches say of the frame itself the log outweighs.
    assert np.linalg.norm(off(it.found.frames["f03"].placed, it.truth["f03"])[:3]) < 1.0 * DEG


@pytest.mark.parametrize(("share", "reach_px"), [(0.3, 10.0), (0.6, 10.0), (0.3, 100.0)])
@pytest.mark.parametrize("way", WAYS)
def test_wrong_matches_do_no_harm(way: str, share: float, reach_px: float) -> None:
    for seed in range(3):
        it = flight(seed, 5, way, count=100, edit=shifted(share, reach_px))
        assert max(it.absolute()) < FIVE_SIGMAS
        assert max(it.relative()) < FIVE_SIGMAS


def anywhere(share: float) -> Edit:
    """A share of the matches goes to any pixel of src."""

    def edit(found: list[Matched], rng: np.random.Generator) -> list[Matched]:
        out = []
        for some in found:
            wrong = rng.random(len(some)) < share
            at = rng.uniform((0.0, 0.0), (CAMERA.width, CAMERA.height), some.src_px.shape)
            src_px = np.where(wrong[:, None], at, some.src_px)
            out.append(replace(some, src_px=src_px, rays=replace(some.rays, src=CAMERA.rays(src_px))))
        return out

    return edit


@pytest.mark.parametrize(("way", "share"), [("forward", 0.3), ("sideways", 0.3), ("sideways", 0.6)])
def test_matches_that_are_anywhere_do_no_harm(way: str, share: float) -> None:
    for seed in range(3):
        it = flight(seed, 5, way, count=100, edit=anywhere(share))
        assert max(it.absolute()) < FIVE_SIGMAS
        if share < 0.5:
            assert max(it.relative()) < FIVE_SIGMAS
        # By their sigmas forty right matches fix a pair to a thousandth of a degree; a hundredth is no harm.
        for pair in it.log.pairs.values():
            found = relative_placement(*(it.found.frames[name].placed for name in (pair.ref, pair.src)), np.eye(6))
            truth = relative_placement(it.truth[pair.ref], it.truth[pair.src], np.eye(6))
            assert np.linalg.norm(vector_from_rotation(truth.rotation.T @ found.rotation)) < 0.03 * DEG


@pytest.mark.parametrize("times", ["same", "none", "some", "backwards"])
def test_odd_times(times: str) -> None:
    names = list(straight(5))
    known = {
        "same": dict.fromkeys(names, 1.7e9),
        "none": dict.fromkeys(names, float("nan")),
        "some": {name: 1.7e9 + 2.0 * i if i != 2 else float("nan") for i, name in enumerate(names)},
        "backwards": {name: 1.7e9 - 2.0 * i for i, name in enumerate(names)},
    }[times]
    it = flight(5, 5, times=known)
    assert max(it.absolute()) < FIVE_SIGMAS
    assert max(it.relative()) < FIVE_SIGMAS
    assert not it.problems()


def test_a_log_of_centimetres_and_one_that_knows_all() -> None:
    rtk = PoseSigmas(np.array([0.015, 0.015, 0.03]), OWN.gimbal_rad)
    it = flight(6, own=rtk, common=NONE)
    assert max(it.absolute()) < FIVE_SIGMAS
    assert max(it.relative()) < FIVE_SIGMAS
    exact = flight(6, own=PoseSigmas(np.full(3, 1e-6), np.full(3, 1e-8)), common=NONE)
    for name, at in exact.truth.items():
        assert np.linalg.norm(off(exact.found.frames[name].placed, at)[3:]) < 1e-3


def test_the_same_stars_give_the_same_bytes() -> None:
    first, again = flight(7), flight(7)
    for name in first.truth:
        np.testing.assert_array_equal(first.found.frames[name].covariance, again.found.frames[name].covariance)
        np.testing.assert_array_equal(
            first.found.frames[name].placed.rotation, again.found.frames[name].placed.rotation
        )
