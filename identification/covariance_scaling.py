"""Scale a covariance, or convert it to correlations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TINY = np.finfo(np.float64).tiny


def correlation(covariance: Array) -> Array:
    """Return the correlations (n, n) of a covariance (n, n), exactly 1 on the diagonal.

    Those of a number without variance are 0.
    """
    variance = np.diag(covariance)
    found = scaled(covariance, np.where(variance > 0.0, 1.0 / np.maximum(variance, _TINY), 0.0))
    np.fill_diagonal(found, 1.0)
    return found


def scaled(covariance: Array, by: Array | float) -> Array:
    """Scale the variances of a covariance (n, n) by `by`, (n,) or scalar; correlations stay."""
    root = np.sqrt(np.broadcast_to(by, len(covariance)))
    return np.asarray(covariance * np.outer(root, root))
