"""Additional lag and delay of single coils: a slower current loop, a valve, a delayed command.

The equations use the mean of the force over each period, and its moment: a force that acts late in
a period gives less way. In the mean, the responses of a first-order lag and of a delay of a
fraction of a period to a held command differ only after the first period (Franklin, Powell,
Workman, *Digital Control of Dynamic Systems*, 1998, ch. 4). Lateness (`lag`, `delay`) and duration
of the error (`tail`, `back`) are separate parameters; for a plain lag or delay they are equal. A
coil can be faster than the others by at most the declared lag and delay. A servo valve and a
current loop with an integrator are of second order (Merritt, *Hydraulic Control Systems*, 1967,
ch. 7): they ring, and far below their frequency are late by 2 damping / (2 pi frequency).
Signature: a force error
proportional to the rate of change of one coil's command, so it grows with frequency and is zero for
a constant command. A gain error does not grow with frequency.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_coil
from .lag_and_hysteresis_recursions import lagged_mean, lagged_moment, resonant, with_moment
from .operating_range import Extent

_ONE_BY_ONE = "excitation of the coils one by one, up to high frequencies"
_SECOND = "a second sensor or another source of force"
_LAGS = "same for all coils: the declared lag; shorter than a period: delay"
_DELAYS = "same for all coils: the declared delay; shorter than a period: lag"
_LATE_S = 2e-3
_LATEST_S, _LATEST_PERIODS = 0.1, 40.0
"""Longest delay or lag in s, and in periods of the highest frequency; the longer of both counts."""
_APART = 2.0
"""Ratio of neighbouring start values of a delay."""
_DAMPING, _MOST_DAMPING = 0.7, 3.0
"""Damping ratio of a second-order lag to start from, and the largest one: above it is of first
order."""
_OVER_BAND = (0.5, 1.0, 2.0, 4.0)
"""Start values of a second-order lag's frequency over the highest one without aliasing."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return lag and delay of every coil."""
    found = []
    # In a linear plant of one input and one output the order of its parts does not show.
    single = not places.beam and places.coils == places.sensors == len(places.dof) == 1
    for c in range(places.coils):
        where = (places.actuator(c),)
        found += [
            Effect(
                "actuator_lag",
                places.worded("Additional lag of a coil"),
                "actuator_lag",
                where,
                "force = F + (F lagged by tail - F) lag / tail",
                (Quantity("lag", "s", -extent.late_s),),
                partial(_lag, coil=c),
                (Quantity("tail", "s", 1e-4, latest_s(places, extent), log=True),),
                late_starts(places, extent),
                absorbed_by=places.worded(_LAGS),
                told_apart_by=_SECOND if single else places.worded(_ONE_BY_ONE),
                equal_numbers=("lag", "tail"),
                same_if_linear=("reading.lag",) if single else (),
            ),
            Effect(
                "delay",
                places.worded("Additional delay of a coil"),
                "delay",
                where,
                "force = F + (F(t - back) - F) delay / back, by means over each period",
                (Quantity("delay", "s", -extent.late_s),),
                partial(_delay, coil=c),
                (Quantity("back", "s", 1e-4, latest_s(places, extent), log=True),),
                late_starts(places, extent),
                absorbed_by=places.worded(_DELAYS),
                told_apart_by=_SECOND if single else places.worded(_ONE_BY_ONE),
                equal_numbers=("delay", "back"),
                same_if_linear=("reading.delay",) if single else (),
            ),
        ]
        if not places.beam:
            found.append(_of_second_order(places, extent, c))
    return found


def latest_s(places: Places, extent: Extent) -> float:
    """Return the longest delay or lag in s that is looked for, longer in records of slow plants."""
    if places.beam or not math.isfinite(extent.fastest_hz):
        return _LATEST_S
    return max(_LATEST_S, _LATEST_PERIODS / extent.fastest_hz)


def late_starts(places: Places, extent: Extent) -> tuple[tuple[float, ...], ...]:
    """Return start values of a delay or lag, farther apart the longer they are."""
    if places.beam:
        return ((_LATE_S,),)
    last = latest_s(places, extent)
    count = math.ceil(math.log(last / _LATE_S) / math.log(_APART))
    return tuple((_LATE_S * _APART**k,) for k in range(max(count, 1)))


def _of_second_order(places: Places, extent: Extent, coil: int) -> Effect:
    highest_hz = 2.0 * max(_OVER_BAND) * extent.highest_hz
    return Effect(
        "actuator_lag.second_order",
        places.worded("Second-order lag of a coil"),
        "actuator_lag",
        (places.actuator(coil),),
        "force = F + depth (f - F), f'' + 2 damping w f' + w^2 f = w^2 F; w = 2 pi frequency",
        (Quantity("depth", "1"),),
        partial(_second_order, coil=coil),
        (
            Quantity("frequency", "Hz", extent.slowest_hz, highest_hz, log=True, corner=True),
            Quantity("damping", "1", 1e-3, _MOST_DAMPING, log=True),
        ),
        tuple((share * extent.highest_hz, _DAMPING) for share in _OVER_BAND),
        absorbed_by=places.worded(_LAGS),
        told_apart_by=places.worded(_ONE_BY_ONE),
        whole=True,
        shape_of_unit_amplitude=None if places.beam else _whole_second_order,
    )


def _whole_second_order(depth: Sequence[float], shape: Sequence[float]) -> tuple[float, ...]:
    """Return frequency and damping of a lag of depth 1 that is as late, and bends as much."""
    root = math.sqrt(depth[0]) if depth[0] > 0.0 else 1.0
    return shape[0] / root, shape[1] * root


def _lag(signals: Signals, shape: Sequence[float], *, coil: int) -> list[Term]:
    F = signals.coil[:, coil]
    late = with_moment(
        lagged_mean(F, shape[0], signals.Ts_s), lagged_moment(F, shape[0], signals.Ts_s)
    )
    return [on_coil(signals, coil, (late - F) / shape[0])]


def _second_order(signals: Signals, shape: Sequence[float], *, coil: int) -> list[Term]:
    F, (frequency, damping) = signals.coil[:, coil], shape
    late = with_moment(*resonant(F, frequency, damping, signals.Ts_s))
    return [on_coil(signals, coil, late - F)]


def _delay(signals: Signals, shape: Sequence[float], *, coil: int) -> list[Term]:
    F = signals.coil[:, coil]
    whole, share = divmod(shape[0] / signals.Ts_s, 1.0)
    # The mean of delayed held commands over a period is a weighted sum of two commands.
    before = np.arange(len(F)) - int(whole)
    new, old = F[np.maximum(before, 0)], F[np.maximum(before - 1, 0)]
    mean = (1 - share) * new + share * old
    late = with_moment(mean, 0.5 * share * (1 - share) * (new - old))
    return [on_coil(signals, coil, (late - F) / shape[0])]
