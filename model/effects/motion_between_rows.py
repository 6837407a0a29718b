"""Means around rows of a force that turns with the motion faster than records are sampled.

Between two rows the speed is the cubic that has both rows' speeds and accelerations, and the
position that of both rows' positions and speeds. Each half of a row is cut into parts in which it
is nearly linear, so that the mean of a law is a difference of its integral, however fast it turns.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .base import Array, Signals

_PARTS = 2
"""Parts of each half of a row."""
_FAR = -0.5 * float(np.log(np.finfo(float).eps))
"""Argument beyond which tanh is 1 to the last digit, and powers of e would only underflow."""
_STILL = 1e-4
"""Change of a law's argument in a part below which the law is that of the middle, to 1e-9."""


def speeds_between_rows(signals: Signals, dof: int) -> Array:
    """Return the speeds (2 _PARTS + 1, N - 1) of a DOF from each row to the next one."""
    return _between(signals.qd[:, dof], signals.Ts_s * signals.qdd[:, dof])


def positions_between_rows(signals: Signals, dof: int) -> Array:
    """Return the positions (2 _PARTS + 1, N - 1) of a DOF from each row to the next one."""
    return _between(signals.q[:, dof], signals.Ts_s * signals.qd[:, dof])


def _between(values: Array, changes: Array) -> Array:
    """Return the cubics (2 _PARTS + 1, N - 1) through rows' values (N,) with changes per row."""
    s = np.linspace(0.0, 1.0, 2 * _PARTS + 1)
    end = s * s * (3.0 - 2.0 * s)
    weights = np.stack([1.0 - end, end, s * (1.0 - s) ** 2, s * s * (s - 1.0)], axis=1)
    return np.asarray(weights @ np.stack([values[:-1], values[1:], changes[:-1], changes[1:]]))


def means_of_parts(
    x: Array, law: Callable[[Array], Array], integral: Callable[[Array], Array]
) -> Array:
    """Return the means (2 _PARTS, N - 1) of a law over parts that end at arguments x."""
    whole, change = integral(x), x[1:] - x[:-1]
    still = np.abs(change) <= _STILL
    means = np.divide(whole[1:] - whole[:-1], change, where=~still, out=np.empty_like(change))
    means[still] = law(middles(x)[still])
    return np.asarray(means)


def law_of_speed(
    signals: Signals,
    dof: int,
    v: float,
    law: Callable[[Array], Array],
    integral: Callable[[Array], Array],
) -> Array:
    """Return a law of the speed of a DOF over a speed v (N,), which may turn within a row.

    Where signals ask for it, this is what its means around the rows tell.
    """
    if not signals.around_rows:
        return law(signals.qd[:, dof] / v)
    return at_rows(means_of_parts(speeds_between_rows(signals, dof) / v, law, integral))


def means_while_acting(
    signals: Signals,
    values: Array,
    rates: Array,
    law: Callable[[Array], Array],
    integral: Callable[[Array], Array],
) -> tuple[Array, Array]:
    """Return means and first moments (N,) of a law over the periods in which rows' commands act.

    values, rates (N,): its argument at the rows, and that per second. Moments are in periods from
    the middle, as those of `Signals.while_acting`, which takes the law to be smooth.
    """
    x = _between(values, signals.Ts_s * rates)
    parts, ends = means_of_parts(x, law, integral), law(x)
    centres = (np.arange(2 * _PARTS) + 0.5) / (2 * _PARTS) - 0.5
    within = (ends[-1] - ends[0]) / (12.0 * (2 * _PARTS) ** 2)
    means, moments = parts.mean(axis=0), centres @ parts / (2 * _PARTS) + within
    acts = np.minimum(np.arange(signals.rows) + signals.delay_cycles, signals.rows - 2)
    return means[acts], moments[acts]


def ln_cosh(x: Array) -> Array:
    """Return ln cosh x of any shape, the integral of tanh from 0 to x."""
    size = np.abs(x)
    return np.asarray(size + np.log1p(np.exp(-2.0 * np.minimum(size, _FAR))) - np.log(2.0))


def middles(x: Array) -> Array:
    """Return the arguments (2 _PARTS, N - 1) in the middle of each part."""
    return np.asarray(0.5 * (x[1:] + x[:-1]))


def at_rows(parts: Array) -> Array:
    """Return the values at rows (N,) of a force with these means of parts, behind a low-pass.

    The mean around a row of a wave of w is smaller than the wave by (w Ts)^2 / 24.
    """
    before, behind = parts[:_PARTS].mean(axis=0), parts[_PARTS:].mean(axis=0)
    means = 0.5 * (np.append(before, behind[-1]) + np.append(before[0], behind))
    slopes = (means[1:] - means[:-1]) / 24.0
    means[:-1] -= slopes
    means[1:] += slopes
    return np.asarray(means)
