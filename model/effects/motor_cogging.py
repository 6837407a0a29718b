"""Cogging of a motor on a DOF: a force periodic in the position.

Iron teeth attract the magnets, so the force is periodic in the pole or slot pitch, without any
current (Zhu and Howe, *Influence of design parameters on cogging torque in permanent magnet
machines*, IEEE Trans. Energy Conversion 15, 2000). A rotary motor has the same equation over its
angle. The travel is taken as four standard deviations of the motion. Start values of the pitch are
half a cycle over the travel apart, from two to 20 cycles over it: with fewer it is a nonlinear
stiffness, or gravity on an arm. Shorter pitches begin at the strongest lines of the missing force
over the position. Poles, slots and a harmonic of either are lines of their own: beside one, another
one is asked. Signature: depends on the position only, not on speed, direction or command.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_dof
from .operating_range import TRAVEL, Extent

_KEY = "cogging.position"
_FEWEST, _MOST, _APART = 2.0, 20.0, 0.5
"""Cycles over the travel: fewest, most, and between neighbouring start values."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return cogging of every DOF; empty for the rig."""
    if places.beam:
        return []
    found = []
    for (i, dof), another in product(enumerate(places.dof), (False, True)):
        unit, lines = places.dof_units[i], extent.periods[i] if extent.periods else ()
        pitches = _pitches(TRAVEL * extent.reach[i], lines)
        found.append(
            Effect(
                _KEY + (".another" if another else ""),
                "Another cogging of a motor" if another else "Cogging of a motor",
                "cogging",
                (dof,),
                "force = a sin(2 pi q / pitch) + b cos(2 pi q / pitch)",
                (Quantity("a", places.force_unit(i)), Quantity("b", places.force_unit(i))),
                partial(_cogging, dof=i),
                (Quantity("pitch", unit, 0.5 * min(pitches), max(pitches), log=True),),
                tuple((pitch,) for pitch in pitches),
                absorbed_by="pitch longer than the travel: stiffness and constant force",
                told_apart_by="slow motion over many pitches, in both directions",
                beside=_KEY if another else "",
            )
        )
    return found


def _pitches(travel: float, lines: Sequence[float]) -> list[float]:
    """Return start values of the pitch, those of lines in the force over the position last."""
    count = round((_MOST - _FEWEST) / _APART) + 1
    found = [travel / cycles for cycles in np.linspace(_FEWEST, _MOST, count).tolist()]
    return found + [pitch for pitch in lines if pitch < travel / _MOST]


def _cogging(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    angle = 2 * np.pi / shape[0] * signals.q[:, dof]
    return [on_dof(signals, dof, np.sin(angle)), on_dof(signals, dof, np.cos(angle))]
