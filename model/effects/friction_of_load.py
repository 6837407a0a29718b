"""Dry friction that grows with the load: of a worm gear, a lead screw, a ball screw.

The teeth of such a gear slide under the force that they pass on, and friction takes a share of it,
against the motion (Olsson, Astrom, Canudas de Wit, Gafvert, Lischinsky, *Friction models and
friction compensation*, Eur. J. Control 4, 1998). Signature: dry friction that is large while the
command is large, and absent without a command.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_coil
from .friction import turning_speed
from .lag_and_hysteresis_recursions import with_moment
from .motion_between_rows import ln_cosh, means_while_acting
from .operating_range import Extent
from .point_force_conversion import heights

_BEGINS = (0.03, 0.3)
"""Start values of the speed within which it turns, over the RMS speed."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the friction of the gear of every actuator; empty for the rig."""
    if places.beam:
        return []
    found = []
    for c in range(places.coils):
        speed = float(np.abs(places.actuator_motion[c]) @ np.array(extent.speed))
        if speed > 0.0:
            found.append(
                Effect(
                    "actuator.load_friction",
                    "Friction of a gear that grows with its load",
                    "friction",
                    (places.actuator(c),),
                    "force = F - share |F| tanh(q'/v_s), q' the speed at the actuator",
                    (Quantity("share", "1", 0.0, 1.0),),
                    partial(_rubbing, coil=c),
                    (turning_speed(places.motion_unit(c), speed),),
                    tuple((begin * speed,) for begin in _BEGINS),
                    absorbed_by="at a constant command: dry friction",
                    told_apart_by="two amplitudes of the command",
                )
            )
    return found


def _rubbing(signals: Signals, shape: Sequence[float], *, coil: int) -> list[Term]:
    motion = signals.places.actuator_motion[[coil]]
    ahead = heights(signals.qd + signals.lag_s * signals.qdd, motion)[:, 0] / shape[0]
    rates = heights(signals.qdd, motion)[:, 0] / shape[0]
    mean, moment = means_while_acting(signals, ahead, rates, np.tanh, ln_cosh)
    load = np.abs(signals.coil[:, coil])
    return [on_coil(signals, coil, -with_moment(load * mean, load * moment))]
