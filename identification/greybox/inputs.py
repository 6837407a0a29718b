"""What an input does between samples, as moments over each period: hold, delay and lag, exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal import lfilter

Array = NDArray[np.float64]
Hold = Literal["zoh", "foh", "band_limited"]

_OVERSAMPLING = 8
_EDGE_S_ROWS = 256
_SMOOTH = 10.0
"""Time constants that a stretch may last for Gauss's rule to take the exponential for a polynomial.

What is left of exp(-10 x) times a polynomial of degree 40 (motion.taylor_scale asks for no more) is
below rounding with 32 points. Beyond, the exponential is gone before the stretch ends, and by parts
nothing cancels.
"""
_GAUSS = np.polynomial.legendre.leggauss(32)
_NODES, _WEIGHTS = 0.5 + 0.5 * _GAUSS[0], 0.5 * _GAUSS[1]


@dataclass(frozen=True)
class HeldStep:
    """One period of a held input behind a delay and a first-order lag, as numbers.

    In period k the input jumps from `old` to `new` late by `split_s`; the lagged input begins at l.
    moments: m_j = integral of (Ts - s)^j / j! of the lagged input over the period, which is
    from_old[j] old + from_new[j] new + from_lag[j] l, j = 0 .. order - 1; the lagged input at the
    end is end_old old + end_new new + end_lag l. `whole` periods of delay come before.
    """

    whole: int
    from_old: Array
    from_new: Array
    from_lag: Array
    end_old: float
    end_new: float
    end_lag: float


def moments(u: Array, Ts_s: float, order: int, hold: Hold, delay_s: float, lag_s: float) -> Array:
    """Return m (N, order, p): integrals of (Ts - s)^j / j! times the acting input over each period.

    With x' = A x + B l(t), a step of length Ts adds sum_j A^j B m_j to the state: the input's whole
    effect, whatever it does between samples. `u` (N, p) is commanded at the samples; it acts
    delay_s later behind a first-order lag of lag_s. Before the record the first row is taken to
    have acted.
    """
    if hold == "zoh":
        return _held(u, held_step(Ts_s, order, delay_s, lag_s))
    fine, step_s = _between(u, Ts_s, hold, delay_s, lag_s)
    return _piecewise_linear(fine, Ts_s, step_s, order, len(u))


def held_step(Ts_s: float, order: int, delay_s: float, lag_s: float) -> HeldStep:
    """Return how a zero-order-held input acts within one period."""
    whole = math.floor(delay_s / Ts_s + 1e-9)
    split_s = min(max(delay_s - whole * Ts_s, 0.0), Ts_s)
    j = np.arange(order)
    factorial = np.array([math.factorial(i) for i in range(order)], float)
    before = (Ts_s ** (j + 1) - (Ts_s - split_s) ** (j + 1)) / (factorial * (j + 1))
    after = (Ts_s - split_s) ** (j + 1) / (factorial * (j + 1))
    if lag_s <= 0.0:
        return HeldStep(whole, before, after, np.zeros(order), 0.0, 1.0, 0.0)
    # The lagged input is c + (l - c) exp(-s / lag) on each side of the jump. What rises there is
    # integrated as it is: as a difference of integrals it would be lost to rounding in a long lag.
    first, rising_first = _lagged_moments(Ts_s, 0.0, split_s, lag_s, order)
    second, rising_second = _lagged_moments(Ts_s, split_s, Ts_s, lag_s, order)
    decay_split, decay_rest = math.exp(-split_s / lag_s), math.exp(-(Ts_s - split_s) / lag_s)
    at_split = -math.expm1(-split_s / lag_s)  # of old, in the lagged input at the jump
    return HeldStep(
        whole,
        from_old=rising_first + at_split * second,
        from_new=rising_second,
        from_lag=first + decay_split * second,
        end_old=at_split * decay_rest,
        end_new=-math.expm1(-(Ts_s - split_s) / lag_s),
        end_lag=decay_split * decay_rest,
    )


def _held(u: Array, step: HeldStep) -> Array:
    old, new = _around_jump(u, step)
    lagged = lagged_input(u, step)
    return np.asarray(
        step.from_old[:, None] * old[:, None]
        + step.from_new[:, None] * new[:, None]
        + step.from_lag[:, None] * lagged[:, None]
    )


def lagged_input(u: Array, step: HeldStep) -> Array:
    """Return the lagged input (N, p) at the beginning of each period, at rest before the record."""
    old, new = _around_jump(u, step)
    lagged = np.empty_like(u)
    lagged[0] = u[0]
    drive = step.end_old * old[:-1] + step.end_new * new[:-1]
    lagged[1:], _ = lfilter([1.0], [1.0, -step.end_lag], drive, axis=0, zi=step.end_lag * u[:1])
    return lagged


def _around_jump(u: Array, step: HeldStep) -> tuple[Array, Array]:
    """Return what acts in each period before and after the jump within it, both (N, p)."""
    rows = np.arange(len(u))
    return u[np.maximum(rows - step.whole - 1, 0)], u[np.maximum(rows - step.whole, 0)]


def _lagged_moments(
    Ts_s: float, start: float, end: float, lag_s: float, order: int
) -> tuple[Array, Array]:
    """Return the integrals of (Ts - s)^j / j! times E and 1 - E from start to end, each (order,).

    E = exp(-(s - start) / lag). By parts each integral follows from the one before times the lag,
    rounding included; in a lag longer than the period the integrals shrink while that grows.
    """
    length = end - start
    if length == 0.0:
        return np.zeros(order), np.zeros(order)
    if length > _SMOOTH * lag_s:
        return _by_parts(Ts_s, start, end, lag_s, order)
    s = length * _NODES
    kernel = np.empty((order, len(s)))
    kernel[0] = length * _WEIGHTS
    np.divide(Ts_s - start - s, np.arange(1, order)[:, None], out=kernel[1:])
    np.multiply.accumulate(kernel, axis=0, out=kernel)
    rise = -np.expm1(s / -lag_s)
    return kernel @ (1.0 - rise), kernel @ rise


def _by_parts(
    Ts_s: float, start: float, end: float, lag_s: float, order: int
) -> tuple[Array, Array]:
    decaying, rising = np.empty(order), np.empty(order)
    decay = math.exp(-(end - start) / lag_s)
    previous = 0.0
    for j in range(order):
        factorial = math.factorial(j)
        edge = ((Ts_s - start) ** j - decay * (Ts_s - end) ** j) / factorial
        decaying[j] = previous = lag_s * (edge - previous)
        whole = ((Ts_s - start) ** (j + 1) - (Ts_s - end) ** (j + 1)) / (factorial * (j + 1))
        rising[j] = whole - previous
    return decaying, rising


def _between(
    u: Array, Ts_s: float, hold: Hold, delay_s: float, lag_s: float
) -> tuple[Array, float]:
    """Return the acting input at `oversampling` points a period, and their distance."""
    fine = _OVERSAMPLING if hold == "band_limited" else 1
    n = len(u)
    if hold == "foh" and delay_s == 0.0 and lag_s == 0.0:
        return np.vstack([u, 2 * u[-1] - u[-2]]), Ts_s
    # Odd reflection at both ends keeps value and slope: what a Fourier interpolation would ring at.
    edge = min(_EDGE_S_ROWS, n - 1)
    long = np.vstack([2 * u[0] - u[edge:0:-1], u, 2 * u[-1] - u[-2 : -edge - 2 : -1]])
    length = next_fast_len(2 * len(long), real=True)
    turned = np.vstack([long, np.zeros((length - len(long), u.shape[1]))])
    ramp = np.linspace(1.0, 0.0, length - len(long))[:, None]
    turned[len(long) :] = ramp * long[-1] + (1.0 - ramp) * long[0]
    spectrum = rfft(turned, axis=0)
    s = 2j * np.pi * rfftfreq(length, Ts_s)[:, None]
    spectrum *= np.exp(-s * delay_s) / (1.0 + s * lag_s)
    acting = irfft(spectrum, fine * length, axis=0) * fine
    begin = fine * edge
    return np.asarray(acting[begin : begin + fine * n + 1]), Ts_s / fine


def _piecewise_linear(fine: Array, Ts_s: float, step_s: float, order: int, n: int) -> Array:
    pieces = round(Ts_s / step_s)
    result = np.zeros((n, order, fine.shape[1]))
    # As many Gauss points as a straight line times a polynomial of degree order - 1 needs.
    nodes, weights = np.polynomial.legendre.leggauss(order // 2 + 2)
    for piece in range(pieces):
        left = fine[piece : piece + pieces * n : pieces][:n]
        right = fine[piece + 1 : piece + 1 + pieces * n : pieces][:n]
        for node, weight in zip(0.5 + 0.5 * nodes, 0.5 * weights, strict=True):
            rest = Ts_s - (piece + node) * step_s
            value = (1.0 - node) * left + node * right
            for j in range(order):
                result[:, j] += weight * step_s * rest**j / math.factorial(j) * value
    return result
