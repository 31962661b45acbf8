"""Epipolar transfer to a virtual view, in closed form, with the depth's variance.

Turn the src ray into the ref camera's axes and scale it to z = 1: r = (p, q, 1). With the ref ray d = (x, y, 1) and
the src centre C in the ref frame, a depth s on the ref ray has to satisfy two equations,

    s (x - p) = Cx - p Cz        s (y - q) = Cy - q Cz        in short  s g = h.

A virtual view at V intersects the ref ray with the plane through V and the src ray. That plane's normal n has n . r =
0, so it is fixed by its first two components c, and

    depth = (c . h) / (c . g),     n = (c1, c2, -p c1 - q c2)

so choosing a virtual view is choosing how the two equations are weighted: V = b u gives c = (b uy - h2, h1 - b ux).
The error of the two equations has the 2x2 covariance S (pose and pixels), and the variance of the depth is (c . S c)
/ (c . g)^2. It is least for c = S^-1 g: the adaptive virtual view.

Source: Aggarwal et al., "EpiTransfer", section III, for the transfer; docs/method.md for the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.poses import RelativePose

# Points per block: the block's temporaries stay in the second-level cache.
BLOCK = 8192
# Depths at which the linearisation is evaluated when the first estimate is absurd, in baselines.
_NEAREST, _FARTHEST = 0.5, 1000.0


class VirtualView(Enum):
    """Where the virtual view stands."""

    LATERAL = "lateral"
    VERTICAL = "vertical"
    ADAPTIVE = "adaptive"


@dataclass(frozen=True, slots=True)
class Depths:
    """Depths of n matches.

    Args:
        depth_m: (n,) along the ref camera's optical axis; not finite where the geometry gives none.
        variance_m2: (n,) of the depth.
        normal: (n, 3) depth change per metre by which the src ray is displaced at the point, ref RDF.
    """

    depth_m: Floats
    variance_m2: Floats
    normal: Floats


@dataclass(frozen=True, slots=True)
class PixelNoise:
    """Covariance of the matched positions on the image plane (z = 1).

    Args:
        ref: (3,) or (3, n): xx, xy, yy in ref.
        src: (3,) or (3, n): xx, xy, yy in src.
    """

    ref: Floats
    src: Floats

    @classmethod
    def isotropic(cls, sigma_px: float, focal_px: float) -> PixelNoise:
        """The same noise in all directions and in both images."""
        variance = (sigma_px / focal_px) ** 2
        one = np.array([variance, 0.0, variance])
        return cls(one, one)

    def block(self, part: slice) -> PixelNoise:
        """The noise of some of the points."""
        return PixelNoise(*(n if n.ndim == 1 else n[:, part] for n in (self.ref, self.src)))


def transfer(
    ref_xy: Floats, src_xy: Floats, pose: RelativePose, view: VirtualView, *, virtual_baseline_m: float = 1.0
) -> Floats:
    """Depths alone; the adaptive view then takes equal noise in all directions (the midpoint's depth on the ref ray).

    Args:
        ref_xy: (2, n) ideal image-plane coordinates in ref.
        src_xy: (2, n) ideal image-plane coordinates in src.
        pose: src_from_ref.
        view: Which virtual view.
        virtual_baseline_m: Distance of the lateral or vertical view from ref.

    Returns:
        (n,) m; not finite or negative where the rays do not meet in front of ref.
    """
    depth = np.empty(ref_xy.shape[1])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for start in range(0, depth.size, BLOCK):
            part = slice(start, start + BLOCK)
            equations = _Equations.of(ref_xy[:, part], src_xy[:, part], pose)
            c1, c2 = equations.weights(view, virtual_baseline_m)
            depth[part] = equations.depth(c1, c2)
    return depth


def transfer_with_sigma(
    ref_xy: Floats,
    src_xy: Floats,
    pose: RelativePose,
    view: VirtualView,
    noise: PixelNoise,
    *,
    virtual_baseline_m: float = 1.0,
) -> Depths:
    """Depths with their variance from the covariance of pose and pixels.

    Args:
        ref_xy: (2, n) ideal image-plane coordinates in ref.
        src_xy: (2, n) ideal image-plane coordinates in src.
        pose: src_from_ref with its covariance.
        view: Which virtual view; ADAPTIVE weights by the covariance, per point.
        noise: Of the matched positions.
        virtual_baseline_m: Distance of the lateral or vertical view from ref.
    """
    n = ref_xy.shape[1]
    depth, variance, normal = np.empty(n), np.empty(n), np.empty((n, 3))
    polynomials = _pose_polynomials(pose.covariance)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for start in range(0, n, BLOCK):
            part = slice(start, start + BLOCK)
            equations = _Equations.of(ref_xy[:, part], src_xy[:, part], pose)
            covariance = equations.covariance(polynomials, noise.block(part))
            c1, c2 = equations.weights(view, virtual_baseline_m)
            found = equations.depth(c1, c2)
            spread = covariance.at(found)
            if view is VirtualView.ADAPTIVE:
                # The weights depend on the depth: once with the midpoint's, once with the better one.
                spread = covariance.at(equations.depth(*equations.best_weights(spread)))
                c1, c2 = equations.best_weights(spread)
                found = equations.depth(c1, c2)
            depth[part] = found
            variance[part] = equations.variance(c1, c2, spread)
            normal[part, 0], normal[part, 1], normal[part, 2] = equations.normal(c1, c2)
    return Depths(depth, variance, normal)


def variance_at(
    ref_xy: Floats, src_xy: Floats, pose: RelativePose, depth_m: Floats, noise: PixelNoise
) -> tuple[Floats, Floats]:
    """Variance and normal of a depth found with equal weights in all directions (DLT, midpoint), at given depths.

    Returns:
        (n,) m^2 and (n, 3), as in `Depths`.
    """
    variance, normal = np.empty(depth_m.size), np.empty((depth_m.size, 3))
    polynomials = _pose_polynomials(pose.covariance)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for start in range(0, depth_m.size, BLOCK):
            part = slice(start, start + BLOCK)
            equations = _Equations.of(ref_xy[:, part], src_xy[:, part], pose)
            c1, c2 = equations.weights(VirtualView.ADAPTIVE, 0.0)
            spread = equations.covariance(polynomials, noise.block(part)).at(depth_m[part])
            variance[part] = equations.variance(c1, c2, spread)
            normal[part, 0], normal[part, 1], normal[part, 2] = equations.normal(c1, c2)
    return variance, normal


def transfer_angle(src_xy: Floats, pose: RelativePose, normal: Floats) -> Floats:
    """The angle about the src ray between the plane that was used and the match's epipolar plane.

    Image noise is inflated by the inverse of its sine: 90 deg is the best plane, 0 the trifocal plane.

    Args:
        src_xy: (2, n) ideal image-plane coordinates in src.
        pose: src_from_ref.
        normal: (n, 3) from `Depths`.

    Returns:
        (n,) rad in [0, pi/2].
    """
    rays = np.concatenate([src_xy, np.ones((1, src_xy.shape[1]))]).T @ pose.rotation
    epipolar = np.cross(pose.centre, rays)
    across = np.linalg.norm(np.cross(normal, epipolar), axis=1)
    out: Floats = np.arctan2(across, np.abs(np.sum(normal * epipolar, axis=1)))
    return out


def parallax(ref_xy: Floats, src_xy: Floats, pose: RelativePose) -> Floats:
    """The angle between the two rays of each match.

    Args:
        ref_xy: (2, n) ideal image-plane coordinates in ref.
        src_xy: (2, n) ideal image-plane coordinates in src.
        pose: src_from_ref.

    Returns:
        (n,) rad.
    """
    one = np.ones((1, ref_xy.shape[1]))
    ref = np.concatenate([ref_xy, one]).T
    src = np.concatenate([src_xy, one]).T @ pose.rotation
    across = np.linalg.norm(np.cross(ref, src), axis=1)
    out: Floats = np.arctan2(across, np.sum(ref * src, axis=1))
    return out


# Monomials p^i q^j of degree up to 2 and up to 4, in which the covariance of the two equations is polynomial.
_QUADRATIC = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
_QUARTIC = tuple((i, degree - i) for degree in range(5) for i in range(degree, -1, -1))
_FOLD = np.array(
    [[[(a[0] + b[0], a[1] + b[1]) == m for m in _QUARTIC] for b in _QUADRATIC] for a in _QUADRATIC], np.float64
)
# How the equations move when src turns by a and shifts by e: tau (a x r) + e on rows (1, 0, -p) and (0, 1, -q), r =
# (p, q, 1). Rows: axis of a or e; columns: the quadratic monomials.
_TURN = np.zeros((2, 3, 6))
_TURN[0, 0, 4], _TURN[0, 1, [0, 3]], _TURN[0, 2, 2] = -1.0, 1.0, -1.0
_TURN[1, 0, [0, 5]], _TURN[1, 1, 4], _TURN[1, 2, 1] = -1.0, 1.0, 1.0
_SHIFT = np.zeros((2, 3, 6))
_SHIFT[0, 0, 0], _SHIFT[0, 2, 1] = 1.0, -1.0
_SHIFT[1, 1, 0], _SHIFT[1, 2, 2] = 1.0, -1.0


def _pose_polynomials(covariance: Floats) -> Floats:
    """Coefficients of the pose part of S as a polynomial in tau, p and q.

    Args:
        covariance: (6, 6) of the relative pose.

    Returns:
        (9, 15): for S11, S12, S22 in turn the factors of tau^2, tau and 1, over the monomials of degree up to 4.
    """
    turn, cross, shift = covariance[:3, :3], covariance[:3, 3:], covariance[3:, 3:]
    rows = []
    for i, j in ((0, 0), (0, 1), (1, 1)):
        mixed = _TURN[i].T @ cross @ _SHIFT[j] + _SHIFT[i].T @ cross.T @ _TURN[j]
        forms = (_TURN[i].T @ turn @ _TURN[j], mixed, _SHIFT[i].T @ shift @ _SHIFT[j])
        rows += [np.einsum("ab,abm->m", form, _FOLD) for form in forms]
    return np.stack(rows)


def _quartic(p: Floats, q: Floats) -> Floats:
    """(15, n): the monomials of degree up to 4."""
    out = np.empty((15, p.size))
    out[0] = 1.0
    previous = 0
    for degree in range(1, 5):
        start = degree * (degree + 1) // 2
        np.multiply(out[previous : previous + degree], p, out=out[start : start + degree])
        np.multiply(out[previous + degree - 1], q, out=out[start + degree])
        previous = start
    return out


Spread = tuple[Floats, Floats, Floats]


@dataclass(frozen=True, slots=True)
class _Equations:
    """The two equations s g = h of a block of matches."""

    p: Floats
    q: Floats
    g1: Floats
    g2: Floats
    h1: Floats
    h2: Floats
    w: Floats
    pose: RelativePose

    @classmethod
    def of(cls, ref_xy: Floats, src_xy: Floats, pose: RelativePose) -> _Equations:
        a, centre = pose.rotation.T, pose.centre
        x, y = ref_xy
        u, v = src_xy
        w = a[2, 0] * u + a[2, 1] * v + a[2, 2]
        p = (a[0, 0] * u + a[0, 1] * v + a[0, 2]) / w
        q = (a[1, 0] * u + a[1, 1] * v + a[1, 2]) / w
        return cls(p, q, x - p, y - q, centre[0] - p * centre[2], centre[1] - q * centre[2], w, pose)

    def weights(self, view: VirtualView, baseline_m: float) -> tuple[Floats, Floats]:
        if view is VirtualView.LATERAL:
            return -self.h2, self.h1 - baseline_m
        if view is VirtualView.VERTICAL:
            return baseline_m - self.h2, self.h1
        # Displacements of equal size in all directions across the src ray: S = F F^T, F = [[1, 0, -p], [0, 1, -q]].
        pq = self.p * self.q
        return self.best_weights((1.0 + self.p * self.p, pq, 1.0 + self.q * self.q))

    def best_weights(self, spread: Spread) -> tuple[Floats, Floats]:
        s11, s12, s22 = spread
        return s22 * self.g1 - s12 * self.g2, s11 * self.g2 - s12 * self.g1

    def depth(self, c1: Floats, c2: Floats) -> Floats:
        out: Floats = (c1 * self.h1 + c2 * self.h2) / (c1 * self.g1 + c2 * self.g2)
        return out

    def variance(self, c1: Floats, c2: Floats, spread: Spread) -> Floats:
        s11, s12, s22 = spread
        along = c1 * self.g1 + c2 * self.g2
        out: Floats = (c1 * (c1 * s11 + 2.0 * c2 * s12) + c2 * c2 * s22) / (along * along)
        return out

    def normal(self, c1: Floats, c2: Floats) -> tuple[Floats, Floats, Floats]:
        scale = 1.0 / (c1 * self.g1 + c2 * self.g2)
        n1, n2 = c1 * scale, c2 * scale
        return n1, n2, -self.p * n1 - self.q * n2

    def covariance(self, polynomials: Floats, noise: PixelNoise) -> _Covariance:
        return _Covariance(
            polynomials @ _quartic(self.p, self.q), self._src_noise(noise.src), noise.ref, self.pose.centre
        )

    def _src_noise(self, noise: Floats) -> Spread:
        """Src pixel covariance carried to (p, q) by the Jacobian of the rotation to the ref axes."""
        a = self.pose.rotation.T
        scale = 1.0 / self.w
        j11, j12 = (a[0, 0] - self.p * a[2, 0]) * scale, (a[0, 1] - self.p * a[2, 1]) * scale
        j21, j22 = (a[1, 0] - self.q * a[2, 0]) * scale, (a[1, 1] - self.q * a[2, 1]) * scale
        xx, xy, yy = noise
        k11, k12 = j11 * xx + j12 * xy, j11 * xy + j12 * yy
        k21, k22 = j21 * xx + j22 * xy, j21 * xy + j22 * yy
        return k11 * j11 + k12 * j12, k11 * j21 + k12 * j22, k21 * j21 + k22 * j22


@dataclass(frozen=True, slots=True)
class _Covariance:
    """S of a block of matches as a function of depth."""

    pose: Floats
    src_noise: Spread
    ref_noise: Floats
    centre: Floats

    def at(self, depth: Floats) -> Spread:
        """S11, S12, S22 at the given depths.

        A point at depth s lies tau = s - Cz along the src ray r. Shifting src by e and turning it by a moves the ray
        there by e + tau a x r; src pixels enter the equations with -tau, ref pixels with s.
        """
        length = float(np.sqrt(self.centre @ self.centre))
        # A depth that is negative or no number is one beyond infinity.
        s = np.where((depth > 0.0) & (depth < _FARTHEST * length), depth, _FARTHEST * length)
        np.maximum(s, _NEAREST * length, out=s)
        tau = s - self.centre[2]
        s2 = s * s
        out = []
        for k in range(3):
            total = self.pose[3 * k] + self.src_noise[k]
            total *= tau
            total += self.pose[3 * k + 1]
            total *= tau
            total += self.pose[3 * k + 2]
            total += s2 * self.ref_noise[k]
            out.append(total)
        return out[0], out[1], out[2]
