"""A beam that gives way in its bearings when the platform tilts: a mass on a spring that yields.

A bearing's balls are elastic before they roll, and begin to roll one after the other (Iwan, *A
distributed-element model for hysteresis*, J. Appl. Mech. 33, 1966; on ball guides Al-Bender and
Symens, *Characterization of frictional hysteresis in ball-bearing guideways*, Wear 258, 2005).
Drives that hold the carriage do not see the beam shift on it: along the rails that shows in theta,
across them in psi. Signature: a resonance that is lower and broader the larger the tilt; a mass on
a plain spring keeps its frequency and its damping, friction against the fixed frame has none.

The equation has all of the inertia of what gives way: the J of a model with it is that of what
does not, lower by m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

from .base import Effect, Places, Quantity, Signals, Term, on_dof
from .driven_range import Extent
from .recursions import yielding

_ALONG, _ACROSS = 1, 0
"""The tilts that shift the beam along and across its rails."""
_FIRST = ((15.0, 0.1, 2.0), (30.0, 0.1, 2.0), (60.0, 0.1, 2.0), (15.0, 0.2, 20.0))
"""Frequency in Hz, damping, and the shift at which all of the spring slips, of how far the platform
tilts, rms: it slips, or all but holds."""
_HEIGHT_M = 0.1


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the beam's give along and across its rails; nothing where there is no beam."""
    if not places.beam:
        return []
    found = []
    for i in (_ALONG, _ACROSS):
        unit, reach = places.dof_units[i], extent.reach[i]
        found.append(
            Effect(
                "friction.bearing",
                "Beam that gives way in its bearings",
                "friction",
                ("beam", places.dof[i]),
                "force = -m (x'' + q'') + m g x / h, x'' + 2 zeta w x' + w^2 r = "
                "(g q + a_b) / h - q'', r = mean of r_j, dr_j = dx while |r_j| < x_j, "
                "x_j evenly from 0 to x_s; w = 2 pi frequency, zeta = damping, h = height, "
                "a_b along the rails alone",
                (Quantity("m", f"{places.force_unit(i)} s^2/{unit}", 0.0),),
                partial(_shifted, dof=i),
                (
                    Quantity("frequency", "Hz", 5.0, 300.0, log=True),
                    Quantity("damping", "1", 1e-3, 0.7, log=True),
                    Quantity("x_s", unit, 1e-2 * reach, 100.0 * reach, log=True),
                    Quantity("height", "m", 0.01, 1.0, log=True),
                ),
                tuple((f, zeta, loose * reach, _HEIGHT_M) for f, zeta, loose in _FIRST),
                absorbed_by="far below its frequency: mass; J is without m",
                told_apart_by="tilts of several sizes, up to its frequency",
            )
        )
    return found


def _shifted(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    frequency, damping, x_s, height = shape
    q, qd, g = signals.q[:, dof], signals.qd[:, dof], signals.gravity_m_s2
    pull = g * q + signals.a_b_m_s2 if dof == _ALONG else g * q
    w = 2 * math.pi * frequency
    x, taken = yielding(q, qd, pull / height, w, damping, x_s, signals.Ts_s)
    # A declared model has the beam rigid: its weight, and what it takes to speed it up.
    return [on_dof(signals, dof, taken - pull / height + g / height * x)]
