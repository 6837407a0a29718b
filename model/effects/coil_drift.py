"""Drift of coils: force offset and force constant over time, force constant over heat.

A coil's heat follows the square of its current through a first-order lag, and its magnet weakens
with temperature (Sebastian, *Temperature effects on torque production of PM motors*, IEEE Trans.
Ind. Appl. 31, 1995). A platform that flies through a session has a load between records as well,
and was cold at the time `before` ahead of the first one; an actuator that rests between records
cools down there, and was cold when the first one began. Signature: a force error that depends on
the time since the session's begin, not on frequency. Thermal drift is proportional to the command
and recovers when the coil cools; the drift of an offset does not depend on the command and does not
recover.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_coil
from .force_units import per_unit
from .lag_and_hysteresis_recursions import heat

_WARM_S = 40.0
_BEFORE_S, _LONGEST_BEFORE_S = 3.0, 60.0
"""Time from lift-off to the first record: start value and upper bound."""
_LONG = "long records with the same excitation at begin and end of a session"


def effects(places: Places) -> list[Effect]:
    """Return drift of offset and gain of every coil, and of the common gain of all coils."""
    found = []
    every = tuple(range(places.coils))
    for coils in [*((c,) for c in every), *([every] if len(every) > 1 else [])]:
        where = tuple(places.actuator(c) for c in coils)
        unit = places.command_unit(coils[0])
        suffix = ", same for all coils" if len(coils) > 1 else ""
        if not suffix:
            found.append(
                Effect(
                    "force_offset.drift",
                    places.worded("Offset of a coil that drifts"),
                    "force_offset",
                    where,
                    "force = F + rate t, t from the session's begin",
                    (Quantity("rate", f"{unit}/s"),),
                    partial(_offset, coil=coils[0]),
                    absorbed_by="constant within a record: the record's constant force",
                    told_apart_by="long records",
                )
            )
        found.append(
            Effect(
                "thermal_drift.time",
                places.worded(f"Gain that drifts with time{suffix}"),
                "thermal_drift",
                where,
                "force = (1 - rate t) F, t from the session's begin",
                (Quantity("rate", "1/s"),),
                partial(_with_time, coils=coils),
                told_apart_by=_LONG,
            )
        )
        if len(coils) > 1 and not places.one_command_unit:
            continue  # one law of heat for all needs commands of one unit
        found.append(_heat(places, coils, suffix, rests=False))
        if not places.beam:
            found.append(_heat(places, coils, suffix, rests=True))
    return found


def _heat(places: Places, coils: tuple[int, ...], suffix: str, rests: bool) -> Effect:
    """Return the heat of coils that rest between records, or of such that do not."""
    title = "Gain that falls with the coil's heat"
    begin = "heat = 0 and F as in the first row from `before` the session's first record on"
    tau = Quantity("tau", "s", 0.5, 1000.0, log=True)
    before = Quantity("before", "s", 0.1, _LONGEST_BEFORE_S, log=True)
    if rests:
        title += ", with rests"
        begin = "heat = 0 at the session's begin, and F = 0 between its records"
    return Effect(
        "thermal_drift.heat" + ("_with_rests" if rests else ""),
        places.worded(title + suffix),
        "thermal_drift",
        tuple(places.actuator(c) for c in coils),
        f"force = (1 - a heat) F, heat' = (F^2 - heat) / tau; {begin}",
        (Quantity("a", per_unit(places.command_unit(coils[0]), 2)),),
        partial(_with_heat, coils=coils, rests=rests),
        (tau,) if rests else (tau, before),
        ((_WARM_S,) if rests else (_WARM_S, _BEFORE_S),),
        absorbed_by=places.worded("in thermal equilibrium: the coil's gain"),
        told_apart_by=_LONG,
    )


def _offset(signals: Signals, _shape: Sequence[float], *, coil: int) -> list[Term]:
    return [on_coil(signals, coil, signals.time_s)]


def _with_time(signals: Signals, _shape: Sequence[float], *, coils: tuple[int, ...]) -> list[Term]:
    return _held(signals, coils, [-signals.time_s * signals.coil[:, c] for c in coils])


def _with_heat(
    signals: Signals, shape: Sequence[float], *, coils: tuple[int, ...], rests: bool
) -> list[Term]:
    return _held(signals, coils, [_weakened(signals, c, rests, *shape) for c in coils])


def _weakened(
    signals: Signals, coil: int, rests: bool, tau_s: float, before_s: float = 0.0
) -> Array:
    F, begin = signals.coil[:, coil], carried(signals, coil, tau_s, before_s, rests)
    return -heat(F * F, tau_s, signals.Ts_s, begin) * F


def carried(
    signals: Signals, coil: int, tau_s: float, before_s: float, rests: bool = False
) -> float:
    """Return a coil's heat (its unit squared) at the record's begin, from the session before it.

    rests: whether there is no command between records.
    """
    begin_s, loads = float(signals.time_s[0]), signals.places.loads
    if loads is None and rests:
        return 0.0
    if loads is None:  # assume the record's median command since the session's begin
        since_s = max(float(signals.time_s[0]), 0.0) + before_s
        return float(np.median(signals.coil[:, coil])) ** 2 * -math.expm1(-since_s / tau_s)
    squares, begins_s = np.array(loads.squares)[:, coil], np.array(loads.times_s)
    ends_s = np.append(begins_s[1:], np.inf)
    begins_s[0] -= before_s
    if rests and loads.between:
        squares = np.where(loads.between, 0.0, squares)
    left = np.exp(np.minimum([begins_s - begin_s, ends_s - begin_s], 0.0) / tau_s)
    return float(squares @ (left[1] - left[0]))


def _held(signals: Signals, coils: tuple[int, ...], values: list[Array]) -> list[Term]:
    if len(coils) == 1:
        return [on_coil(signals, coils[0], values[0])]
    shape = signals.places.coil_shape
    held = np.zeros((signals.rows, shape.shape[1]))
    for c, value in zip(coils, values, strict=True):
        held += value[:, None] * shape[c]
    return [Term(held=held)]
