"""Tell which signals of a record change: far faster than their range, which NumPy takes by rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_FIRST = 1000
"""Rows after which most signals have changed."""


def varying(x: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which columns (k,) of x (N, k) differ in any row from the first; a nan differs."""
    return np.array([_varies(column) for column in x.T], dtype=bool)


def _varies(column: NDArray[np.float64]) -> bool:
    return any(bool(np.any(part != column[0])) for part in (column[1:_FIRST], column[_FIRST:]))
