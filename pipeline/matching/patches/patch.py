"""Patches of an image and the normal equations that they give to least-squares matching."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from pipeline.geometry.arrays import Bools, Bytes, Floats, Ints, Singles
from pipeline.matching.tiles import Tile

# Sigma of the Gaussian weights over half the patch's side.
_WEIGHT_SIGMA = 0.6
# Keeps the contrast of a flat patch from being divided by, grey values squared.
_LEAST_VARIANCE = np.float32(1e-6)


@dataclass(frozen=True, slots=True)
class Window:
    """A square of p pixels about a point, weighted by a Gaussian.

    Args:
        half: Half its side, without the middle pixel.
        x: (p,) columns.
        y: (p,) rows.
        weights: (p,) of sum 1.
        count: How many pixels of equal weight tell as much.
        corners: (4, 2) columns and rows.
        parts: (p, q) share of each pixel in each of q overlapping squares of half the side; a pixel's squares sum to 1.
    """

    half: int
    x: Singles
    y: Singles
    weights: Singles
    count: float
    corners: Floats
    parts: Singles

    @classmethod
    @lru_cache(maxsize=8)
    def of(cls, half: int) -> Window:
        """The window of a size."""
        y, x = (axis.ravel() for axis in np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64))
        weights = np.exp(-(x * x + y * y) / (2.0 * (_WEIGHT_SIGMA * half) ** 2))
        weights /= weights.sum()
        corners = half * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
        count = float(1.0 / np.sum(weights**2))
        x, y, weights = (values.astype(np.float32) for values in (x, y, weights))
        return cls(half, x, y, weights, count, corners, _parts(half))


def _parts(half: int) -> Singles:
    """As `Window.parts`; the squares go over the edge, so that the outer pixels are in as many as the others."""
    stride = max(1, half // 3)
    first = np.arange(1 - half, 2 * half + 1, stride)
    apart = np.arange(2 * half + 1)[:, None] - first
    along = ((apart >= 0) & (apart < half)).astype(np.float64)
    along /= np.sqrt(along.sum(axis=1, keepdims=True))
    return np.kron(along, along).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Level:
    """A piece of an image at one size.

    Args:
        grey: (h, w) blurred.
        scale: (2,) the whole image's size over that as given.
        corner: (2,) px, column and row of the piece's first pixel.
    """

    grey: Singles
    scale: Floats
    corner: Floats

    @classmethod
    def of(cls, image: Bytes, tile: Tile, scale: Floats, blur_px: float) -> Level:
        """A piece of an image, blurred.

        Args:
            image: (h, w) brought to the level's size.
            tile: The piece.
            scale: (2,) its size over that of the image as given.
            blur_px: Sigma of the blur.
        """
        kernel = cv2.getGaussianKernel(2 * int(np.ceil(3.0 * blur_px)) + 1, blur_px, cv2.CV_32F)
        piece = tile.cut(image)
        blurred = cv2.sepFilter2D(piece, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
        return cls(np.asarray(blurred, np.float32), scale, np.array([tile.left, tile.top], np.float64))

    def pixels(self, full_px: Floats) -> Floats:
        """Pixels of this piece from those of the image as given."""
        out: Floats = (full_px + 0.5) * self.scale - 0.5 - self.corner
        return out

    def full_pixels(self, pixels: Floats) -> Floats:
        """Pixels of the image as given from those of this piece."""
        out: Floats = (pixels + self.corner + 0.5) / self.scale - 0.5
        return out

    def holds(self, pixels: Floats, margin: float) -> Bools:
        """Whether pixels lie at least a margin inside; one that is no number does not."""
        last = np.array(self.grey.shape[::-1]) - 1.0 - margin
        inside: Bools = np.all((pixels >= margin) & (pixels <= last), axis=-1)
        return inside

    def holds_patches(self, origin: Floats, warp: Floats, window: Window) -> Bools:
        """(n,) whether patches about (n, 2) pixels under (n, 2, 2) warps lie in the image."""
        inside: Bools = np.all(self.holds(origin[:, None] + window.corners @ warp.transpose(0, 2, 1), 0.0), axis=1)
        return inside

    def seen(self, origin: Floats, warp: Floats, window: Window) -> Singles:
        """(n, p) grey values of such patches."""
        at, by = origin.astype(np.float32), warp.astype(np.float32)
        columns, rows = (
            by[:, axis, :1] * window.x + by[:, axis, 1:] * window.y + at[:, axis : axis + 1] for axis in (0, 1)
        )
        # OpenCV before 5 rounds positions to 1/32 px here; over a patch that is turned or scaled it averages out.
        values = cv2.remap(self.grey, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(values, np.float32)


@dataclass(frozen=True, slots=True)
class Patches:
    """Ref patches of n matches, with the normal equations of their six parameters: shift and change of the warp.

    The change is told column by column, as the movement at half a patch's side.

    Args:
        window: Of all.
        inside: (n,) the patch lies in the image.
        offset: (n, 2) px from the patch's middle, a whole pixel, to the point.
        grey: (n, p) less its mean.
        weighted: (n, p) the same times the weights.
        variance: (n,) weighted, of the patch.
        solve: (n, 6, p) parameters per grey value of the difference.
        inverse: (n, 6, 6) of the normal matrix, with the prior.
        pull: (n, 6, 4) parameters per bend of the warp from the predicted one, by the prior.
    """

    window: Window
    inside: Bools
    offset: Floats
    grey: Singles
    weighted: Singles
    variance: Singles
    solve: Singles
    inverse: Floats
    pull: Floats

    @classmethod
    def of(cls, level: Level, at: Floats, window: Window, prior_grey: float) -> Patches:
        """The patches about pixels.

        Args:
            level: Of the ref image.
            at: (n, 2) its pixels.
            window: Their size.
            prior_grey: Sigma of the grey values over that of the warp's elements.
        """
        # A pixel more for the gradient, and half a one for the rounding.
        inside = level.holds(at, window.half + 1.5)
        at = np.where(inside[:, None], at, window.half + 1.0)
        middle = np.rint(at).astype(np.int64)
        patch = _cut(level.grey, middle, window.half + 1)
        grey = patch[:, 1:-1, 1:-1].reshape(len(at), -1)
        grey = grey - (grey @ window.weights)[:, None]
        weighted = grey * window.weights
        variance = np.maximum(np.einsum("np,np->n", weighted, grey), _LEAST_VARIANCE)
        design = _design(patch, window)
        # What gain and offset could explain of it is taken out.
        design -= (design @ window.weights)[:, :, None]
        share = np.einsum("nkp,np->nk", design, weighted) / variance[:, None]
        design -= share[:, :, None] * grey[:, None, :]
        heavy = design * window.weights
        normal = (heavy @ design.transpose(0, 2, 1)).astype(np.float64)
        prior = (prior_grey / window.half) ** 2 / window.count
        # The second term only keeps the matrix of a flat patch from being singular.
        normal += np.diag([0.0, 0.0, prior, prior, prior, prior]) + 1e-6 * np.eye(6)
        inverse = np.linalg.inv(normal).astype(np.float64)
        solve = inverse.astype(np.float32) @ heavy
        return cls(window, inside, at - middle, grey, weighted, variance, solve, inverse, inverse[:, :, 2:] * prior)

    def compared(self, rows: Ints, seen: Singles) -> tuple[Singles, Singles]:
        """Correlation of some patches with what src shows, and the gain that makes the contrasts equal; (n,) each."""
        mean = seen @ self.window.weights
        variance = np.maximum((seen * seen) @ self.window.weights - mean * mean, _LEAST_VARIANCE)
        own = self.variance[rows]
        product = np.einsum("np,np->n", seen, self.weighted[rows])
        return product / np.sqrt(variance * own), np.sqrt(own / variance)


def _cut(grey: Singles, middle: Ints, half: int) -> Singles:
    """(n, 2 half + 1, 2 half + 1) squares about whole pixels; an image smaller than that is filled up."""
    side = 2 * half + 1
    if min(grey.shape) < side:
        grey = np.pad(grey, [(0, max(0, side - length)) for length in grey.shape])
    views = np.lib.stride_tricks.sliding_window_view(grey, (side, side))
    out: Singles = views[middle[:, 1] - half, middle[:, 0] - half]
    return out


def _design(patch: Singles, window: Window) -> Singles:
    """(n, 6, p) grey values per parameter: the gradient, then its products with columns and with rows."""
    n, side = len(patch), 2 * window.half + 1
    out = np.empty((n, 6, side * side), np.float32)
    squares = out.reshape(n, 6, side, side)
    np.subtract(patch[:, 1:-1, 2:], patch[:, 1:-1, :-2], out=squares[:, 0])
    np.subtract(patch[:, 2:, 1:-1], patch[:, :-2, 1:-1], out=squares[:, 1])
    out[:, :2] *= np.float32(0.5)
    for first, lever in ((2, window.x), (4, window.y)):
        np.multiply(out[:, :2], lever / np.float32(window.half), out=out[:, first : first + 2])
    return out
