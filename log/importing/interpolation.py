"""Interpolate samples, and measure the error on known samples that are left out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

Method = Literal["cubic", "linear", "previous value"]


def interpolate(at: Array, values: Array, to: Array, method: Method) -> Array:
    """Return values (n,), known at increasing places `at` (n,), interpolated to the places `to`."""
    if method == "cubic":
        return np.asarray(CubicSpline(at, values)(to))
    if method == "linear":
        return np.asarray(np.interp(to, at, values))
    return np.asarray(values[np.maximum(np.searchsorted(at, to, side="right") - 1, 0)])


def left_out_error(at: Array, values: Array, left_out: Mask, method: Method) -> float:
    """Return the RMS error of values (n,) at the places left out (n,), over the standard deviation.

    The first and the last value must not be left out.
    """
    found = interpolate(at[~left_out], values[~left_out], at[left_out], method)
    spread = float(np.std(values))
    error = float(np.sqrt(np.mean((found - values[left_out]) ** 2)))
    return error / spread if spread > 0.0 else 0.0


def best_method(
    at: Array, values: Array, left_out: Mask, methods: Sequence[Method]
) -> tuple[Method, float]:
    """Return the method with the smallest left-out error, and this error."""
    errors = {method: left_out_error(at, values, left_out, method) for method in methods}
    best = min(errors, key=errors.__getitem__)
    return best, errors[best]
