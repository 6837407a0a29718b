"""Undeclared damping: linear damping of single DOFs, drag, squeeze-film damping.

Drag of a plate in free air grows with the speed squared. The damping of a squeezed air film is
proportional to height^-3 (Reynolds' equation; Bao and Yang, *Squeeze film air damping in MEMS*,
Sensors and Actuators A 136, 2007). Signature: a force that is zero at zero speed. Drag is an odd
function of the speed and responds at odd lines of a multisine; a film also responds at even lines,
and its force depends on the pose. Friction, unlike damping, does not grow with the speed. The
viscosity of grease falls with the shear rate (Cross, *Rheology of non-Newtonian fluids*, J. Colloid
Sci. 20, 1965): such damping grows less than the speed, and levels off at high speeds only. The drag
of eddy currents has its maximum at a critical speed and falls beyond (Wouterse, *Critical torque
and speed of eddy current brake with widely separated soft iron poles*, IEE Proc. B 138, 1991).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import combinations

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof
from .friction_leveling_off import leveled, leveled_integral
from .motion_between_rows import law_of_speed
from .operating_range import Extent
from .point_force_conversion import forces, heights

_SMALLEST_M = 1e-3
"""The end stops are at 0.9 mm: the film at the working point is at least as thick."""
_SPEEDS = (0.1, 10.0)
"""Range of the speed at which damping has halved, over the RMS speed: below it is dry friction, and
above it is linear damping."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return linear damping of single DOFs, drag, thinning grease and squeeze films."""
    effect_class = "air_damping" if places.beam else "damping"
    found = []
    for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True)):
        force = places.force_unit(i)
        if places.beam:
            # The rig declares one damping for all coils; other models declare it for each DOF.
            found.append(
                Effect(
                    "air_damping.linear",
                    "Additional damping of one DOF",
                    effect_class,
                    (dof,),
                    "force = -d q'",
                    (Quantity("d", f"{force} s/{unit}"),),
                    partial(_linear, dof=i),
                    absorbed_by="the part common to all coils: the declared damping",
                    told_apart_by="excitation of every DOF around its resonance",
                )
            )
        found.append(
            Effect(
                f"{effect_class}.quadratic",
                "Quadratic damping",
                effect_class,
                (dof,),
                "force = -d2 |q'| q'",
                (Quantity("d2", f"{force} s^2/{unit}^2", 0.0),),
                partial(_quadratic, dof=i),
                absorbed_by="the part linear in the speed: the declared damping",
                told_apart_by="two amplitudes of excitation",
            )
        )
    found += _across(places, effect_class)
    if places.beam:
        return found + _of_plates(places)
    return found + _with_positions(places) + _falling(places, extent)


def _across(places: Places, effect_class: str) -> list[Effect]:
    """Return damping that couples two DOFs; models mostly declare it for each DOF alone."""
    return [
        Effect(
            f"{effect_class}.across",
            "Damping across two DOFs",
            effect_class,
            (places.dof[i], places.dof[j]),
            "force = -d q', q' of the other DOF",
            (Quantity("d", f"{places.force_unit(i)} s/{places.dof_units[j]}"),),
            partial(_coupled, pair=(i, j)),
            absorbed_by="declared damping that couples these DOFs",
            told_apart_by="excitation of both DOFs around their resonances",
            linear=not places.beam,
        )
        for i, j in combinations(range(len(places.dof)), 2)
    ]


def _of_plates(places: Places) -> list[Effect]:
    h0 = (Quantity("h0", "m", _SMALLEST_M, 0.05, log=True),)
    grid = ((2e-3,),)
    z = places.dof[-1]
    return [
        Effect(
            "air_damping.drag",
            "Drag of the plates over the coils",
            "air_damping",
            places.dof,
            "force = -d2 sum over coils of s |s^T q'| s^T q', s = [y, x, 1]",
            (Quantity("d2", "N s^2/m^2", 0.0),),
            _drag,
            absorbed_by="the part linear in the speed: the declared damping",
            told_apart_by="simultaneous excitation of all DOFs, at two amplitudes",
        ),
        Effect(
            "air_damping.squeeze_film",
            "Squeeze-film damping under the platform",
            "air_damping",
            places.dof,
            "force = -d sum over coils of s ((1 + h/h0)^-3 - 1) h', h = s^T q, s = [y, x, 1]",
            (Quantity("d", "N s/m", 0.0),),
            _squeeze_under_coils,
            h0,
            grid,
            absorbed_by="the part independent of the height: the declared damping",
            told_apart_by="large slow motions superposed with small fast ones",
        ),
        Effect(
            "air_damping.squeeze_film_lift",
            "Squeeze-film damping of the vertical motion",
            "air_damping",
            (z,),
            "force = -d ((1 + z/h0)^-3 - 1) z'",
            (Quantity("d", "N s/m", 0.0),),
            _squeeze_lift,
            h0,
            grid,
            absorbed_by="the part independent of the height: the declared damping",
            told_apart_by="large slow motions superposed with small fast ones",
        ),
    ]


def _with_positions(places: Places) -> list[Effect]:
    """Return damping that depends on the position or on the direction."""
    return [
        Effect(
            f"damping.{name}",
            title,
            "damping",
            (dof,),
            equation,
            (Quantity("d", f"{places.force_unit(i)} s/{unit}^{power + 1}"),),
            partial(_with_position, dof=i, power=power),
            absorbed_by="the part independent of the position: the declared damping",
            told_apart_by="two amplitudes of excitation",
        )
        for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True))
        for power, name, title, equation in (
            (1, "one_sided", "Damping linear in the position", "force = -d q q'"),
            (2, "outward", "Damping quadratic in the position", "force = -d q^2 q'"),
        )
    ] + [
        Effect(
            "damping.asymmetric",
            "Viscous friction that depends on the direction",
            "damping",
            (dof,),
            "force = -asymmetry |q'|",
            (Quantity("asymmetry", f"{places.force_unit(i)} s/{unit}"),),
            partial(_asymmetric, dof=i),
            absorbed_by="the mean: the constant force",
            told_apart_by="two amplitudes of excitation",
        )
        for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True))
    ]


def _falling(places: Places, extent: Extent) -> list[Effect]:
    """Return damping that falls with the speed, of each DOF, as of grease and of eddy currents."""
    found = []
    for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True)):
        low, high = (share * extent.speed[i] for share in _SPEEDS)
        v_0 = Quantity("v_0", f"{unit}/s", low, high, log=True, another_below=True)
        found += [
            Effect(
                key,
                name,
                "damping",
                (dof,),
                equation,
                (Quantity("d", f"{places.force_unit(i)} s/{unit}", 0.0),),
                partial(law, dof=i),
                (v_0,),
                tuple((share * extent.speed[i],) for share in (0.2, 0.5, 1.0, 3.0)),
                absorbed_by="the part linear in the speed: the declared damping",
                told_apart_by="two amplitudes of excitation",
            )
            for key, name, equation, law in (
                ("damping.falling", "Damping that falls with the speed",
                 "force = -d q' / (1 + |q'| / v_0)", _thinning),
                ("damping.eddy_current", "Damping by eddy currents, with a critical speed",
                 "force = -d q' / (1 + (q' / v_0)^2)", _eddy_currents),
            )
        ]  # fmt: skip
    return found


def _thinning(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    v_0 = shape[0]
    return [on_dof(signals, dof, -v_0 * law_of_speed(signals, dof, v_0, leveled, leveled_integral))]


def _eddy_currents(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    v_0 = shape[0]
    return [on_dof(signals, dof, -v_0 * law_of_speed(signals, dof, v_0, _eddy, _eddy_integral))]


def _eddy(ratio: Array) -> Array:
    return np.asarray(ratio / (1.0 + ratio**2))


def _eddy_integral(ratio: Array) -> Array:
    return np.asarray(0.5 * np.log1p(ratio**2))


def _coupled(signals: Signals, _shape: Sequence[float], *, pair: tuple[int, int]) -> list[Term]:
    force = np.zeros_like(signals.qd)
    for one, other in (pair, pair[::-1]):
        force[:, one] = -signals.qd[:, other]
    return [Term(force=force)]


def _linear(signals: Signals, _shape: Sequence[float], *, dof: int) -> list[Term]:
    return [on_dof(signals, dof, -signals.qd[:, dof])]


def _quadratic(signals: Signals, _shape: Sequence[float], *, dof: int) -> list[Term]:
    qd = signals.qd[:, dof]
    return [on_dof(signals, dof, -np.abs(qd) * qd)]


def _with_position(
    signals: Signals, _shape: Sequence[float], *, dof: int, power: int
) -> list[Term]:
    q, qd = signals.q[:, dof], signals.qd[:, dof]
    return [on_dof(signals, dof, -q * qd if power == 1 else -q * q * qd)]


def _asymmetric(signals: Signals, _shape: Sequence[float], *, dof: int) -> list[Term]:
    return [on_dof(signals, dof, -np.abs(signals.qd[:, dof]))]


def _drag(signals: Signals, _shape: Sequence[float]) -> list[Term]:
    s = signals.places.coil_shape
    speed = heights(signals.qd, s)
    return [Term(force=-forces(np.abs(speed) * speed, s))]


def _squeeze_under_coils(signals: Signals, shape: Sequence[float]) -> list[Term]:
    s = signals.places.coil_shape
    excess = _excess(heights(signals.q, s), shape[0])
    return [Term(force=-forces(excess * heights(signals.qd, s), s))]


def _squeeze_lift(signals: Signals, shape: Sequence[float]) -> list[Term]:
    return [on_dof(signals, -1, -_excess(signals.q[:, -1], shape[0]) * signals.qd[:, -1])]


def _excess(height: Array, h0: float) -> Array:
    """Return the relative excess of film damping at heights (...,) over the working point's."""
    left = 1.0 / np.maximum(1.0 + height / h0, 0.05)
    return np.asarray(left * left * left - 1.0)
