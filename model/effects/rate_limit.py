"""Rate limit of an actuator: its force follows the command by at most so much in a second.

Servo valves, drives with a ramp and amplifiers at their voltage limit on an inductance have one
(Klyde and Mitchell, *Investigating the role of rate limiting in pilot-induced oscillations*, J.
Guidance, Control and Dynamics 27, 2004). A controller that limits the steps of its command holds it
over each period. Signature: a lag that grows with amplitude and frequency of the command, and none
where it changes slowly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
from numba import njit

from .base import Effect, Places, Quantity, Signals, Term, on_coil
from .lag_and_hysteresis_recursions import with_moment
from .operating_range import Extent

_OCTAVES = 8
"""Start values of the limit, an octave apart, below that of no effect."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the rate limit of every actuator; empty for the rig."""
    if places.beam:
        return []
    found = []
    for c in range(places.coils):
        # The largest command, at the highest frequency without aliasing.
        most = 2 * math.pi * extent.highest_hz * extent.largest_command((c,))
        unit = places.command_unit(c)
        found += [
            Effect(
                key,
                places.worded(title),
                "rate_limit",
                (places.actuator(c),),
                f"force = F + depth (f - F), f follows F by at most rate, {how}",
                (Quantity("depth", "1", 0.0, 1.0),),
                partial(_limited, coil=c, held=held),
                (Quantity("rate", f"{unit}/s", most / 2.0 ** (_OCTAVES + 2), most, log=True),),
                tuple((most / 2.0**k,) for k in range(1, _OCTAVES + 1)),
                absorbed_by="above the largest rate of the command: nothing",
                told_apart_by="excitation at two amplitudes",
                whole=True,
            )
            for key, title, how, held in (
                ("rate_limit", "Rate limit of a coil", "on a ramp", False),
                ("rate_limit.held", "Rate limit of a command", "held over each period", True),
            )
        ]
    return found


def _limited(signals: Signals, shape: Sequence[float], *, coil: int, held: bool) -> list[Term]:
    F = np.ascontiguousarray(signals.coil[:, coil])
    mean, moment, end = _followed(F, shape[0] * signals.Ts_s)
    return [on_coil(signals, coil, (end if held else with_moment(mean, moment)) - F)]


@njit(cache=True, nogil=True)
def _followed(F, step):  # type: ignore[no-untyped-def]
    """Return mean, moment and end (N,) over each period of a ramp that follows commands F (N,).

    It moves by at most `step` in a period. The moment is the mean times (t / Ts - 1/2).
    """
    mean, moment, last = np.empty(len(F)), np.empty(len(F)), np.empty(len(F))
    value = F[0]
    for row in range(len(F)):
        left = F[row] - value
        share = min(abs(left) / step, 1.0)  # of the period, in which it moves
        way = left if share < 1.0 else math.copysign(step, left)
        end = value + way
        mean[row] = end - 0.5 * share * way
        # Of (s / share - 1) way, for s below the share, times s - 1/2.
        moment[row] = way * share * (0.25 - share / 6.0)
        last[row] = value = end
    return mean, moment, last
