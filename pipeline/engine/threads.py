"""Keeping the numeric libraries on one thread per process."""

import os

# Shards are the parallelism, and BLAS's own threads would change last digits with their number.
_ONE_THREAD = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)


def limit_threads() -> None:
    """Keeps the numeric libraries on one thread; call before they are imported."""
    for name in _ONE_THREAD:
        os.environ[name] = "1"
