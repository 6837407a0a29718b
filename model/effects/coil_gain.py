"""Coil gain errors: a constant gain, and a force constant that depends on the height.

A voice coil's force constant falls with the distance from the magnet's middle: equally in both
directions or, near the end of a magnet, in one direction only (Furlani, *Permanent Magnet and
Electromechanical Devices*, 2001, ch. 5). Signature: a force error proportional to one coil's
command; the responses of the DOFs have the ratio of that coil's arms. A sensor's gain error, in
contrast, also appears in the non-rigid part of the readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from .base import Effect, Places, Quantity, Signals, Term, on_coil
from .point_force_conversion import forces, times_height

_ONE_BY_ONE = "excitation of the coils one by one"
_KNOWN = "a known force beside it, such as a weight"
_MOST_GAIN = 3.0
"""Bound of the gain error: a dead coil has -1, a coil with reversed polarity -2."""
_ALL = "same gain for all coils: mass, damping and stiffness by the same factor"


def effects(places: Places) -> list[Effect]:
    """Return gain and height-dependent force constant of every coil, the latter also for all.

    The rig has its scale of all coils elsewhere; other plants have the gain of all actuators here.
    """
    found = []
    for c in range(places.coils):
        where = (places.actuator(c),)
        found.append(
            Effect(
                "coil_gain",
                places.worded("Gain of a coil"),
                "coil_gain",
                where,
                "force = (1 + gain) F",
                (Quantity("gain", "1", -_MOST_GAIN, _MOST_GAIN),),
                partial(_times_height, coils=(c,), power=0),
                absorbed_by=places.worded(_ALL),
                told_apart_by=_KNOWN if places.coils == 1 else places.worded(_ONE_BY_ONE),
                linear=not places.beam,
            )
        )
        if _has_height(places):
            found += [_constant(places, (c,), power) for power in (1, 2)]
    if not places.beam and places.coils > 1 and places.one_command_unit:
        every = tuple(range(places.coils))
        found.append(
            Effect(
                "coil_gain.all",
                places.worded("Gain of all coils"),
                "coil_gain",
                tuple(places.actuator(c) for c in every),
                "force = (1 + gain) F",
                (Quantity("gain", "1", -_MOST_GAIN, _MOST_GAIN),),
                partial(_times_height, coils=every, power=0),
                absorbed_by="free parameters of the model, all of them together",
                told_apart_by=_KNOWN,
                linear=True,
            )
        )
    one_unit = len({places.motion_unit(c) for c in range(places.coils)}) == 1
    if _has_height(places) and places.coils > 1 and one_unit:
        found += [_constant(places, tuple(range(places.coils)), power) for power in (1, 2)]
    return found


def _constant(places: Places, coils: tuple[int, ...], power: int) -> Effect:
    name, title = {
        1: ("linear", "Force constant that changes with the height"),
        2: ("quadratic", "Force constant that changes with the height squared"),
    }[power]
    unit = places.motion_unit(coils[0])
    suffix = ", same for all coils" if len(coils) > 1 else ""
    return Effect(
        f"force_constant.{name}",
        places.worded(f"{title}{suffix}"),
        "force_constant",
        tuple(places.actuator(c) for c in coils),
        "force = (1 + a h) F" if power == 1 else "force = (1 + b h^2) F",
        (Quantity("ab"[power - 1], f"1/{unit}" if power == 1 else f"1/{unit}^2"),),
        partial(_times_height, coils=coils, power=power),
        absorbed_by="static force times height: stiffness" if power == 1 else "",
        told_apart_by=places.worded(
            "excitation of all DOFs and of single coils, at two amplitudes"
        ),
    )


def _has_height(places: Places) -> bool:
    return bool(places.actuator_motion.shape[1] == len(places.dof))


def _times_height(
    signals: Signals, _shape: Sequence[float], *, coils: tuple[int, ...], power: int
) -> list[Term]:
    rows = list(coils)
    F = signals.coil[:, rows]
    if power:
        F = times_height(signals, rows, F, lambda h: h**power)
    if len(rows) == 1:
        return [on_coil(signals, rows[0], F[:, 0])]
    return [Term(held=forces(F, signals.places.coil_shape[rows]))]
