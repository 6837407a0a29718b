"""Torque ripple: a motor whose force for one command is periodic in the position.

The back-EMF of a motor is no sine, and its phases differ a little: the force per ampere varies over
a pole or a revolution (Jahns and Soong, *Pulsating torque minimization techniques for permanent
magnet AC motor drives*, IEEE Trans. Industrial Electronics 43, 1996). Cogging is there without any
current; this is in proportion to it. Start values of the period are the strongest lines over the
position of what is missing in proportion to the command. Signature: an error of the gain that
depends on the position, equally at all amplitudes and speeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_coil
from .operating_range import TRAVEL, Extent
from .point_force_conversion import times_height

_TYPICAL_CYCLES, _WIDER = 5.0, 2.0
"""Cycles over the travel to start from if no line is known; bounds beyond the start values."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the ripple of every actuator over its own position; empty for the rig."""
    if places.beam:
        return []
    found = []
    for c in range(places.coils):
        where, motion = (places.actuator(c),), np.abs(places.actuator_motion[c])
        typical = TRAVEL * float(motion @ np.asarray(extent.reach)) / _TYPICAL_CYCLES
        if not typical > 0.0:
            continue  # it moves nothing
        pitches = (extent.ripples[c] if extent.ripples else ()) or (typical,)
        found.append(
            Effect(
                "torque_ripple.position",
                places.worded("Ripple of a coil's force over the position"),
                "torque_ripple",
                where,
                "force = F + F (a sin(2 pi x / pitch) + b cos(2 pi x / pitch)), x the position at "
                "the actuator as the command acts",
                (Quantity("a", "1"), Quantity("b", "1")),
                partial(_ripple, coil=c),
                (
                    Quantity(
                        "pitch", places.motion_unit(c), min(pitches) / _WIDER,
                        _WIDER * max(pitches), log=True,
                    ),
                ),
                tuple((pitch,) for pitch in pitches),
                absorbed_by="pitch longer than the travel: gain",
                told_apart_by="excitation at several places, at two amplitudes",
            )
        )  # fmt: skip
    return found


def _ripple(signals: Signals, shape: Sequence[float], *, coil: int) -> list[Term]:
    def waves(x: Array) -> Array:
        return np.stack([np.sin(2 * np.pi / shape[0] * x), np.cos(2 * np.pi / shape[0] * x)])

    F = signals.coil[:, [coil]]
    return [on_coil(signals, coil, w[:, 0]) for w in times_height(signals, [coil], F, waves)]
