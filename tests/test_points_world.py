"""World points against redrawn poses and pixels, and merging without counting an error twice."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pixel_noise import drawn, slanted

from pipeline.depthing import Limits, MatchedRays, depths_by
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Pose, PoseSigmas, relative_pose
from pipeline.geometry.rotations import enu_from_cam, gimbal_error_axes, rotation_from_vector
from pipeline.geometry.transfer import VirtualView
from pipeline.points.merge import merge_voxels
from pipeline.points.world import Shot, WorldPoints, world_points

DEG = np.pi / 180.0
PLAIN = Camera("pinhole", 4000, 3000, 2800.0, 2810.0, 2010.0, 1490.0)
LENS = Camera("brown", 4000, 3000, 2900.0, 2905.0, 2010.0, 1490.0, (-0.1, 0.02, 0.001, -0.0005, 0.0))
WIDE = Camera("fisheye", 1600, 1200, 700.0, 705.0, 802.0, 597.0, (0.02, -0.003, 0.0, 0.0))
ALL = Limits(np.inf, np.inf)
NONE = PoseSigmas(np.zeros(3), np.zeros(3))
OWN = PoseSigmas(np.array([0.02, 0.03, 0.04]), np.array([0.05, 0.03, 0.04]) * DEG)
COMMON = PoseSigmas(np.array([1.0, 1.5, 2.5]), np.array([0.5, 0.3, 0.2]) * DEG)
FORWARD = ((3.0, -20.0, 0.5), (0.0, 8.0, 31.0)), ((1.0, -21.0, 0.0), (0.5, 0.0, 30.5))
SIDEWAYS = ((40.0, -35.0, -1.0), (3.0, -2.5, 31.0)), ((42.0, -34.0, 1.0), (0.0, 0.0, 31.0))
# Ref pixels as shares of the image, off the epipole of the forward pair, and ranges.
AT = np.array([[0.25, 0.85], [0.5, 0.75], [0.75, 0.7], [0.35, 0.6], [0.25, 0.5]])
RANGE_M = np.array([18.0, 25.0, 30.0, 40.0, 35.0])


def turned(rotation: Floats, gimbal_rad: Floats) -> Floats:
    """A camera with errors of its gimbal's yaw, pitch and roll."""
    out: Floats = rotation_from_vector(gimbal_error_axes(rotation) @ gimbal_rad) @ rotation
    return out


class Pair:
    """Two cameras over known points."""

    def __init__(
        self,
        ends: tuple[tuple[tuple[float, ...], ...], ...],
        cameras: tuple[Camera, Camera],
        sigmas: dict[str, PoseSigmas],
    ) -> None:
        self.ends, self.cameras, self.sigmas = ends, cameras, sigmas
        ref, src = self.poses(np.zeros(18))
        camera = cameras[0]
        self.ref_px = AT * (camera.width, camera.height)
        rays = camera.rays(self.ref_px)
        # Of the same pixels of an image that is matched at a size of its own.
        self.covariance = slanted(len(AT), max(cameras[1].width / 2000.0, 1.0))
        self.points = (
            ref.centre + (rays / np.linalg.norm(rays, axis=1, keepdims=True) * RANGE_M[:, None]) @ ref.rotation.T
        )
        self.src_px = cameras[1].project((self.points - src.centre) @ src.rotation)
        assert np.isfinite(self.src_px).all()

    def poses(self, error: Floats) -> tuple[Pose, Pose]:
        """Both poses with errors: (gimbal, position) own of ref, own of src, and common."""
        common = error[12:]
        return tuple(  # type: ignore[return-value]
            Pose(
                turned(enu_from_cam(*np.radians(angles)), own[:3] + common[:3]),
                np.array(centre) + own[3:] + common[3:],
                self.sigmas.get("own", NONE),
                self.sigmas.get("common", NONE),
            )
            for (angles, centre), own in zip(self.ends, (error[:6], error[6:12]), strict=True)
        )

    def placed(self, error: Floats, ref_px: Floats, src_px: Floats, *, noisy: bool = True) -> WorldPoints:
        """The points as the pipeline finds them from disturbed poses and pixels."""
        ref, src = self.poses(error)
        covariance = np.tile(self.covariance, (len(ref_px) // len(AT), 1))
        rays = MatchedRays.of(ref_px, src_px, *self.cameras, covariance)
        found = depths_by("epitransfer", VirtualView.ADAPTIVE, 1.0, rays, relative_pose(ref, src), ALL)
        shots = (Shot(camera, pose) for camera, pose in zip(self.cameras, (ref, src), strict=True))
        return world_points(ref_px, found.depths.depth_m, found.depths.normal, found.pixel_sigma_m * noisy, *shots)

    def redrawn(self, rng: np.random.Generator, draws: int, *, own: bool, common: bool) -> Floats:
        """(draws, n, 3): where the points come to lie with disturbed poses and pixels."""
        out = []
        scale = np.concatenate(
            [
                wanted * np.concatenate([s.gimbal_rad, s.position_m])
                for s, wanted in ((OWN, own), (OWN, own), (COMMON, common))
            ]
        )
        for _ in range(draws):
            src_px = self.src_px + own * drawn(rng, self.covariance)
            out.append(self.placed(rng.normal(0.0, scale), self.ref_px, src_px).p_in_enu_m)
        return np.array(out)

    def derivatives(self) -> Floats:
        """(18, n, 3): how the points move with each pose error, by central differences."""
        step = 1e-6

        def moved(error: Floats) -> Floats:
            return self.placed(error, self.ref_px, self.src_px).p_in_enu_m

        return np.array([(moved(step * e) - moved(-step * e)) / (2.0 * step) for e in np.eye(18)])


def assert_spread(points: Floats, covariance: Floats, within: float) -> None:
    """The redrawn points' covariance in the coordinates in which the predicted one is the unit matrix."""
    for j in range(points.shape[1]):
        found = np.cov(points[:, j].T)
        root = np.linalg.inv(np.linalg.cholesky(covariance[j]))
        eigenvalues = np.linalg.eigvalsh(root @ found @ root.T)
        np.testing.assert_allclose(np.sqrt(eigenvalues), 1.0, atol=within)


CAMERAS = {"pinhole": (PLAIN, PLAIN), "brown": (LENS, LENS), "unequal": (LENS, WIDE), "unequal back": (WIDE, PLAIN)}
ENDS = {"forward": FORWARD, "sideways": SIDEWAYS}


@pytest.mark.parametrize("cameras", CAMERAS)
@pytest.mark.parametrize("ends", ENDS)
def test_pixel_noise_alone(ends: str, cameras: str) -> None:
    """Through lens distortion, off the axis, with src of another size; it moves a point along its ref ray."""
    pair = Pair(ENDS[ends], CAMERAS[cameras], {})
    rng, draws, n = np.random.default_rng(1), 4000, len(AT)
    ref_px, src_px = (np.tile(px, (draws, 1)) for px in (pair.ref_px, pair.src_px))
    src_px += drawn(rng, np.tile(pair.covariance, (draws, 1)))
    points = pair.placed(np.zeros(18), ref_px, src_px).p_in_enu_m.reshape(draws, n, 3)
    predicted = pair.placed(np.zeros(18), pair.ref_px, pair.src_px)
    sight = pair.points - pair.poses(np.zeros(18))[0].centre
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    length = np.sqrt(np.einsum("ni,nij,nj->n", sight, predicted.own, sight))
    line = length[:, None] * sight
    np.testing.assert_allclose(predicted.own, line[:, :, None] * line[:, None, :], rtol=1e-9, atol=1e-15)
    spread = np.std(np.einsum("dni,ni->dn", points, sight), axis=0)
    np.testing.assert_allclose(spread / length, 1.0, atol=0.06)
    assert not predicted.common.any()


@pytest.mark.parametrize("cameras", CAMERAS)
@pytest.mark.parametrize("ends", ENDS)
def test_pose_errors_to_first_order(ends: str, cameras: str) -> None:
    """Own and common parts from numerical derivatives of the whole chain, pose to point."""
    pair = Pair(ENDS[ends], CAMERAS[cameras], {"own": OWN, "common": COMMON})
    predicted = pair.placed(np.zeros(18), pair.ref_px, pair.src_px, noisy=False)
    derivatives = pair.derivatives()
    for part, sigmas, found in (
        (slice(0, 12), [OWN, OWN], predicted.own),
        (slice(12, 18), [COMMON], predicted.common),
    ):
        scale = np.concatenate([np.concatenate([s.gimbal_rad, s.position_m]) for s in sigmas])
        scaled = derivatives[part] * scale[:, None, None]
        expected = np.einsum("ani,anj->nij", scaled, scaled)
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("ends", ENDS)
def test_redrawn_poses_and_pixels(ends: str) -> None:
    pair = Pair(ENDS[ends], (PLAIN, PLAIN), {"own": OWN, "common": COMMON})
    predicted = pair.placed(np.zeros(18), pair.ref_px, pair.src_px)
    rng = np.random.default_rng(2)
    assert_spread(pair.redrawn(rng, 900, own=True, common=False), predicted.own, 0.12)
    assert_spread(pair.redrawn(rng, 900, own=False, common=True), predicted.common, 0.12)


def test_a_point_lies_on_the_ref_ray_at_its_depth_and_where_it_was() -> None:
    pair = Pair(FORWARD, (LENS, WIDE), {"own": OWN, "common": COMMON})
    found = pair.placed(np.zeros(18), pair.ref_px, pair.src_px)
    np.testing.assert_allclose(found.p_in_enu_m, pair.points, atol=1e-6)
    ref, _ = pair.poses(np.zeros(18))
    moved = pair.placed(np.zeros(18), pair.ref_px, pair.src_px + 3.0)
    in_ref = (moved.p_in_enu_m - ref.centre) @ ref.rotation
    np.testing.assert_allclose(LENS.project(in_ref), pair.ref_px, atol=1e-7)
    assert np.abs(moved.p_in_enu_m - pair.points).max() > 0.1


def test_covariances_are_symmetric_and_positive() -> None:
    pair = Pair(SIDEWAYS, (LENS, LENS), {"own": OWN, "common": COMMON})
    found = pair.placed(np.zeros(18), pair.ref_px, pair.src_px)
    for covariance in (found.own, found.common):
        np.testing.assert_allclose(covariance, np.swapaxes(covariance, 1, 2), rtol=1e-12, atol=1e-18)
        assert np.linalg.eigvalsh(covariance).min() > 0.0
    # The error is longest along the line of sight.
    ref, _ = pair.poses(np.zeros(18))
    sight = found.p_in_enu_m - ref.centre
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    longest = np.linalg.eigh(found.own)[1][:, :, 2]
    assert np.abs(np.sum(longest * sight, axis=1)).min() > 0.95


# --- merging ---


def covariances(rng: np.random.Generator, n: int, scale: float = 0.1) -> Floats:
    a = rng.normal(0.0, scale, (n, 3, 3))
    return a @ np.swapaxes(a, 1, 2) + 1e-4 * np.eye(3)


def test_one_observation_stays_as_it_is() -> None:
    rng = np.random.default_rng(5)
    own, common = covariances(rng, 1), covariances(rng, 1, 1.0)
    found = merge_voxels(np.array([[1.1, -2.2, 3.3]]), own, common, np.array([4]), np.array([[2, 1]]), 0.25)
    np.testing.assert_allclose(found.xyz, [[1.1, -2.2, 3.3]], atol=1e-12)
    np.testing.assert_allclose(found.covariance, own + common, rtol=1e-9)
    assert found.n_pairs.tolist() == [1]
    assert found.best.tolist() == [0]


@pytest.mark.parametrize(
    ("seen_by", "n_pairs", "divided_by"),
    [
        ([(1, 0)], 1, 1),
        ([(1, 0)] * 5, 1, 1),  # points of one pair share its error
        ([(1, 0), (3, 2)], 2, 2),  # nothing in common
        ([(1, 0)] * 3 + [(3, 2)], 2, 2),
        ([(3, 0), (3, 1), (3, 2)], 3, 1),  # one ref frame
        ([(1, 0), (2, 0), (3, 0)], 3, 1),  # one src frame
        ([(1, 0), (2, 1)], 2, 1.5),  # a chain of three frames
        ([(1, 0), (2, 1), (3, 2), (4, 3)], 4, 2.5),
        ([(4, 0), (4, 1), (5, 2), (5, 3)], 4, 2),
    ],
)
def test_how_far_the_covariance_shrinks(seen_by: list[tuple[int, int]], n_pairs: int, divided_by: float) -> None:
    """Equal covariances in one voxel."""
    n = len(seen_by)
    own = np.broadcast_to(np.diag([0.04, 0.01, 0.09]), (n, 3, 3))
    common = np.broadcast_to(np.diag([1.0, 2.0, 4.0]), (n, 3, 3))
    xyz = 0.1 + 0.01 * np.arange(3.0 * n).reshape(n, 3) / n
    pair = np.array([100 * ref + src for ref, src in seen_by])
    found = merge_voxels(xyz, own, common, pair, np.array(seen_by), 1.0)
    assert found.n_pairs.tolist() == [n_pairs]
    np.testing.assert_allclose(found.covariance[0], own[0] / divided_by + common[0], rtol=1e-9)


def test_pairs_weigh_by_their_variance_and_points_of_a_pair_among_themselves() -> None:
    xyz = np.array([[0.1, 0.1, 0.1], [0.3, 0.3, 0.3], [0.5, 0.5, 0.5]])
    own = np.eye(3) * np.array([0.01, 0.03, 0.01])[:, None, None]
    common = np.eye(3) * np.array([5.0, 6.0, 7.0])[:, None, None]
    pair, frames = np.array([0, 0, 1]), np.array([[1, 0], [1, 0], [3, 2]])
    found = merge_voxels(xyz, own, common, pair, frames, 1.0)
    # The first pair: 3/4 of the first and 1/4 of the second, with a variance of 0.015; then 2/5 against 3/5.
    np.testing.assert_allclose(found.xyz[0], 0.4 * 0.15 + 0.6 * 0.5)
    np.testing.assert_allclose(found.covariance[0], np.eye(3) * (0.16 * 0.015 + 0.36 * 0.01 + 5.0))
    # A tie in variance is the first row's, and with it the common part.
    assert found.best.tolist() == [0]
    assert merge_voxels(xyz, own[::-1] * np.array([2, 1, 1])[:, None, None], common, pair, frames, 1.0).best[0] == 2


@settings(max_examples=60)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 60), voxel=st.sampled_from([0.25, 0.5, 2.0]))
def test_merging_keeps_its_promises(seed: int, n: int, voxel: float) -> None:
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-1.5, 1.5, (n, 3))
    own, common = covariances(rng, n), covariances(rng, n, 1.0)
    pair = rng.integers(0, 6, n)
    frames = np.stack([1 + pair // 2, pair // 3 + 7 * (pair % 2)], axis=1)
    found = merge_voxels(xyz, own, common, pair, frames, voxel)

    cells = np.floor(xyz / voxel).astype(int)
    assert len(found.xyz) == len({tuple(cell) for cell in cells})
    home = cells[found.best]
    assert [tuple(cell) for cell in home] == sorted(tuple(cell) for cell in home), "in the order of the voxels"
    for i, cell in enumerate(home):
        members = np.flatnonzero((cells == cell).all(axis=1))
        stays = np.abs(found.xyz[i] - (cell + 0.5) * voxel) <= 0.5 * voxel + 1e-9
        assert stays.all(), "a merged point stays in its voxel"
        assert found.n_pairs[i] == len(set(pair[members]))
        traces = np.trace(own[members], axis1=1, axis2=2)
        assert np.trace(own[found.best[i]]) == traces.min()
        rest = found.covariance[i] - common[found.best[i]]
        assert np.linalg.eigvalsh(rest).min() > 0.0, "the common part never shrinks"
        assert traces.min() / len(members) * (1 - 1e-9) <= np.trace(rest) <= traces.max() * (1 + 1e-9)

    order = rng.permutation(n)
    mixed = merge_voxels(xyz[order], own[order], common[order], pair[order], frames[order], voxel)
    np.testing.assert_allclose(mixed.xyz, found.xyz, atol=1e-9)
    np.testing.assert_allclose(mixed.covariance, found.covariance, rtol=1e-9, atol=1e-15)
    assert (mixed.n_pairs == found.n_pairs).all()
    assert (order[mixed.best] == found.best).all()


def test_merged_points_are_as_far_off_as_they_say() -> None:
    """Redraws of four pairs of two ref frames that bring all of the error, three points each."""
    rng = np.random.default_rng(6)
    truth, sigma = np.array([0.5, 0.5, 0.5]), np.array([0.02, 0.03, 0.05])
    pair, ref = np.repeat([0, 1, 2, 3], 3), np.repeat([0, 0, 1, 1], 3)
    frames = np.stack([ref, pair + 10], axis=1)
    own = np.broadcast_to(np.diag(sigma**2), (12, 3, 3))
    common = np.zeros((12, 3, 3))
    errors = []
    for _ in range(1500):
        of_ref = rng.normal(0.0, sigma, (2, 3))
        found = merge_voxels(truth + of_ref[ref], own, common, pair, frames, 1.0)
        errors.append(found.xyz[0] - truth)
    predicted = np.sqrt(np.diag(found.covariance[0]))
    np.testing.assert_allclose(np.std(errors, axis=0), predicted, rtol=0.07)
