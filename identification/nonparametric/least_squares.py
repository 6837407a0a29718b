"""Least squares of many rows: reduced block by block to a triangle, which every fit shares."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCK_ROWS = 1000
"""Rows that are reduced at once: a few times the columns, so that the work stays in the cache."""


def triangle(parts: Iterable[Array]) -> Array:
    """Return R (c, c), upper triangular, of the QR of all parts (N, c) beneath each other.

    For columns [X Y] the leading block of R solves the least squares of Y on the leading columns of
    X, and what is left of R in Y below that block is the residual: R holds the fits of every nested
    choice of columns, as accurate as QR of the whole. Fewer than c rows leave zeros at the end.
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
    """Say whether no column of X is, within `tolerance` of its size, a sum of those before it."""
    size = np.maximum(np.linalg.norm(R, axis=0), np.finfo(float).tiny)
    return bool(np.all(np.abs(np.diag(R)) > tolerance * size))
