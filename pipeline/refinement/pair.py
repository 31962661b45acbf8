"""A pair refined by itself: what its matches and the log say of the two cameras together.

The relative pose is the robust maximum a posteriori of `relative`. The two absolute poses follow it by the covariance
that the log gives them together, so that the points' place on earth profits too. With S the log's covariance of both
cameras (12 x 12), L the way from it to the relative pose and G G^T the information of the matches,

    K = S L^T G (G^T L S L^T G + I)^-1      error left = (I - K G^T L) error of the log + K noise

which keeps every correlation: that of the two cameras, and that with other pairs through the frames they share.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.poses import (
    PlacedPair,
    Placement,
    Pose,
    RelativePose,
    joint_covariance,
    relative_jacobian,
    relative_placement,
    relative_pose,
)
from pipeline.refinement.logged import NO_INLIER, Log, as_logged
from pipeline.refinement.matched import Matched, Rays, epipolar
from pipeline.refinement.refusals import Refusal, agreeing, in_front, refusal_after, refusal_before
from pipeline.refinement.relative import CAUCHY_SCALE, Prior, fit, follow, inverse, minimal_fits
from pipeline.refinement.rows import PAIR, Misses, RefinedFrame, RefinedPair
from pipeline.refinement.scatter import SHARED_PX, scatter_of
from pipeline.refinement.starts import homography_errors

# More matches hardly make a pose more certain, but every one costs.
_MOST_MATCHES, _FOLLOWED_ON = 1000, 300
_SAMPLES, _SAMPLE_SIZE, _SCORED_ON = 64, 6, 200
# Samples of few matches are followed to a pixel or so, not to a match's own twentieth.
_SAMPLE_NOISE = 10.0
_POLISHED = 3
# What a gimbal that lies may be off by.
_ANY_TURN_RAD = 0.2
# A pose farther from the log than this many sigmas means that the log's sigmas are too small, or that it lies.
FAR_SIGMAS = 6.0


@dataclass(frozen=True, slots=True)
class RelativeFit:
    """What the matches make of a relative pose.

    Args:
        error: (6,) of the logged one.
        information: (6, 6) of the matches alone.
        prior_scale: By how much the log's covariance had to be widened for the fit to be credible.
        moved_sigmas: How far it is from the logged pose.
    """

    error: Floats
    information: Floats
    prior_scale: float
    moved_sigmas: float


def refine_pair(log: Log, matched: Matched) -> RefinedPair:
    """Refines one pair; the logged poses stand where the matches do not determine a pose.

    Args:
        log: The flight as logged.
        matched: The pair's inliers.
    """
    if not len(matched):
        return as_logged(log, matched)
    ref, src = log.poses[matched.pair.ref], log.poses[matched.pair.src]
    pose = relative_pose(ref, src)
    try:
        found = relative_fit(matched, pose)
    except Refusal as refusal:
        return as_logged(log, matched, str(refusal))
    placed, covariance = _placed(ref, src, found, pose)
    after = relative_placement(placed.ref, placed.src, pose.covariance)
    problem = ""
    if found.moved_sigmas > FAR_SIGMAS:
        problem = f"the matches put it {found.moved_sigmas:.0f} sigmas from the logged pose; sigmas widened"
    before, now = (Misses.of(matched.residuals_px(one)) for one in (pose, after))
    return RefinedPair(placed, covariance, PAIR, before, now, found.moved_sigmas, problem)


def surest_frames(
    logged: Mapping[str, RefinedFrame], pairs: Iterable[tuple[Matched, RefinedPair]]
) -> dict[str, RefinedFrame]:
    """Every frame as the pair has it that knows it best; as logged where no pair was refined.

    Args:
        logged: Every frame as logged.
        pairs: With their poses.
    """
    out = dict(logged)
    best = dict.fromkeys(logged, 6.0)
    for matched, found in pairs:
        if found.mode != PAIR:
            continue
        both = (matched.pair.ref, found.placed.ref, slice(0, 6)), (matched.pair.src, found.placed.src, slice(6, 12))
        for name, placed, part in both:
            covariance = found.covariance[part, part]
            left = float(np.trace(inverse(logged[name].covariance) @ covariance))
            if left < best[name]:
                best[name], out[name] = left, RefinedFrame(placed, covariance, True, found.problem)
    return out


def relative_fit(matched: Matched, pose: RelativePose) -> RelativeFit:
    """The relative pose of a pair by its matches, with the logged one as prior.

    Args:
        matched: The pair's inliers.
        pose: src_from_ref as logged, with its covariance.

    Raises:
        Refusal: They do not determine it.
    """
    refusal_before(matched, pose)
    rng = np.random.default_rng(zlib.crc32(matched.pair.pair_id.encode()))
    rows = np.sort(rng.permutation(len(matched))[:_MOST_MATCHES])
    rays, prior = matched.rays.some(rows), Prior.of(pose)
    few = rays.some(np.sort(rng.permutation(len(rows))[:_FOLLOWED_ON]))
    fits = fit(few, prior, _starts(few, prior, rng))
    split = refusal_after(few, prior, fits)
    best = fits.error[int(np.argmin(fits.cost))]
    # A match that would lie behind the cameras is a wrong one, however well it fits the epipolar lines.
    ahead = np.flatnonzero(in_front(rays, prior, best))
    rays, ref_px = rays.some(ahead), matched.ref_px[rows[ahead]]
    found = follow(rays, prior, best[None], np.zeros(1))
    scatter = max(split, _scatter(rays, ref_px, prior, found.error[0], found.information[0]))
    shared_rad = SHARED_PX / matched.focal_px
    error, information = found.error[0], _with_shared_turn(found.information[0] / scatter, shared_rad)
    moved = float(np.sqrt(error @ prior.information @ error))
    scale = 1.0
    if moved > FAR_SIGMAS:
        # The log's sigmas are too small for what happened: the factor that makes the distance an ordinary one.
        scale = moved**2 / 6.0
        wide = replace(prior, information=prior.information / scale)
        again = follow(rays, wide, error[None], np.zeros(1))
        error, information = again.error[0], _with_shared_turn(again.information[0] / scatter, shared_rad)
    return RelativeFit(error, information, scale, moved)


def trusted(log: Log, matched: Matched) -> tuple[Matched, str]:
    """The matches of a pair that agree with one pose; none of them, and why, where too few do.

    Args:
        log: The flight as logged.
        matched: The pair's inliers.
    """
    if not len(matched):
        return matched, NO_INLIER
    pose = relative_pose(log.poses[matched.pair.ref], log.poses[matched.pair.src])
    try:
        return _agreeing_with_any(matched, pose, relative_fit(matched, pose).error[None]), ""
    except Refusal as refusal:
        if not refusal.doubtful:
            # What two frames leave open the others may tell.
            some = matched if refusal.errors is None else _agreeing_with_any(matched, pose, refusal.errors)
            return some, ""
        reason = str(refusal)
    # Or the log is what is wrong: a receiver that jumped, a gimbal that lied. The matches then agree without it.
    length = float(np.linalg.norm(pose.centre))
    anywhere = replace(pose, covariance=np.diag([_ANY_TURN_RAD**2] * 3 + [length**2] * 3))
    try:
        found = relative_fit(matched, anywhere)
    except Refusal:
        return matched.without_matches(), reason
    some = _agreeing_with_any(matched, anywhere, found.error[None])
    return (some, "") if len(some) > 0.5 * len(matched) else (matched.without_matches(), reason)


def _agreeing_with_any(matched: Matched, pose: RelativePose, errors: Floats) -> Matched:
    """The matches that agree with one of several errors (k, 6) of a pose, in front of both cameras."""
    prior = Prior.of(pose)
    agree = agreeing(epipolar(matched.rays, *prior.moved(errors)))
    ahead = np.stack([in_front(matched.rays, prior, error) for error in errors])
    return matched.some(np.flatnonzero(np.any(agree & ahead, axis=0)))


def _starts(rays: Rays, prior: Prior, rng: np.random.Generator) -> Floats:
    """(b, 6): the logged pose, the best of what few matches say, and what a plane would allow."""
    n = len(rays.ref)
    samples = np.argsort(rng.random((_SAMPLES, n)), axis=1)[:, :_SAMPLE_SIZE]
    tried = minimal_fits(rays, prior, samples, _SAMPLE_NOISE)
    tried = np.concatenate([tried, homography_errors(rays, prior)])
    scored_on = rays.some(np.sort(rng.permutation(n)[:_SCORED_ON]))
    found = epipolar(scored_on, *prior.moved(tried))
    limit = _SAMPLE_NOISE * CAUCHY_SCALE
    score = np.mean(np.minimum(np.abs(found.sine / found.sigma), limit), axis=1)
    best = np.argsort(score, kind="stable")[:_POLISHED]
    plane = np.arange(_SAMPLES, len(tried))
    return np.concatenate([np.zeros((1, 6)), tried[best], tried[np.setdiff1d(plane, best)]])


def _scatter(rays: Rays, ref_px: Floats, prior: Prior, error: Floats, information: Floats) -> float:
    """The factor by which the matches' information is too large."""
    found = epipolar(rays, *prior.moved(error))
    residual = found.sine / found.sigma
    weight = residual / (1.0 + (residual / CAUCHY_SCALE) ** 2)
    gradient = weight[:, None] * found.jacobian / found.sigma[:, None]
    return max(1.0, scatter_of(gradient, ref_px, information))


def _with_shared_turn(information: Floats, sigma_rad: float) -> Floats:
    """The information once all rays of src may be turned by a small angle that no match shows (Woodbury)."""
    turn = information[:, :3]
    out: Floats = information - turn @ np.linalg.solve(np.eye(3) / sigma_rad**2 + turn[:3], turn.T)
    return out


def _placed(ref: Pose, src: Pose, found: RelativeFit, pose: RelativePose) -> tuple[PlacedPair, Floats]:
    """Both cameras after the fit, and the covariance of their errors."""
    joint = joint_covariance(ref, src)
    both = joint @ relative_jacobian(ref, src).T @ inverse(pose.covariance) @ found.error
    new_ref = Placement(ref.rotation, ref.centre).moved(both[:6])
    ref_from_src, centre = Prior.of(pose).moved(found.error)
    # The relative pose as found, not as the two first-order moves would leave it.
    new_src = Placement(new_ref.rotation @ ref_from_src, new_ref.centre + new_ref.rotation @ centre)
    values, vectors = np.linalg.eigh(found.information)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    wide = found.prior_scale * joint
    across = root.T @ relative_jacobian(new_ref, new_src)
    kalman = wide @ across.T @ np.linalg.inv(across @ wide @ across.T + np.eye(6))
    gain = np.eye(12) - kalman @ across
    left = gain @ joint @ gain.T
    noise = kalman @ kalman.T + (found.prior_scale - 1.0) * left
    return PlacedPair(new_ref, new_src, gain, noise), left + noise
