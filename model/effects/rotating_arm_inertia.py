"""Inertia about an axis that another DOF changes: a Furuta pendulum, a helicopter, a polar arm.

A pendulum on a turning arm adds to the arm's inertia what it has at its distance from the axis,
with the square of the sine of its angle; the pitch of a helicopter takes from that of its yaw, with
the square of the cosine (Fantoni and Lozano, *Non-linear Control for Underactuated Mechanical
Systems*, 2002, ch. 5 and 13). A polar arm has the more the farther it extends (Spong, Hutchinson,
Vidyasagar, *Robot Modeling and Control*, 2006, ch. 6). The declared inertia is that at the zero of
the other DOF, which need not be where the inertia is least: of c and s, the second one is of the
slope there. Signature: the product of both speeds at the one DOF, and the square of the first speed
at the other, with the same numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import permutations

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term
from .gravity import RADIANS


def effects(places: Places) -> list[Effect]:
    """Return the inertia of each angle that each other DOF may change; empty for the rig."""
    if places.beam:
        return []
    found, units = [], places.dof_units
    for i, j in permutations(range(len(units)), 2):
        if units[i] in RADIANS and units[j] == units[i]:
            found.append(_rotating(places, i, j, tilts=True))
        if units[i] == "rad" and units[j] == "m":
            found.append(_rotating(places, i, j, tilts=False))
    return found


def _rotating(places: Places, i: int, j: int, tilts: bool) -> Effect:
    """Return the inertia of one DOF that another one changes: an angle, or a length."""
    unit = f"{places.force_unit(i)} s^2"
    change = "c sin^2 q + s sin q cos q" if tilts else "c q^2 + s q"
    what = "in rad" if tilts else "in m"
    units = (unit, unit) if tilts else (f"{unit}/m^2", f"{unit}/m")
    c, s = (Quantity(name, u) for name, u in zip("cs", units, strict=True))
    return Effect(
        "inertia.tilting" if tilts else "inertia.extending",
        f"Inertia of a rotating arm that {'tilts' if tilts else 'extends'}",
        "inertia",
        (places.dof[i], places.dof[j]),
        f"force = -e x'' - e' q' x' on the first, e' x'^2 / 2 on the second; e = {change}, e' its "
        f"derivative; x the first in rad, q the second {what}",
        (c, s),
        partial(_changing, pair=(i, j), tilts=tilts, radians=RADIANS[places.dof_units[i]]),
        absorbed_by="near one position: the declared inertia",
        told_apart_by=f"{'tilting' if tilts else 'extending'} far, at several speeds of the first",
    )


def _changing(
    signals: Signals,
    _shape: Sequence[float],
    *,
    pair: tuple[int, int],
    tilts: bool,
    radians: float,
) -> list[Term]:
    i, j = pair
    q, w = signals.q[:, j], signals.qd[:, j]
    v, a = radians * signals.qd[:, i], radians * signals.qdd[:, i]
    if tilts:
        q, w = radians * q, radians * w
        forms = (np.sin(q) ** 2, np.sin(2.0 * q)), (0.5 * np.sin(2.0 * q), np.cos(2.0 * q))
    else:
        forms = (q**2, 2.0 * q), (q, np.ones_like(q))
    terms = []
    for inertia, slope in forms:
        force = np.zeros_like(signals.q)
        force[:, i] = -inertia * a - slope * w * v
        force[:, j] = 0.5 * slope * v**2
        terms.append(Term(force=force / radians))
    return terms
