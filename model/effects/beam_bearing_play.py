"""Play of the beam in its bearings when the platform tilts: a mass that moves between two stops.

A bearing without preload leaves the beam a gap, along and across its rails. The beam lies on one
side until its inertia exceeds its weight, then crosses the gap, hits the other side, and bounces
(Nordin and Gutman, *Controlling mechanical systems with backlash - a survey*, Automatica 38, 2002).
The drives' encoders do not measure that. The shift along the rails causes a torque on theta, the
shift across the rails a torque on psi. Signature: in small motions the platform carries the beam,
in large ones it is without the beam's inertia for a part of the time. A mass on a spring is carried
equally at all amplitudes; the resonance of a beam that preslides falls gradually.

Each bounce depends on the last one, and records hold the platform's motion once in a cycle, with
noise. So the law follows the beam over some bounces only: a small play may not be told from a mass
on a spring, and one of many micrometres leaves much of the error.

The equation contains the whole inertia m of the beam about the tilt axis, so the model's moment of
inertia of that axis (J_psi or J_theta) must not contain m as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

from .base import Array, Effect, Places, Quantity, Signals, Term
from .beam_bearing_presliding import ACROSS, ALONG, HEIGHT_M, beam_on_bearing
from .lag_and_hysteresis_recursions import between_stops
from .operating_range import Extent

_CONTACT = (60.0, 0.1)
"""Start values: frequency of a contact in Hz and its damping ratio, beside those of the resonance
that small motions show."""
_HALVES = (0.003, 0.01, 0.03)
"""Start values of half the gap over the RMS tilt of the liveliest record."""
_COARSE = 0.05
"""Of a beam that bounces, derivatives are of what it does on average."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return play along and across the rails; empty for a plant without a beam."""
    if not places.beam:
        return []
    found = []
    for i in (ALONG, ACROSS):
        unit, reach = places.dof_units[i], extent.reach[i]
        seen = tuple((f, zeta) for at, f, zeta in extent.dof_resonances if at == i)
        found.append(
            Effect(
                "backlash.bearing",
                "Play of the beam in its bearings as a mass between two stops",
                "backlash",
                ("beam", places.dof[i]),
                "force = -m (x'' + q'') + m g x / h, x'' = (g q + a_b) / h - q'' - f, "
                "f = w^2 (x - clip(x, -half, half)) + 2 zeta w x' where |x| > half, a push; "
                "w = 2 pi frequency, zeta = damping, h = height, a_b only along the rails",
                (Quantity("m", f"{places.force_unit(i)} s^2/{unit}", 0.0),),
                partial(_shifted, dof=i),
                (
                    Quantity("frequency", "Hz", 5.0, 300.0, log=True, difference=_COARSE),
                    Quantity("damping", "1", 1e-3, 2.0, log=True, difference=_COARSE),
                    Quantity(
                        "half", unit, 1e-4 * reach, 10.0 * reach, log=True, difference=_COARSE
                    ),
                    Quantity("height", "m", 0.01, 1.0, log=True, difference=_COARSE),
                ),
                tuple(
                    (f, zeta, half * reach, HEIGHT_M)
                    for f, zeta in (*seen, _CONTACT)
                    for half in _HALVES
                ),
                absorbed_by="in small motions: mass; the model's J does not include m",
                told_apart_by="tilt excitation at several amplitudes, with beam at rest and moving",
            )
        )
    return found


def _shifted(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    frequency, damping, half, height = shape
    w = 2 * math.pi * frequency

    def bearing(q: Array, qd: Array, pull: Array) -> tuple[Array, Array]:
        return between_stops(q, qd, pull, w, damping, half, signals.Ts_s)

    return [beam_on_bearing(signals, dof, height, bearing)]
