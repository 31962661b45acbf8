"""Stars: what one frame's pixels look like from the frames it is paired with.

A star is one pixel of ref, taken as exact, with its matches in several src frames. Its point has one unknown, the
inverse depth along the ref ray, so that a frame's stars are eliminated in one stroke and leave a small dense factor
between the frame and its partners. Scale travels from pair to pair through the stars that more than one src sees.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.refinement.matched import Matched
from pipeline.refinement.scatter import cells_of

# Per ref frame. Two hundred well spread stars fix a pose to a hundredth of a pixel; more cost and tell nothing new.
MOST_STARS = 200
_CELLS = (12, 9)


@dataclass(frozen=True, slots=True)
class Stars:
    """The stars of one ref frame; observations are rows of arrays of equal length.

    Args:
        frames: (k + 1,) numbers of ref and of its src frames.
        ray: (n, 3) ref rays, z = 1.
        ref_px: (n, 2) pixels of ref as given.
        star: (m,) which star an observation is of.
        of: (m,) place of its src frame in `frames`, from 1.
        src_px: (m, 2) pixels of src as given.
        xy: (m, 2) on src's image plane.
        root: (m, 2, 2) W with W^T W the inverse covariance of xy.
    """

    frames: Ints
    ray: Floats
    ref_px: Floats
    star: Ints
    of: Ints
    src_px: Floats
    xy: Floats
    root: Floats


def stars_by_ref(matched: Sequence[Matched], number: Mapping[str, int]) -> list[Stars]:
    """The stars of several pairs, one set per ref frame.

    Args:
        matched: The inliers of the pairs.
        number: Of every frame.
    """
    by_ref: dict[str, list[Matched]] = {}
    for some in matched:
        if len(some):
            by_ref.setdefault(some.pair.ref, []).append(some)
    return [stars_of(of_ref, number) for of_ref in by_ref.values()]


def stars_of(matched: Sequence[Matched], number: Mapping[str, int], most: int = MOST_STARS) -> Stars:
    """The stars of a ref frame, thinned evenly over the image, those that most frames see first.

    Args:
        matched: The inliers of all pairs with that ref.
        number: Of every frame.
        most: How many to keep.
    """
    sizes = [len(some) for some in matched]
    ref_px = np.concatenate([some.ref_px for some in matched])
    noise = np.concatenate([some.rays.noise for some in matched])
    pixels, first, star = np.unique(ref_px, axis=0, return_index=True, return_inverse=True)
    star = star.reshape(-1)
    seen = np.bincount(star)
    uncertain = np.bincount(star, noise[:, 0] + noise[:, 2]) / np.maximum(seen, 1)
    kept = _spread(pixels, seen, uncertain, most)
    place = np.full(len(pixels), -1, np.int64)
    place[kept] = np.arange(len(kept))
    rows = np.flatnonzero(place[star] >= 0)
    frames = np.array([number[matched[0].pair.ref], *(number[some.pair.src] for some in matched)], np.int64)
    src = np.concatenate([some.rays.src for some in matched])
    return Stars(
        frames,
        np.concatenate([some.rays.ref for some in matched])[first[kept]],
        pixels[kept],
        place[star[rows]],
        np.repeat(np.arange(1, len(matched) + 1), sizes)[rows],
        np.concatenate([some.src_px for some in matched])[rows],
        src[rows, :2],
        _roots(noise[rows]),
    )


def _spread(pixels: Floats, seen: Ints, uncertain: Floats, most: int) -> Ints:
    """Rows of the best pixels of each cell of the image, then of the second best, and so on."""
    cell = cells_of(pixels, _CELLS)
    order = np.lexsort((uncertain, -seen, cell))
    starts = np.searchsorted(cell[order], cell[order])
    rank = np.arange(len(order)) - starts
    chosen = order[np.argsort(rank, kind="stable")[:most]]
    return np.sort(chosen)


def _roots(noise: Floats) -> Floats:
    """(m, 2, 2) W with W^T W = C^-1, of covariances xx, xy, yy (m, 3)."""
    xx, xy, yy = noise.T
    out = np.zeros((len(noise), 2, 2))
    # C^-1 = W^T W with W upper triangular: the Cholesky factor of C, inverted.
    rest = np.sqrt(np.maximum(yy - xy * xy / xx, 1e-24))
    out[:, 0, 0] = 1.0 / np.sqrt(xx)
    out[:, 1, 0] = -xy / (xx * rest)
    out[:, 1, 1] = 1.0 / rest
    return out
