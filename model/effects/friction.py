"""Friction of a cable chain or a bearing between a DOF and the fixed frame, sliding and presliding.

Coulomb friction has constant size and the sign of the speed; Stribeck friction is larger near rest.
Dahl and Maxwell elements are elastic before they slip, so force over displacement is a hysteresis
loop (Dahl 1968; Wen, *Method for random vibration of hysteretic systems*, J. Eng. Mech. 102, 1976;
Canudas de Wit et al., *A new model for control of systems with friction*, IEEE TAC 40, 1995;
Al-Bender, Lampaert, Swevers, *The generalized Maxwell-slip model*, IEEE TAC 50, 2005). Three
Maxwell elements leave at most about a fifth of what a stiffness and a damping leave of the other
friction models' hysteresis loops. Signature: the height of the hysteresis loop does not depend on
the speed, and its width follows the amplitude of the motion, so the equivalent damping falls with
the amplitude. The hysteresis loop of a lag, in contrast, grows with the speed. Sliding friction of
two levels, one for each direction, is symmetric friction and a force that is constant while the DOF
moves (Armstrong-Helouvry, Dupont, Canudas de Wit, *A survey of models, analysis tools and
compensation methods for the control of machines with friction*, Automatica 30, 1994).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof
from .lag_and_hysteresis_recursions import bouc_wen, dahl, lugre, slip
from .motion_between_rows import (
    at_rows,
    law_of_speed,
    ln_cosh,
    means_of_parts,
    middles,
    speeds_between_rows,
)
from .operating_range import Extent

LAWS = tuple(
    f"friction.{law}"
    for law in ("coulomb", "leveling_off", "stribeck", "coulomb_asymmetric", "stribeck_asymmetric",
                "dahl", "bouc_wen", "lugre", "maxwell_slip")
)  # fmt: skip
"""Keys of the laws of friction between a DOF and the frame. They exclude each other."""

_ELEMENTS = (1.0, 4.0, 16.0)
"""Break-away displacements of the Maxwell elements, relative to the smallest."""
SLOWEST = 1e-3
"""Smallest speed within which friction turns, over the RMS speed."""
STILL_DRY = 0.2
"""Largest speed within which dry friction turns, over the RMS speed: a random motion is slower
for a sixth of the time. What takes longer is a damping that levels off."""
_WIDE = 1e3
_LOOPS = "several amplitudes of a slow excitation"
_ELASTIC = "without slip: stiffness; with fast full slip: offset"


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return every friction model for every DOF."""
    found = []
    for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True)):
        force, reach, speed = places.force_unit(i), extent.reach[i], extent.speed[i]
        amplitude = (Quantity("friction", force, 0.0),)
        v_s = turning_speed(unit, speed)
        x_s = Quantity("x_s", unit, reach / _WIDE, 10 * reach, log=True)
        found += [
            Effect(
                "friction.coulomb",
                "Coulomb friction",
                "friction",
                (dof,),
                "force = -friction tanh(q'/v_s)",
                amplitude,
                partial(_coulomb, dof=i),
                (v_s,),
                ((0.02 * speed,), (0.15 * speed,)),
                absorbed_by="at small amplitudes, damping",
                told_apart_by="two amplitudes of excitation",
            ),
            Effect(
                "friction.stribeck",
                "Friction with a Stribeck peak",
                "friction",
                (dof,),
                "force = -(friction + peak exp(-(q'/v_s)^2)) tanh(q'/(turn v_s))",
                (*amplitude, Quantity("peak", force, 0.0)),
                partial(_stribeck, dof=i),
                (v_s, Quantity("turn", "1", 0.02, 1.0, log=True)),
                ((0.1 * speed, 0.2), (0.6 * speed, 0.2)),
                absorbed_by="at small amplitudes, damping",
                told_apart_by="slow and fast motions of the same amplitude",
                contains={"friction.coulomb": _turn},
            ),
            *_asymmetric(i, dof, force, speed, v_s),
            Effect(
                "friction.dahl",
                "Dahl friction (elastic before slip)",
                "friction",
                (dof,),
                "force = -friction f, df = (1 - f sign dq) dq / x_s",
                amplitude,
                partial(_dahl, dof=i),
                (x_s,),
                ((0.08 * reach,), (0.4 * reach,)),
                absorbed_by=_ELASTIC,
                told_apart_by=_LOOPS,
                initial_force_decay=partial(_remains, dof=i),
            ),
            Effect(
                "friction.bouc_wen",
                "Bouc-Wen hysteresis",
                "friction",
                (dof,),
                "force = -friction z, dz = (1 - |z|^n (b sign(z dq) + 1 - b)) dq / x_s",
                amplitude,
                partial(_bouc_wen, dof=i),
                (
                    x_s,
                    Quantity("n", "1", 0.5, 6.0, log=True),
                    Quantity("b", "1", 0.0, 1.0),
                ),
                ((0.25 * reach, 1.5, 0.6),),
                absorbed_by=_ELASTIC,
                told_apart_by=_LOOPS,
                initial_force_decay=partial(_remains, dof=i),
            ),
            Effect(
                "friction.lugre",
                "LuGre friction (elastic, with a Stribeck peak)",
                "friction",
                (dof,),
                "force = -friction f, df = (1 - f sign dq / g) dq / x_s, "
                "g = 1 + peak exp(-(q'/v_s)^2)",
                amplitude,
                partial(_lugre, dof=i),
                (x_s, Quantity("peak", "1", 0.0, 4.0), v_s),
                ((0.15 * reach, 0.4, 0.1 * speed), (0.08 * reach, 0.7, 0.8 * speed)),
                absorbed_by=_ELASTIC,
                told_apart_by=_LOOPS + ", slow and fast",
                contains={"friction.dahl": _elastic_reach},
                initial_force_decay=partial(_remains, dof=i),
            ),
            Effect(
                "friction.maxwell_slip",
                "Maxwell-slip presliding hysteresis",
                "friction",
                (dof,),
                "force = -sum of f_j, df_j = friction_j dq / x_j while |f_j| < friction_j; "
                "x_j = x_s, 4 x_s, 16 x_s",
                tuple(Quantity(f"friction_{j + 1}", force, 0.0) for j in range(len(_ELEMENTS))),
                partial(_maxwell, dof=i),
                (x_s,),
                ((0.15 * reach,),),
                absorbed_by=_ELASTIC,
                told_apart_by=_LOOPS,
                initial_force_decay=partial(_remains, dof=i),
            ),
        ]
    return found


def turning_speed(unit: str, speed: float) -> Quantity:
    """Return v_s, within which friction turns, of a DOF in a unit with an RMS speed."""
    low, high = SLOWEST * speed, 3 * speed
    return Quantity("v_s", f"{unit}/s", low, high, log=True, another_above=STILL_DRY * speed)


def direction(signals: Signals, dof: int, v_s: float, peak: float = np.inf) -> Array:
    """Return tanh(q' / v_s) (N,), times a Stribeck peak exp(-(q' / peak)^2).

    Friction that turns faster than the records are sampled would be known to a row only: where
    signals ask for it, this is what its means around the rows tell.
    """
    if not np.isfinite(peak):
        return law_of_speed(signals, dof, v_s, np.tanh, ln_cosh)
    return _with_peak(signals, dof, v_s, peak)[1]


def _with_peak(signals: Signals, dof: int, v_s: float, peak: float) -> tuple[Array, Array]:
    """Return `direction` (N,) without and with a Stribeck peak."""
    if not signals.around_rows:
        speed = signals.qd[:, dof]
        turned = np.tanh(speed / v_s)
        return turned, np.asarray(turned * np.exp(-((speed / peak) ** 2)))
    speed = speeds_between_rows(signals, dof)
    parts = means_of_parts(speed / v_s, np.tanh, ln_cosh)
    return at_rows(parts), at_rows(parts * np.exp(-((middles(speed) / peak) ** 2)))


def _asymmetric(i: int, dof: str, force: str, speed: float, v_s: Quantity) -> list[Effect]:
    """Return sliding friction with one level for each direction."""
    levels = (Quantity("friction", force, 0.0, another_below=True), Quantity("asymmetry", force))
    absorbed = "asymmetry: the constant force while the DOF moves; at small amplitudes, damping"
    apart = "two amplitudes of excitation, with rests"
    return [
        Effect(
            "friction.coulomb_asymmetric",
            "Coulomb friction that depends on the direction",
            "friction",
            (dof,),
            "force = -(friction + asymmetry s) s, s = tanh(q'/v_s)",
            levels,
            partial(_coulomb_asymmetric, dof=i),
            (v_s,),
            ((0.02 * speed,), (0.15 * speed,)),
            absorbed_by=absorbed,
            told_apart_by=apart,
            contains={"friction.coulomb": tuple},
        ),
        Effect(
            "friction.stribeck_asymmetric",
            "Friction with a Stribeck peak that depends on the direction",
            "friction",
            (dof,),
            "force = -(friction + peak exp(-(q'/v_s)^2) + asymmetry s) s, s = tanh(q'/(turn v_s))",
            (levels[0], Quantity("peak", force, 0.0), levels[1]),
            partial(_stribeck_asymmetric, dof=i),
            (v_s, Quantity("turn", "1", 0.02, 1.0, log=True)),
            ((0.1 * speed, 0.2), (0.6 * speed, 0.2)),
            absorbed_by=absorbed,
            told_apart_by=apart + ", slow and fast",
            contains={
                "friction.coulomb": _turn,
                "friction.coulomb_asymmetric": _turn,
                "friction.stribeck": tuple,
            },
        ),
    ]


def _elastic_reach(shape: Sequence[float]) -> tuple[float, ...]:
    """Return the displacement of elastic friction without its Stribeck peak."""
    return (shape[0],)


def _turn(shape: Sequence[float]) -> tuple[float, ...]:
    """Return the speed within which sliding friction with a Stribeck peak turns."""
    return (shape[0] * shape[1],)


def _coulomb(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    return [on_dof(signals, dof, -direction(signals, dof, shape[0]))]


def _turned_squared(signals: Signals, dof: int, v_s: float) -> Array:
    """Return the same of tanh(q' / v_s)^2, whose integral is x - tanh x."""
    return law_of_speed(signals, dof, v_s, lambda x: np.tanh(x) ** 2, lambda x: x - np.tanh(x))


def _stribeck(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    v_s = shape[0] * shape[1]
    return [on_dof(signals, dof, -level) for level in _with_peak(signals, dof, v_s, shape[0])]


def _coulomb_asymmetric(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    s, squared = direction(signals, dof, shape[0]), _turned_squared(signals, dof, shape[0])
    return [on_dof(signals, dof, v) for v in (-s, -squared)]


def _stribeck_asymmetric(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    v_s = shape[0] * shape[1]
    sliding, peak = _with_peak(signals, dof, v_s, shape[0])
    squared = _turned_squared(signals, dof, v_s)
    return [on_dof(signals, dof, -level) for level in (sliding, peak, squared)]


def _dahl(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    return [on_dof(signals, dof, -dahl(signals.q[:, dof], shape[0], signals.Ts_s))]


def _bouc_wen(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    return [
        on_dof(
            signals, dof, -bouc_wen(signals.q[:, dof], shape[0], shape[1], shape[2], signals.Ts_s)
        )
    ]


def _lugre(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    q, qd = signals.q[:, dof], signals.qd[:, dof]
    return [on_dof(signals, dof, -lugre(q, qd, shape[0], shape[1], shape[2], signals.Ts_s))]


def _remains(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    """Return the decay of an unknown force at row 0; exact for Dahl, approximate for the others."""
    path = np.abs(np.diff(signals.q[:, dof], prepend=signals.q[0, dof])).cumsum()
    return [on_dof(signals, dof, np.exp(-path / shape[0]))]


def _maxwell(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    q = signals.q[:, dof]
    return [on_dof(signals, dof, -slip(q, shape[0] * r, signals.Ts_s)) for r in _ELEMENTS]
