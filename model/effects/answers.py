"""A force that answers a motion with a resonance: linear dynamics of which nobody knows the cause.

What hangs, swings or flows beside the platform takes up its motion and gives it back later, of one
DOF or between two. A free form as those of `freeform`: it names nothing. It says which motion is
answered where, at what frequency and how sharply.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_dof
from .recursions import oscillator

_PREFIX = "unknown.answer."
_FREQUENCIES_HZ = (6.0, 12.0, 24.0, 48.0)
_DAMPING = 0.15
"""Broad enough that a resonance between two frequencies of the grid is seen from both."""


def answers(places: Places) -> list[Effect]:
    """Return answers of every DOF to every DOF."""
    return [_answer(places, to, i) for i in range(len(places.dof)) for to in range(len(places.dof))]


def answer(places: Places, key: str, where: Sequence[str]) -> Effect | None:
    """Return the answer that a model file names by key and place; None if it is none."""
    motion = key.removeprefix(_PREFIX)
    if motion == key or motion not in places.dof or len(where) != 1 or where[0] not in places.dof:
        return None
    return _answer(places, places.dof.index(motion), places.dof.index(where[0]))


def answered(effect: Effect) -> str | None:
    """Return the DOF that an effect answers; None if it is no answer."""
    motion = effect.key.removeprefix(_PREFIX)
    return None if motion == effect.key else motion


def _answer(places: Places, to: int, dof: int) -> Effect:
    unit = f"{places.force_unit(dof)}/{places.dof_units[to]}"
    motion = places.dof[to]
    return Effect(
        _PREFIX + motion,
        f"Force that answers {motion} with a resonance",
        "unknown",
        (places.dof[dof],),
        f"a (x - {motion}) + b x'/w, x'' + 2 zeta w x' + w^2 x = w^2 {motion}; "
        "w = 2 pi frequency, zeta = damping",
        (Quantity("a", unit), Quantity("b", unit)),
        partial(_forces, to=to, dof=dof),
        (
            Quantity("frequency", "Hz", 1.0, 300.0, log=True),
            Quantity("damping", "1", 1e-3, 0.7, log=True),
        ),
        tuple((f, _DAMPING) for f in _FREQUENCIES_HZ),
        told_apart_by=f"{motion} excited alone, up to its frequency",
    )


def _forces(signals: Signals, shape: Sequence[float], *, to: int, dof: int) -> list[Term]:
    w, q = 2 * np.pi * shape[0], signals.q[:, to]
    # Held at the mean of a period's ends, an input comes neither early nor late.
    x, rate = oscillator(
        0.5 * w * w * (q + np.append(q[1:], q[-1])), shape[0], shape[1], signals.Ts_s
    ).T
    return [on_dof(signals, dof, x - q), on_dof(signals, dof, rate / w)]
