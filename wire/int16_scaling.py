"""Convert values to 16-bit counts and back; one count stands for a missing value."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Counts = NDArray[np.int16]

NO_VALUE = -32768
"""Count of a missing value, sent for a channel that cannot be read."""
LARGEST = 32767


def quantise(values: Array, per_unit: float, counts: Counts) -> None:
    """Fill `counts` with `values` times `per_unit`, rounded and clipped, NO_VALUE if not finite."""
    _quantise(values, per_unit, counts)


def scale(counts: Counts, unit: float, values: Array) -> None:
    """Fill `values` with `counts` times `unit`, with nan where the count is NO_VALUE."""
    _scale(counts, unit, values)


@njit(cache=True)
def _quantise(values: Any, per_unit: float, counts: Any) -> None:
    for i in range(counts.size):
        value = values[i] * per_unit
        if math.isfinite(value):
            counts[i] = np.int16(min(max(np.rint(value), -LARGEST), LARGEST))
        else:
            counts[i] = NO_VALUE


@njit(cache=True)
def _scale(counts: Any, unit: float, values: Any) -> None:
    for i in range(counts.size):
        values[i] = counts[i] * unit if counts[i] != NO_VALUE else np.nan
