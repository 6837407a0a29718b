"""Scale a covariance, or convert it to correlations."""

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
    """Scale the variances of a covariance (n, n) by `by`, (n,) or scalar; correlations stay."""
    root = np.sqrt(np.broadcast_to(by, len(covariance)))
    return np.asarray(covariance * np.outer(root, root))
