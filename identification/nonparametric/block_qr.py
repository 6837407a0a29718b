"""Reduce a tall least-squares problem to its triangular factor R by block QR."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCK_ROWS = 1000
"""Rows in a block: a few times the columns, so that the work stays in the cache."""


def triangle(parts: Iterable[Array]) -> Array:
    """Return the upper triangular factor R (c, c) of the stacked parts (N, c).

    For columns [X Y], the leading block of R solves the least squares of Y on the leading columns
    of X, and the entries of Y below that block hold the residual. So R contains the fits for every
    leading subset of columns, as accurate as QR of all rows. With fewer than c rows, the last rows
    of R are zero.
    """
    R: Array | None = None
    for part in parts:
        if R is None:
            R = np.zeros((0, part.shape[1]))
        for row in range(0, len(part), BLOCK_ROWS):
            R = np.asarray(np.linalg.qr(np.vstack([R, part[row : row + BLOCK_ROWS]]), mode="r"))
    assert R is not None
    return np.vstack([R, np.zeros((R.shape[1] - len(R), R.shape[1]))])


def independent(R: Array, tolerance: float) -> bool:
    """Return whether the columns of X = Q R are linearly independent, to a relative tolerance."""
    size = np.maximum(np.linalg.norm(R, axis=0), np.finfo(float).tiny)
    return bool(np.all(np.abs(np.diag(R)) > tolerance * size))
