"""Damping and stiffness with a power of the speed or of the deflection that is not known before.

Dampers with orifices and shims give a force with a power of the speed between 1 and 2, elastomers
and wire ropes with others; a ball on a plate is pressed with the power 3/2 of the deflection
(Hertz), and cushions and bump stops harden with powers of 3 and more (Harris and Piersol, *Shock
and Vibration Handbook*, 2002, ch. 31 and 32). A power of one is the model's own damping or
stiffness. The key ends with the speed [v] or deflection [d] at which the force is given, the
rounded RMS value of the records. Signature: an odd function of speed or position alone that has no
scale of its own: with twice the amplitude all its harmonics grow by the same factor.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof
from .motion_between_rows import law_of_speed
from .operating_range import Extent

_KEY = re.compile(r"(?P<law>damping\.power|damping\.root|stiffness\.power)\[(?P<at>[0-9.e+-]+)\]")


@dataclass(frozen=True)
class _Law:
    """A law: its title, equation, range of powers, start values, and the laws of one power."""

    title: str
    equation: str
    powers: tuple[float, float]
    begins: tuple[float, ...]
    contains: tuple[str, ...] = ()


_LAWS: Mapping[str, _Law] = {
    "damping.power": _Law(
        "Damping with a power of the speed",
        "force = -F |q'/v|^p sign(q'), v = ",
        (1.2, 4.0),  # nearer to one it is hardly told from a linear force
        (1.5, 3.0),
        ("damping.quadratic",),
    ),
    "damping.root": _Law(
        "Damping with a root of the speed",
        "force = -F |q'/v|^p sign(q'), v = ",
        (0.4, 0.8),  # below it is a friction that levels off
        (0.5,),
    ),
    "stiffness.power": _Law(
        "Spring with a power of the deflection",
        "force = -F |q/d|^p sign(q), d = ",
        (1.3, 8.0),
        (1.5, 5.0),
        ("stiffness.cubic",),
    ),
}


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return damping and stiffness with a power, of every DOF; empty for the rig."""
    if places.beam:
        return []
    values = {"damping": extent.speed, "stiffness": extent.reach}
    return [
        _effect(places, i, name, float(f"{values[name.partition('.')[0]][i]:.1g}"))
        for i in range(len(places.dof))
        for name in _LAWS
    ]


def power_law_effect(places: Places, key: str, where: Sequence[str]) -> Effect | None:
    """Return the law with a model file's key and location; None for other keys."""
    found = _KEY.fullmatch(key)
    if found is None or places.beam or len(where) != 1 or where[0] not in places.dof:
        return None
    try:
        at = float(found["at"])
    except ValueError:
        return None
    return _effect(places, places.dof.index(where[0]), found["law"], at) if at > 0.0 else None


def _effect(places: Places, dof: int, name: str, at: float) -> Effect:
    law, unit, kind = _LAWS[name], places.dof_units[dof], name.partition(".")[0]
    return Effect(
        f"{name}[{at:g}]",
        law.title,
        kind,
        (places.dof[dof],),
        f"{law.equation}{at:g} {unit}" + ("/s" if kind == "damping" else ""),
        (Quantity("F", places.force_unit(dof), 0.0 if kind == "damping" else -np.inf),),
        partial(_power, dof=dof, of_speed=kind == "damping", at=at),
        (Quantity("p", "1", *law.powers, another_below=True),),
        tuple((p,) for p in law.begins),
        absorbed_by=f"the linear part: the declared {kind}",
        told_apart_by="two amplitudes of excitation",
        contains=dict.fromkeys(law.contains, _no_shape),
    )


def _no_shape(_shape: Sequence[float]) -> tuple[float, ...]:
    return ()


def _power(
    signals: Signals, shape: Sequence[float], *, dof: int, of_speed: bool, at: float
) -> list[Term]:
    (p,) = shape
    if of_speed:
        return [on_dof(signals, dof, -law_of_speed(signals, dof, at, *_law_of(p)))]
    return [on_dof(signals, dof, -_law_of(p)[0](signals.q[:, dof] / at))]


def _law_of(p: float) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """Return the law |x|^p sign(x) and its integral from 0."""

    def law(x: Array) -> Array:
        return np.asarray(np.sign(x) * np.abs(x) ** p)

    def integral(x: Array) -> Array:
        return np.asarray(np.abs(x) ** (p + 1.0) / (p + 1.0))

    return law, integral
