"""Sizes and correlations of a covariance, apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def correlation(covariance: Array) -> Array:
    """Return the correlations (n, n) of a covariance (n, n), exactly 1 on the diagonal."""
    found = scaled(covariance, 1.0 / np.diag(covariance))
    np.fill_diagonal(found, 1.0)
    return found


def scaled(covariance: Array, by: Array | float) -> Array:
    """Return a covariance (n, n) of `by` times the variances, (n,) or all alike.

    Correlations stay as they are.
    """
    root = np.sqrt(np.broadcast_to(by, len(covariance)))
    return np.asarray(covariance * np.outer(root, root))
