"""Remove the known delay and lag from a loop's Markov parameters, so that they add no states.

All steps are exact algebra on power series in z^-1 (Markov parameters), truncated at their length.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from ..records.record import PiController

Array = NDArray[np.float64]


def without_delay(
    g: Array, leading_zeros: int, lag_pole: float, controller: PiController | None, Ts_s: float
) -> Array:
    """Return the Markov parameters (L - d, m, p) of the loop g (L, m, p) without delay and lag.

    With P = E Q, E(z) = z^-d (1 - a) / (1 - a z^-1) for d = `leading_zeros` and a = `lag_pole`, the
    measured loop is G = P (I + C P)^-1. The result is Q (I + C Q)^-1 = F (I + (1 - E) C F)^-1 with
    F = G / E. As 1 - E is zero at z = 1, the integrators cancel in (1 - E) C. Delay and lag are
    short, so the inverse is close to I and does not amplify noise. Without controller (open loop)
    the result is F.
    """
    forward = _forward(g, leading_zeros, lag_pole)
    if controller is None:
        return forward
    feedback = _feedback(len(forward), leading_zeros, lag_pole, controller, Ts_s)
    return product(forward, inverse(_with_identity(product(feedback, forward))))


def change_without_delay(
    g: Array, leading_zeros: int, lag_pole: float, controller: PiController, Ts_s: float
) -> Callable[[Array], Array]:
    """Return how the result of without_delay changes with small changes of g (L, m, p).

    With K = (1 - E) C it is (I + F K)^-1 dF (I + K F)^-1.
    """
    forward = _forward(g, leading_zeros, lag_pole)
    feedback = _feedback(len(forward), leading_zeros, lag_pole, controller, Ts_s)
    left = inverse(_with_identity(product(forward, feedback)))
    right = inverse(_with_identity(product(feedback, forward)))

    def change(dg: Array) -> Array:
        return product(product(left, _forward(dg, leading_zeros, lag_pole)), right)

    return change


def _forward(g: Array, leading_zeros: int, lag_pole: float) -> Array:
    """Return F = G / E."""
    forward = g[leading_zeros:]
    if lag_pole:
        forward = signal.lfilter([1.0, -lag_pole], [1.0 - lag_pole], forward, axis=0)
    return np.asarray(forward)


def _feedback(
    length: int, leading_zeros: int, lag_pole: float, controller: PiController, Ts_s: float
) -> Array:
    """Return (1 - E) C = kp (1 - E) + ki Ts (1 - E) / (1 - z^-1); the latter is a step response."""
    step = np.ones(length)
    step[leading_zeros:] -= 1.0 - lag_pole ** np.arange(1, length - leading_zeros + 1)
    impulse = np.diff(step, prepend=0.0)
    return _diagonal(impulse[:, None] * controller.kp + step[:, None] * controller.ki * Ts_s)


def _with_identity(series: Array) -> Array:
    series[0] += np.eye(series.shape[1])
    return series


def product(a: Array, b: Array) -> Array:
    """Return the product of two series (L, m, n) and (L, n, p), truncated to L terms."""
    size = fft.next_fast_len(2 * len(a), real=True)
    spectrum = fft.rfft(a, size, axis=0) @ fft.rfft(b, size, axis=0)
    return np.asarray(fft.irfft(spectrum, size, axis=0)[: len(a)])


def inverse(a: Array) -> Array:
    """Return the inverse (L, p, p) of the series a (L, p, p), a(0) regular, by Newton's method."""
    x = np.linalg.inv(a[:1])
    while len(x) < len(a):
        n = min(2 * len(x), len(a))
        padded = np.concatenate([x, np.zeros((n - len(x), *x.shape[1:]))])
        error = -product(a[:n], padded)
        error[0] += 2 * np.eye(a.shape[1])
        x = product(padded, error)
    return np.asarray(x)


def _diagonal(series: Array) -> Array:
    out = np.zeros((*series.shape, series.shape[1]))
    index = np.arange(series.shape[1])
    out[:, index, index] = series
    return out
