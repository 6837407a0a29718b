"""Free-form resonant response to a motion: a second-order filter of unknown cause.

An object that hangs, swings or flows near the platform responds to a DOF's motion with a force on
the same or another DOF. The rig's base responds to the beam's motion with a force on a DOF or, if a
sensor's holder moves along, with a reading error. Like the forms in `freeform` it does not name a
cause: it gives motion, location, frequency and damping.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof, on_sensor
from .lag_and_hysteresis_recursions import smooth_oscillator

_PREFIX = "unknown.answer."
_BEAM, _ARM = "x_b", "x_b*x_b"
"""Motion x_b, without and with x_b as the arm of the force (a force that acts at the beam)."""
_FREQUENCIES_HZ = (6.0, 12.0, 24.0, 48.0)
_BEAM_FREQUENCIES_HZ = tuple(2.0 ** (0.5 * k) for k in range(11))
"""A rig's base has low resonance frequencies, near those of the DOFs."""
_DAMPING, _LOW_DAMPING = 0.15, 0.04
"""Damping ratios to start from: one so large that neighbouring grid frequencies overlap, and one of
a base on springs."""


def filtered_response_effects(places: Places) -> list[Effect]:
    """Return responses of every DOF to every DOF, and of every DOF and sensor to the beam."""
    found = [_answer(places, motion, dof) for motion in places.dof for dof in places.dof]
    if places.beam:
        found += [_answer(places, _BEAM, where) for where in (*places.dof, *_sensors(places))]
        found += [_answer(places, _ARM, dof) for dof in places.dof]
    return found


def filtered_response_effect(places: Places, key: str, where: Sequence[str]) -> Effect | None:
    """Return the resonant response with a model file's key and location; None for other keys."""
    motion = key.removeprefix(_PREFIX)
    if motion == key or len(where) != 1:
        return None
    known = list(places.dof) if motion in (*places.dof, _BEAM, _ARM) else []
    if motion in (_BEAM, _ARM) and not places.beam:
        return None
    known += _sensors(places) if motion == _BEAM else []
    return _answer(places, motion, where[0]) if where[0] in known else None


def filtered_response_signal(effect: Effect) -> str | None:
    """Return the motion that causes the response, a DOF or x_b; None for other effects."""
    motion = effect.key.removeprefix(_PREFIX)
    return None if motion == effect.key else motion.partition("*")[0]


def _sensors(places: Places) -> list[str]:
    return [f"sensor:{s}" for s in range(places.sensors)]


def _answer(places: Places, motion: str, where: str) -> Effect:
    by_beam, arm = motion in (_BEAM, _ARM), motion == _ARM
    motion = _BEAM if by_beam else motion
    of = "m" if by_beam else places.dof_units[places.dof.index(motion)]
    if where in places.dof:
        what, per = "Force", places.force_unit(places.dof.index(where))
        build = partial(_forces, motion=motion, dof=places.dof.index(where), arm=arm)
    else:
        what, per = "Reading", places.sensor_unit
        build = partial(_readings, motion=motion, sensor=int(where.partition(":")[2]))
    grid = tuple((f, _DAMPING) for f in _FREQUENCIES_HZ)
    if by_beam:
        grid = tuple((f, zeta) for f in _BEAM_FREQUENCIES_HZ for zeta in (_DAMPING, _LOW_DAMPING))
    per_of = f"{of}^2" if arm else of
    unit = "1" if per == per_of else f"{per}/{per_of}"
    swung = f"a (x - {motion}) + b x'/w"
    equation = f"x_b ({swung})" if arm else swung
    return Effect(
        _PREFIX + (_ARM if arm else motion),
        f"{what} with a resonant response to {motion}" + (", times x_b" if arm else ""),
        "unknown",
        (where,),
        f"{equation}, x'' + 2 zeta w x' + w^2 x = w^2 {motion}; w = 2 pi frequency, zeta = damping",
        (Quantity("a", unit), Quantity("b", unit)),
        build,
        (
            Quantity("frequency", "Hz", 0.5 if by_beam else 1.0, 300.0, log=True),
            Quantity("damping", "1", 1e-3, 0.7, log=True),
        ),
        grid,
        told_apart_by=f"{motion} {'moved' if by_beam else 'excited'} alone, up to its frequency",
    )


def _forces(
    signals: Signals, shape: Sequence[float], *, motion: str, dof: int, arm: bool
) -> list[Term]:
    by = signals.x_b_m if arm else 1.0
    return [on_dof(signals, dof, by * x) for x in _filtered(signals, shape, motion)]


def _readings(signals: Signals, shape: Sequence[float], *, motion: str, sensor: int) -> list[Term]:
    return [on_sensor(signals, sensor, x) for x in _filtered(signals, shape, motion)]


def _filtered(signals: Signals, shape: Sequence[float], motion: str) -> tuple[Array, Array]:
    """Return the filter's position minus its input, and its speed over w (N,)."""
    w = 2 * np.pi * shape[0]
    q = signals.x_b_m if motion == _BEAM else signals.q[:, signals.places.dof.index(motion)]
    x, rate = smooth_oscillator(w * w * q, shape[0], shape[1], signals.Ts_s).T
    return x - q, rate / w
