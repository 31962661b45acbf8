"""Covariances of matched positions, long and slanted so that a swapped or forgotten term shows, and draws of them."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import Floats


def slanted(n: int, scale: float = 1.0, seed: int = 0) -> Floats:
    """(n, 3) uu, uv, vv: sigmas of 0.5 to 0.9 and of 0.1 to 0.3 times `scale`, in all directions."""
    rng = np.random.default_rng(seed)
    along, across = rng.uniform(0.5, 0.9, n) * scale, rng.uniform(0.1, 0.3, n) * scale
    c, s = np.cos(turn := rng.uniform(0.0, np.pi, n)), np.sin(turn)
    return np.stack(
        [(c * along) ** 2 + (s * across) ** 2, c * s * (along**2 - across**2), (s * along) ** 2 + (c * across) ** 2],
        axis=1,
    )


def matrices(covariance: Floats) -> Floats:
    """(n, 2, 2) of (n, 3)."""
    out: Floats = covariance[:, [[0, 1], [1, 2]]]
    return out


def drawn(rng: np.random.Generator, covariance: Floats) -> Floats:
    """(n, 2) errors with these covariances."""
    out: Floats = np.einsum(
        "nij,nj->ni", np.linalg.cholesky(matrices(covariance)), rng.normal(size=(len(covariance), 2))
    )
    return out
