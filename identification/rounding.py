"""What the rounding of floating-point numbers may do, and steps of numerical derivatives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import uniform

Array = NDArray[np.float64]

_EPS = float(np.finfo(float).eps)

TINY = float(np.finfo(float).tiny) ** 0.5
"""A divisor of at least this much is never zero, and its inverse is finite times any signal."""
ROUNDING = _EPS**0.5
"""Half of the digits: relative differences of this size are what a long calculation may round."""
DIFFERENCE = float(np.cbrt(_EPS))
"""Half step of a central difference over the size of its number: rounding and the next order of the
function then give errors of the same size."""
SINGLE_ROUNDING = float(np.finfo(np.float32).eps)
"""Least noise of a signal over its RMS: below, it is rounding of what was stored in 32 bits."""
ROUNDED_SD = float(uniform.std())
"""Standard deviation of what rounding to a step of 1 leaves, evenly spread over the step."""
RIDGE = DIFFERENCE**2
"""Addition to a Gram matrix of unit diagonal: keeps parallel columns solvable, far above rounding
and far below what tells two columns apart."""


def basis_of(columns: Array) -> Array:
    """Return an orthonormal basis (rows, r) of columns (rows, C), without those that depend on
    others."""
    size = np.linalg.norm(columns, axis=0)
    Q, R = np.linalg.qr(columns[:, size > 0.0] / size[size > 0.0])
    return np.asarray(Q[:, np.abs(np.diag(R)) > ROUNDING])
