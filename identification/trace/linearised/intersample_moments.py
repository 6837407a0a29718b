"""Compute the moments of a sampled force over each period, by interpolation."""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ...greybox.experiment.intersample_input import Hold, moments
from ..search_options import SearchOptions

Array = NDArray[np.float64]

POINTS = SearchOptions.interpolated
"""Rows used to interpolate a force over a period: k - 2 to k + 3."""
_BEFORE = POINTS // 2 - 1


def force_moments(force: Array, Ts_s: float, order: int, hold: Hold) -> Array:
    """Return the moments (N, order, n): integrals of (Ts - s)^j / j! times a force over a period.

    The force (N, n) depends on the motion, so it is smooth: a polynomial through six rows has an
    error of 10^-4 at a tenth of the sampling rate, a straight line of three percent. For models
    with a band-limited input, the force is band-limited.
    """
    if hold == "band_limited":
        return moments(force, Ts_s, order, hold, 0.0, 0.0)
    weights = polynomial_weights(Ts_s, order)
    rows, n = force.shape
    return (around(force) @ np.kron(weights, np.eye(n)).T).reshape(rows, order, n)


def nonzero_columns(values: Array) -> list[int]:
    """Return the columns that are not zero: of most effects one, as they act at one place."""
    return [i for i, one in enumerate(values.T) if one.any()]


def around(force: Array) -> Array:
    """Return the six rows around each period (N, 6 n) of a force (N, n), earliest first.

    The force is constant beyond its ends. In this layout the moments are one matrix product.
    """
    padded = np.concatenate(
        [np.repeat(force[:1], _BEFORE, 0), force, np.repeat(force[-1:], POINTS // 2, 0)]
    )
    n = padded.shape[1]
    return np.ascontiguousarray(sliding_window_view(padded.ravel(), POINTS * n)[::n])


def polynomial_weights(Ts_s: float, order: int) -> Array:
    """Return weights w (order, 6): moment j of period k is w[j] times rows k - 2 to k + 3."""
    nodes = np.arange(POINTS) - float(_BEFORE)
    # Columns of the inverse Vandermonde are the Lagrange polynomials' coefficients, s in periods.
    lagrange = np.linalg.inv(np.vander(nodes, POINTS, increasing=True))
    weights = np.empty((order, POINTS))
    for j in range(order):
        # The integral of (1 - s)^j / j! s^i over 0 .. 1 is i! / (i + j + 1)!.
        integrals = [math.factorial(i) / math.factorial(i + j + 1) for i in range(POINTS)]
        weights[j] = Ts_s ** (j + 1) * np.array(integrals) @ lagrange
    return weights
