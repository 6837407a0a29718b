"""Gravity of a rotating arm: a pendulum, an unbalanced rotor, a joint of a robot.

The torque of a weight is a sine of the angle (Goldstein, *Classical Mechanics*, ch. 1; Spong,
Hutchinson, Vidyasagar, *Robot Modeling and Control*, 2006, ch. 7). The two amplitudes contain the
unknown zero of the angle: their ratio is the tangent of its shift. For angles in degrees, q is
converted to radians inside sine and cosine. Signature: a force that depends on the angle alone and
repeats with every revolution. A cubic stiffness agrees with it only for small angles; cogging has
more than one period in a revolution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_dof

RADIANS = {"rad": 1.0, "deg": math.pi / 180, "1": 1.0}
"""Radians per unit of a DOF that can be an angle."""


def effects(places: Places) -> list[Effect]:
    """Return gravity on every rotating DOF; empty for the rig.

    Where a model has the line that stands for it at small angles, as a stiffness that is no free
    parameter, gravity also takes the place of that.
    """
    if places.beam:
        return []
    found = []
    for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True)):
        if unit not in RADIANS:
            continue
        force = places.force_unit(i)
        gravity = Effect(
            "gravity.sine",
            "Gravity on a rotating arm",
            "gravity",
            (dof,),
            "force = -(k_s sin q + k_c cos q)",
            (Quantity("k_s", force), Quantity("k_c", force)),
            partial(_gravity, dof=i, radians=RADIANS[unit]),
            absorbed_by="at small angles: the declared stiffness (the part linear in the angle) "
            "and the constant force",
            told_apart_by="motion over a large part of a revolution",
            exact=True,
        )
        found += [
            gravity,
            replace(
                gravity,
                key="gravity.sine_for_stiffness",
                title="Gravity on a rotating arm in place of a stiffness",
                equation="force = k q - (k_s sin q + k_c cos q), k of the declared stiffness",
                amplitudes=(*gravity.amplitudes, Quantity("k", f"{force}/{unit}", 0.0)),
                build=partial(_for_stiffness, dof=i, radians=RADIANS[unit]),
                absorbed_by="a free stiffness: k",
                contains={"linear.stiffness": tuple, "gravity.sine": tuple},
            ),
        ]
    return found


def _gravity(signals: Signals, _shape: Sequence[float], *, dof: int, radians: float) -> list[Term]:
    angle = radians * signals.q[:, dof]
    return [on_dof(signals, dof, -np.sin(angle)), on_dof(signals, dof, -np.cos(angle))]


def _for_stiffness(
    signals: Signals, shape: Sequence[float], *, dof: int, radians: float
) -> list[Term]:
    line = on_dof(signals, dof, signals.q[:, dof])
    return [*_gravity(signals, shape, dof=dof, radians=radians), line]
