"""Mass, damping, stiffness and friction that change over a session.

A spool fills and a tank drains, grease and seals warm up, rubber creeps and a belt stretches. What
changes at a constant rate is a term of the model times the session's time. Friction falls towards
that of a warm bearing as its heat does, in one time constant (Olsson et al., *Friction models and
friction compensation*, European Journal of Control 4, 1998, section 2; Simoni et al., *Friction
modeling with temperature effects for industrial robot manipulators*, IROS 2015). Signature: the
same motion needs another force later. A gain of the only actuator that drifts changes all terms of
a model in one proportion.
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
        found += [_grease(places, i, tau, starts_s), _bearing(places, extent, i, tau, starts_s)]
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


def _grease(places: Places, i: int, tau: Quantity, starts_s: tuple[float, ...]) -> Effect:
    return Effect(
        "damping.warming",
        "Damping that changes as it warms",
        "damping",
        (places.dof[i],),
        "force = -cold exp(-t / tau) q', t from the session's begin",
        (Quantity("cold", f"{places.force_unit(i)} s/{places.dof_units[i]}"),),
        partial(_cooling, dof=i),
        (tau,),
        tuple((start_s,) for start_s in starts_s),
        absorbed_by="in thermal equilibrium: damping",
        told_apart_by=_LATER,
    )


def _bearing(
    places: Places, extent: Extent, i: int, tau: Quantity, starts_s: tuple[float, ...]
) -> Effect:
    force, unit, speed = places.force_unit(i), places.dof_units[i], extent.speed[i]
    return Effect(
        "friction.warming",
        "Dry friction that changes as it warms",
        "friction",
        (places.dof[i],),
        "force = -(friction + cold exp(-t / tau)) tanh(q'/v_s), t from the session's begin",
        (Quantity("friction", force, 0.0), Quantity("cold", force)),
        partial(_warm, dof=i),
        (turning_speed(unit, speed), tau),
        tuple((0.02 * speed, start_s) for start_s in starts_s),
        absorbed_by="in thermal equilibrium: Coulomb friction",
        told_apart_by=_LATER,
        contains={"friction.coulomb": _cold},
    )


def _in_time(signals: Signals, _shape: Sequence[float], *, name: str, dof: int) -> list[Term]:
    motion = {"inertia": signals.qdd, "damping": signals.qd, "stiffness": signals.q}[name]
    return [on_dof(signals, dof, -signals.time_s * motion[:, dof])]


def _cooling(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    fading = np.exp(-signals.time_s / shape[0])
    return [on_dof(signals, dof, -fading * signals.qd[:, dof])]


def _warm(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    v_s, tau_s = shape
    level = -direction(signals, dof, v_s)
    fading = np.exp(-signals.time_s / tau_s)
    return [on_dof(signals, dof, level), on_dof(signals, dof, fading * level)]


def _cold(shape: Sequence[float]) -> tuple[float, ...]:
    return tuple(shape[:1])
