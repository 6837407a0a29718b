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
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_dof

RADIANS = {"rad": 1.0, "deg": math.pi / 180, "1": 1.0}
"""Radians per unit of a DOF that can be an angle."""


def effects(places: Places) -> list[Effect]:
    """Return gravity on every rotating DOF; empty for the rig."""
    if places.beam:
        return []
    return [
        Effect(
            "gravity.sine",
            "Gravity on a rotating arm",
            "gravity",
            (dof,),
            "force = -(k_s sin q + k_c cos q)",
            (Quantity("k_s", places.force_unit(i)), Quantity("k_c", places.force_unit(i))),
            partial(_gravity, dof=i, radians=RADIANS[unit]),
            absorbed_by="at small angles: the declared stiffness (the part linear in the angle) "
            "and the constant force",
            told_apart_by="motion over a large part of a revolution",
        )
        for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True))
        if unit in RADIANS
    ]


def _gravity(signals: Signals, _shape: Sequence[float], *, dof: int, radians: float) -> list[Term]:
    angle = radians * signals.q[:, dof]
    return [on_dof(signals, dof, -np.sin(angle)), on_dof(signals, dof, -np.cos(angle))]
