"""Linear terms that a model lacks: entries of M, D, K and B that are zero or held at a wrong value.

A centre of mass that is not where the coordinates begin couples two DOF by inertia, a spring or
damper beside both axes by stiffness or damping, a turning rotor by a gyroscopic force that does no
work; matrices of the others are symmetric (Meirovitch, *Fundamentals of Vibrations*, 2001, ch. 7;
Genta, *Dynamics of Rotating Systems*, 2005). An input with a wrong lever acts otherwise on one DOF
than declared. Signature: a force in proportion to one signal, at any amplitude. What a free
parameter of the model explains is none of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import combinations

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_dof
from .force_units import ratio
from .lag_and_hysteresis_recursions import lagged_mean

_AMPLITUDES = "two amplitudes of excitation: a nonlinear law has another share at each"
_TERMS = (
    ("inertia", "Inertia", "m", "q''", " s^2"),
    ("damping", "Linear damping", "d", "q'", " s"),
    ("stiffness", "Linear stiffness", "k", "q", ""),
)
_GYROSCOPIC = "gyroscopic"


def effects(places: Places) -> list[Effect]:
    """Return the entries of every DOF, pair of DOF, and input; none for the rig, which declares its
    own."""
    if places.beam:
        return []
    n = len(places.dof)
    found = [_term(places, i, i, *term) for i in range(n) for term in _TERMS]
    for i, j in combinations(range(n), 2):
        # Damping across two DOF is among the laws of damping.
        found += [_term(places, i, j, *term) for term in _TERMS if term[0] != "damping"]
        found.append(_gyroscopic(places, i, j))
    if n > 1 or places.coils > 1:
        found += [_input(places, i, c) for i in range(n) for c in range(places.coils)]
    return found


def _term(
    places: Places, i: int, j: int, name: str, title: str, symbol: str, of: str, time: str
) -> Effect:
    alone, force = i == j, places.force_unit(i)
    return Effect(
        f"linear.{name}" if alone else f"linear.{name}_across",
        f"{title} that the model lacks" if alone else f"{title} across two DOFs",
        f"linear_{name}",
        (places.dof[i],) if alone else (places.dof[i], places.dof[j]),
        f"force = -{symbol} {of}" + ("" if alone else f", {of} of the other DOF"),
        (Quantity(symbol, f"{force}{time}/{places.dof_units[j]}"),),
        partial(_proportional, name=name, pair=(i, j)),
        absorbed_by="a free entry of the model at the same place",
        told_apart_by=_AMPLITUDES if alone else "excitation of both DOFs, one at a time",
        linear=True,
        exact=True,
    )


def _gyroscopic(places: Places, i: int, j: int) -> Effect:
    return Effect(
        f"linear.{_GYROSCOPIC}",
        "Gyroscopic coupling",
        _GYROSCOPIC,
        (places.dof[i], places.dof[j]),
        "force = -g q' of the second at the first, g q' of the first at the second",
        (Quantity("g", f"{places.force_unit(i)} s/{places.dof_units[j]}"),),
        partial(_proportional, name=_GYROSCOPIC, pair=(i, j)),
        absorbed_by="a free entry of the model at the same place",
        told_apart_by="excitation of both DOFs, one at a time",
        linear=True,
        exact=True,
    )


def _input(places: Places, dof: int, coil: int) -> Effect:
    return Effect(
        "linear.input",
        "Lever of an input",
        "input_lever",
        (places.dof[dof], places.actuator(coil)),
        "force = b u at this DOF, u the command as it acts",
        (Quantity("b", ratio(places.force_unit(dof), places.command_unit(coil))),),
        partial(_of_input, dof=dof, coil=coil),
        absorbed_by="a free entry of B at the same place",
        told_apart_by="a known inertia of this DOF: levers of all inputs scale with it",
        linear=True,
        exact=True,
    )


def _proportional(
    signals: Signals, _shape: Sequence[float], *, name: str, pair: tuple[int, int]
) -> list[Term]:
    i, j = pair
    of = {"inertia": signals.qdd, "stiffness": signals.q}.get(name, signals.qd)
    force = np.zeros_like(of)
    force[:, j] = of[:, i] if name == _GYROSCOPIC else -of[:, i]
    force[:, i] = -of[:, j]
    return [Term(force=force)]


def _of_input(signals: Signals, _shape: Sequence[float], *, dof: int, coil: int) -> list[Term]:
    held = signals.coil[:, coil]
    if signals.lag_s > 0.0:
        held = lagged_mean(held, signals.lag_s, signals.Ts_s)
    now = np.arange(signals.rows) - signals.delay_cycles
    before, after, next_one, last = (
        held[np.clip(now + k, 0, signals.rows - 1)] for k in (-1, 0, 1, -2)
    )
    # What a held command is at a row, below half the rate: its steps have images above.
    middle = (13.0 * (before + after) - (next_one + last)) / 24.0
    return [on_dof(signals, dof, middle)]
