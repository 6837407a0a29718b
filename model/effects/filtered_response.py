"""What answers a motion with a resonance: linear dynamics of which nobody knows the cause.

What hangs, swings or flows beside the platform takes up its motion and gives it back later, of one
DOF or between two. What the rig stands on takes up the beam's, as a force on a DOF or, where a
sensor's holder swings along, as a false reading. A free form as those of `freeform`: it names
nothing. It says which motion is answered where, at what frequency and how sharply.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof, on_sensor
from .recursions import oscillator

_PREFIX = "unknown.answer."
_BEAM, _ARM = "x_b", "x_b*x_b"
"""What the beam moves, and the same with the beam's place for an arm: the beam feels it too."""
_FREQUENCIES_HZ = (6.0, 12.0, 24.0, 48.0)
_OF_BEAM_HZ = tuple(2.0 ** (0.5 * k) for k in range(11))
"""A rig's table swings slowly, where springs and loops of a DOF are, and rings after every move."""
_DAMPING, _SHARP = 0.15, 0.04
"""Broad enough that a resonance between two frequencies of the grid is seen from both, and one that
rings on where a table is on springs."""


def answers(places: Places) -> list[Effect]:
    """Return answers of every DOF to every DOF, and of every DOF and sensor to the beam."""
    found = [_answer(places, motion, dof) for motion in places.dof for dof in places.dof]
    if places.beam:
        found += [_answer(places, _BEAM, where) for where in (*places.dof, *_sensors(places))]
        found += [_answer(places, _ARM, dof) for dof in places.dof]
    return found


def answer(places: Places, key: str, where: Sequence[str]) -> Effect | None:
    """Return the answer that a model file names by key and place; None if it is none."""
    motion = key.removeprefix(_PREFIX)
    if motion == key or len(where) != 1:
        return None
    known = list(places.dof) if motion in (*places.dof, _BEAM, _ARM) else []
    if motion in (_BEAM, _ARM) and not places.beam:
        return None
    known += _sensors(places) if motion == _BEAM else []
    return _answer(places, motion, where[0]) if where[0] in known else None


def answered(effect: Effect) -> str | None:
    """Return the DOF that an effect answers, or x_b; None if it is no answer."""
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
        grid = tuple((f, zeta) for f in _OF_BEAM_HZ for zeta in (_DAMPING, _SHARP))
    per_of = f"{of}^2" if arm else of
    unit = "1" if per == per_of else f"{per}/{per_of}"
    swung = f"a (x - {motion}) + b x'/w"
    equation = f"x_b ({swung})" if arm else swung
    return Effect(
        _PREFIX + (_ARM if arm else motion),
        f"{what} that answers {motion} with a resonance" + (", times x_b" if arm else ""),
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
    return [on_dof(signals, dof, by * answered) for answered in _swung(signals, shape, motion)]


def _readings(signals: Signals, shape: Sequence[float], *, motion: str, sensor: int) -> list[Term]:
    return [on_sensor(signals, sensor, answered) for answered in _swung(signals, shape, motion)]


def _swung(signals: Signals, shape: Sequence[float], motion: str) -> tuple[Array, Array]:
    """Return by how much what swings is ahead of what it answers, and its speed over w (N,)."""
    w = 2 * np.pi * shape[0]
    q = signals.x_b_m if motion == _BEAM else signals.q[:, signals.places.dof.index(motion)]
    # Held at the mean of a period's ends, an input comes neither early nor late.
    x, rate = oscillator(
        0.5 * w * w * (q + np.append(q[1:], q[-1])), shape[0], shape[1], signals.Ts_s
    ).T
    return x - q, rate / w
