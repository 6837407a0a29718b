"""Coils and amplifiers that are late: a current loop slower than declared, a command that waits.

A held command through a first-order lag, and one that comes a share of a period later, differ only
in their tail (Franklin, Powell, Workman, *Digital Control of Dynamic Systems*, 1998, ch. 4); both
are taken by their mean over each period. Signature: follows the change of one coil's command, grows
with frequency, nothing at rest. A gain does not grow with frequency.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_coil
from .recursions import lagged_mean

_ONE_BY_ONE = "excitation of the coils one by one, up to high frequencies"
_LAG_S = 2e-3


def effects(places: Places) -> list[Effect]:
    """Return lag and delay of every coil."""
    found = []
    for c in range(places.coils):
        where = (f"coil:{c}",)
        found += [
            Effect(
                "actuator_lag",
                "Lag of a coil beyond the others",
                "actuator_lag",
                where,
                "force = F + (F lagged by tail - F) lag / tail",
                (Quantity("lag", "s"),),
                partial(_lag, coil=c),
                (Quantity("tail", "s", 1e-4, 0.1, log=True),),
                ((_LAG_S,),),
                absorbed_by="all coils alike: the declared lag; shorter than a period: delay",
                told_apart_by=_ONE_BY_ONE,
            ),
            Effect(
                "delay",
                "Delay of a coil beyond the others",
                "delay",
                where,
                "force = F(t - delay) by its mean over each period; beyond one, to first order",
                (Quantity("delay", "s"),),
                partial(_delay, coil=c),
                absorbed_by="all coils alike: the declared delay; shorter than a period: lag",
                told_apart_by=_ONE_BY_ONE,
            ),
        ]
    return found


def _lag(signals: Signals, shape: Sequence[float], *, coil: int) -> list[Term]:
    F = signals.coil[:, coil]
    late = lagged_mean(F, shape[0], signals.Ts_s) - F
    return [on_coil(signals, coil, late / shape[0])]


def _delay(signals: Signals, _shape: Sequence[float], *, coil: int) -> list[Term]:
    F = signals.coil[:, coil]
    return [on_coil(signals, coil, -np.diff(F, prepend=F[0]) / signals.Ts_s)]
