"""Squared characteristic of an actuator that acts after its lag: propeller, fan, pump.

The speed of a propeller's motor follows the command with a lag, and the thrust is proportional to
the square of the speed (Fossen, *Handbook of Marine Craft Hydrodynamics and Motion Control*, 2011,
ch. 9): first the lag, then the square. `actuator_nonlinearity.py` has the other order. The lag is
the model's, or that of an effect at the same actuator. Signature: after a step of the
command the force changes with the lag when the speed begins at zero, sooner when it falls from a
large one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from .actuator_nonlinearity import SAME_FOR_ALL
from .base import Array, Effect, Places, Quantity, Signals, Term, on_coil, total
from .force_units import per_unit
from .lag_and_hysteresis_recursions import lagged_within, with_moment
from .operating_range import Extent

Square = Callable[[Array], tuple[Array, Array]]

_GAUSS = 3
"""Points of the integral over a period; the lagged command is an exponential between them."""
_LINEAR = "the part linear around the mean command: gain and lag; the mean: constant force"
_TOLD_APART = "steps of two sizes from several constant commands"
_SQUARES = {"squared": "a squared characteristic", "quadratic": "a quadratic nonlinearity"}
_KEY = re.compile(r"actuator\.quadratic_after_lag(?:\[([-+]?\d+\.?\d*(?:e[-+]?\d+)?)\])?")


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return both squares of every actuator; empty for the rig."""
    if places.beam:
        return []
    single = [
        _after(places, (c,), name, extent.mean_command(c) if name == "quadratic" else 0.0)
        for c in range(places.coils)
        for name in _SQUARES
    ]
    if places.coils == 1 or not places.one_command_unit:
        return single
    return [_after(places, range(places.coils), "squared", 0.0), *single]


def quadratic_after_lag(places: Places, key: str, where: Sequence[str]) -> Effect | None:
    """Return the quadratic one with a model file's key and location; None for other keys."""
    found = _KEY.fullmatch(key)
    if found is None or places.beam or len(where) != 1 or where[0] not in places.actuators:
        return None
    coil = places.actuators.index(where[0])
    return _after(places, (coil,), "quadratic", float(found[1] or 0.0))


def _after(places: Places, coils: Sequence[int], name: str, at: float) -> Effect:
    return Effect(
        f"actuator.{name}_after_lag" + (f"[{at:g}]" if at else ""),
        f"Actuator with {_SQUARES[name]} after its lag"
        + (places.worded(SAME_FOR_ALL) if len(coils) > 1 else ""),
        "actuator_nonlinearity",
        tuple(places.actuator(c) for c in coils),
        f"force = F_l + a {_square_in_words(name, at)}, F_l the command after the lag"
        + _mean_in_words(at),
        (Quantity("a", per_unit(places.command_unit(coils[0]), 1)),),
        partial(_after_lag, coils=coils, square=partial(_square, name=name, at=at)),
        absorbed_by=_LINEAR,
        told_apart_by=_TOLD_APART,
        before_lag=f"actuator.{name}" + (f"[{at:g}]" if at else ""),
    )


def _square_in_words(name: str, at: float) -> str:
    return "F_l |F_l|" if name == "squared" else "(F_l - F_m)^2" if at else "F_l^2"


def _mean_in_words(at: float) -> str:
    return f", F_m = {at:g}" if at else ""


def _after_lag(
    signals: Signals, _shape: Sequence[float], *, coils: Sequence[int], square: Square
) -> list[Term]:
    def held(F: Array) -> Array:
        if signals.lag_s <= 0.0:
            return square(F)[0]

        def before_the_lag(F_l: Array) -> Array:
            # The command S + tau S' is the square S after the model's lag; tau F_l' = F - F_l.
            S, slope = square(F_l)
            return S + slope * (F - F_l)

        return _over_periods(F, signals.lag_s, signals.Ts_s, before_the_lag)

    return [total([on_coil(signals, c, held(signals.coil[:, c])) for c in coils])]


def _over_periods(F: Array, tau_s: float, Ts_s: float, law: Callable[[Array], Array]) -> Array:
    """Return held commands (N,) that act as law(F lagged by tau_s) does between the rows."""
    nodes, weights = np.polynomial.legendre.leggauss(_GAUSS)
    values = [law(lagged_within(F, tau_s, Ts_s, 0.5 + 0.5 * node)) for node in nodes]
    mean, moment = np.stack([0.5 * weights, 0.25 * weights * nodes]) @ np.stack(values)
    return with_moment(mean, moment)


def _square(F: Array, *, name: str, at: float) -> tuple[Array, Array]:
    """Return the square of a command (N,) and its slope."""
    F = F - at
    size = np.abs(F) if name == "squared" else F
    return F * size, 2.0 * size
