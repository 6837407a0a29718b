"""Inertial coupling with a swinging arm: a pendulum on a cart or an arm, the load of a gantry.

The declared coupling is that at the zero of the angle. With the angle it falls as its cosine, and
the arm's centrifugal force appears (Goldstein, *Classical Mechanics*, ch. 1; Fantoni and Lozano,
*Non-linear Control for Underactuated Mechanical Systems*, 2002, ch. 3 and 5). Signature: forces
with the angle's square times an acceleration, at both DOF with one number.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term
from .gravity import RADIANS


def effects(places: Places) -> list[Effect]:
    """Return the coupling of each DOF with each other one that is an angle; empty for the rig."""
    if places.beam:
        return []
    return [
        Effect(
            "inertia.swinging",
            "Coupling with a swinging arm",
            "inertia",
            (moved, arm),
            "force = h ((1 - cos q) q'' + q'^2 sin q) on the first, h (1 - cos q) x'' on the "
            "second; x the first, q the second in rad",
            (Quantity("h", f"{places.force_unit(i)} s^2"),),
            partial(_swinging, moved=i, arm=j, radians=RADIANS[unit]),
            absorbed_by="at small angles: nothing; at a constant angle: the declared coupling",
            told_apart_by="swinging far, with and without acceleration of the first DOF",
        )
        for i, moved in enumerate(places.dof)
        for j, (arm, unit) in enumerate(zip(places.dof, places.dof_units, strict=True))
        if i != j and unit in RADIANS
    ]


def _swinging(
    signals: Signals, _shape: Sequence[float], *, moved: int, arm: int, radians: float
) -> list[Term]:
    angle, rate, turn = (radians * s[:, arm] for s in (signals.q, signals.qd, signals.qdd))
    force, falls = np.zeros_like(signals.q), 1.0 - np.cos(angle)
    force[:, moved] = falls * turn + rate**2 * np.sin(angle)
    force[:, arm] = falls * signals.qdd[:, moved]
    return [Term(force=force)]
