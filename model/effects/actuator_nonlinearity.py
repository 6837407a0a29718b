"""Nonlinearity of an actuator: squared, cubic, root, asymmetric, with speed, quantised, hysteresis.

A valve, a propeller or a fan gives a force proportional to the square of its command, with its sign
(Fossen, *Handbook of Marine Craft Hydrodynamics and Motion Control*, 2011, ch. 9), alone or beside
a linear part; an actuator of
one direction has a square without a sign; the flow through a valve is as the root of the pressure
that drives it, and a cylinder with one rod has another gain in each direction (Merritt, *Hydraulic
Control Systems*, 1967). The force of a motor at its voltage limit and of a pump falls with the
speed, in proportion to the command. A back-EMF alone gives a force proportional to the speed; the
declared damping contains it. A converter with few bits rounds the command. The force of a piezo
stack at its voltage, and of iron at its current, depends on where the command came from: a sum of
play operators of several widths (Kuhnen, *Modeling, identification and compensation of complex
hysteretic nonlinearities*, European Journal of Control 9, 2003). All of these act on the command
before delay, hold and lag. Signature: a force error that depends on the command of one actuator,
equally at all frequencies, with harmonics at large amplitudes; even harmonics for the square
without sign and the gains of two directions, odd ones for the others. A hysteresis is late by the
same angle at all frequencies.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_coil, total
from .force_units import per_unit, unit_power
from .lag_and_hysteresis_recursions import play
from .operating_range import Extent
from .point_force_conversion import times_speed

_FEWEST_LEVELS, _MOST_LEVELS = 2.0, 60.0
"""Bounds of the largest command over the step. With fewer levels, a dead zone or a saturation looks
like a converter."""
_LEVELS = tuple(0.5 * k for k in range(6, round(2 * _MOST_LEVELS)))
"""Start values of the same: half a step apart at the largest command, as the rounding of two steps
farther apart has nothing in common."""
_TWO_AMPLITUDES = "excitation of one actuator at a time, at two amplitudes"
SAME_FOR_ALL = ", same for all coils"
_POWERS = {
    "squared": ("Actuator with a squared characteristic", 2, "F |F|"),
    "quadratic": ("Quadratic nonlinearity of an actuator", 2, "F^2"),
    "cubic": ("Cubic nonlinearity of an actuator", 3, "F^3"),
    "root": ("Actuator with the root of its command", 0.5, "sqrt(|F|) sign(F)"),
    "asymmetric": ("Actuator with another gain in each direction", 1, "|F|"),
}
_ELEMENTS = (1.0, 3.0, 9.0)
"""Half widths of the play operators, relative to the smallest."""
_HALVES, _HALF_BOUNDS = (0.03, 0.1), (1e-3, 0.15)
"""Start values and bounds of the smallest half width, over the command's standard deviation. The
widest play moves then for a sixth of the time: one that never moves is a gain."""
_KEY = re.compile(r"actuator\.quadratic(?:\[([-+]?\d+\.?\d*(?:e[-+]?\d+)?)\])?")
_SQUARE_KEY = re.compile(r"actuator\.square\[(\d+\.?\d*(?:e[-+]?\d+)?)\]")
_LINEAR = "the part linear around the mean command: gain; the mean: constant force"


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the nonlinearities of every actuator; empty for the rig."""
    if places.beam:
        return []
    found = []
    if places.coils > 1 and places.one_command_unit:
        found.append(_static(places, range(places.coils), "squared", 0.0))
        found.append(_square(places, range(places.coils), extent.command_spread(0)))
    for c in range(places.coils):
        where, unit = (places.actuator(c),), places.command_unit(c)
        largest = extent.largest_command((c,))
        found += [
            _static(places, (c,), "squared", 0.0),
            _static(places, (c,), "quadratic", extent.mean_command(c)),
            _static(places, (c,), "cubic", 0.0),
            _static(places, (c,), "root", 0.0),
            _static(places, (c,), "asymmetric", 0.0),
            _square(places, (c,), extent.command_spread(c)),
        ]
        found.append(
            Effect(
                "actuator.times_speed",
                "Force of an actuator that falls with the speed",
                "actuator_nonlinearity",
                where,
                "force = F + a F q', q' the speed at the actuator as the command acts",
                (Quantity("a", f"s/{places.motion_unit(c)}"),),
                partial(_times_speed, coil=c),
                absorbed_by="mean command times speed: the declared damping",
                told_apart_by="excitation around several constant commands",
            )
        )
        found.append(
            Effect(
                "actuator.quantised",
                "Quantised command",
                "actuator_nonlinearity",
                where,
                "force = F + depth (round(F / step) step - F)",
                (Quantity("depth", "1", 0.0, 1.0),),
                partial(_quantised, coil=c),
                (
                    Quantity(
                        "step", unit, largest / _MOST_LEVELS, largest / _FEWEST_LEVELS, log=True
                    ),
                ),
                tuple((largest / levels,) for levels in _LEVELS),
                absorbed_by="step far below the command's changes: force noise",
                told_apart_by="small slow excitation",
                shape_of_unit_amplitude=_whole_step,
            )
        )
        spread = extent.command_spread(c)
        least, most = (share * spread for share in _HALF_BOUNDS)
        found.append(
            Effect(
                "actuator.hysteresis",
                "Hysteresis of an actuator",
                "actuator_nonlinearity",
                where,
                "force = F - sum of a_j (F - p_j), p_j follows F at most r_j away; "
                "r_j = r, 3 r, 9 r",
                tuple(Quantity(f"a_{j + 1}", "1", 0.0) for j in range(len(_ELEMENTS))),
                partial(_hysteresis, coil=c),
                (Quantity("r", unit, least, most, log=True),),
                tuple((share * spread,) for share in _HALVES),
                absorbed_by="without play: gain; with full play: constant force",
                told_apart_by="several amplitudes of a slow excitation, and a fast one",
            )
        )
    return found


def quadratic_actuator(places: Places, key: str, where: Sequence[str]) -> Effect | None:
    """Return the law with a number in its key, of a model file's key and location; None for other
    keys: the quadratic nonlinearity, and the force that is the square of its command."""
    quadratic, square = _KEY.fullmatch(key), _SQUARE_KEY.fullmatch(key)
    if places.beam or not set(where).issubset(places.actuators):
        return None
    coils = [places.actuators.index(name) for name in where]
    if quadratic is not None and len(coils) == 1:
        return _static(places, coils, "quadratic", float(quadratic[1] or 0.0))
    if square is not None and len(coils) in (1, places.coils) and float(square[1]) > 0.0:
        return _square(places, coils, float(square[1]))
    return None


def _square(places: Places, coils: Sequence[int], at: float) -> Effect:
    """Return the square of the command in its place, at one actuator, or at all.

    Where its command is `at`, the force is that of the declared gain, whose meaning it keeps so.
    """
    at = float(f"{at:.2g}")
    return Effect(
        f"actuator.square[{at:g}]",
        "Actuator whose force is the square of its command"
        + (places.worded(SAME_FOR_ALL) if len(coils) > 1 else ""),
        "actuator_nonlinearity",
        tuple(places.actuator(c) for c in coils),
        f"force = F + depth (F |F| / F_s - F), F_s = {at:g}",
        (Quantity("depth", "1", 0.0, 1.0),),
        partial(_squares, coils=coils, at=at),
        absorbed_by="around a constant command: gain",
        told_apart_by=_TWO_AMPLITUDES,
        whole=True,
    )


def _static(places: Places, coils: Sequence[int], name: str, at: float) -> Effect:
    """Return a power of the command, less `at`, at one actuator, or the same at some.

    About the mean command the gain of the model keeps its meaning. About zero it is the slope there
    and the number may have no bound: that of a propeller with a purely squared thrust has none.
    """
    title, power, added = _POWERS[name]
    return Effect(
        f"actuator.{name}" + (f"[{at:g}]" if at else ""),
        title + (places.worded(SAME_FOR_ALL) if len(coils) > 1 else ""),
        "actuator_nonlinearity",
        tuple(places.actuator(c) for c in coils),
        f"force = F + a {added}" if not at else f"force = F + a (F - F_m)^2, F_m = {at:g}",
        (Quantity("a", _unit_of(places.command_unit(coils[0]), power)),),
        partial(_power, coils=coils, name=name, at=at),
        absorbed_by=_LINEAR,
        told_apart_by=_TWO_AMPLITUDES,
    )


def _unit_of(unit: str, power: float) -> str:
    """Return the unit of the factor of a power of a command in a unit, over the command."""
    if power == 1.0 or unit == "1":
        return "1"
    return per_unit(unit, round(power) - 1) if power > 1.0 else f"{unit_power(unit, 1)}^0.5"


def _power(
    signals: Signals, _shape: Sequence[float], *, coils: Sequence[int], name: str, at: float
) -> list[Term]:
    def law(F: Array) -> Array:
        size = np.abs(F)
        laws = {
            "squared": F * size,
            "quadratic": F * F,
            "asymmetric": size,
            "root": np.sign(F) * np.sqrt(size),
        }
        return laws.get(name, F**3)

    return [total([on_coil(signals, c, law(signals.coil[:, c] - at)) for c in coils])]


def _squares(
    signals: Signals, _shape: Sequence[float], *, coils: Sequence[int], at: float
) -> list[Term]:
    F = signals.coil
    return [total([on_coil(signals, c, F[:, c] * (np.abs(F[:, c]) / at - 1.0)) for c in coils])]


def _times_speed(signals: Signals, _shape: Sequence[float], *, coil: int) -> list[Term]:
    F = times_speed(signals, [coil], signals.coil[:, [coil]], lambda speed: speed)
    return [on_coil(signals, coil, F[:, 0])]


def _quantised(signals: Signals, shape: Sequence[float], *, coil: int) -> list[Term]:
    F = signals.coil[:, coil]
    return [on_coil(signals, coil, np.round(F / shape[0]) * shape[0] - F)]


def _hysteresis(signals: Signals, shape: Sequence[float], *, coil: int) -> list[Term]:
    F = signals.coil[:, coil]
    plays = (play(F, shape[0] * ratio, signals.Ts_s) for ratio in _ELEMENTS)
    return [on_coil(signals, coil, one - F) for one in plays]


def _whole_step(_depth: Sequence[float], shape: Sequence[float]) -> tuple[float, ...]:
    return tuple(shape)
