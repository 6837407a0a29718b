"""Squared characteristic of an actuator that acts after its lag: propeller, fan, pump.

The speed of a propeller's motor follows the command with a lag, and the thrust is proportional to
the square of the speed (Fossen, *Handbook of Marine Craft Hydrodynamics and Motion Control*, 2011,
ch. 9): first the lag, then the square. `actuator_nonlinearity.py` has the other order. The lag is
the model's, if it has one; else it is a parameter of the effect. Signature: after a step of the
command the force changes with the lag when the speed begins at zero, sooner when it falls from a
large one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_coil
from .force_units import per_unit
from .lag_and_hysteresis_recursions import (
    lagged_mean,
    lagged_moment,
    lagged_within,
    with_moment,
)
from .operating_range import Extent

_GAUSS = 3
"""Points of the integral over a period; the lagged command is an exponential between them."""
_STARTS_S = (0.01, 0.03, 0.1)
_LINEAR = "the part linear around the mean command: gain and lag; the mean: constant force"
_TOLD_APART = "steps of two sizes from several constant commands"
_LAWS = (
    ("squared", "a squared characteristic", "F_l |F_l|"),
    ("quadratic", "a quadratic nonlinearity", "F_l^2"),
)


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return both squares of every actuator, with the lag that is known; empty for the rig."""
    if places.beam:
        return []
    found = []
    for c in range(places.coils):
        amplitude = Quantity("a", per_unit(places.command_unit(c), 1))
        for name, words, square in _LAWS:
            if extent.lagging is not False:
                found.append(
                    Effect(
                        f"actuator.{name}_after_lag",
                        f"Actuator with {words} after its lag",
                        "actuator_nonlinearity",
                        (places.actuator(c),),
                        f"force = F_l + a {square}, F_l the command after the model's lag",
                        (amplitude,),
                        partial(_after_lag, coil=c, signed=name == "squared"),
                        absorbed_by=_LINEAR,
                        told_apart_by=_TOLD_APART,
                    )
                )
            if not extent.lagging:
                found.append(
                    Effect(
                        f"actuator.{name}_with_lag",
                        f"Actuator with a lag and {words} after it",
                        "actuator_nonlinearity",
                        (places.actuator(c),),
                        "force = F + (F_l - F) lag / tail + "
                        f"a {square}, F_l the command lagged by tail",
                        (Quantity("lag", "s", -extent.late_s), amplitude),
                        partial(_with_lag, coil=c, signed=name == "squared"),
                        (Quantity("tail", "s", 1e-4, 1.0, log=True),),
                        tuple((start,) for start in _STARTS_S),
                        absorbed_by=_LINEAR,
                        told_apart_by=_TOLD_APART,
                        contains={f"actuator.{name}": _without_lag, "actuator_lag": tuple},
                    )
                )
    return found


def _after_lag(signals: Signals, _shape: Sequence[float], *, coil: int, signed: bool) -> list[Term]:
    F, tau_s = signals.coil[:, coil], signals.lag_s
    if tau_s <= 0.0:
        return [on_coil(signals, coil, _square(F, signed))]

    def before_the_lag(F_l: Array) -> Array:
        # The command S + tau S' is F_l |F_l| = S after the model's lag; tau F_l' = F - F_l.
        slope = 2.0 * (np.abs(F_l) if signed else F_l)
        return _square(F_l, signed) + slope * (F - F_l)

    return [on_coil(signals, coil, _over_periods(F, tau_s, signals.Ts_s, before_the_lag))]


def _with_lag(signals: Signals, shape: Sequence[float], *, coil: int, signed: bool) -> list[Term]:
    F, tail_s, Ts_s = signals.coil[:, coil], shape[0], signals.Ts_s
    late = with_moment(lagged_mean(F, tail_s, Ts_s), lagged_moment(F, tail_s, Ts_s))
    squares = _over_periods(F, tail_s, Ts_s, partial(_square, signed=signed))
    return [on_coil(signals, coil, (late - F) / tail_s), on_coil(signals, coil, squares)]


def _without_lag(_shape: Sequence[float]) -> tuple[float, ...]:
    return ()


def _over_periods(F: Array, tau_s: float, Ts_s: float, law: Callable[[Array], Array]) -> Array:
    """Return held commands (N,) that act as law(F lagged by tau_s) does between the rows."""
    nodes, weights = np.polynomial.legendre.leggauss(_GAUSS)
    values = [law(lagged_within(F, tau_s, Ts_s, 0.5 + 0.5 * node)) for node in nodes]
    mean, moment = np.stack([0.5 * weights, 0.25 * weights * nodes]) @ np.stack(values)
    return with_moment(mean, moment)


def _square(F: Array, signed: bool) -> Array:
    return F * (np.abs(F) if signed else F)
