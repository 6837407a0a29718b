"""Stops that a moving part meets at one end of its way: springs, with dampers or without.

A contact pushes from a position on. Buffers of axes and vehicles, a landing gear, or two structures
that hit each other (pounding) also resist the speed there (Hunt and Crossley, *Coefficient of
restitution interpreted as damping in vibroimpact*, 1975, where this is the Kelvin-Voigt model). A
contact that takes stiffness away at one side adds it at the other, beside another declared
stiffness. Signature: a kink at one position, and beyond it a loop if there is a damper. A gap
(`backlash`) has two such ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from .base import Array, Build, Effect, Places, Quantity, Signals, Term, on_dof
from .operating_range import Extent

_WIDE = 3.0
_STARTS = (-0.5, -0.25, 0.0, 0.25, 0.5)
"""Start positions of a stop over three standard deviations of the record with most motion."""
_APART = "two amplitudes of excitation: the kink does not move"
_SIDES = {"above": 1.0, "below": -1.0}
_NAMES = {"above": "Upper", "below": "Lower"}


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return stops above and below for every DOF, with and without a damper; empty for the rig."""
    if places.beam:
        return []
    return [
        effect
        for i in range(len(places.dof))
        for side in _SIDES
        for effect in _stops(places, i, side, extent.around(i), _WIDE * extent.reach[i])
    ]


def _stops(places: Places, i: int, side: str, middle: float, wide: float) -> list[Effect]:
    unit, force = places.dof_units[i], places.force_unit(i)
    k, c = Quantity("k", f"{force}/{unit}", 0.0), Quantity("c", f"{force} s/{unit}", 0.0)
    q0 = (Quantity("q0", unit, middle - wide, middle + wide),)
    starts = tuple((middle + share * wide,) for share in _STARTS)
    where = f"where q {'>' if side == 'above' else '<'} q0, else 0"
    bare = "stiffness.one_sided" + (".below" if side == "below" else "")
    push = partial(_pushed_back, dof=i, sign=_SIDES[side])
    return [
        Effect(
            bare, f"One-sided stiffness (contact) {side}", "stiffness", (places.dof[i],),
            f"force = -k (q - q0) {where}", (k,), partial(_spring, push=push), q0, starts,
            absorbed_by="the part linear in the position: the declared stiffness",
            told_apart_by=_APART,
        ),
        Effect(
            f"stiffness.stop.{side}", f"{_NAMES[side]} stop with spring and damper", "stiffness",
            (places.dof[i],), f"force = -k (q - q0) - c q' {where}",
            (replace(k, another_below=True), c), push, q0, starts,
            absorbed_by="the part linear in the motion: declared stiffness and damping",
            told_apart_by=_APART,
            contains={bare: tuple},
        ),
    ]  # fmt: skip


def contact(signals: Signals, dof: int, beyond: Array, sign: float) -> tuple[Array, Array]:
    """Return the forces (N,) of the spring and of the damper of a stop, for k and c of 1.

    beyond (N,): how far the DOF is beyond its edge; sign: 1 if the stop is above, -1 if below.
    """
    speed = signals.qd[:, dof]
    # The share of a row's time in which it touches, as it moves on by `way` meanwhile.
    way = np.maximum(np.abs(speed) * signals.Ts_s, np.finfo(float).tiny)
    touches = np.clip(0.5 + beyond / way, 0.0, 1.0)
    return -sign * np.maximum(beyond, 0.0), -touches * speed


def upper_edge(shape: Sequence[float]) -> tuple[float, ...]:
    """Return the shape of a stop at the upper edge of a gap: its middle plus its half width."""
    return (shape[0] + shape[1],)


def lower_edge(shape: Sequence[float]) -> tuple[float, ...]:
    """Return the shape of a stop at the lower edge of a gap: its middle less its half width."""
    return (shape[0] - shape[1],)


def _pushed_back(signals: Signals, shape: Sequence[float], *, dof: int, sign: float) -> list[Term]:
    beyond = sign * (signals.q[:, dof] - shape[0])
    return [on_dof(signals, dof, force) for force in contact(signals, dof, beyond, sign)]


def _spring(signals: Signals, shape: Sequence[float], *, push: Build) -> list[Term]:
    return push(signals, shape)[:1]
