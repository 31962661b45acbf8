"""The relative pose that matches and a Gaussian prior say: robust maximum a posteriori on the epipolar residual.

The unknown is the error of the logged relative pose, a turn a and a shift e of src on ref's axes. What is minimised is

    sum rho(r / sigma) + (a, e) P (a, e)^T / 2,    rho(x) = c^2 / 2 log(1 + (x / c)^2)

over the epipolar residuals r with the sigmas of their own matches; P is the inverse of the prior's covariance. Five of
the six unknowns are seen by the matches; along the baseline's length only the prior speaks. All functions work on many
starting points at a time: leading axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.poses import RelativePose
from pipeline.geometry.rotations import rotation_from_vector, vector_from_rotation
from pipeline.refinement.matched import Epipolar, Rays, epipolar

# In sigmas. Sub-pixel positions are a little worse than Gaussian in their tails.
CAUCHY_SCALE = 2.5
_MOST_SAY = 3.0
_MOST_STEPS = 30
_SMALL = 1e-3
_HALVING = 0.5


@dataclass(frozen=True, slots=True)
class Prior:
    """The logged relative pose.

    Args:
        ref_from_src: (3, 3).
        centre: (3,) m, src's in ref.
        information: (6, 6) inverse covariance of turn (rad) and shift (m) on ref's axes.
        spread: (6, 6) sigmas of turn and shift on the diagonal: the units in which derivatives are compared.
    """

    ref_from_src: Floats
    centre: Floats
    information: Floats
    spread: Floats

    @classmethod
    def of(cls, pose: RelativePose) -> Prior:
        """From a relative pose; what its covariance says nothing of is taken as certain."""
        spread = np.diag(np.sqrt(np.diag(pose.covariance)))
        return cls(pose.rotation.T, pose.centre, inverse(pose.covariance), spread)

    def moved(self, error: Floats) -> tuple[Floats, Floats]:
        """ref_from_src (..., 3, 3) and src's centre (..., 3) after errors (..., 6)."""
        return rotation_from_vector(error[..., :3]) @ self.ref_from_src, self.centre + error[..., 3:]


@dataclass(frozen=True, slots=True)
class Fits:
    """Relative poses that minimise the cost.

    Args:
        error: (b, 6) of the logged relative pose.
        cost: (b,) at the narrowest robust scale.
        information: (b, 6, 6) of the matches alone.
    """

    error: Floats
    cost: Floats
    information: Floats


def inverse(covariance: Floats) -> Floats:
    """The inverse of a covariance of turns and shifts, whose units differ by orders; a floor for what is exact."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-16))
    correlation = covariance / np.outer(scale, scale) + 1e-10 * np.eye(len(scale))
    out: Floats = np.linalg.inv(correlation) / np.outer(scale, scale)
    return out


def costs(rays: Rays, prior: Prior, error: Floats) -> Floats:
    """(b,) the cost of errors (b, 6)."""
    square = _whitened(rays, prior, error)[0] ** 2
    data = 0.5 * CAUCHY_SCALE**2 * np.sum(np.log1p(square / CAUCHY_SCALE**2), axis=-1)
    out: Floats = data + 0.5 * np.einsum("...i,ij,...j->...", error, prior.information, error)
    return out


def fit(rays: Rays, prior: Prior, starts: Floats) -> Fits:
    """The minima that starts lead to, each followed in two ways.

    Once the robust scale narrows from what the start leaves to the noise's, which forgives a start far off; once it is
    the noise's from the beginning, which does not leave a good start when most matches are wrong.

    Args:
        rays: The matches.
        prior: The logged relative pose.
        starts: (b, 6) errors to start from.

    Returns:
        2 b of them.
    """
    left = 1.5 * np.median(np.abs(_whitened(rays, prior, starts)[0]), axis=-1)
    return follow(rays, prior, np.concatenate([starts, starts]), np.concatenate([left, np.zeros(len(starts))]))


def follow(rays: Rays, prior: Prior, starts: Floats, scale: Floats) -> Fits:
    """Iteratively reweighted Gauss-Newton.

    Args:
        rays: The matches.
        prior: The logged relative pose.
        starts: (b, 6) errors to start from.
        scale: (b,) robust scales to start with, in sigmas; they narrow to CAUCHY_SCALE.
    """
    error = starts.copy()
    scale = np.maximum(CAUCHY_SCALE, scale)
    for _ in range(_MOST_STEPS):
        step, _, sigmas = _step(rays, prior, error, scale)
        error = composed(step, error)
        narrow = scale <= CAUCHY_SCALE
        if np.all(narrow & (sigmas < _SMALL)):
            break
        scale = np.maximum(CAUCHY_SCALE, scale * _HALVING)
    information = _step(rays, prior, error, np.full(len(error), CAUCHY_SCALE))[1]
    return Fits(error, costs(rays, prior, error), information)


def minimal_fits(rays: Rays, prior: Prior, rows: Ints, noise_factor: float) -> Floats:
    """Errors (b, 6) that few matches each, rows (b, m), and the prior say; for starting points.

    Args:
        rays: The matches.
        prior: The logged relative pose.
        rows: (b, m) which matches.
        noise_factor: By how much their sigmas are widened: a few matches must not be followed to the hundredth pixel.
    """
    some = rays.some(rows)
    some = Rays(some.ref, some.src, some.noise * noise_factor**2)
    error = np.zeros((len(rows), 6))
    wide = np.full(len(rows), np.inf)
    for _ in range(4):
        error = composed(_step(some, prior, error, wide)[0], error)
    return error


def composed(step: Floats, error: Floats) -> Floats:
    """A turn and shift after another, (..., 6)."""
    turn = vector_from_rotation(rotation_from_vector(step[..., :3]) @ rotation_from_vector(error[..., :3]))
    out: Floats = np.concatenate([turn, step[..., 3:] + error[..., 3:]], axis=-1)
    return out


def _whitened(rays: Rays, prior: Prior, error: Floats) -> tuple[Floats, Floats]:
    found = epipolar(rays, *prior.moved(error))
    # A match next to the epipole, or one whose parallax is that of a thing before the lens, moves with the pose more
    # than all others together: were it wrong, the pose would be what suits it. So none has more than a few times the
    # say of a usual one.
    sigma = bounded_sigma(found, prior)
    return found.sine / sigma, found.jacobian / sigma[..., None]


def bounded_sigma(found: Epipolar, prior: Prior) -> Floats:
    """(..., n) sigmas, widened for matches that would say more than a few times what the usual one does."""
    say = np.linalg.norm(found.jacobian @ prior.spread, axis=-1) / found.sigma
    out: Floats = found.sigma * np.maximum(1.0, say / (_MOST_SAY * np.median(say, axis=-1, keepdims=True)))
    return out


def _step(rays: Rays, prior: Prior, error: Floats, scale: Floats) -> tuple[Floats, Floats, Floats]:
    """The Gauss-Newton step (b, 6), the matches' information (b, 6, 6), and the step's size in posterior sigmas."""
    residual, jacobian = _whitened(rays, prior, error)
    weight = 1.0 / (1.0 + (residual / scale[:, None]) ** 2)
    information = np.einsum("bn,bni,bnj->bij", weight, jacobian, jacobian, optimize=True)
    gradient = np.einsum("bn,bni->bi", weight * residual, jacobian) + error @ prior.information
    whole = information + prior.information
    step = -np.linalg.solve(whole, gradient[..., None])[..., 0]
    return step, information, np.sqrt(np.abs(np.sum(step * gradient, axis=-1)))
