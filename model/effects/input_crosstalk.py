"""Crosstalk of actuators: a part of one command acts at another input, as of misaligned axes.

Signature: a force in one axis with the command of another one, at all frequencies. A coupling by
mass, damping or stiffness follows the motion instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from .base import Effect, Places, Quantity, Signals, Term, on_coil
from .force_units import ratio


def effects(places: Places) -> list[Effect]:
    """Return the crosstalk of every pair of actuators; empty for the rig."""
    if places.beam:
        return []
    units = [places.command_unit(c) for c in range(places.coils)]
    return [
        Effect(
            "actuator.crosstalk",
            "Actuator with a part of another command",
            "actuator_crosstalk",
            (places.actuator(at), places.actuator(other)),
            "force = F + share F_2, F_2 the command of the second",
            (Quantity("share", ratio(units[at], units[other])),),
            partial(_crosstalk, coil=at, other=other),
            absorbed_by="free entries of B",
            told_apart_by="excitation of both inputs, one at a time",
        )
        for at in range(places.coils)
        for other in range(places.coils)
        if other != at
    ]


def _crosstalk(signals: Signals, _shape: Sequence[float], *, coil: int, other: int) -> list[Term]:
    return [on_coil(signals, coil, signals.coil[:, other])]
