"""Dry friction that reaches its level slowly as the speed grows.

Dry friction turns within speeds far below those of a session. Where lubricant is drawn in between
the surfaces, or many contacts begin to slide one after another, it also still grows beyond: half of
it is there at v_0, and at ten times v_0 a tenth is still lacking. A damping that falls with the
speed has the same form (`damping`); there v_0 is not far below the speeds, so that its level is
never seen. Of all frictions it leaves least of the measured force of a ball screw drive (Janot,
Gautier, Brunot, *Data set and reference models of EMPS*, Nonlinear System Identification
Benchmarks, 2019). Signature: a force with the sign of the speed that still grows a little where dry
friction is constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof
from .friction import SLOWEST, STILL_DRY
from .motion_between_rows import law_of_speed
from .operating_range import Extent


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the friction of every DOF; empty for the rig, whose cable chain is Coulomb's."""
    if places.beam:
        return []
    found = []
    for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True)):
        speed = extent.speed[i]
        v_0 = Quantity("v_0", f"{unit}/s", SLOWEST * speed, STILL_DRY * speed, log=True)
        found.append(
            Effect(
                "friction.leveling_off",
                "Dry friction that levels off slowly",
                "friction",
                (dof,),
                "force = -friction q' / (|q'| + v_0)",
                (Quantity("friction", places.force_unit(i), 0.0),),
                partial(_leveling, dof=i),
                (v_0,),
                ((0.02 * speed,), (0.1 * speed,)),
                absorbed_by="at small amplitudes, damping",
                told_apart_by="two amplitudes of excitation",
                contains={"friction.coulomb": tuple},
            )
        )
    return found


def leveled(ratio: Array) -> Array:
    """Return x / (1 + |x|) of ratios x of speeds, of any shape."""
    return np.asarray(ratio / (1.0 + np.abs(ratio)))


def leveled_integral(ratio: Array) -> Array:
    """Return the integral of x / (1 + |x|) from 0 to ratios x, of any shape."""
    size = np.abs(ratio)
    return np.asarray(size - np.log1p(size))


def _leveling(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    level = law_of_speed(signals, dof, shape[0], leveled, leveled_integral)
    return [on_dof(signals, dof, -level)]
