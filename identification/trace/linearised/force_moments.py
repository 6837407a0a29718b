"""What a force that is known at the rows does between them, as moments over each period."""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ...greybox.intersample_input import Hold, moments

Array = NDArray[np.float64]

POINTS = 6
"""Rows around a period that a force's course within it is told from: two before, four after."""


def force_moments(force: Array, Ts_s: float, order: int, hold: Hold) -> Array:
    """Return m (N, order, n): integrals of (Ts - s)^j / j! times a force (N, n) over each period.

    The force depends on how the plant moves, so it is as smooth as that: a polynomial through six
    rows, which at a tenth of the rate errs by 10^-4 where a straight line errs by three percent; or
    band-limited, for a model whose inputs are.
    """
    if hold == "band_limited":
        return moments(force, Ts_s, order, hold, 0.0, 0.0)
    weights = polynomial_weights(Ts_s, order)
    rows, n = force.shape
    return (around(force) @ np.kron(weights, np.eye(n)).T).reshape(rows, order, n)


def around(force: Array) -> Array:
    """Return the six rows around each period (N, 6 n), earliest first, of a force (N, n).

    Beyond its ends it is what it is there. Side by side, what they do is one product of matrices.
    """
    padded = np.concatenate([np.repeat(force[:1], 2, 0), force, np.repeat(force[-1:], 3, 0)])
    n = padded.shape[1]
    return np.ascontiguousarray(sliding_window_view(padded.ravel(), POINTS * n)[::n])


def polynomial_weights(Ts_s: float, order: int) -> Array:
    """Return w (order, 6): moment j is the sum of w[j] over rows k - 2 ... k + 3 of period k."""
    nodes = np.arange(-2.0, 4.0)
    # Columns of the inverse Vandermonde are the Lagrange polynomials' coefficients, s in periods.
    lagrange = np.linalg.inv(np.vander(nodes, POINTS, increasing=True))
    weights = np.empty((order, POINTS))
    for j in range(order):
        # The integral of (1 - s)^j / j! s^i over 0 .. 1 is i! / (i + j + 1)!.
        integrals = [math.factorial(i) / math.factorial(i + j + 1) for i in range(POINTS)]
        weights[j] = Ts_s ** (j + 1) * np.array(integrals) @ lagrange
    return weights
