"""World points against moved cameras and disturbed pixels, through the whole chain from rays to points."""

from __future__ import annotations

import numpy as np
import pytest
from pixel_noise import drawn, slanted

from pipeline.depthing import Limits, MatchedRays, depths_by
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import PlacedPair, Placement, relative_jacobian, relative_placement
from pipeline.geometry.rotations import enu_from_cam, skew
from pipeline.geometry.transfer import VirtualView
from pipeline.points.world import WorldPoints, world_points

DEG = np.pi / 180.0
PLAIN = Camera("pinhole", 4000, 3000, 2800.0, 2810.0, 2010.0, 1490.0)
LENS = Camera("brown", 4000, 3000, 2900.0, 2905.0, 2010.0, 1490.0, (-0.1, 0.02, 0.001, -0.0005, 0.0))
WIDE = Camera("fisheye", 1600, 1200, 700.0, 705.0, 802.0, 597.0, (0.02, -0.003, 0.0, 0.0))
ALL = Limits(np.inf, np.inf)
# Sigmas of the two cameras' turns (rad) and shifts (m), far from equal so that a mixed-up term shows.
SIGMAS = np.concatenate([np.array([0.05, 0.03, 0.04]) * DEG, [0.02, 0.03, 0.04], np.full(3, 0.06) * DEG, [0.05] * 3])
FORWARD = ((3.0, -20.0, 0.5), (0.0, 8.0, 31.0)), ((1.0, -21.0, 0.0), (0.5, 0.0, 30.5))
SIDEWAYS = ((40.0, -35.0, -1.0), (3.0, -2.5, 31.0)), ((42.0, -34.0, 1.0), (0.0, 0.0, 31.0))
# Ref pixels as shares of the image, off the epipole of the forward pair, and ranges.
AT = np.array([[0.25, 0.85], [0.5, 0.75], [0.75, 0.7], [0.35, 0.6], [0.25, 0.5]])
RANGE_M = np.array([18.0, 25.0, 30.0, 40.0, 35.0])


class Pair:
    """Two cameras over known points."""

    def __init__(self, ends: tuple[tuple[tuple[float, ...], ...], ...], cameras: tuple[Camera, Camera]) -> None:
        self.cameras = cameras
        self.true = [Placement(enu_from_cam(*np.radians(angles)), np.array(centre)) for angles, centre in ends]
        ref, src = self.true
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

    def placed(
        self,
        error: Floats,
        ref_px: Floats,
        src_px: Floats,
        *,
        noisy: bool = True,
        gain: Floats | None = None,
        noise: Floats | None = None,
    ) -> WorldPoints:
        """The points as the pipeline finds them from cameras that were moved and from disturbed pixels."""
        ref, src = (camera.moved(part) for camera, part in zip(self.true, (error[:6], error[6:]), strict=True))
        covariance = np.tile(self.covariance, (len(ref_px) // len(AT), 1))
        rays = MatchedRays.of(ref_px, src_px, *self.cameras, covariance)
        to_relative = relative_jacobian(ref, src)
        relative = relative_placement(ref, src, to_relative @ np.diag(SIGMAS**2) @ to_relative.T)
        found = depths_by("epitransfer", VirtualView.ADAPTIVE, 1.0, rays, relative, ALL)
        sigma = found.pixel_sigma_m * noisy
        placed = PlacedPair(
            ref, src, np.eye(12) if gain is None else gain, np.zeros((12, 12)) if noise is None else noise
        )
        return world_points(ref_px, found.depths.depth_m, found.depths.normal, sigma, self.cameras[0], placed)

    def at_rest(self, *, noisy: bool = True, gain: Floats | None = None, noise: Floats | None = None) -> WorldPoints:
        """The points from the true cameras and pixels."""
        return self.placed(np.zeros(12), self.ref_px, self.src_px, noisy=noisy, gain=gain, noise=noise)

    def derivatives(self) -> Floats:
        """(n, 3, 12): how the points move with each error, by central differences through the whole chain."""
        step = 1e-6

        def moved(error: Floats) -> Floats:
            return self.placed(error, self.ref_px, self.src_px).p_in_enu_m

        columns = [(moved(step * e) - moved(-step * e)) / (2.0 * step) for e in np.eye(12)]
        return np.stack(columns, axis=2)


CAMERAS = {"pinhole": (PLAIN, PLAIN), "brown": (LENS, LENS), "unequal": (LENS, WIDE), "unequal back": (WIDE, PLAIN)}
ENDS = {"forward": FORWARD, "sideways": SIDEWAYS}


@pytest.mark.parametrize("cameras", CAMERAS)
@pytest.mark.parametrize("ends", ENDS)
def test_pixel_noise_alone(ends: str, cameras: str) -> None:
    """Through lens distortion, off the axis, with src of another size; it moves a point along its ref ray."""
    pair = Pair(ENDS[ends], CAMERAS[cameras])
    rng, draws, n = np.random.default_rng(1), 4000, len(AT)
    ref_px, src_px = (np.tile(px, (draws, 1)) for px in (pair.ref_px, pair.src_px))
    src_px += drawn(rng, np.tile(pair.covariance, (draws, 1)))
    points = pair.placed(np.zeros(12), ref_px, src_px).p_in_enu_m.reshape(draws, n, 3)
    predicted = pair.at_rest().independent
    sight = pair.points - pair.true[0].centre
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    length = np.sqrt(np.einsum("ni,nij,nj->n", sight, predicted, sight))
    line = length[:, None] * sight
    np.testing.assert_allclose(predicted, line[:, :, None] * line[:, None, :], rtol=1e-9, atol=1e-15)
    spread = np.std(np.einsum("dni,ni->dn", points, sight), axis=0)
    np.testing.assert_allclose(spread / length, 1.0, atol=0.06)


@pytest.mark.parametrize("cameras", CAMERAS)
@pytest.mark.parametrize("ends", ENDS)
def test_errors_of_both_cameras_to_first_order(ends: str, cameras: str) -> None:
    """The Jacobian against numerical derivatives of the whole chain, camera to point."""
    pair = Pair(ENDS[ends], CAMERAS[cameras])
    found = pair.at_rest(noisy=False)
    want = pair.derivatives()
    # In units of what each error's sigma does, so that a turn counts as much as a shift.
    np.testing.assert_allclose(found.jacobian * SIGMAS, want * SIGMAS, atol=2e-5, rtol=1e-4)
    assert np.abs(want * SIGMAS).max(axis=(0, 1)).min() > 1e-3, "every error counts"
    assert not found.independent.any()


@pytest.mark.parametrize("ends", ENDS)
def test_a_gain_and_a_noise_of_the_pair(ends: str) -> None:
    """A pair refined by itself: its cameras' errors are a gain times those of the frames, and some of its own."""
    pair = Pair(ENDS[ends], (LENS, LENS))
    rng = np.random.default_rng(8)
    gain, root = rng.normal(size=(12, 12)), rng.normal(size=(12, 12)) * SIGMAS
    plain = pair.at_rest()
    found = pair.at_rest(gain=gain, noise=root.T @ root)
    want = pair.derivatives()
    np.testing.assert_allclose(found.jacobian * SIGMAS, want @ gain * SIGMAS, rtol=1e-3, atol=1e-3)
    more = found.independent - plain.independent
    np.testing.assert_allclose(more, want @ root.T @ root @ np.swapaxes(want, 1, 2), rtol=1e-3, atol=1e-5)
    assert np.linalg.eigvalsh(more).max() > 1e-4


def test_a_shift_of_both_cameras_shifts_the_points() -> None:
    """And a turn of both about the ref centre turns them about it: nothing relative has changed."""
    pair = Pair(FORWARD, (PLAIN, PLAIN))
    found = pair.at_rest().jacobian
    np.testing.assert_allclose(found[:, :, 3:6] + found[:, :, 9:], np.broadcast_to(np.eye(3), (len(AT), 3, 3)))
    ref, src = pair.true
    turn = found[:, :, :3] + found[:, :, 6:9] + found[:, :, 9:] @ -skew(src.centre - ref.centre)
    np.testing.assert_allclose(turn, -skew(pair.points - ref.centre), atol=1e-6)


def test_a_point_lies_on_the_ref_ray_at_its_depth_and_where_it_was() -> None:
    pair = Pair(FORWARD, (LENS, WIDE))
    np.testing.assert_allclose(pair.at_rest().p_in_enu_m, pair.points, atol=1e-6)
    ref = pair.true[0]
    moved = pair.placed(np.zeros(12), pair.ref_px, pair.src_px + 3.0)
    in_ref = (moved.p_in_enu_m - ref.centre) @ ref.rotation
    np.testing.assert_allclose(LENS.project(in_ref), pair.ref_px, atol=1e-7)
    assert np.abs(moved.p_in_enu_m - pair.points).max() > 0.1
