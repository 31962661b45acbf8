"""Sub-pixel positions of matches: least-squares matching of patches, with a covariance for each match.

The pixel in ref defines the point; the patch about it is looked for in src under an affine warp, a gain and an offset.
It is done in the inverse-compositional way: the warp's increment acts on the ref patch, whose gradients, and with them
the normal equations, stay the same in all steps. The patch sits on whole pixels of ref, so only src is interpolated.
Gain and offset are taken out of the design beforehand, so a step is one product with the patch seen. The affine part
is held near the predicted warp by a weak prior; the shift is free in both directions, so the pose is not pulled into
the positions.

Source: Ackermann, Digital image correlation, Photogrammetric Record 11 (64), 1984; Gruen, Adaptive least squares
correlation, South African J. of Photogrammetry, Remote Sensing and Cartography 14 (3), 1985; Baker and Matthews,
Lucas-Kanade 20 years on, IJCV 56 (3), 2004, for the inverse composition.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Bools, Bytes, Floats, Ints, Singles
from pipeline.matching.images import resized, shrunk_size
from pipeline.matching.patches.patch import Level, Patches, Window
from pipeline.matching.patches.warps import inverse_2x2
from pipeline.matching.tiles import Tile, tiles

# Matches per block: enough to hide the calls' own cost, few enough for the caches.
_BLOCK = 256
# Largest ratio of neighbouring levels' sizes: a pixel of the coarser is within the capture range of the finer.
_LEVEL_RATIO = 2.6
_LONGEST_STEP_PX = 1.5
# A step shorter than this ends the iteration; one that is still longer than the other has not converged.
_STILL_PX, _MOVING_PX = 0.01, 0.1
# Elements of the warp's change from the predicted one, in all and in one step.
_LARGEST_BEND, _LARGEST_BEND_STEP = 0.6, 0.3
# Parameters of a patch: shift, warp, gain and offset.
_PARAMETERS = 8
_LEAST_NOISE_GREY = 1.0
# OpenCV resamples no more than 32766 pixels of a patch at once.
_LARGEST_HALF_PX = 90
# Side of the pieces that large images are refined in.
_PIECE_PX = 4096
# Of a patch in src against that in ref, as far as pieces are concerned.
_LARGEST_STRETCH = 4.0
# Square of a central difference of slightly blurred white noise over the square of two images' difference.
_NOISE_GRADIENT = 0.25
# The covariance is _FORMAL times that of the normal equations, and _SCATTER times that of the patch's parts, and
# _FLOOR_PX squared at each level. Their ratio was fitted by likelihood on photos warped by known homographies (noise of
# 2 grey values, JPEG 90) and on the example flight's exact depths, for half sides of 5 to 12 pixels; their size lies
# between what these need and what real photos of a wall and a fountain do (distances from the epipolar lines of the
# pair's own pose). Mean normalised squares per axis, which should be 1: 0.5 with homographies; 1.0 on the flight, of
# which 0.4 % lie beyond 5 sigma, on outlines of trees and roofs; 1.2 on the real photos, and 1.6 at twice the size
# matched at.
_FORMAL, _SCATTER, _FLOOR_PX = 0.65, 2.5, 0.012


@dataclass(frozen=True, slots=True)
class PatchSetting:
    """How patches are matched.

    Args:
        matched_px: Longest side the images were matched at; the refinement starts there.
        finest_px: Longest side it ends at; larger images are shrunk to it.
        half_px: Half the patch's side, without its middle pixel, at the size matched at; at finer levels it grows
            with the square root of the size.
        iterations: Most steps per level.
        blur_px: Sigma of the blur beforehand, which keeps the interpolation from biasing the position.
        bend_sigma: One sigma of the affine warp about the predicted one, per element (1).
        misfit_grey: One sigma of the patches' difference that the prior on the warp is weighed against.
        reach_px: Farthest a match may move at a level, in that level's pixels.
        least_correlation: Of the patches at the end (1).
        largest_sigma_px: Of the position in its worst direction, in pixels of the level it was found at; that of a
            flat or striped patch is larger.
    """

    matched_px: int
    finest_px: int = 100_000
    half_px: int = 9
    iterations: int = 10
    blur_px: float = 0.55
    bend_sigma: float = 0.1
    misfit_grey: float = 8.0
    reach_px: float = 2.0
    least_correlation: float = 0.7
    largest_sigma_px: float = 0.5

    def half_at(self, longest_px: int) -> int:
        """Half the patch's side in a level whose longest side is this.

        A larger patch tells more and costs more, and reaches over more of the scene's depths.
        """
        grown = round(self.half_px * math.sqrt(max(1.0, longest_px / self.matched_px)))
        return min(grown, _LARGEST_HALF_PX)

    def sizes(self, width: int, height: int) -> list[tuple[int, int]]:
        """Widths and heights, coarse to fine, that an image is refined at."""
        fine = min(self.finest_px, max(width, height))
        coarse = min(self.matched_px, fine)
        steps = math.ceil(math.log(fine / coarse) / math.log(_LEVEL_RATIO) - 1e-9)
        longest = [round(coarse * (fine / coarse) ** (i / steps)) for i in range(steps)]
        return [shrunk_size(width, height, px) for px in (*longest, fine)]


@dataclass(frozen=True, slots=True)
class Refined:
    """Refined matches.

    Args:
        src_px: (n, 2) pixels of the src image as given; unchanged where not refined.
        covariance: (n, 3) uu, uv, vv in px^2 of the src image as given, of src for the given ref; NaN where not
            refined.
        refined: (n,).
        correlation: (n,) of the patches at the end, at the finest level that worked; 0 where not refined.
    """

    src_px: Floats
    covariance: Floats
    refined: Bools
    correlation: Floats

    @classmethod
    def none(cls, src_px: Floats) -> Refined:
        """Nothing refined yet."""
        n = len(src_px)
        return cls(np.array(src_px, np.float64), np.full((n, 3), np.nan), np.zeros(n, np.bool_), np.zeros(n))


def refine(
    ref_image: Bytes,
    src_image: Bytes,
    ref_px: Floats,
    src_px: Floats,
    affines: Sequence[Floats],
    setting: PatchSetting,
) -> Refined:
    """Moves the src pixel of every match to where the patch about its ref pixel is seen.

    A match is left as it is where a patch leaves its image, has no texture, does not converge, moves too far or
    differs too much in the end. Where that happens at a finer level only, the coarser one's position stays.

    Args:
        ref_image: (height, width).
        src_image: (height, width).
        ref_px: (n, 2) pixels of the ref image as given.
        src_px: (n, 2) pixels of the src image as given.
        affines: Candidates, each (n, 2, 2) d src / d ref; for each match the one that correlates best is taken.
        setting: How.
    """
    found = Refined.none(src_px)
    images = (ref_image, src_image)
    sizes = [setting.sizes(image.shape[1], image.shape[0]) for image in images]
    for level in range(max(len(of) for of in sizes)):
        # An image with fewer levels stays at its own finest for the rest.
        ref, src = (_Sized.of(image, of[min(level, len(of) - 1)]) for image, of in zip(images, sizes, strict=True))
        window = Window.of(setting.half_at(max(ref.image.shape)))
        warps = [src.scale[:, None] * affine / ref.scale for affine in affines]
        for rows, in_ref, in_src in _pieces(ref, src, ref_px, found.src_px, window, setting):
            patches = Patches.of(in_ref, in_ref.pixels(ref_px[rows]), window, setting.misfit_grey / setting.bend_sigma)
            moved = _moved(patches, in_src, in_src.pixels(found.src_px[rows]), [warp[rows] for warp in warps], setting)
            good = rows[moved.refined]
            found.src_px[good] = in_src.full_pixels(moved.src_px[moved.refined])
            found.covariance[good] = moved.covariance[moved.refined] / (src.scale[[0, 0, 1]] * src.scale[[0, 1, 1]])
            found.refined[good] = True
            found.correlation[good] = moved.correlation[moved.refined]
    return found


@dataclass(frozen=True, slots=True)
class _Sized:
    """An image brought to the size of a level.

    Args:
        image: (h, w).
        scale: (2,) its size over that of the image as given.
    """

    image: Bytes
    scale: Floats

    @classmethod
    def of(cls, image: Bytes, size: tuple[int, int]) -> _Sized:
        full = (image.shape[1], image.shape[0])
        return cls(resized(image, size), np.array(size) / np.array(full))

    def tiles(self, margin: int) -> list[Tile]:
        return tiles(self.image.shape[1], self.image.shape[0], _PIECE_PX, margin)

    def pixels(self, full_px: Floats) -> Floats:
        out: Floats = (full_px + 0.5) * self.scale - 0.5
        return out


def _pieces(
    ref: _Sized, src: _Sized, ref_px: Floats, src_px: Floats, window: Window, setting: PatchSetting
) -> Iterator[tuple[Ints, Level, Level]]:
    """Blocks of matches with the pieces of both images that their patches lie in: no image is held blurred as a whole.

    Matches outside their image are in none.
    """
    # A patch of src may be stretched, turned and moved.
    margin = math.ceil(2.0 * window.half * _LARGEST_STRETCH + setting.reach_px + 4.0)
    in_ref, in_src = ref.pixels(ref_px), src.pixels(src_px)
    for ref_tile in ref.tiles(margin):
        near = np.flatnonzero(ref_tile.owns(in_ref))
        if not near.size:
            continue
        of_ref = Level.of(ref.image, ref_tile, ref.scale, setting.blur_px)
        for src_tile in src.tiles(margin):
            rows = near[src_tile.owns(in_src[near])]
            if not rows.size:
                continue
            of_src = Level.of(src.image, src_tile, src.scale, setting.blur_px)
            for start in range(0, len(rows), _BLOCK):
                yield rows[start : start + _BLOCK], of_ref, of_src


def _moved(patches: Patches, src: Level, start: Floats, warps: Sequence[Floats], setting: PatchSetting) -> Refined:
    """A block of matches refined at one level, in that level's pixels."""
    base, usable = _best_warps(patches, src, start, warps)
    out = Refined.none(start)
    rows = np.flatnonzero(usable)
    fit = _Fit.of(np.where(usable[:, None], start - _times(base, patches.offset), 0.0), base)
    active = rows
    for _ in range(setting.iterations):
        if not active.size:
            break
        active = active[fit.advanced(patches, src, active, setting.reach_px)]
    end = fit.origin + _times(fit.warp, patches.offset)
    seen = src.seen(fit.origin, fit.warp, patches.window)
    correlation, gain = patches.compared(np.arange(len(start)), seen)
    seen -= (seen @ patches.window.weights)[:, None]
    covariance = _covariance(patches, seen * gain[:, None] - patches.grey, fit.warp)
    good = usable & (fit.last_step_px <= _MOVING_PX) & src.holds_patches(fit.origin, fit.warp, patches.window)
    good &= (correlation >= setting.least_correlation) & (_worst(covariance) <= setting.largest_sigma_px**2)
    good &= np.linalg.norm(end - np.where(usable[:, None], start, 0.0), axis=1) <= setting.reach_px
    out.src_px[good], out.refined[good], out.correlation[good] = end[good], True, correlation[good]
    out.covariance[good] = covariance[good]
    return out


def _best_warps(patches: Patches, src: Level, start: Floats, warps: Sequence[Floats]) -> tuple[Floats, Bools]:
    """The candidate that correlates best, for each match, and whether any keeps the patch inside src.

    Returns:
        (n, 2, 2) and (n,).
    """
    n = len(start)
    best, score = np.tile(np.eye(2), (n, 1, 1)), np.full(n, -np.inf)
    for warp in warps:
        with np.errstate(invalid="ignore"):
            usable = patches.inside & (np.abs(np.linalg.det(warp)) > 1e-6) & np.all(np.isfinite(start), axis=1)
        by = np.where(usable[:, None, None], warp, np.eye(2))
        origin = np.where(usable[:, None], start, 0.0) - _times(by, patches.offset)
        usable &= src.holds_patches(origin, by, patches.window)
        # A single candidate needs no comparison.
        found = 0.0 if len(warps) == 1 else patches.compared(np.arange(n), src.seen(origin, by, patches.window))[0]
        better = usable & (found > score)
        best[better], score[better] = by[better], np.broadcast_to(found, n)[better]
    return best, score > -np.inf


@dataclass(frozen=True, slots=True)
class _Fit:
    """Where the patches of a block lie in src; changed in place.

    Args:
        origin: (n, 2) px of src, of the patches' middles.
        warp: (n, 2, 2).
        start: (n, 2) px, `origin` at first.
        unbend: (n, 2, 2) inverse of the predicted warp.
        last_step_px: (n,) infinite before the first, and where it went astray.
    """

    origin: Floats
    warp: Floats
    start: Floats
    unbend: Floats
    last_step_px: Floats

    @classmethod
    def of(cls, origin: Floats, warp: Floats) -> _Fit:
        return cls(origin.copy(), warp.copy(), origin, inverse_2x2(warp), np.full(len(origin), np.inf))

    def advanced(self, patches: Patches, src: Level, rows: Ints, reach_px: float) -> Bools:
        """Goes one step with some patches; tells which are to go on."""
        half = patches.window.half
        seen = src.seen(self.origin[rows], self.warp[rows], patches.window)
        _, gain = patches.compared(rows, seen)
        bend = self.unbend[rows] @ self.warp[rows] - np.eye(2)
        solve = patches.solve if rows.size == len(patches.solve) else patches.solve[rows]
        step = (np.einsum("nkp,np->nk", solve, seen) * gain[:, None]).astype(np.float64)
        step += _times(patches.pull[rows], bend.transpose(0, 2, 1).reshape(-1, 4) * half)
        length = np.linalg.norm(step[:, :2], axis=1)
        shift = step[:, :2] * np.minimum(1.0, _LONGEST_STEP_PX / np.maximum(length, _STILL_PX))[:, None]
        change = np.clip(
            step[:, 2:].reshape(-1, 2, 2).transpose(0, 2, 1) / half, -_LARGEST_BEND_STEP, _LARGEST_BEND_STEP
        )
        # The increment moves the ref patch, so its inverse goes into the warp.
        warp = self.warp[rows] @ inverse_2x2(np.eye(2) + change)
        origin = self.origin[rows] - _times(warp, shift)
        self.warp[rows], self.origin[rows] = warp, origin
        astray = np.any(np.abs(bend) > _LARGEST_BEND, axis=(1, 2))
        astray |= np.linalg.norm(origin - self.start[rows], axis=1) > reach_px + _LONGEST_STEP_PX
        self.last_step_px[rows] = np.where(astray, np.inf, length)
        on: Bools = ~astray & (length > _STILL_PX)
        return on


def _covariance(patches: Patches, residual: Singles, warp: Floats) -> Floats:
    """Covariance of the positions in src, in the level's pixels.

    Neither the normal equations alone, which take every pixel's noise for its own, nor the scatter alone, which is
    poor where a patch has few independent parts, tell the errors that happen; their sum does. Noise has gradients too,
    which tell nothing: their share of the normal matrix is taken out, or a stripe's ends would seem to be known.

    Args:
        patches: Of ref.
        residual: (n, p) src less ref, in ref's contrast.
        warp: (n, 2, 2).

    Returns:
        (n, 3) uu, uv, vv.
    """
    count, shift = patches.window.count, patches.inverse[:, :2, :2]
    noise = (residual * residual) @ patches.window.weights / (1.0 - _PARAMETERS / count)
    formal = shift * (np.maximum(noise, _LEAST_NOISE_GREY**2) / count)[:, None, None]
    in_ref = _FORMAL * formal + _SCATTER * _scatter(patches, residual)
    told = inverse_2x2(shift)
    true = told - (_NOISE_GRADIENT * noise)[:, None, None] * np.eye(2)
    # Where nothing but noise is left, in one direction, nothing is known.
    true[_worst(-_upper(true)) >= 0.0] = np.nan
    more = inverse_2x2(true) @ told
    in_ref = more @ in_ref @ more.transpose(0, 2, 1)
    full = warp @ in_ref @ warp.transpose(0, 2, 1) + _FLOOR_PX**2 * np.eye(2)
    return _upper(full)


def _upper(symmetric: Floats) -> Floats:
    """(n, 3) first, mixed and second element of (n, 2, 2)."""
    return np.stack([symmetric[:, 0, 0], symmetric[:, 0, 1], symmetric[:, 1, 1]], axis=1)


def _scatter(patches: Patches, residual: Singles) -> Floats:
    """Covariance of a shift from how the parts of a patch pull at it: whole, they balance.

    Args:
        patches: Of ref.
        residual: (n, p) src less ref, in ref's contrast.

    Returns:
        (n, 2, 2) px^2 of the ref level.

    Source: Newey and West, Econometrica 55 (3), 1987; in two dimensions Conley, J. of Econometrics 92 (1), 1999.
    """
    pulls = (patches.solve[:, :2] * residual[:, None]) @ patches.window.parts
    out: Floats = (pulls @ pulls.transpose(0, 2, 1)).astype(np.float64)
    return out


def _worst(covariance: Floats) -> Floats:
    """(n,) the variance in the direction where it is largest, of (n, 3) uu, uv, vv."""
    uu, uv, vv = covariance.T
    out: Floats = 0.5 * (uu + vv) + np.hypot(0.5 * (uu - vv), uv)
    return out


def _times(matrices: Floats, vectors: Floats) -> Floats:
    """(n, i) products of (n, i, j) and (n, j)."""
    out: Floats = np.einsum("nij,nj->ni", matrices, vectors)
    return out
