"""The stars of one ref frame, linearised and their depths eliminated: a quadratic in the errors of a few frames.

With d a star's ref ray, rho its inverse depth and R, C the cameras, the ray to its point from src is

    w = R_ref d + rho (C_ref - C_src),    y = R_src^T w,    x = y / y_z

in units of 1 / rho, so that points far away are nothing special. A turn t of ref moves w by t x R_ref d, shifts move it
by rho (e_ref - e_src), and a turn t of src moves y by R_src^T (w x t).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.poses import Placement
from pipeline.geometry.rotations import skew
from pipeline.refinement.flight.lens import LensChange
from pipeline.refinement.flight.stars import Stars
from pipeline.refinement.scatter import sums_by_cell

_FIRST_STEPS, _STEPS = 6, 2
# Inverse depths are kept between that of a thousand kilometres and of a decimetre.
_FARTHEST, _NEAREST = 1e-6, 10.0
_LEAST_AHEAD = 1e-3


@dataclass(frozen=True, slots=True)
class Quadratic:
    """What a frame's stars say: error^T information error / 2 + gradient . error, in the errors of `Stars.frames`.

    Args:
        information: (6 k, 6 k), or with three more unknowns of the lens behind them.
        gradient: (6 k,).
        by_cell: (cells, 6 k) sums of the stars' gradients within cells of the image.
    """

    information: Floats
    gradient: Floats
    by_cell: Floats


def residuals(stars: Stars, at: list[Placement], inverse_depth: Floats) -> tuple[Floats, Floats, Floats]:
    """(m, 2) whitened residuals, and the rays w (m, 3) and y (m, 3) they come from; NaN for a point behind src."""
    w, y = _rays(stars, at, inverse_depth)
    found = np.einsum("mij,mj->mi", stars.root, y[:, :2] / y[:, 2:] - stars.xy)
    return found, w, y


def inverse_depths(stars: Stars, at: list[Placement], start: Floats | None, scale: float) -> Floats:
    """(n,) the inverse depths that fit best with the poses fixed.

    Args:
        stars: Of one ref frame.
        at: Placements of `stars.frames`.
        start: (n,) to start from; None for the midpoint of the rays.
        scale: Of the robust weights, in sigmas.
    """
    rho = _midpoints(stars, at) if start is None else start
    turned = _toward(stars, at)[1]
    for _ in range(_FIRST_STEPS if start is None else _STEPS):
        found, _, y = residuals(stars, at, rho)
        by_depth = _by_point(stars, y, turned)
        weight = _weights(found, scale)
        by_depth, found = np.nan_to_num(by_depth), np.nan_to_num(found)
        top = np.bincount(stars.star, weight * np.sum(by_depth * found, axis=1), len(rho))
        bottom = np.bincount(stars.star, weight * np.sum(by_depth**2, axis=1), len(rho))
        step = -top / np.maximum(bottom, 1e-12)
        # No more than to half or double at a time: the first guess may be far off.
        rho = np.clip(np.clip(rho + step, 0.5 * rho, 2.0 * rho), _FARTHEST, _NEAREST)
    return rho


def eliminated(
    stars: Stars, at: list[Placement], inverse_depth: Floats, scale: float, lens: LensChange | None = None
) -> Quadratic:
    """The quadratic that is left when every star takes the depth that suits it best.

    Args:
        stars: Of one ref frame.
        at: Placements of `stars.frames`.
        inverse_depth: (n,) as `inverse_depths` finds them.
        scale: Of the robust weights, in sigmas.
        lens: Given where the lens is unknown, too.
    """
    n, k = len(stars.ray), len(at)
    found, w, y = residuals(stars, at, inverse_depth)
    weight = _weights(found, scale)
    jacobian = _by_poses(stars, at, inverse_depth, w, y, k)
    if lens is not None:
        jacobian = np.concatenate([jacobian, _by_lens(stars, at, y, lens)], axis=2)
    by_depth = _by_point(stars, y, _toward(stars, at)[1])
    root = np.sqrt(weight)[:, None]
    jacobian, by_depth, found = (
        np.nan_to_num(values) * one for values, one in ((jacobian, root[:, :, None]), (by_depth, root), (found, root))
    )
    size = jacobian.shape[2]
    flat = jacobian.reshape(-1, size)
    information = flat.T @ flat
    cross = _summed(np.einsum("mi,mij->mj", by_depth, jacobian), stars, n)
    depth_information = np.maximum(np.bincount(stars.star, np.sum(by_depth**2, axis=1), n), 1e-12)
    depth_gradient = np.bincount(stars.star, np.sum(by_depth * found, axis=1), n)
    information -= (cross / depth_information[:, None]).T @ cross
    gradients = _summed(np.einsum("mi,mij->mj", found, jacobian), stars, n)
    gradients -= cross * (depth_gradient / depth_information)[:, None]
    by_cell = sums_by_cell(gradients, stars.ref_px)
    return Quadratic(information, gradients.sum(axis=0), by_cell)


def _weights(found: Floats, scale: float) -> Floats:
    """(m,) of whitened residuals; none for what is not seen, by src or through the lens."""
    out: Floats = 1.0 / (1.0 + np.sum(found**2, axis=1) / scale**2)
    return np.nan_to_num(out)


def _rays(stars: Stars, at: list[Placement], inverse_depth: Floats) -> tuple[Floats, Floats]:
    rotations = np.stack([placed.rotation for placed in at])[stars.of]
    w = (stars.ray @ at[0].rotation.T)[stars.star] + inverse_depth[stars.star, None] * _toward(stars, at)[0]
    y = np.einsum("mji,mj->mi", rotations, w)
    # A point behind src would be mirrored to where it seems to fit.
    y[:, 2] = np.where(y[:, 2] > _LEAST_AHEAD, y[:, 2], np.nan)
    return w, y


def _toward(stars: Stars, at: list[Placement]) -> tuple[Floats, Floats]:
    """(m, 3) from src to ref in ENU and on src's axes: how w and y change with the inverse depth."""
    step = np.stack([at[0].centre - placed.centre for placed in at])
    turned = np.stack([placed.rotation.T @ one for placed, one in zip(at, step, strict=True)])
    return step[stars.of], turned[stars.of]


def _projected(stars: Stars, y: Floats, change: Floats) -> Floats:
    """(m, 2, c) whitened, of changes (m, 3, c) of y."""
    x = y[:, :2] / y[:, 2:]
    on_plane = (change[:, :2] - x[:, :, None] * change[:, 2:]) / y[:, 2, None, None]
    out: Floats = stars.root @ on_plane
    return out


def _by_point(stars: Stars, y: Floats, turned: Floats) -> Floats:
    out: Floats = _projected(stars, y, turned[:, :, None])[:, :, 0]
    return out


def _by_poses(stars: Stars, at: list[Placement], inverse_depth: Floats, w: Floats, y: Floats, k: int) -> Floats:
    """(m, 2, 6 k) whitened residuals by turns and shifts of the frames."""
    m = len(stars.of)
    into_src = np.stack([placed.rotation.T for placed in at])[stars.of]
    rho = inverse_depth[stars.star, None, None]
    by_turn_ref = _projected(stars, y, into_src @ -skew(stars.ray @ at[0].rotation.T)[stars.star])
    by_shift = _projected(stars, y, into_src * rho)
    by_turn_src = _projected(stars, y, into_src @ skew(w))
    out = np.zeros((m, 2, k, 6))
    out[:, :, 0, :3], out[:, :, 0, 3:] = by_turn_ref, by_shift
    rows = np.arange(m)
    out[rows, :, stars.of, :3] = by_turn_src
    out[rows, :, stars.of, 3:] = -by_shift
    return out.reshape(m, 2, 6 * k)


def _by_lens(stars: Stars, at: list[Placement], y: Floats, lens: LensChange) -> Floats:
    into_src = np.stack([placed.rotation.T for placed in at])[stars.of] @ at[0].rotation
    by_ref = _projected(stars, y, into_src[:, :, :2] @ lens.ref[stars.star])
    out: Floats = by_ref - stars.root @ lens.src
    return out


def _summed(values: Floats, stars: Stars, n: int) -> Floats:
    """(n, c) sums of rows (m, c) by star."""
    out: Floats = np.stack([np.bincount(stars.star, column, n) for column in values.T], axis=1)
    return out


def _midpoints(stars: Stars, at: list[Placement]) -> Floats:
    """(n,) inverse depths from the rays' nearest points, the widest parallax of each star."""
    src = np.concatenate([stars.xy, np.ones((len(stars.xy), 1))], axis=1)
    turned = np.einsum("mij,mj->mi", np.stack([placed.rotation for placed in at])[stars.of], src)
    ref = (stars.ray @ at[0].rotation.T)[stars.star]
    apart = np.stack([placed.centre - at[0].centre for placed in at])[stars.of]
    # s ref - t src = apart in least squares; rho = 1 / s.
    rr, ss, rs = (np.sum(a * b, axis=1) for a, b in ((ref, ref), (turned, turned), (ref, turned)))
    ra, sa = np.sum(ref * apart, axis=1), np.sum(turned * apart, axis=1)
    rho = (rr * ss - rs * rs) / np.where(ss * ra - rs * sa > 0.0, ss * ra - rs * sa, np.inf)
    sine = np.sqrt(np.maximum(rr * ss - rs * rs, 0.0))
    best = np.lexsort((-sine, stars.star))
    first = best[np.searchsorted(stars.star[best], np.arange(len(stars.ray)))]
    length = float(np.linalg.norm(apart, axis=1).max())
    out: Floats = np.clip(rho[first], 1.0 / (1000.0 * length), 1.0 / (0.1 * length))
    return out
