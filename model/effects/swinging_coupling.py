"""Inertial coupling with a swinging arm: a pendulum on a cart or an arm, a gantry, two links.

The declared coupling is that at the zero of the angle. With the angle it falls as its cosine, and
the arm's centrifugal force appears (Goldstein, *Classical Mechanics*, ch. 1; Fantoni and Lozano,
*Non-linear Control for Underactuated Mechanical Systems*, 2002, ch. 3 and 5). Of two links in one
plane the coupling falls with the angle between them, which is a DOF of its own for the joints of a
robot (Spong, Hutchinson, Vidyasagar, *Robot Modeling and Control*, 2006, ch. 6), and the difference
of two for angles from one direction. It need not be zero where the links are one line: c and s are
of the cosine and the sine of that angle. Signature: forces
with the angle's square times an acceleration, at both DOF with one number.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import permutations

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
    ] + [
        _two_links(places, i, j, jointed)
        for i, j in permutations(range(len(places.dof)), 2)
        for jointed in (True, False)
        if places.dof_units[i] == places.dof_units[j] in RADIANS and (jointed or i < j)
    ]


def _two_links(places: Places, i: int, j: int, jointed: bool) -> Effect:
    """Return the coupling of two links; jointed: the second angle is that between them."""
    unit = f"{places.force_unit(i)} s^2"
    equation = (
        "force = -e (2 x'' + q'') + g (2 x' q' + q'^2) on the first, -e x'' - g x'^2 on the "
        "second; e = c (cos q - 1) - s sin q, g = c sin q + s cos q; x the first, q the "
        "second in rad"
        if jointed
        else "force = -e q'' + g q'^2 on the first, -e x'' - g x'^2 on the second; e = c (cos d - "
        "1) - s sin d, g = c sin d + s cos d, d = q - x; x the first, q the second in rad"
    )
    return Effect(
        "inertia.jointed" if jointed else "inertia.two_links",
        "Inertia of an arm of two links" if jointed else "Coupling of two links",
        "inertia",
        (places.dof[i], places.dof[j]),
        equation,
        (Quantity("c", unit), Quantity("s", unit)),
        partial(_linked, pair=(i, j), jointed=jointed, radians=RADIANS[places.dof_units[j]]),
        absorbed_by="at small angles: nothing; at a constant angle: the declared inertia",
        told_apart_by="bending far, at several speeds of the first link",
    )


def _linked(
    signals: Signals,
    _shape: Sequence[float],
    *,
    pair: tuple[int, int],
    jointed: bool,
    radians: float,
) -> list[Term]:
    i, j = pair
    (x, q), (v, w), (a, b) = ((radians * s[:, i], radians * s[:, j])
                              for s in (signals.q, signals.qd, signals.qdd))  # fmt: skip
    angle = q if jointed else q - x
    terms = []
    for inertia, pull in (
        (np.cos(angle) - 1.0, np.sin(angle)),
        (-np.sin(angle), np.cos(angle)),
    ):
        force = np.zeros_like(signals.q)
        both, turn = (2.0 * a + b, 2.0 * v * w + w**2) if jointed else (b, w**2)
        force[:, i] = pull * turn - inertia * both
        force[:, j] = -inertia * a - pull * v**2
        terms.append(Term(force=force / radians))
    return terms


def _swinging(
    signals: Signals, _shape: Sequence[float], *, moved: int, arm: int, radians: float
) -> list[Term]:
    angle, rate, turn = (radians * s[:, arm] for s in (signals.q, signals.qd, signals.qdd))
    force, falls = np.zeros_like(signals.q), 1.0 - np.cos(angle)
    force[:, moved] = falls * turn + rate**2 * np.sin(angle)
    force[:, arm] = falls * signals.qdd[:, moved]
    return [Term(force=force)]
