"""Force of a permanent magnet over the gap, without a current.

A magnet attracts iron, or another magnet, with a power of one over the gap: two between large
faces that are close, four between magnets that are small beside the gap (Furlani, *Permanent
Magnet and Electromechanical Devices*, 2001, ch. 3). Magnetic springs and bearings work with it. The
equation is the force less that at a working point, which is a constant force of the model; a
stiffness of the model is that without the magnet. The key ends with the working point [q_m], the
rounded mean of the position, and tells whether the gap opens or closes with q. y0 is the gap there,
and c the force. Signature: a force of the position alone that is stiffer the nearer the magnet is.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial

from .base import Effect, Places, Quantity, Signals, Term, on_dof
from .magnetic_force import GAP_BOUNDS, GAPS, SIGNS, over_gap
from .operating_range import EXCURSION, Extent

_POWERS = (2, 4)
_KEY = re.compile(r"permanent_magnet\.y(?P<power>\d)\.(?P<way>\w+)\[(?P<at>[0-9.e+-]+)\]")


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the forces of permanent magnets on every DOF; empty for the rig."""
    if places.beam:
        return []
    return [
        _force(places, extent, i, power, way, extent.around(i))
        for i in range(len(places.dof))
        for power in _POWERS
        for way in SIGNS
    ]


def permanent_magnet_effect(
    places: Places, extent: Extent, key: str, where: Sequence[str]
) -> Effect | None:
    """Return the force with a model file's key and location; None for other keys."""
    found = _KEY.fullmatch(key)
    if found is None or places.beam or len(where) != 1 or where[0] not in places.dof:
        return None
    if int(found["power"]) not in _POWERS or found["way"] not in SIGNS:
        return None
    try:
        at = float(found["at"])
    except ValueError:
        return None
    dof = places.dof.index(where[0])
    return _force(places, extent, dof, int(found["power"]), found["way"], at)


def _force(places: Places, extent: Extent, dof: int, power: int, way: str, at: float) -> Effect:
    largest = EXCURSION * extent.reach[dof]
    low, high = (share * largest for share in GAP_BOUNDS)
    sign = "+" if way == "opens" else "-"
    return Effect(
        f"permanent_magnet.y{power}.{way}[{at:g}]",
        f"Force of a permanent magnet, 1 over gap^{power}, gap {way} with the position",
        "magnetic_force",
        (places.dof[dof],),
        f"force = c ((y0 / (y0 {sign} y))^{power} - 1), y = q - q_m",
        (Quantity("c", places.force_unit(dof)),),
        partial(_attracting, dof=dof, power=power, sign=SIGNS[way], at=at),
        (Quantity("y0", places.dof_units[dof], low, high, log=True),),
        tuple((gap * largest,) for gap in GAPS),
        absorbed_by="the linear part: stiffness; at the working point: constant force",
        told_apart_by="two amplitudes of excitation",
    )


def _attracting(
    signals: Signals, shape: Sequence[float], *, dof: int, power: int, sign: float, at: float
) -> list[Term]:
    x = sign * (signals.q[:, dof] - at) / shape[0]
    return [on_dof(signals, dof, over_gap(x, power) - 1.0)]
