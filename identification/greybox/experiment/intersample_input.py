"""Compute the moments of an input over each period, exact for hold, delay and lag."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numba import njit
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal import lfilter

Array = NDArray[np.float64]
Hold = Literal["zoh", "foh", "band_limited"]

_OVERSAMPLING = 8
_EDGE_S_ROWS = 256
_SMOOTH = 10.0
"""Longest interval, in time constants, that is integrated by Gauss's rule.

With 32 points the error for exp(-10 x) times a polynomial of degree 40 (the highest of
discretisation.taylor_scale) is below rounding. For longer intervals the exponential decays within
the interval, and integration by parts does not cancel.
"""
_GAUSS = np.polynomial.legendre.leggauss(32)
_NODES, _WEIGHTS = 0.5 + 0.5 * _GAUSS[0], 0.5 * _GAUSS[1]


@dataclass(frozen=True)
class HeldStep:
    """The effect of a held input in one period, after a delay and a first-order lag.

    In period k the input jumps from `old` to `new` after `split_s`; the lagged input starts at l.
    Its moments m_j, the integrals of (Ts - s)^j / j! times the lagged input over the period, are
    from_old[j] old + from_new[j] new + from_lag[j] l, j = 0 .. order - 1. The lagged input at the
    end is end_old old + end_new new + end_lag l. The delay has `whole` more periods.
    """

    whole: int
    from_old: Array
    from_new: Array
    from_lag: Array
    end_old: float
    end_new: float
    end_lag: float


def moments(u: Array, Ts_s: float, order: int, hold: Hold, delay_s: float, lag_s: float) -> Array:
    """Return the moments (N, order, p): integrals of (Ts - s)^j / j! times the input over a period.

    With x' = A x + B l(t), a period adds sum_j A^j B m_j to the state, exactly for any input
    between samples. `u` (N, p) is commanded at the samples; it acts delay_s later, after a
    first-order lag of lag_s. The first row is assumed to have acted before the record.
    """
    if hold == "zoh":
        return _held(u, held_step(Ts_s, order, delay_s, lag_s))
    if hold == "foh":
        return _ramped(u, Ts_s, order, delay_s, lag_s)
    fine = _between(u, Ts_s, delay_s, lag_s)
    return _piecewise_linear(fine, Ts_s, order, len(u))


def held_step(Ts_s: float, order: int, delay_s: float, lag_s: float) -> HeldStep:
    """Return the effect of a zero-order-held input within one period."""
    whole, split_s = _split(delay_s, Ts_s)
    j = np.arange(order)
    factorial = np.array([math.factorial(i) for i in range(order)], float)
    before = (Ts_s ** (j + 1) - (Ts_s - split_s) ** (j + 1)) / (factorial * (j + 1))
    after = (Ts_s - split_s) ** (j + 1) / (factorial * (j + 1))
    if lag_s <= 0.0:
        return HeldStep(whole, before, after, np.zeros(order), 0.0, 1.0, 0.0)
    # The lagged input is c + (l - c) exp(-s / lag) on each side of the jump. The rise is integrated
    # directly: as a difference of integrals it would be lost to rounding for a long lag.
    first, rising_first, _ = _lagged_moments(Ts_s, 0.0, split_s, lag_s, order)
    second, rising_second, _ = _lagged_moments(Ts_s, split_s, Ts_s, lag_s, order)
    decay_split, decay_rest = math.exp(-split_s / lag_s), math.exp(-(Ts_s - split_s) / lag_s)
    at_split = -math.expm1(-split_s / lag_s)  # share of old in the lagged input at the jump
    return HeldStep(
        whole,
        from_old=rising_first + at_split * second,
        from_new=rising_second,
        from_lag=first + decay_split * second,
        end_old=at_split * decay_rest,
        end_new=-math.expm1(-(Ts_s - split_s) / lag_s),
        end_lag=decay_split * decay_rest,
    )


def _split(delay_s: float, Ts_s: float) -> tuple[int, float]:
    """Return the whole periods of a delay, and the remainder in s."""
    whole = math.floor(delay_s / Ts_s + 1e-9)
    return whole, min(max(delay_s - whole * Ts_s, 0.0), Ts_s)


def _held(u: Array, step: HeldStep) -> Array:
    old, new = _around_jump(u, step)
    held = np.empty((len(u), len(step.from_old), u.shape[1]))
    weighted_sum(
        np.ascontiguousarray(old), np.ascontiguousarray(new), lagged_input(u, step),
        step.from_old, step.from_new, step.from_lag, held,
    )  # fmt: skip
    return held


@njit(cache=True, nogil=True)
def weighted_sum(old, new, lagged, from_old, from_new, from_lag, out):  # type: ignore[no-untyped-def]
    """Fill `out` (N, J, p) with the sums of three inputs (N, p), each times a factor (J,)."""
    for k in range(len(old)):
        for j in range(len(from_old)):
            for i in range(old.shape[1]):
                out[k, j, i] = (
                    from_old[j] * old[k, i] + from_new[j] * new[k, i] + from_lag[j] * lagged[k, i]
                )


def lagged_input(u: Array, step: HeldStep) -> Array:
    """Return the lagged input (N, p) at the start of each period, constant before the record."""
    old, new = _around_jump(u, step)
    lagged = np.empty_like(u)
    lagged[0] = u[0]
    drive = step.end_old * old[:-1] + step.end_new * new[:-1]
    lagged[1:], _ = lfilter([1.0], [1.0, -step.end_lag], drive, axis=0, zi=step.end_lag * u[:1])
    return lagged


def _around_jump(u: Array, step: HeldStep) -> tuple[Array, Array]:
    """Return the input in each period before and after the jump within it, both (N, p)."""
    return shifted(u, step.whole + 1), shifted(u, step.whole)


def shifted(u: Array, rows: int) -> Array:
    """Return an input (N, p) as many rows later, constant before the record."""
    if rows == 0:
        return u
    later = np.empty_like(u)
    later[:rows], later[rows:] = u[0], u[:-rows]
    return later


def _ramped(u: Array, Ts_s: float, order: int, delay_s: float, lag_s: float) -> Array:
    """Return the moments of an input linear between samples, after delay and lag, exactly.

    After the last sample the input continues linearly.
    """
    whole, split_s = _split(delay_s, Ts_s)
    rows = np.arange(len(u))
    more = np.vstack([u, 2 * u[-1] - u[-2]])
    old, new, coming = (more[np.maximum(rows - whole + i, 0)] for i in (-1, 0, 1))
    # Within a period the delayed input is linear from `first` to `new`, then towards `coming`.
    first = new + split_s / Ts_s * (old - new)
    slopes = (new - old) / Ts_s, (coming - new) / Ts_s
    decay_1, rise_1, ramp_1 = _lagged_line(split_s, lag_s)
    decay_2, rise_2, ramp_2 = _lagged_line(Ts_s - split_s, lag_s)
    at_bend = rise_1 * first + ramp_1 * slopes[0]  # from a lagged input of zero
    lagged = np.empty_like(u)
    lagged[0] = u[0]
    drive = (decay_2 * at_bend + rise_2 * new + ramp_2 * slopes[1])[:-1]
    decay = decay_1 * decay_2
    lagged[1:], _ = lfilter([1.0], [1.0, -float(decay)], drive, axis=0, zi=decay * u[:1])
    at_bend = at_bend + decay_1 * lagged
    before = _lagged_moments(Ts_s, 0.0, split_s, lag_s, order)
    after = _lagged_moments(Ts_s, split_s, Ts_s, lag_s, order)
    result = np.zeros((len(u), order, u.shape[1]))
    for weights, values in (
        *zip(before, (lagged, first, slopes[0]), strict=True),
        *zip(after, (at_bend, new, slopes[1]), strict=True),
    ):
        result += weights[:, None] * values[:, None]
    return result


def _lagged_line(s: float | Array, lag_s: float) -> tuple[Array, Array, Array]:
    """Return the response of a lag after s seconds to its state, a unit step and a ramp of 1/s."""
    x = np.asarray(s, float)
    if lag_s <= 0.0:
        return np.zeros_like(x), np.ones_like(x), x
    x = x / lag_s
    rise = -np.expm1(-x)
    # The ramp is lag (x - rise), which is rounding for a long lag: there, use the rise's mean.
    slow = np.minimum(x, _SMOOTH)
    mean = -np.expm1(-np.multiply.outer(slow, _NODES)) @ _WEIGHTS
    return np.exp(-x), rise, lag_s * np.where(x < _SMOOTH, slow * mean, x - rise)


def _lagged_moments(
    Ts_s: float, start: float, end: float, lag_s: float, order: int
) -> tuple[Array, Array, Array]:
    """Return the integrals of (Ts - s)^j / j! from start to end times _lagged_line, each (order,).

    Integration by parts multiplies the rounding error of each integral by the lag, which fails if
    the lag is longer than the period: there, Gauss's rule is used.
    """
    length = end - start
    s = length * _NODES
    kernel = np.empty((order, len(s)))
    kernel[0] = length * _WEIGHTS
    np.divide(Ts_s - start - s, np.arange(1, order)[:, None], out=kernel[1:])
    np.multiply.accumulate(kernel, axis=0, out=kernel)
    if length <= _SMOOTH * lag_s:
        decay, rise, ramp = _lagged_line(s, lag_s)
        return kernel @ decay, kernel @ rise, kernel @ ramp
    decaying = _decaying(Ts_s, start, end, lag_s, order)
    rising = kernel.sum(axis=1) - decaying
    return decaying, rising, kernel @ s - lag_s * rising


def _decaying(Ts_s: float, start: float, end: float, lag_s: float, order: int) -> Array:
    values = np.zeros(order)
    if lag_s <= 0.0:
        return values
    decay = math.exp(-(end - start) / lag_s)
    previous = 0.0
    for j in range(order):  # by parts
        edge = ((Ts_s - start) ** j - decay * (Ts_s - end) ** j) / math.factorial(j)
        values[j] = previous = lag_s * (edge - previous)
    return values


def _between(u: Array, Ts_s: float, delay_s: float, lag_s: float) -> Array:
    """Return the band-limited input after delay and lag, at _OVERSAMPLING points a period."""
    n, fine = len(u), _OVERSAMPLING
    # Odd reflection at both ends keeps value and slope, so that the interpolation does not ring.
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
    return np.asarray(acting[begin : begin + fine * n + 1])


def _piecewise_linear(fine: Array, Ts_s: float, order: int, n: int) -> Array:
    periods = sliding_window_view(fine[: _OVERSAMPLING * n + 1], _OVERSAMPLING + 1, axis=0)
    return np.asarray((periods[::_OVERSAMPLING] @ _of_points(Ts_s, order).T).swapaxes(1, 2))


@cache
def _of_points(Ts_s: float, order: int) -> Array:
    """Return the moments (order, _OVERSAMPLING + 1) of the lines through the points of a period."""
    step_s = Ts_s / _OVERSAMPLING
    # Enough Gauss points for a straight line times a polynomial of degree order - 1.
    nodes, weights = np.polynomial.legendre.leggauss(order // 2 + 2)
    nodes, weights = 0.5 + 0.5 * nodes, 0.5 * weights * step_s
    factorial = np.array([math.factorial(i) for i in range(order)], float)[:, None, None]
    left_s = Ts_s - (np.arange(_OVERSAMPLING)[:, None] + nodes) * step_s
    kernel = left_s ** np.arange(order)[:, None, None] / factorial
    found = np.zeros((order, _OVERSAMPLING + 1))
    found[:, :-1] = kernel @ (weights * (1.0 - nodes))
    found[:, 1:] += kernel @ (weights * nodes)
    return found
