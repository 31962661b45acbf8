"""When a pair must not be refined: what its matches do not determine stays as logged, and the table says why."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.poses import RelativePose
from pipeline.refinement.matched import Epipolar, Matched, Rays, epipolar
from pipeline.refinement.relative import Fits, Prior, costs
from pipeline.refinement.starts import homography

# Five unknowns are seen; the spread of the residuals has to be, too.
LEAST_MATCHES = 20
# Standard deviation across the line that the ref rays would lie on, on the image plane.
_LEAST_WIDTH = 0.02
# What a turn alone leaves of the matches' motion, in sigmas of their positions and in rays.
_LEAST_PARALLAX_SIGMAS, _LEAST_PARALLAX = 6.0, 1e-3
_LEAST_AGREEING, _AGREE_SIGMAS, _AGREE = 0.3, 6.0, 5e-4
_LEAST_IN_FRONT = 0.5
# Twice the difference of cost below which a second pose is as good: e^-6 to one.
_CLEARLY_BETTER, _BY_CHANCE = 12.0, 6.0
_APART_SIGMAS = 5.0
# Minima that are nearer than this, as turns and as shares of the baseline, are one pose that a lens or a few moving
# things have split; its sigmas can cover them.
_NEAR_RAD, _NEAR = 3e-3, 0.03
# Of the logged baseline: the shortest that is thought of.
_SHORTEST = 0.1
_PLANE_SHARE = 0.9


class Refusal(Exception):  # noqa: N818 - no error: a finding
    """The matches do not determine the relative pose; the text says why.

    Args:
        reason: For people.
        doubtful: Whether the matches themselves are in doubt, and not only what they determine.
        errors: (k, 6) of the logged pose that the matches cannot choose between.
    """

    def __init__(self, reason: str, *, doubtful: bool = False, errors: Floats | None = None) -> None:
        super().__init__(reason)
        self.doubtful = doubtful
        self.errors = errors


def refusal_before(matched: Matched, pose: RelativePose) -> None:
    """What can be seen before any fit.

    Raises:
        Refusal: Too few matches, on a line, or without parallax.
    """
    if len(matched) < LEAST_MATCHES:
        raise Refusal(f"too few matches: {len(matched)}, and {LEAST_MATCHES} are needed", doubtful=True)
    if _width(matched.rays.ref) < _LEAST_WIDTH:
        raise Refusal("the matches lie along a line")
    left = _left_by_a_turn(matched.rays)
    sigma = float(np.sqrt(np.median(matched.rays.noise[:, [0, 2]])))
    if left < max(_LEAST_PARALLAX_SIGMAS * sigma, _LEAST_PARALLAX):
        raise Refusal(f"nearly a pure rotation: a turn alone explains the matches to {left * matched.focal_px:.1f} px")
    if not np.linalg.norm(pose.centre) > 0.0:
        raise Refusal("the logged baseline is zero")


def refusal_after(rays: Rays, prior: Prior, fits: Fits) -> float:
    """What can be seen once the matches were followed from several starts.

    Args:
        rays: The matches.
        prior: The logged relative pose.
        fits: From every start.

    Returns:
        The factor that the matches' information has to be divided by to cover other minima next to the best one.

    Raises:
        Refusal: Two poses explain the matches, few agree with the best, or it puts them behind the cameras.
    """
    best = int(np.argmin(fits.cost))
    error = fits.error[best]
    found = epipolar(rays, *prior.moved(error))
    agree = agreeing(found)
    if np.mean(agree) < _LEAST_AGREEING:
        raise Refusal(f"only {np.mean(agree):.0%} of the matches agree with one pose", doubtful=True)
    ahead = np.mean(in_front(rays, prior, error)[agree])
    if ahead < _LEAST_IN_FRONT:
        raise Refusal(f"the pose that fits would have {1.0 - ahead:.0%} of the matches behind the cameras")
    rivals, apart = _rivals(rays, prior, fits, best)
    away = rivals - fits.error[best]
    far = np.linalg.norm(away[:, :3], axis=1) > _NEAR_RAD
    far |= np.linalg.norm(away[:, 3:], axis=1) > _NEAR * np.linalg.norm(prior.centre + fits.error[best, 3:])
    if np.any(far):
        _, on_plane = homography(rays, float(np.median(found.sigma)) * _AGREE_SIGMAS + _AGREE)
        flat = np.mean(on_plane) > _PLANE_SHARE
        text = "the matches lie on a plane that two poses explain" if flat else "two poses explain the matches"
        raise Refusal(text, errors=np.concatenate([fits.error[best][None], rivals[far]]))
    return max(1.0, float(np.max(apart, initial=0.0)) ** 2 / 2.0)


def agreeing(found: Epipolar) -> Bools:
    """Which matches agree with a pose, by their residuals under it."""
    out: Bools = np.abs(found.sine) <= np.maximum(_AGREE_SIGMAS * found.sigma, _AGREE)
    return out


def _rivals(rays: Rays, prior: Prior, fits: Fits, best: int) -> tuple[Floats, Floats]:
    """(k, 6) other errors that are as good and have the points in front, and (k,) how far they are in sigmas."""
    # Residuals do not know on which side src is: a minimum with all points behind stands for one with them in front.
    others = np.concatenate([fits.error, [_mirrored(prior, error) for error in fits.error]])
    away = others - fits.error[best]
    apart = np.sqrt(np.einsum("bi,ij,bj->b", away, fits.information[best] + prior.information, away))
    less = 2.0 * (costs(rays, prior, others) - fits.cost[best])
    # Two poses see different parts of the matches' noise: by chance alone their costs differ as the square root of n.
    enough = _CLEARLY_BETTER + _BY_CHANCE * np.sqrt(len(rays.ref))
    rivals = np.flatnonzero((apart > _APART_SIGMAS) & (less < enough))
    ahead = [i for i in rivals if np.mean(in_front(rays, prior, others[i])) >= _LEAST_IN_FRONT]
    return others[ahead], apart[ahead]


def _mirrored(prior: Prior, error: Floats) -> Floats:
    """The error with src on the other side of ref, as far from it as the log finds likeliest."""
    centre = prior.centre + error[3:]
    way = np.concatenate([np.zeros(3), -centre / max(float(np.linalg.norm(centre)), 1e-9)])
    here = np.concatenate([error[:3], -prior.centre])
    length = -(way @ prior.information @ here) / (way @ prior.information @ way)
    out: Floats = here + max(length, _SHORTEST * float(np.linalg.norm(prior.centre))) * way
    return out


def _width(rays: Floats) -> float:
    """Standard deviation of the rays across the line they lie nearest to."""
    at = rays[:, :2] - rays[:, :2].mean(axis=0)
    return float(np.linalg.svd(at, compute_uv=False)[-1] / np.sqrt(len(at)))


def _left_by_a_turn(rays: Rays) -> float:
    """Median angle that the best turn leaves between matched rays (Kabsch, once more without the worst half)."""
    ref = rays.ref / np.linalg.norm(rays.ref, axis=1, keepdims=True)
    src = rays.src / np.linalg.norm(rays.src, axis=1, keepdims=True)
    rows = np.arange(len(ref))
    left = np.zeros(len(ref))
    for _ in range(3):
        u, _, vt = np.linalg.svd(src[rows].T @ ref[rows])
        turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        left = np.linalg.norm(src - ref @ turn.T, axis=1)
        rows = np.argsort(left, kind="stable")[: max(len(left) // 2, 3)]
    return float(np.median(left))


def in_front(rays: Rays, prior: Prior, error: Floats) -> Bools:
    """(n,) where the point nearest to both rays is in front of both cameras."""
    ref_from_src, centre = prior.moved(error)
    src = rays.src @ ref_from_src.T
    # s ref - t src = centre in least squares.
    aa, bb, ab = (np.sum(x * y, axis=1) for x, y in ((rays.ref, rays.ref), (src, src), (rays.ref, src)))
    ac, bc = rays.ref @ centre, src @ centre
    out: Bools = (bb * ac - ab * bc > 0.0) & (ab * ac - aa * bc > 0.0)
    return out
