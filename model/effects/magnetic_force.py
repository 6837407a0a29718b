"""Magnetic force over current and gap: a magnet under a coil, a reluctance actuator.

A reluctance actuator attracts iron with (current / gap)^2. The force between a coil and a magnet on
its axis is proportional to the current and, at a distance, falls with the fourth power of the gap
(Furlani, *Permanent Magnet and Electromechanical Devices*, 2001, ch. 3 and 5). Iron at a distance
from a coil is attracted with the current squared and a power of the gap above two; the fourth
stands for these. Two magnets at both sides of what they carry, one of which gets the more current
as the other gets less, are an active magnetic bearing (Schweitzer and Maslen, *Magnetic Bearings*,
2009, ch. 4): its force is odd in current and position together, i x^2, i^2 x and x^3. The equation
is the force around a working point, without its constant and linear
part, because stiffness, gain and constant force of the model contain them. The key ends with the
working point [q_m,F_m], rounded means of position and command, and tells whether the gap opens or
closes with q. y0 is the gap and i0 the current at the working point; c is the force there.
Signature: a force that depends on position and command together: the stiffness changes with the
command, and the gain with the position. A nonlinear stiffness does not change with the command.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof
from .lag_and_hysteresis_recursions import lagged_mean
from .operating_range import EXCURSION, Extent

_LAWS = {"i2_y2": (2, 2), "i1_y4": (1, 4), "i2_y4": (2, 4)}
"""Exponents of current and gap of each law."""
_DIFFERENTIAL = "differential"
"""The law of two magnets, at both sides."""
SIGNS = {"opens": 1.0, "closes": -1.0}
_KEY = re.compile(
    r"magnetic_force\.(?P<law>\w+)\.(?P<way>\w+)\[(?P<at>[0-9.e+-]+),(?P<command>[0-9.e+-]+)\]"
)
GAPS, GAP_BOUNDS = (1.5, 4.0), (1.2, 10.0)
_CURRENTS, _CURRENT_BOUNDS = (0.7, 3.0), (0.1, 6.0)
"""Start values and bounds of y0 and i0, over the largest excursion of position and command.

With a longer gap and a larger current, the equation would be that of a quadratic stiffness.
"""
_LEAST_GAP = 0.05
"""During a fit, simulated poses can exceed the measured range: least gap over y0."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the magnetic forces of every actuator on every DOF; empty for the rig.

    With as many actuators as DOF, each acts on its own DOF only.
    """
    if places.beam:
        return []
    n = len(places.dof)
    pairs = [(i, c) for i in range(n) for c in range(places.coils) if places.coils != n or i == c]
    return [
        _force(places, extent, i, c, law, way, (extent.around(i), extent.mean_command(c)))
        for i, c in pairs
        for law in (*_LAWS, _DIFFERENTIAL)
        for way in SIGNS
    ]


def magnetic_force_effect(
    places: Places, extent: Extent, key: str, where: Sequence[str]
) -> Effect | None:
    """Return the magnetic force with a model file's key and location; None for other keys."""
    found = _KEY.fullmatch(key)
    if (
        found is None
        or found["law"] not in (*_LAWS, _DIFFERENTIAL)
        or found["way"] not in SIGNS
        or places.beam
    ):
        return None
    if len(where) != 2 or where[0] not in places.dof or where[1] not in places.actuators:
        return None
    try:
        at = float(found["at"]), float(found["command"])
    except ValueError:
        return None
    dof, coil = places.dof.index(where[0]), places.actuators.index(where[1])
    return _force(places, extent, dof, coil, found["law"], found["way"], at)


def _force(
    places: Places,
    extent: Extent,
    dof: int,
    coil: int,
    law: str,
    way: str,
    at: tuple[float, float],
) -> Effect:
    force, unit, largest = places.force_unit(dof), places.dof_units[dof], extent.reach[dof]
    largest *= EXCURSION
    command = EXCURSION * extent.command_spread(coil)
    least, most = GAP_BOUNDS
    y0 = Quantity("y0", unit, least * largest, most * largest, log=True)
    least, most = _CURRENT_BOUNDS
    i0 = Quantity("i0", places.command_unit(coil), least * command, most * command, log=True)
    plus, minus = ("+", "-") if way == "opens" else ("-", "+")
    if law == _DIFFERENTIAL:
        name = f"Magnetic force of two magnets, gap of the first {way} with the position"
        ratio = f"(((i0 + i) / (y0 {plus} y))^2 - ((i0 - i) / (y0 {minus} y))^2) (y0 / i0)^2 / 4"
        build = partial(_of_two_magnets, dof=dof, coil=coil, sign=SIGNS[way], at=at)
    else:
        a, b = _LAWS[law]
        name = f"Magnetic force, current^{a} over gap^{b}, gap {way} with the position"
        current = f"(i0 {'+' if at[1] >= 0.0 else '-'} i)"
        ratio = f"({current} / i0)^{a} (y0 / (y0 {plus} y))^{b}"
        build = partial(_magnetic, dof=dof, coil=coil, law=law, sign=SIGNS[way], at=at)
    return Effect(
        f"magnetic_force.{law}.{way}[{at[0]:g},{at[1]:g}]",
        name,
        "magnetic_force",
        (places.dof[dof], places.actuator(coil)),
        f"force = c ({ratio}, less its linear part); y = q - q_m, i = F - F_m",
        (Quantity("c", force),),
        build,
        (y0, i0),
        tuple((y * largest, i * command) for y in GAPS for i in _CURRENTS),
        absorbed_by="the linear part: stiffness, gain and constant force",
        told_apart_by="excitation at several positions and mean commands",
    )


def _magnetic(
    signals: Signals,
    shape: Sequence[float],
    *,
    dof: int,
    coil: int,
    law: str,
    sign: float,
    at: tuple[float, float],
) -> list[Term]:
    a, b = _LAWS[law]
    x = sign * (signals.q[:, dof] - at[0]) / shape[0]
    r = (1.0 if at[1] >= 0.0 else -1.0) * (_current(signals, coil) - at[1]) / shape[1]
    pull = signals.acting((1 + r) ** a)
    force = pull * over_gap(x, b) - 1 - a * signals.acting(r) + b * x
    return [on_dof(signals, dof, force)]


def _of_two_magnets(
    signals: Signals,
    shape: Sequence[float],
    *,
    dof: int,
    coil: int,
    sign: float,
    at: tuple[float, float],
) -> list[Term]:
    x = sign * (signals.q[:, dof] - at[0]) / shape[0]
    r = (_current(signals, coil) - at[1]) / shape[1]
    pulls = (signals.acting((1 + way * r) ** 2) * over_gap(way * x, 2) for way in (1, -1))
    first, second = pulls
    return [on_dof(signals, dof, 0.25 * (first - second) - signals.acting(r) + x)]


def over_gap(x: Array, power: int) -> Array:
    """Return (y0 / gap)^power at deflections x (N,) over y0."""
    return np.asarray(np.maximum(1 + x, _LEAST_GAP) ** -float(power))


def _current(signals: Signals, coil: int) -> Array:
    """Return a command (N,) after the lag, held over each period.

    What is not linear in it acts as the mean of its power over the periods around a row, not as the
    power of the mean: a noisy loop moves its command from row to row.
    """
    held = signals.coil[:, coil]
    if signals.lag_s > 0.0:
        held = lagged_mean(held, signals.lag_s, signals.Ts_s)
    return held
