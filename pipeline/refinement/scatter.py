"""How far matches are from being independent: what a pose's covariance has to be widened by."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import Floats, Ints

SHARED_PX = 0.008
"""What all matches of an image have in common and their scatter does not show; found on rendered photos, whose lenses
are exact."""
_CELLS = (8, 6)
_UNSEEN = 1e-9


def scatter_of(gradients: Floats, pixels: Floats, information: Floats) -> float:
    """As `scatter_between`, from the gradients of every match.

    Args:
        gradients: (n, u) of the cost by the unknowns, of every match at the minimum.
        pixels: (n, 2) where the matches are.
        information: (u, u) sum of the matches' own.
    """
    return scatter_between(sums_by_cell(gradients, pixels), information)


def sums_by_cell(gradients: Floats, pixels: Floats) -> Floats:
    """(cells, u) sums of gradients (n, u) of matches at pixels (n, 2) within cells of the image."""
    members = np.zeros((_CELLS[0] * _CELLS[1], len(pixels)))
    members[cells_of(pixels, _CELLS), np.arange(len(pixels))] = 1.0
    out: Floats = members @ gradients
    return out


def scatter_between(sums: Floats, information: Floats) -> float:
    """The factor by which an information matrix is too large, from how alike the residuals of one place are.

    An error of the lens, a moving shutter or a car makes neighbouring residuals alike; counting them as independent
    would promise too much. The gradients are summed within cells of the image, and the spread of these sums is compared
    with what independent ones would have (a sandwich estimator over clusters, as a mean over the axes that are seen).

    Args:
        sums: (cells, u) of the gradients of the cost within cells of the image.
        information: (u, u) sum of the matches' own.
    """
    # On axes on which the information is the unit matrix; what is not seen, a baseline's length, has none.
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    seen = values > _UNSEEN * values[-1]
    axes = scale[:, None] * vectors[:, seen] / np.sqrt(values[seen])
    return float(np.mean(np.sum((sums @ axes) ** 2, axis=0)))


def cells_of(pixels: Floats, cells: tuple[int, int]) -> Ints:
    """(n,) the cell of a grid over their bounding box that pixels (n, 2) lie in."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    at = ((pixels - low) / np.maximum(high - low, 1e-9) * cells).astype(np.int64)
    u, v = np.minimum(at, np.array(cells) - 1).T
    out: Ints = u * cells[1] + v
    return out
