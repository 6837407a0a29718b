"""Backlash of a gear, a spindle or a joint: a spring with a gap, and a dragged part with play.

In a gap the contact force is zero; beyond its edges it grows with the deflection (Nordin and
Gutman, *Controlling mechanical systems with backlash - a survey*, Automatica 38, 2002). If the part
beyond the gap is dragged along and stays where it was left, its position p is the output of a play
operator (Brokate and Sprekels, *Hysteresis and Phase Transitions*, 1996, ch. 2); the contact force
k (q - p) then equals that of one Maxwell-slip element with friction k half. Signature of the gap: a
force that depends on the position alone, with two kinks that do not move. Signature of the play: a
hysteresis loop with straight edges, whose width does not depend on speed or amplitude. The loop of
Dahl friction is rounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_dof
from .end_stop import contact, lower_edge, upper_edge
from .lag_and_hysteresis_recursions import play, slip_range
from .operating_range import Extent

_WIDE = 3.0
_MIDDLES = (-0.4, 0.0, 0.4)
"""Start positions of the gap's middle over three standard deviations of the motion."""
_GAPS = (0.3, 1.0)
_PLAYS = (0.1, 0.4, 1.5)
"""Start values of half the width, over the standard deviation of the motion."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return a gap and a play for every DOF; empty for the rig."""
    if places.beam:
        return []
    found = []
    for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True)):
        reach, middle = extent.reach[i], extent.around(i)
        wide = _WIDE * reach
        stiffness = (Quantity("k", f"{places.force_unit(i)}/{unit}", 0.0),)
        half = Quantity("half", unit, 1e-3 * reach, wide, log=True)
        found += [
            Effect(
                "backlash.dead_zone_spring",
                "Spring with a gap (backlash)",
                "backlash",
                (dof,),
                "force = -k (q - q0 - clip(q - q0, -half, half))",
                stiffness,
                partial(_dead_zone_spring, dof=i),
                (Quantity("q0", unit, middle - wide, middle + wide), half),
                tuple((middle + m * wide, gap * reach) for m in _MIDDLES for gap in _GAPS),
                absorbed_by="the part linear in the position: the declared stiffness",
                told_apart_by="two amplitudes of excitation: the kinks do not move",
                contains={
                    "stiffness.one_sided": upper_edge,
                    "stiffness.one_sided.below": lower_edge,
                },
            ),
            Effect(
                "backlash.dead_zone_contact",
                "Spring and damper with a gap (backlash)",
                "backlash",
                (dof,),
                "force = -k (q - q0 - clip(q - q0, -half, half)) - c q' where |q - q0| > half",
                (
                    replace(stiffness[0], another_below=True),
                    Quantity("c", f"{places.force_unit(i)} s/{unit}", 0.0),
                ),
                partial(_dead_zone_contact, dof=i),
                (Quantity("q0", unit, middle - wide, middle + wide), half),
                tuple((middle + m * wide, gap * reach) for m in _MIDDLES for gap in _GAPS),
                absorbed_by="the part linear in the motion: declared stiffness and damping",
                told_apart_by="two amplitudes of excitation: the kinks do not move",
                contains={
                    "backlash.dead_zone_spring": tuple,
                    "stiffness.stop.above": upper_edge,
                    "stiffness.stop.below": lower_edge,
                },
            ),
            Effect(
                "backlash.play",
                "Play (backlash with hysteresis)",
                "backlash",
                (dof,),
                "force = -k (q - p), p follows q at most half away",
                stiffness,
                partial(_play, dof=i),
                (half,),
                tuple((share * reach,) for share in _PLAYS),
                absorbed_by="without slip: stiffness; with fast full slip: offset",
                told_apart_by="several amplitudes of a slow excitation",
                initial_force_decay=partial(_remains, dof=i),
            ),
        ]
    return found


def _dead_zone_spring(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    away = signals.q[:, dof] - shape[0]
    return [on_dof(signals, dof, -(away - np.clip(away, -shape[1], shape[1])))]


def _dead_zone_contact(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    away = signals.q[:, dof] - shape[0]
    above, below = (contact(signals, dof, sign * away - shape[1], sign) for sign in (1.0, -1.0))
    return [on_dof(signals, dof, one + other) for one, other in zip(above, below, strict=True)]


def _play(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    q = signals.q[:, dof]
    return [on_dof(signals, dof, -(q - play(q, shape[0], signals.Ts_s)))]


def _remains(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    """Return the decay of an unknown contact force at row 0."""
    _, half = slip_range(signals.q[:, dof], shape[0])
    return [on_dof(signals, dof, half)]
