"""Camera models: pixel <-> ray with OpenCV's pixel centre and distortion, exactly inverted.

Pixel (0, 0) is the centre of the top-left pixel. Rays are in the camera's right-down-forward frame, scaled to z = 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pipeline.geometry.arrays import Bools, Floats

MODELS = ("pinhole", "brown", "fisheye")
_NEWTON_STEPS = 30


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera's intrinsics.

    Args:
        model: "pinhole", "brown" (k1 k2 p1 p2 k3 [k4 k5 k6], OpenCV's rational form) or "fisheye"
            (k1..k4, equidistant).
        width: Image width, px.
        height: Image height, px.
        fx: Focal length along rows, px.
        fy: Focal length along columns, px.
        cx: Principal point column, px.
        cy: Principal point row, px.
        distortion: Coefficients in OpenCV's order.
    """

    model: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    @property
    def focal_px(self) -> float:
        """Geometric mean of the focal lengths, px."""
        return float(np.sqrt(self.fx * self.fy))

    @property
    def matrix(self) -> Floats:
        """The 3x3 calibration matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points: Floats) -> Floats:
        """Pixels of points in the camera frame.

        Args:
            points: (..., 3) RDF, m (any scale); z > 0.

        Returns:
            (..., 2) pixels u, v; NaN where z <= 0 or beyond the fold of the distortion.
        """
        points = np.asarray(points, np.float64)
        z = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
        xy = self.distort(points[..., :2] / z[..., None])
        return xy * (self.fx, self.fy) + (self.cx, self.cy)

    def rays(self, pixels: Floats) -> Floats:
        """Rays of pixels, distortion removed to better than 1e-9 of the image plane.

        Args:
            pixels: (..., 2).

        Returns:
            (..., 3) RDF with z = 1; NaN where no ray has this pixel (beyond the fold of the distortion).
        """
        target = (np.asarray(pixels, np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        xy = self.undistort(target)
        return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)

    def distort(self, xy: Floats) -> Floats:
        """Ideal image-plane coordinates to distorted ones.

        Args:
            xy: (..., 2) at z = 1.

        Returns:
            (..., 2) at z = 1; NaN beyond the fold, where the polynomial would put rays back into the image.
        """
        xy = np.asarray(xy, np.float64)
        fold = self._fold_radius()
        if np.isfinite(fold):
            xy = np.where(np.linalg.norm(xy, axis=-1, keepdims=True) < fold, xy, np.nan)
        return self._distort(xy)[0]

    def undistort(self, target: Floats) -> Floats:
        """Distorted image-plane coordinates to ideal ones, by Newton's method.

        Args:
            target: (..., 2) at z = 1.

        Returns:
            (..., 2) at z = 1; NaN where no ray on this side of the fold has these coordinates.
        """
        target = np.asarray(target, np.float64)
        if self.model == "fisheye":
            return _undistort_fisheye(target, self.distortion, self._fold_radius())
        if self.model == "pinhole" or not any(self.distortion):
            return target.copy()
        fold = self._fold_radius()
        xy = target.copy()
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            for _ in range(_NEWTON_STEPS):
                value, jacobian = self._distort(xy)
                error = value - target
                determinant = _determinant(jacobian)
                determinant = np.where(np.abs(determinant) < 1e-12, np.nan, determinant)
                step_x = (jacobian[..., 1, 1] * error[..., 0] - jacobian[..., 0, 1] * error[..., 1]) / determinant
                step_y = (jacobian[..., 0, 0] * error[..., 1] - jacobian[..., 1, 0] * error[..., 0]) / determinant
                before, xy = xy, xy - np.stack([step_x, step_y], axis=-1)
                # A step over the fold would find another branch of the polynomial: go half the way to the fold instead.
                radius = np.linalg.norm(xy, axis=-1, keepdims=True)
                xy = np.where(radius > fold, 0.5 * (before + xy * (fold / radius)), xy)
                if not np.any(np.abs(xy - before) > 1e-14):
                    break
            value, jacobian = self._distort(xy)
            bad: Bools = ~((_determinant(jacobian) > 0.0) & np.all(np.abs(value - target) < 1e-9, axis=-1))
        return np.where(bad[..., None], np.nan, xy)

    def pixel_jacobian(self, rays: Floats) -> Floats:
        """Derivative of the pixel by the ideal image-plane coordinates, at rays with z = 1.

        Args:
            rays: (..., 3).

        Returns:
            (..., 2, 2) px per unit of the image plane.
        """
        jacobian = self._distort(np.asarray(rays, np.float64)[..., :2])[1]
        out: Floats = jacobian * np.array([[self.fx], [self.fy]])
        return out

    def plane_covariance(self, rays: Floats, covariance: Floats) -> Floats:
        """Covariance of pixels as that of the ideal image-plane coordinates.

        Args:
            rays: (n, 3) with z = 1.
            covariance: (n, 3) px^2: uu, uv, vv.

        Returns:
            (3, n): xx, xy, yy.
        """
        jacobian = self.pixel_jacobian(rays)
        a, b, c, d = (jacobian[:, i, j] for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
        uu, uv, vv = np.asarray(covariance, np.float64).T
        # J^-1 C J^-T, with J^-1 = [[d, -b], [-c, a]] / det.
        return (
            np.stack(
                [
                    d * d * uu - 2.0 * b * d * uv + b * b * vv,
                    (a * d + b * c) * uv - c * d * uu - a * b * vv,
                    c * c * uu - 2.0 * a * c * uv + a * a * vv,
                ]
            )
            / (a * d - b * c) ** 2
        )

    def holds(self, pixels: Floats) -> Bools:
        """Whether pixels lie in the image; one that is no number does not.

        Args:
            pixels: (..., 2).

        Returns:
            (...).
        """
        size = np.array([self.width, self.height]) - 0.5
        inside: Bools = np.all((pixels >= -0.5) & (pixels <= size), axis=-1)
        return inside

    def scaled(self, width: int, height: int) -> Camera:
        """The same camera for the image resampled to another size (half-pixel right)."""
        sx, sy = width / self.width, height / self.height
        return Camera(
            self.model,
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            self.distortion,
        )

    def _fold_radius(self) -> float:
        """Distance from the axis, at z = 1, up to which the radial distortion grows; infinite where it always does."""
        if self.model == "brown" and any(self.distortion):
            return _brown_fold(self.distortion)
        if self.model == "fisheye":
            return _fisheye_fold(self.distortion)
        return float("inf")

    def _distort(self, xy: Floats) -> tuple[Floats, Floats]:
        if self.model == "brown" and any(self.distortion):
            return _brown(xy, self.distortion)
        if self.model == "fisheye":
            return _fisheye(xy, self.distortion)
        return xy.copy(), np.broadcast_to(np.eye(2), (*xy.shape, 2)).copy()


@dataclass(frozen=True, slots=True)
class PixelSigma:
    """How well positions are matched.

    Args:
        sigma_px: One sigma per axis, in pixels of the size the image is matched at.
        longest_px: Longest side images are matched at.
    """

    sigma_px: float
    longest_px: int

    def of(self, camera: Camera) -> float:
        """One sigma per axis in pixels of the image as given."""
        return self.sigma_px * max(1.0, max(camera.width, camera.height) / self.longest_px)


def _brown(xy: Floats, coefficients: tuple[float, ...]) -> tuple[Floats, Floats]:
    """OpenCV's rational model and its Jacobian (OpenCV documentation, calib3d, "Detailed Description")."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *([0.0] * 8))[:8]
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    top = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bottom = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = top / bottom
    top_slope = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)
    bottom_slope = k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6)
    slope = 2.0 * (top_slope - radial * bottom_slope) / bottom
    value = np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )
    jacobian = np.empty((*xy.shape, 2))
    jacobian[..., 0, 0] = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    jacobian[..., 0, 1] = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    jacobian[..., 1, 0] = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    jacobian[..., 1, 1] = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return value, jacobian


def _fisheye(xy: Floats, coefficients: tuple[float, ...]) -> tuple[Floats, Floats]:
    """OpenCV's fisheye model (Kannala-Brandt) and its Jacobian."""
    k1, k2, k3, k4 = (*coefficients, *([0.0] * 4))[:4]
    r = np.linalg.norm(xy, axis=-1)
    theta = np.arctan(r)
    t2 = theta * theta
    theta_d = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    d_theta = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
    small = r < 1e-9
    safe = np.where(small, 1.0, r)
    scale = np.where(small, 1.0, theta_d / safe)
    slope = np.where(small, 0.0, (d_theta / (1.0 + r * r) - scale) / safe**2)
    value = xy * scale[..., None]
    jacobian = scale[..., None, None] * np.eye(2) + slope[..., None, None] * xy[..., :, None] * xy[..., None, :]
    return value, jacobian


def _determinant(jacobian: Floats) -> Floats:
    out: Floats = jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0]
    return out


def _first_root(polynomial: np.polynomial.Polynomial) -> float:
    """The smallest positive real root, infinite without one."""
    # A leading coefficient next to nothing only adds roots next to infinity, and overflows on the way.
    roots = polynomial.trim(1e-12).roots()
    real = roots[np.abs(roots.imag) < 1e-9 * np.abs(roots)].real
    return float(np.min(real[real > 0.0], initial=np.inf))


@lru_cache(maxsize=64)
def _brown_fold(coefficients: tuple[float, ...]) -> float:
    """Where the derivative of r * top / bottom, or bottom, first is 0; both are polynomials in r^2."""
    k1, k2, _, _, k3, k4, k5, k6 = (*coefficients, *([0.0] * 8))[:8]
    top = np.polynomial.Polynomial([1.0, k1, k2, k3])
    bottom = np.polynomial.Polynomial([1.0, k4, k5, k6])
    r2 = np.polynomial.Polynomial([0.0, 1.0])
    slope = top * bottom + 2.0 * r2 * (top.deriv() * bottom - top * bottom.deriv())
    return float(np.sqrt(min(_first_root(slope), _first_root(bottom))))


@lru_cache(maxsize=64)
def _fisheye_fold(coefficients: tuple[float, ...]) -> float:
    """The tangent of the angle at which theta_d stops growing; infinite from 90 deg on."""
    k1, k2, k3, k4 = (*coefficients, *([0.0] * 4))[:4]
    theta = np.sqrt(_first_root(np.polynomial.Polynomial([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4])))
    return float(np.tan(theta)) if theta < 0.5 * np.pi else float("inf")


def _undistort_fisheye(target: Floats, coefficients: tuple[float, ...], fold: float) -> Floats:
    """Inverts theta_d(theta), which grows up to the fold, by Newton's method held between bounds."""
    k1, k2, k3, k4 = (*coefficients, *([0.0] * 4))[:4]
    theta_d = np.linalg.norm(target, axis=-1)
    low, high = np.zeros_like(theta_d), np.full_like(theta_d, np.arctan(fold))
    theta = np.minimum(theta_d, high)
    with np.errstate(invalid="ignore", divide="ignore"):
        for _ in range(_NEWTON_STEPS):
            t2 = theta * theta
            error = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - theta_d
            slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
            low, high = np.where(error < 0.0, theta, low), np.where(error > 0.0, theta, high)
            newton = theta - error / slope
            before, theta = theta, np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
            if not np.any(np.abs(theta - before) > 1e-15):
                break
        xy = target * np.where(theta_d > 0.0, np.tan(theta) / theta_d, 1.0)[..., None]
    # Without a root the bounds close in on the fold or on 90 deg, and the error stays.
    good = (np.abs(error) < 1e-9) & (theta < 0.5 * np.pi)
    return np.where(good[..., None], xy, np.nan)
