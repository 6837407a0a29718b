"""Stiffness that is not linear: of powers, one-sided, preloaded, exponential, viscoelastic.

Clamped rods in bending stretch as they deflect, so their force has a cubic part (Duffing; Kovacic
and Brennan, *The Duffing Equation*, 2011). The force of buckled rods differs between upward and
downward deflection; a quadratic part describes this. The force of a one-sided contact has a kink
over the deflection (Shaw and Holmes 1983). A spring that is preloaded against a stop to both sides
returns to the middle with a force that jumps there, as that of a throttle valve at its limp-home
position (Deur et al., *An electronic throttle control strategy*, 2004). Buckled beams and disc
springs level off within their travel, and such a spring that pushes away from its middle snaps
through; foam and tissue harden exponentially (Fung, *Biomechanics*, 1993, ch. 7). Rubber and
polymers creep: a spring in series with a damper, beside the declared one, is soft when slow and
stiff when fast; several such arms stand for creep that has no time of its own (Lakes, *Viscoelastic
Materials*, 2009, ch. 2). Signature: a force that depends on the pose only, not on the speed; the
cubic part responds at odd lines of a multisine, the quadratic part at even lines and in the mean. A
sensor's nonlinearity instead looks like a force that grows with frequency squared, and also appears
in the non-rigid part of the readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof
from .end_stop import lower_edge, upper_edge
from .force_units import unit_power
from .lag_and_hysteresis_recursions import lagged_motion
from .motion_between_rows import at_rows, ln_cosh, means_of_parts, positions_between_rows
from .operating_range import Extent
from .point_force_conversion import forces, heights

_WIDE = 3.0
_CONTACTS = (-0.4, 0.0, 0.4)
"""Start positions of a contact over three standard deviations of the record with most motion."""
_YIELDS, _YIELD_BOUNDS = (0.03, 0.3, 1.0), (1e-4, 3.0)
"""Start values and bounds of the deflection within which a preload is reached, over the standard
deviation of the motion. With a longer one the force would be that of a linear spring."""
_LEVELING = {
    "leveling_off": ("Spring that levels off", -1.0, (0.3, 1.0), _YIELD_BOUNDS[1]),
    "snap_through": ("Spring that snaps through", 1.0, (0.1, 0.4), 1.0),
}
"""Title, sign, start values and upper bound of the deflection within which the force levels off,
over the same. One that snaps through within more than the RMS motion is a cubic spring there."""
_WAYS, _HARDENS = {"up": 1.0, "down": -1.0}, (0.2, 10.0)
"""Ways in which a spring hardens exponentially, and bounds of the deflection within which it does,
over the same. With a longer one it is a quadratic spring."""
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
                    told_apart_by="two amplitudes of excitation"
                    + (", several beam positions" if places.beam else ""),
                )
            )
        reach, middle = _WIDE * extent.reach[i], extent.around(i)
        if places.beam:
            found.append(
                Effect(
                    "rod_stiffness.one_sided",
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
        else:
            shortest, longest = (share * extent.reach[i] for share in _YIELD_BOUNDS)
            found.append(
                Effect(
                    "stiffness.preloaded",
                    "Preloaded spring (detent)",
                    "preload",
                    (dof,),
                    "force = -P clip((q - q0) / width, -1, 1)",
                    (Quantity("P", force, 0.0),),
                    partial(_preloaded, dof=i),
                    (
                        Quantity("q0", unit, middle - reach, middle + reach),
                        Quantity("width", unit, shortest, longest, log=True),
                    ),
                    tuple(
                        (middle + share * reach, one * extent.reach[i])
                        for share in _CONTACTS
                        for one in _YIELDS
                    ),
                    absorbed_by=_LINEAR,
                    told_apart_by="two amplitudes of excitation: the jump does not move",
                    contains={
                        "stiffness.one_sided": lower_edge,
                        "stiffness.one_sided.below": upper_edge,
                    },
                )
            )
            found += [_leveling(places, i, name, extent) for name in _LEVELING]
            found += [_exponential(places, i, way, extent) for way in _WAYS]
            creep = Effect(
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
            found.append(creep)
            found.append(
                replace(
                    creep,
                    key="stiffness.viscoelastic.another",
                    title="Another viscoelastic spring",
                    beside="stiffness.viscoelastic",
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


def _leveling(places: Places, i: int, name: str, extent: Extent) -> Effect:
    unit, reach = places.dof_units[i], extent.reach[i]
    title, sign, starts, most = _LEVELING[name]
    middle, farthest = extent.around(i), _WIDE * reach
    return Effect(
        f"stiffness.{name}",
        title,
        "stiffness",
        (places.dof[i],),
        f"force = {'-' if sign < 0.0 else ''}P tanh((q - q0) / width)",
        (Quantity("P", places.force_unit(i), 0.0),),
        partial(_tanh, dof=i, sign=sign),
        (
            Quantity("q0", unit, middle - farthest, middle + farthest),
            Quantity("width", unit, _YIELD_BOUNDS[0] * reach, most * reach, log=True),
        ),
        tuple((middle, one * reach) for one in starts),
        absorbed_by=_LINEAR,
        told_apart_by="two amplitudes of excitation",
    )


def _exponential(places: Places, i: int, way: str, extent: Extent) -> Effect:
    unit, reach = places.dof_units[i], extent.reach[i]
    low, high = (share * reach for share in _HARDENS)
    return Effect(
        f"stiffness.exponential.{way}",
        f"Spring that hardens exponentially, {way}wards",
        "stiffness",
        (places.dof[i],),
        "force = -P (exp(q/d) - 1)" if way == "up" else "force = P (exp(-q/d) - 1)",
        (Quantity("P", places.force_unit(i)),),
        partial(_hardening, dof=i, sign=_WAYS[way]),
        (Quantity("d", unit, low, high, log=True),),
        ((0.7 * reach,), (2.0 * reach,)),
        absorbed_by=_LINEAR,
        told_apart_by="two amplitudes of excitation",
    )


def _hardening(signals: Signals, shape: Sequence[float], *, dof: int, sign: float) -> list[Term]:
    away = sign * signals.q[:, dof] / shape[0]
    with np.errstate(over="ignore"):  # a fit may try a travel that hardens beyond all numbers
        force = -sign * np.expm1(away)
    return [on_dof(signals, dof, force)]


def _power_of_pose(
    signals: Signals, _shape: Sequence[float], *, dof: int, power: int
) -> list[Term]:
    q = signals.q[:, dof]
    return [on_dof(signals, dof, -q * q if power == 2 else -q * q * q)]


def _one_sided(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    return [on_dof(signals, dof, -np.maximum(signals.q[:, dof] - shape[0], 0.0))]


def _preloaded(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    # Also in a free run: the jump may take less than a row.
    away = (positions_between_rows(signals, dof) - shape[0]) / shape[1]
    return [on_dof(signals, dof, -at_rows(means_of_parts(away, _clipped, _integral)))]


def _tanh(signals: Signals, shape: Sequence[float], *, dof: int, sign: float) -> list[Term]:
    away = (positions_between_rows(signals, dof) - shape[0]) / shape[1]
    return [on_dof(signals, dof, sign * at_rows(means_of_parts(away, np.tanh, ln_cosh)))]


def _clipped(away: Array) -> Array:
    return np.asarray(np.clip(away, -1.0, 1.0))


def _integral(away: Array) -> Array:
    """Return the integral of the clipped deflection from zero."""
    size = np.abs(away)
    return np.where(size < 1.0, 0.5 * size * size, size - 0.5)


def _viscoelastic(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    q = signals.q[:, dof]
    return [on_dof(signals, dof, lagged_motion(q, shape[0], signals.Ts_s) - q)]


def _corners(signals: Signals, _shape: Sequence[float]) -> list[Term]:
    xy = signals.places.sensor_xy_m
    far = np.sum((xy - xy.mean(axis=0)) ** 2, axis=1)
    s = signals.places.sensor_shape[far > 0.99 * far.max()]
    h = heights(signals.q, s)
    return [Term(force=-forces(h * h * h, s))]
