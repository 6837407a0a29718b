"""Stiffness that is not linear: cubic, quadratic, one-sided, viscoelastic.

Clamped rods in bending stretch as they deflect, so their force has a cubic part (Duffing; Kovacic
and Brennan, *The Duffing Equation*, 2011). The force of buckled rods differs between upward and
downward deflection; a quadratic part describes this. The force of a one-sided contact has a kink
over the deflection (Shaw and Holmes 1983). Rubber and polymers creep: a spring in series with a
damper, beside the declared one, is soft when slow and stiff when fast (Lakes, *Viscoelastic
Materials*, 2009, ch. 2). Signature: a force that depends on the pose only, not on
the speed; the cubic part responds at odd lines of a multisine, the quadratic part at even lines and
in the mean. A sensor's nonlinearity instead looks like a force that grows with frequency squared,
and also appears in the non-rigid part of the readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_dof
from .force_units import unit_power
from .lag_and_hysteresis_recursions import lagged_motion
from .operating_range import Extent
from .point_force_conversion import forces, heights

_WIDE = 3.0
_CONTACTS = (-0.4, 0.0, 0.4)
"""Start positions of a contact over three standard deviations of the record with most motion."""
_CREEP_S = (0.03, 0.3, 3.0)
"""Start values of a creep's time."""
_LINEAR = "the part linear in the pose: the declared stiffness"


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return cubic, quadratic and one-sided stiffness of every DOF, and of the corner rods."""
    effect_class = "rod_stiffness" if places.beam else "stiffness"
    # Of a spring that gives way faster than the records show, mass and damping are left.
    shortest_s = max(0.5 / (2 * np.pi * extent.fastest_hz), 1e-4)
    found = []
    for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True)):
        force = places.force_unit(i)
        for name, title, power in (
            ("cubic", "Cubic stiffness", 3),
            ("asymmetric", "Quadratic stiffness", 2),
        ):
            found.append(
                Effect(
                    f"{effect_class}.{name}",
                    title,
                    effect_class,
                    (dof,),
                    f"force = -k{power} q^{power}",
                    (Quantity(f"k{power}", f"{force}/{unit_power(unit, power)}"),),
                    partial(_power_of_pose, dof=i, power=power),
                    absorbed_by=_LINEAR,
                    told_apart_by="two amplitudes of excitation, several beam positions",
                )
            )
        reach, middle = _WIDE * extent.reach[i], extent.around(i)
        found.append(
            Effect(
                f"{effect_class}.one_sided",
                "One-sided stiffness (contact)",
                effect_class,
                (dof,),
                "force = -k (q - q0) where q > q0, else 0",
                (Quantity("k", f"{force}/{unit}"),),
                partial(_one_sided, dof=i),
                (Quantity("q0", unit, middle - reach, middle + reach),),
                tuple((middle + share * reach,) for share in _CONTACTS),
                absorbed_by=_LINEAR,
                told_apart_by="two amplitudes of excitation: the kink does not move",
            )
        )
        if not places.beam:
            found.append(
                Effect(
                    "stiffness.viscoelastic",
                    "Viscoelastic spring",
                    "viscoelasticity",
                    (dof,),
                    "force = -k (q - p), p is q lagged by tau",
                    (Quantity("k", f"{force}/{unit}", 0.0),),
                    partial(_viscoelastic, dof=i),
                    (Quantity("tau", "s", shortest_s, 100.0, log=True),),
                    tuple((max(tau, shortest_s),) for tau in _CREEP_S),
                    absorbed_by="far slower: damping; far faster: stiffness",
                    told_apart_by="slow and fast excitation",
                )
            )
    if places.beam:
        found.append(
            Effect(
                "rod_stiffness.corners",
                "Cubic stiffness of the rods at the corners",
                effect_class,
                places.dof,
                "force = -k3 sum over corners of s (s^T q)^3, s = [y, x, 1]",
                (Quantity("k3", "N/m^3"),),
                _corners,
                absorbed_by=_LINEAR,
                told_apart_by="all DOFs excited at once",
            )
        )
    return found


def _power_of_pose(
    signals: Signals, _shape: Sequence[float], *, dof: int, power: int
) -> list[Term]:
    q = signals.q[:, dof]
    return [on_dof(signals, dof, -q * q if power == 2 else -q * q * q)]


def _one_sided(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    return [on_dof(signals, dof, -np.maximum(signals.q[:, dof] - shape[0], 0.0))]


def _viscoelastic(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    q = signals.q[:, dof]
    return [on_dof(signals, dof, lagged_motion(q, shape[0], signals.Ts_s) - q)]


def _corners(signals: Signals, _shape: Sequence[float]) -> list[Term]:
    xy = signals.places.sensor_xy_m
    far = np.sum((xy - xy.mean(axis=0)) ** 2, axis=1)
    s = signals.places.sensor_shape[far > 0.99 * far.max()]
    h = heights(signals.q, s)
    return [Term(force=-forces(h * h * h, s))]
