"""Observations joined to tracks and merged: one row per point, and a covariance that redrawn errors bear out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import feather

from pipeline.depthing import Limits, MatchedRays, depths_by
from pipeline.geodesy.local_world import LocalTransform
from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.geometry.poses import PlacedPair, Placement, relative_jacobian, relative_placement
from pipeline.geometry.rotations import enu_from_cam
from pipeline.geometry.transfer import VirtualView
from pipeline.points.covariances import of_differences, of_means, squares, sums, whole
from pipeline.points.fusion import Counts, fused_tile, surest_of_cubes
from pipeline.points.fusion import Limits as Asked
from pipeline.points.merge import Merged, agreed, merge, surest_of_pairs
from pipeline.points.observations import Scene
from pipeline.points.observed import Observed
from pipeline.points.tiles import tile_corners, tile_name
from pipeline.points.tracks import stars, tracks
from pipeline.points.world import world_points

CAMERA = Camera("pinhole", 1600, 1200, 1120.0, 1118.0, 803.0, 595.0)
ALL = Limits(np.inf, np.inf)
DEG = np.pi / 180.0
PIXEL = 0.15
# Own sigmas of a frame: turn (rad), then shift (m).
OWN = np.array([0.03 * DEG] * 3 + [0.02] * 3)
COMMON_M = 0.5
# Five frames on a line, looking down and a little ahead.
STATIONS = [((4.0 * i - 8.0, -55.0, 1.5 * i), (0.4 * i, 5.0 * i, 40.0 + 0.3 * i)) for i in range(5)]
GROUND = np.array([[-6.0, 32.0], [0.0, 36.0], [4.0, 40.0], [9.0, 33.0], [-3.0, 41.0], [2.0, 30.0]])
CHAIN = [(1, 0), (2, 1), (3, 2), (4, 3)]


def spread(frames: int, common_m: float = COMMON_M) -> Floats:
    """(6 f, 6 f): every frame's own error, and one shift that all share."""
    out = np.diag(np.tile(OWN**2, frames))
    for axis in (3, 4, 5):
        out[axis::6, axis::6] += common_m**2
    return out


@dataclass
class Flight:
    """Frames over level ground, and what matching and placing make of it."""

    pairs: Sequence[tuple[int, int]]
    ground: Floats = field(default_factory=lambda: GROUND)
    covariance: Floats = field(default_factory=lambda: spread(len(STATIONS)))
    keypoint_px: float = 0.0
    gain: Mapping[int, Floats] = field(default_factory=dict)
    noise: Mapping[int, Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.frames = [Placement(enu_from_cam(*np.radians(angles)), np.array(centre)) for angles, centre in STATIONS]
        self.points = np.column_stack([self.ground, np.zeros(len(self.ground))])
        rng = np.random.default_rng(9)
        # Where each frame's own keypoint of each point lies.
        self.keypoints = [
            self.project(i, self.points) + rng.uniform(-1.0, 1.0, (len(self.ground), 2)) * self.keypoint_px
            for i in range(len(self.frames))
        ]
        assert all(CAMERA.holds(px).all() for px in self.keypoints)

    def project(self, frame: int, points: Floats) -> Floats:
        return CAMERA.project((points - self.frames[frame].centre) @ self.frames[frame].rotation)

    def shown(self, frame: int) -> Floats:
        """(n, 3) what lies at the frame's keypoints."""
        rays = CAMERA.rays(self.keypoints[frame]) @ self.frames[frame].rotation.T
        centre = self.frames[frame].centre
        return centre - rays * (centre[2] / rays[:, 2])[:, None]

    def errors(self) -> PoseErrors:
        names = [str(i) for i in range(len(self.frames))]
        blocks = self.covariance.reshape(len(names), 6, len(names), 6)
        known = [(names[i], names[j], blocks[i, :, j]) for i in range(len(names)) for j in range(i, len(names))]
        return PoseErrors.of(names, known)

    def observed(self, rng: np.random.Generator | None = None, pixel: float = PIXEL) -> Observed:
        """All observations; with a generator from redrawn poses and pixels, else from the true ones."""
        e = np.zeros(len(self.covariance))
        if rng is not None:
            e = np.linalg.cholesky(self.covariance + 1e-18 * np.eye(len(e))) @ rng.normal(size=len(e))
        return Observed.joined([self._pair(number, e.reshape(-1, 6), rng, pixel) for number in range(len(self.pairs))])

    def _pair(self, number: int, e: Floats, rng: np.random.Generator | None, pixel: float) -> Observed:
        ref, src = self.pairs[number]
        gain, noise = self.gain.get(number, np.eye(12)), self.noise.get(number, np.zeros((12, 12)))
        of_cameras = gain @ np.concatenate([e[ref], e[src]])
        ref_px, src_px = self.keypoints[ref], self.project(src, self.shown(ref))
        if rng is not None:
            of_cameras += rng.multivariate_normal(np.zeros(12), noise)
            src_px = src_px + rng.normal(0.0, pixel, src_px.shape)
        # The true cameras are the placed ones with their errors applied.
        placed = PlacedPair(
            self.frames[ref].moved(-of_cameras[:6]), self.frames[src].moved(-of_cameras[6:]), gain, noise
        )
        joint = gain @ self.errors().joint(str(ref), str(src)) @ gain.T + noise
        to_relative = relative_jacobian(placed.ref, placed.src)
        pose = relative_placement(placed.ref, placed.src, to_relative @ joint @ to_relative.T)
        n = len(ref_px)
        rays = MatchedRays.of(ref_px, src_px, CAMERA, CAMERA, np.tile([pixel**2, 0.0, pixel**2], (n, 1)))
        found = depths_by("epitransfer", VirtualView.ADAPTIVE, 1.0, rays, pose, ALL)
        depth = found.depths.depth_m
        points = world_points(ref_px, depth, found.depths.normal, found.pixel_sigma_m, CAMERA, placed)
        return Observed(
            points.p_in_enu_m,
            points.jacobian,
            points.independent,
            np.full(n, number),
            np.tile([ref, src], (n, 1)),
            ref_px,
            src_px,
            np.sqrt(found.depths.variance_m2),
            depth,
            CAMERA.rays(ref_px) @ placed.ref.rotation.T,
            depth / CAMERA.focal_px,
            np.degrees(found.parallax_rad),
            np.tile(np.arange(n, dtype=np.uint8)[:, None], (1, 3)),
        )


def point_of(observed: Observed) -> Ints:
    """Which point of the ground each observation is of."""
    return observed.rgb[:, 0].astype(np.int64)


def tracked(flight: Flight, observed: Observed) -> Ints:
    errors = flight.errors()
    return tracks(observed, whole(observed, errors), errors)


def fused(flight: Flight, observed: Observed, track: Ints) -> Merged:
    errors = flight.errors()
    return merge(observed, track, whole(observed, errors), errors)


# --- covariances ---


def turned_gain() -> Floats:
    """The cameras of a pair that was refined by itself: half of what they differ by is taken away, nothing else."""
    relative = np.block([[np.eye(6), -np.eye(6)], [-np.eye(6), np.eye(6)]]) / 2.0
    return np.eye(12) - 0.5 * relative


SEEN = {
    "one pair": ([(1, 0)], {}, {}),
    "one ref": ([(4, 1), (4, 2), (4, 3)], {}, {}),
    "chain": (CHAIN, {}, {}),
    "all": ([(b, a) for a, b in combinations(range(5), 2)], {}, {}),
    "refined by themselves": (
        [(2, 0), (2, 1), (4, 2)],
        {0: turned_gain(), 1: turned_gain()},
        {0: np.diag(np.tile(0.5 * OWN, 2) ** 2), 2: np.diag(np.tile(0.3 * OWN, 2) ** 2)},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("seen", SEEN)
def test_fused_points_are_as_far_off_as_they_say(seen: str) -> None:
    """Redraws of every error that the tables state: coverage of each axis, and the square in all directions."""
    pairs, gain, noise = SEEN[seen]
    # What is common is no larger than the rest, or it would hide a mistake in that.
    flight = Flight(pairs, covariance=spread(len(STATIONS), 0.03), gain=gain, noise=noise)
    rng, draws = np.random.default_rng(12), 400
    track = point_of(flight.observed())
    z, square = [], []
    for _ in range(draws):
        found = fused(flight, flight.observed(rng), track)
        error = found.xyz - flight.points
        z.append(error / np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)))
        square.append(squares(error, found.covariance))
    share = [np.mean(np.abs(z) <= sigmas) for sigmas in (1.0, 2.0)]
    assert share[0] == pytest.approx(0.683, abs=0.035)
    assert share[1] == pytest.approx(0.954, abs=0.02)
    np.testing.assert_allclose(np.mean(np.abs(z) <= 1.0, axis=(0, 1)), 0.683, atol=0.06)
    # A chi-square with 3 degrees of freedom; the points of a draw share errors, so a draw counts as one sample.
    assert np.mean(square) == pytest.approx(3.0, abs=3.0 * np.sqrt(6.0 / draws))


def test_what_frames_share_cannot_be_averaged_away() -> None:
    flight = Flight([(b, a) for a, b in combinations(range(5), 2)])
    observed = flight.observed()
    found = fused(flight, observed, point_of(observed))
    common = COMMON_M**2 * np.eye(3)
    assert np.linalg.eigvalsh(found.covariance - common).min() > 0.0
    own = whole(observed, flight.errors())[found.best] - common
    rest = np.trace(found.covariance - common, axis1=1, axis2=2)
    assert np.all(rest < 0.8 * np.trace(own, axis1=1, axis2=2)), "but the rest is"


def test_pairs_that_share_a_frame_gain_less_than_pairs_that_share_none() -> None:
    """The same two observations, once with one ref frame's error in both, once with a frame of their own each."""
    flight = Flight([(4, 1), (4, 0)], covariance=np.diag(np.tile(OWN**2, 5)))
    observed = flight.observed()
    track = point_of(observed)
    shared = fused(flight, observed, track).covariance
    frames = observed.frames.copy()
    frames[observed.pair == 1] = (3, 0)
    fields = {name: getattr(observed, name) for name in Observed.__dataclass_fields__}
    independent = fused(flight, Observed(**{**fields, "frames": frames}), track).covariance
    own = whole(observed, flight.errors())
    weight = observed.sigma_m**-2.0 / np.bincount(track, observed.sigma_m**-2.0)[track]
    np.testing.assert_allclose(independent, sums(own * (weight**2)[:, None, None], track), rtol=1e-9)
    assert np.all(np.trace(shared - independent, axis1=1, axis2=2) > 0.05 * np.trace(shared, axis1=1, axis2=2))


def without(errors: PoseErrors, couples: Sequence[tuple[int, int]]) -> PoseErrors:
    numbers = np.array(couples)
    kept = ~np.isin(np.arange(len(errors.couples)), errors.rows(numbers[:, 0], numbers[:, 1]))
    return PoseErrors(errors.index, errors.couples[kept], errors.blocks[kept])


def test_a_covariance_that_is_not_kept_gives_a_bound() -> None:
    flight = Flight([(1, 0), (4, 3)])
    observed, exact = flight.observed(), flight.errors()
    partly = without(exact, [(i, j) for i in (0, 1) for j in (3, 4)])
    track = point_of(observed)
    own = whole(observed, partly)
    np.testing.assert_array_equal(own, whole(observed, exact))
    known, bound = (merge(observed, track, own, errors).covariance for errors in (exact, partly))
    assert np.linalg.eigvalsh(bound - known).min() > 0.0
    assert np.all(np.trace(bound, axis1=1, axis2=2) <= 1.001 * np.bincount(track, np.trace(own, axis1=1, axis2=2)))
    one, other = np.flatnonzero(observed.pair == 0), np.flatnonzero(observed.pair == 1)
    apart, at_most = (of_differences(observed, one, other, own, errors) for errors in (exact, partly))
    assert np.linalg.eigvalsh(at_most - apart).min() > 0.0
    # Even the two frames of a pair may be unknown to each other.
    alone = whole(observed, without(partly, [(0, 1)]))
    assert np.linalg.eigvalsh((alone - own)[one]).min() > -1e-12
    np.testing.assert_array_equal(alone[other], own[other])


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 40), groups=st.integers(1, 8))
def test_means_by_the_book(seed: int, n: int, groups: int) -> None:
    """Random Jacobians, weights and covariances against one big matrix product, in any order of the rows."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(30, 30))
    sigma = root @ root.T
    flight = Flight(CHAIN, covariance=sigma)
    root = rng.normal(size=(n, 3, 3))
    group = np.unique(rng.integers(0, groups, n), return_inverse=True)[1]
    blank = np.zeros(n)
    ref = rng.integers(0, 5, n)
    observed = Observed(
        rng.normal(size=(n, 3)), rng.normal(size=(n, 3, 12)), root @ np.swapaxes(root, 1, 2), rng.integers(0, 4, n),
        np.stack([ref, (ref + rng.integers(1, 5, n)) % 5], axis=1), np.zeros((n, 2)), np.zeros((n, 2)),
        rng.uniform(0.1, 2.0, n), blank, np.zeros((n, 3)), blank, blank, np.zeros((n, 3), np.uint8),
    )  # fmt: skip
    weight = rng.uniform(0.1, 1.0, n)
    weight /= np.bincount(group, weight)[group]
    errors = flight.errors()
    found = of_means(observed, weight, group, whole(observed, errors), errors)
    whole_jacobian = np.zeros((n, 3, 30))
    for i in range(n):
        for role in (0, 1):
            at = 6 * observed.frames[i, role]
            whole_jacobian[i, :, at : at + 6] = observed.jacobian[i, :, 6 * role : 6 * role + 6]
    for g in range(group.max() + 1):
        rows = np.flatnonzero(group == g)
        mean = np.sum(weight[rows, None, None] * whole_jacobian[rows], axis=0)
        want = mean @ sigma @ mean.T + np.sum((weight[rows] ** 2)[:, None, None] * observed.independent[rows], axis=0)
        np.testing.assert_allclose(found[g], want, rtol=1e-9, atol=1e-9)
    one, other = rng.integers(0, n, (2, n))
    apart = whole_jacobian[one] - whole_jacobian[other]
    np.testing.assert_allclose(
        of_differences(observed, one, other, whole(observed, errors), errors),
        apart @ sigma @ np.swapaxes(apart, 1, 2) + observed.independent[one] + observed.independent[other],
        rtol=1e-9,
        atol=1e-9,
    )
    order = rng.permutation(n)
    mixed = observed.take(order)
    again = of_means(mixed, weight[order], group[order], whole(mixed, errors), errors)
    np.testing.assert_allclose(again, found, rtol=1e-9, atol=1e-9)


# --- tracks ---


def test_a_chain_of_stars_is_one_row_per_point() -> None:
    """Five frames, each matched to the last only; the keypoints of a point lie up to 0.7 px off it."""
    flight = Flight(CHAIN, keypoint_px=0.5)
    observed = flight.observed(np.random.default_rng(2))
    track = tracked(flight, observed)
    np.testing.assert_array_equal(np.unique(np.stack([track, point_of(observed)]), axis=1).shape[1], len(GROUND))
    assert track.max() + 1 == len(GROUND)
    found = fused(flight, observed, track)
    assert found.n_pairs.tolist() == [4] * len(GROUND)
    assert found.n_frames.tolist() == [5] * len(GROUND)


def test_stars_that_meet_in_a_frame_without_stars_are_one() -> None:
    """The first frame of a flight is nobody's ref; what two others find in it may still be one point."""
    flight = Flight([(1, 0), (2, 0), (4, 0)])
    observed = flight.observed(np.random.default_rng(3))
    track = tracked(flight, observed)
    assert np.array_equal(track, track[: len(GROUND)][point_of(observed)])
    assert track.max() + 1 == len(GROUND)


def test_points_three_pixels_apart_stay_two() -> None:
    """Among them a pixel that ends half-way between two stars."""
    depth = 50.0
    beside = GROUND + np.array([3.0 * depth / CAMERA.fx, 0.0])
    flight = Flight([*CHAIN, (2, 0), (3, 1)], ground=np.concatenate([GROUND, beside]), keypoint_px=0.3)
    for seed in range(5):
        observed = flight.observed(np.random.default_rng(seed))
        track = tracked(flight, observed)
        assert track.max() + 1 == 2 * len(GROUND)
        assert len(np.unique(np.stack([track, point_of(observed)]), axis=1).T) == 2 * len(GROUND)


def test_pixels_that_meet_while_their_points_do_not_are_two() -> None:
    flight = Flight([(2, 1), (1, 0)])
    observed = flight.observed()
    observed.xyz[0] += [0.0, 0.0, 25.0]
    track = tracked(flight, observed)
    assert track.max() + 1 == len(GROUND) + 1
    assert np.sum(track == track[0]) == 1


def test_a_pixel_that_ends_two_pixels_from_a_star_is_not_its() -> None:
    flight = Flight([(1, 0), (2, 1)])
    observed = flight.observed()
    observed.src_px[observed.pair == 1] += [1.5, 1.5]
    assert tracked(flight, observed).max() + 1 == 2 * len(GROUND)
    observed.src_px[observed.pair == 1] -= [0.6, 0.6]
    assert tracked(flight, observed).max() + 1 == len(GROUND)


def test_of_two_stars_of_a_frame_that_claim_one_the_nearer_has_it() -> None:
    flight = Flight([(1, 0), (2, 1)])
    observed = flight.observed()
    double = Observed.joined(
        [observed, observed.take(np.flatnonzero((observed.pair == 1) & (point_of(observed) == 2)))]
    )
    double.ref_px[-1] += 0.9
    double.src_px[-1] += 0.9
    track = tracked(flight, double)
    assert track.max() + 1 == len(GROUND) + 1
    assert np.sum(track == track[-1]) == 1


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_tracks_do_not_depend_on_the_order_of_the_rows(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flight = Flight([*CHAIN, (3, 0), (4, 1)], keypoint_px=0.6)
    observed = flight.observed(rng)
    order = rng.permutation(len(observed))
    one, other = tracked(flight, observed)[order], tracked(flight, observed.take(order))
    assert len(np.unique(np.stack([one, other]), axis=1).T) == one.max() + 1 == other.max() + 1


def test_a_star_is_one_pixel_of_one_frame() -> None:
    flight = Flight([(4, 0), (4, 1), (3, 1)])
    observed = flight.observed()
    found = stars(observed)
    n = len(GROUND)
    assert np.array_equal(found[:n], found[n : 2 * n])
    assert len(np.unique(found)) == found.max() + 1 == 2 * n
    observed.ref_px[0, 0] += 1e-9
    assert stars(observed).max() + 1 == 2 * n + 1


# --- agreement, weights, thinning ---


def disturbed(flight: Flight, wrong: Mapping[int, Sequence[int]], surer: float = 1.0) -> tuple[Observed, Bools]:
    """Observations of which some pairs' of some points are 15 m off along the sight, with smaller sigmas."""
    observed = flight.observed(np.random.default_rng(4))
    off = np.zeros(len(observed), bool)
    for point, pairs in wrong.items():
        off |= (point_of(observed) == point) & np.isin(observed.pair, pairs)
    sight = observed.xyz - np.array([flight.frames[i].centre for i in observed.frames[:, 0]])
    observed.xyz[off] += 15.0 * (sight / np.linalg.norm(sight, axis=1, keepdims=True))[off]
    observed.sigma_m[off] *= surer
    return observed, off


def test_a_mistake_leaves_its_track_and_of_two_that_disagree_none_stays() -> None:
    flight = Flight([(4, 0), (4, 1), (4, 2)])
    observed, off = disturbed(flight, {0: [1], 1: [0, 1, 2], 2: [0], 3: [2]})
    # The third point has two observations only; the second is wrong as a whole, which agreement cannot tell.
    observed, off = (some.take(keep) if isinstance(some, Observed) else some[keep] for some, keep in (
        (observed, ~((point_of(observed) == 2) & (observed.pair == 2))),
        (off, ~((point_of(observed) == 2) & (observed.pair == 2))),
    ))  # fmt: skip
    errors = flight.errors()
    track = tracked(flight, observed)
    assert track.max() + 1 == len(GROUND), "a star is one track, whatever its observations say"
    agree, sound = agreed(observed, track, whole(observed, errors), errors)
    point = point_of(observed)
    for number in (0, 3):
        assert np.array_equal(agree[point == number], ~off[point == number])
    assert np.unique(track[point == 2]) == np.flatnonzero(~sound)
    assert agree[(point == 4) | (point == 5) | (point == 1)].all()


def test_the_surest_one_may_be_the_mistake() -> None:
    flight = Flight([(4, 0), (4, 1), (4, 2), (4, 3)])
    observed, off = disturbed(flight, {0: [3], 1: [2, 3], 2: [1]}, surer=0.1)
    errors = flight.errors()
    track = tracked(flight, observed)
    agree, sound = agreed(observed, track, whole(observed, errors), errors)
    point = point_of(observed)
    assert np.array_equal(agree[point != 1], ~off[point != 1])
    # Two against two: nothing tells which.
    assert np.flatnonzero(~sound).tolist() == np.unique(track[point == 1]).tolist()


def test_right_observations_hardly_ever_disagree() -> None:
    flight = Flight([(b, a) for a, b in combinations(range(5), 2)], keypoint_px=0.5)
    errors, rng = flight.errors(), np.random.default_rng(5)
    agreement = []
    for _ in range(60):
        observed = flight.observed(rng)
        track = point_of(observed)
        agreement.append(agreed(observed, track, whole(observed, errors), errors)[0])
    assert np.mean(agreement) > 0.995


def test_one_observation_of_a_pair_is_enough() -> None:
    flight = Flight([(1, 0), (2, 1)])
    observed = flight.observed()
    double = Observed.joined([observed, observed.take(np.array([0, 7]))])
    double.sigma_m[-2] *= 2.0
    double.sigma_m[-1] *= 0.5
    keep = surest_of_pairs(double, np.concatenate([point_of(observed), [0, 1]]))
    assert np.flatnonzero(~keep).tolist() == [7, len(observed)]


def test_the_mean_on_a_ray_is_that_of_inverse_depths() -> None:
    """Each weighted by one over its variance, which on one ray is the depth's over the depth to the fourth power."""
    flight = Flight([(4, 0), (4, 2)])
    observed = flight.observed(np.random.default_rng(6))
    found = fused(flight, observed, point_of(observed))
    n = len(GROUND)
    depth, weight = observed.depth_m.reshape(2, n), (observed.depth_m**4 / observed.sigma_m**2).reshape(2, n)
    mean = np.sum(weight, axis=0) / np.sum(weight / depth, axis=0)
    want = observed.xyz[:n] + (mean - depth[0])[:, None] * observed.sight[:n]
    np.testing.assert_allclose(found.xyz, want, rtol=1e-12, atol=1e-12)
    one, other = observed.sigma_m.reshape(2, n)
    assert np.array_equal(found.best, np.where(one <= other, np.arange(n), n + np.arange(n)))
    assert np.abs(depth[0] - depth[1]).min() > 1e-4


def test_means_of_uncertain_depths_are_not_too_near() -> None:
    """Six depths of one point with sigmas of 20 %; weights of one over their own variances would put it 15 % nearer."""
    flight, rng, true = Flight([(4, i) for i in range(4)] + [(3, 0), (3, 1)]), np.random.default_rng(7), 50.0
    observed = flight.observed()
    n = len(observed)
    near = []
    for _ in range(300):
        depth = 1.0 / (1.0 / true + rng.normal(0.0, 0.2 / true, n).clip(-0.5 / true, 0.5 / true))
        sight = np.tile([0.0, 1.0, 0.0], (n, 1))
        fields = {name: getattr(observed, name) for name in Observed.__dataclass_fields__}
        fields |= {"depth_m": depth, "sight": sight, "xyz": depth[:, None] * sight, "sigma_m": 0.2 / true * depth**2}
        near.append(fused(flight, Observed(**fields), point_of(observed)).xyz[:, 1] / true)
    assert np.median(near) == pytest.approx(1.0, abs=0.02)


@given(seed=st.integers(0, 10**6), n=st.integers(1, 60), voxel=st.sampled_from([0.25, 0.5, 2.0]))
def test_thinning_keeps_the_surest_of_each_cube(seed: int, n: int, voxel: float) -> None:
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-1.5, 1.5, (n, 3))
    covariance = np.eye(3) * rng.uniform(0.1, 1.0, (n, 1, 1))
    kept = surest_of_cubes(xyz, covariance, voxel)
    cubes = [tuple(cube) for cube in np.floor(xyz / voxel).astype(int)]
    assert sorted(cubes[i] for i in kept) == sorted(set(cubes))
    for i in kept:
        assert covariance[i, 0, 0] == min(covariance[j, 0, 0] for j in range(n) if cubes[j] == cubes[i])


# --- a tile ---


@pytest.mark.parametrize("lies_here", [True, False])
def test_a_tile_of_which_nothing_survives_is_empty(tmp_path: Path, lies_here: bool) -> None:
    """Two observations of one point that disagree, alone in their tile or in the margin of another."""
    flight = Flight([(4, 0), (4, 1)], ground=GROUND[:1])
    observed, _ = disturbed(flight, {0: [1]})
    corner = tile_corners(observed.xyz, 1000)[0] + (0 if lies_here else 1000)
    folder = tmp_path / tile_name(corner)
    folder.mkdir()
    feather.write_feather(observed.table(), folder / "a.arrow")
    names = [str(i) for i in range(len(STATIONS))]
    scene = Scene(
        {}, dict.fromkeys(names), dict.fromkeys(names, CAMERA), dict(zip(names, flight.frames, strict=True)),
        flight.errors(), {}, {}, LocalTransform(), "epitransfer",
    )  # fmt: skip
    table, counts = fused_tile(scene, folder, Asked(1, 0.1, 1000))
    assert table.num_rows == 0
    assert counts == (Counts(observations=2, contradictory=1) if lies_here else Counts())


def test_spilled_rows_come_back() -> None:
    observed = Flight(CHAIN).observed(np.random.default_rng(7))
    again = Observed.of(observed.table())
    for name in Observed.__dataclass_fields__:
        want, found = getattr(observed, name), getattr(again, name)
        np.testing.assert_allclose(found, want, rtol=1e-6 if name == "jacobian" else 0.0)
