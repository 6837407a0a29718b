"""Presliding of the beam in its bearings when the platform tilts: a mass on a yielding spring.

A bearing's balls deform elastically before they roll, and start to roll one after the other (Iwan,
*A distributed-element model for hysteresis*, J. Appl. Mech. 33, 1966; for ball guides: Al-Bender
and Symens, *Characterization of frictional hysteresis in ball-bearing guideways*, Wear 258, 2005).
In these bearings the beam shifts elastically on its carriage, along and across the rails, and the
drives' encoders do not measure that. The shift along the rails causes a torque on theta, the shift
across the rails a torque on psi. Signature: a resonance whose frequency falls
and whose damping grows with the tilt amplitude. A mass on a linear spring has constant frequency
and damping; friction against the fixed frame has no resonance.

The equation contains the whole inertia m of the shifting mass about the tilt axis, so the model's
moment of inertia of that axis (J_psi or J_theta) must not contain m as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof
from .lag_and_hysteresis_recursions import yielding
from .operating_range import Extent

Bearing = Callable[[Array, Array, Array], tuple[Array, Array]]

ALONG, ACROSS = 1, 0
"""DOF of the tilts that shift the beam along and across its rails."""
_START = ((15.0, 0.1, 2.0), (30.0, 0.1, 2.0), (60.0, 0.1, 2.0), (15.0, 0.2, 20.0))
"""Start values: frequency in Hz, damping ratio, and shift of full slip over the RMS tilt (small:
the spring slips; large: it is almost elastic)."""
HEIGHT_M = 0.1
"""Start value of the height of the beam above the tilt axis."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return presliding along and across the rails; empty for a plant without a beam."""
    if not places.beam:
        return []
    found = []
    for i in (ALONG, ACROSS):
        unit, reach = places.dof_units[i], extent.reach[i]
        found.append(
            Effect(
                "friction.bearing",
                "Presliding of the beam in its bearings as a mass on a yielding spring",
                "friction",
                ("beam", places.dof[i]),
                "force = -m (x'' + q'') + m g x / h, x'' + 2 zeta w x' + w^2 r = "
                "(g q + a_b) / h - q'', r = mean of r_j, dr_j = dx while |r_j| < x_j, "
                "x_j evenly from 0 to x_s; w = 2 pi frequency, zeta = damping, h = height, "
                "a_b only along the rails",
                (Quantity("m", f"{places.force_unit(i)} s^2/{unit}", 0.0),),
                partial(_shifted, dof=i),
                (
                    Quantity("frequency", "Hz", 5.0, 300.0, log=True),
                    Quantity("damping", "1", 1e-3, 0.7, log=True),
                    Quantity("x_s", unit, 1e-2 * reach, 100.0 * reach, log=True),
                    Quantity("height", "m", 0.01, 1.0, log=True),
                ),
                tuple((f, zeta, slip * reach, HEIGHT_M) for f, zeta, slip in _START),
                absorbed_by="far below its frequency: mass; the model's J does not include m",
                told_apart_by="tilt excitation at several amplitudes, up to its frequency",
            )
        )
    return found


def beam_on_bearing(signals: Signals, dof: int, height_m: float, bearing: Bearing) -> Term:
    """Return the generalised force of a unit inertia that a bearing carries when `dof` tilts.

    `bearing` returns the shift (N,) of the beam, in units of the DOF, and the bearing's force on it
    (N,) per inertia, for the tilt and its rate (N,) and the pull (N,) on the beam per inertia.
    """
    q, qd, g = signals.q[:, dof], signals.qd[:, dof], signals.gravity_m_s2
    pull = (g * q + signals.a_b_m_s2 if dof == ALONG else g * q) / height_m
    x, force = bearing(q, qd, pull)
    # The declared model contains the weight and the acceleration force of a rigidly mounted beam.
    return on_dof(signals, dof, force - pull + g / height_m * x)


def _shifted(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    frequency, damping, x_s, height = shape
    w = 2 * math.pi * frequency

    def bearing(q: Array, qd: Array, pull: Array) -> tuple[Array, Array]:
        return yielding(q, qd, pull, w, damping, x_s, signals.Ts_s)

    return [beam_on_bearing(signals, dof, height, bearing)]
