"""Dry friction whose level varies periodically along the position.

A bent lead screw, a shaft that is not straight in its bearings and a guide with uneven preload rub
more at some places than at others, once or a few times a revolution (Armstrong-Helouvry, *Control
of Machines with Friction*, 1991, ch. 4, who measured it on a robot's joints). Start values of the
period are the strongest lines over the position of what is missing times the direction. With the
longest one, beyond the travel, friction grows from one end to the other, as on a rail that is not
parallel. Signature: a force with the sign of the speed whose size depends on the position.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_dof
from .friction import direction, turning_speed
from .operating_range import TRAVEL, Extent

_TYPICAL_CYCLES, _WIDER = 2.0, 2.0
"""Cycles over the travel to start from if no line is known; bounds beyond the start values."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the friction of every DOF; empty for the rig, whose platform moves by less."""
    if places.beam:
        return []
    found = []
    for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True)):
        force, speed = places.force_unit(i), extent.speed[i]
        typical = TRAVEL * extent.reach[i] / _TYPICAL_CYCLES
        pitches = (extent.rubbing[i] if extent.rubbing else ()) or (typical,)
        low, high = min(pitches) / _WIDER, _WIDER * max(pitches)
        found.append(
            Effect(
                "friction.along_position",
                "Dry friction that varies along the position",
                "friction",
                (dof,),
                "force = -(friction + a sin(2 pi q / pitch) + b cos(2 pi q / pitch)) tanh(q'/v_s)",
                (
                    Quantity("friction", force, 0.0, another_below=True),
                    Quantity("a", force),
                    Quantity("b", force),
                ),
                partial(_along, dof=i),
                (
                    turning_speed(unit, speed),
                    Quantity("pitch", unit, low, high, log=True, ends=True),
                ),
                tuple((0.02 * speed, pitch) for pitch in pitches),
                absorbed_by="at small amplitudes, damping",
                told_apart_by="slow motion over the whole travel, in both directions",
                contains={"friction.coulomb": _even},
            )
        )
    return found


def _even(shape: Sequence[float]) -> tuple[float, ...]:
    return (shape[0],)


def _along(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    v_s, pitch = shape
    level = -direction(signals, dof, v_s)
    angle = 2 * np.pi / pitch * signals.q[:, dof]
    shares = np.ones_like(angle), np.sin(angle), np.cos(angle)
    return [on_dof(signals, dof, level * share) for share in shares]
