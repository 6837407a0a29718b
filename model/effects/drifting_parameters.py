"""Mass, damping, stiffness and friction that change over a session.

A spool fills and a tank drains, rubber creeps and a belt stretches: a term of the model changes at
a constant rate. Grease and bearings rub more while they are cold, by an excess that fades with one
time constant (Olsson et al., *Friction models and friction compensation*, European Journal of
Control 4, 1998, section 2; Simoni et al., *Friction modeling with temperature effects for
industrial robot manipulators*, IROS 2015). Signature: the same motion needs another force later. A
drifting gain of the only actuator, in contrast, changes all terms of a model in one proportion.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_dof
from .friction import direction, turning_speed
from .operating_range import Extent

_TERMS = (
    ("inertia", "Mass", "q''", " s^2"),
    ("damping", "Damping", "q'", " s"),
    ("stiffness", "Stiffness", "q", ""),
)
_SHORTEST, _LONGEST = 0.01, 3.0
"""Time constants over the length of the session: shorter ones show in a few blocks of it only,
longer ones are a constant rate."""
_STARTS = (0.1, 0.5)
_TYPICAL_S = 60.0
_LATER = "the same excitation at the begin and the end of a session"


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the drifts of every DOF; empty for the rig."""
    if places.beam:
        return []
    n = range(len(places.dof))
    found = [_drift(places, i, *term) for i in n for term in _TERMS]
    session_s = max((end for _, end in extent.spans_s), default=_TYPICAL_S)
    tau = Quantity("tau", "s", _SHORTEST * session_s, _LONGEST * session_s, log=True)
    starts_s = tuple(share * session_s for share in _STARTS)
    for i in n:
        found += [
            _warming_damping(places, i, tau, starts_s),
            _warming_friction(places, extent, i, tau, starts_s),
        ]
    return found


def _drift(places: Places, i: int, name: str, title: str, of: str, time: str) -> Effect:
    unit = places.dof_units[i]
    return Effect(
        f"{name}.drift",
        f"{title} that changes with time",
        name,
        (places.dof[i],),
        f"force = -rate t {of}, t from the session's begin",
        (Quantity("rate", f"{places.force_unit(i)}{time}/{unit}/s"),),
        partial(_in_time, name=name, dof=i),
        absorbed_by="all at one rate: a gain of the actuator that drifts",
        told_apart_by=_LATER,
    )


def _warming_damping(places: Places, i: int, tau: Quantity, starts_s: tuple[float, ...]) -> Effect:
    return Effect(
        "damping.warming",
        "Damping that changes as it warms",
        "damping",
        (places.dof[i],),
        "force = -excess exp(-t / tau) q', t from the session's begin",
        (Quantity("excess", f"{places.force_unit(i)} s/{places.dof_units[i]}"),),
        partial(_fading_damping, dof=i),
        (tau,),
        tuple((start_s,) for start_s in starts_s),
        absorbed_by="in thermal equilibrium: damping",
        told_apart_by=_LATER,
    )


def _warming_friction(
    places: Places, extent: Extent, i: int, tau: Quantity, starts_s: tuple[float, ...]
) -> Effect:
    force, unit, speed = places.force_unit(i), places.dof_units[i], extent.speed[i]
    return Effect(
        "friction.warming",
        "Dry friction that changes as it warms",
        "friction",
        (places.dof[i],),
        "force = -(friction + excess exp(-t / tau)) tanh(q'/v_s), t from the session's begin",
        (Quantity("friction", force, 0.0), Quantity("excess", force)),
        partial(_fading_friction, dof=i),
        (turning_speed(unit, speed), tau),
        tuple((0.02 * speed, start_s) for start_s in starts_s),
        absorbed_by="in thermal equilibrium: Coulomb friction",
        told_apart_by=_LATER,
        contains={"friction.coulomb": _without_excess},
    )


def _in_time(signals: Signals, _shape: Sequence[float], *, name: str, dof: int) -> list[Term]:
    motion = {"inertia": signals.qdd, "damping": signals.qd, "stiffness": signals.q}[name]
    return [on_dof(signals, dof, -signals.time_s * motion[:, dof])]


def _fading_damping(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    fading = np.exp(-signals.time_s / shape[0])
    return [on_dof(signals, dof, -fading * signals.qd[:, dof])]


def _fading_friction(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    v_s, tau_s = shape
    level = -direction(signals, dof, v_s)
    fading = np.exp(-signals.time_s / tau_s)
    return [on_dof(signals, dof, level), on_dof(signals, dof, fading * level)]


def _without_excess(shape: Sequence[float]) -> tuple[float, ...]:
    return tuple(shape[:1])
