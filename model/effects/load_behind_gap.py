"""Load that a gap joins to a DOF and no sensor sees: backlash measured at the motor.

A gear, a claw coupling or a screw with a worn nut moves its load by contact alone: in the gap the
load coasts, and beyond its edges a spring and a damper act (Nordin and Gutman, *Controlling
mechanical systems with backlash - a survey*, Automatica 38, 2002, section 2). Its own bearings slow
it down. The load starts in the middle of the gap; its motion follows from that of the DOF, and what
it was at first is forgotten with the first contacts if these are damped. Signature: an inertia that
is lost where the motion turns, for as long as the load crosses the gap, and comes back with a blow.
A load on a soft shaft without a gap is never lost. If the load bounces between both edges without
much damping, where it is follows from noise, and no law tells its force. Each bounce gives the
squares another minimum: numbers may be wrong by a tenth, of which their intervals know nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_dof
from .flexible import LOOSE_HZ, LOOSE_MASS
from .lag_and_hysteresis_recursions import between_stops
from .load_on_shaft import LOAD, SLOWED, slowing
from .operating_range import Extent

_DAMPING = 0.2
_GAPS = (0.003, 0.01, 0.03, 0.1)
"""Start values of half the gap, over the standard deviation of the motion: a gear's is small beside
the turns of its motor. A fit finds its way over less than an octave of either number."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return a load behind a gap for every DOF; empty for the rig."""
    if places.beam:
        return []
    found = []
    for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True)):
        reach = extent.reach[i]
        starts_hz = extent.resonance_starts_hz() or LOOSE_HZ
        found.append(
            Effect(
                "backlash.load",
                "Load behind a gap (backlash)",
                "backlash",
                (dof,),
                "force = m f, f = w^2 (x - clip(x, -half, half)) + 2 zeta w x' where |x| > half, "
                "else 0, x'' = -q'' - f - slowing (q' + x'); w = 2 pi frequency, zeta = damping",
                (Quantity("m", f"{places.force_unit(i)} s^2/{unit}", 0.0),),
                partial(_load, dof=i),
                (
                    Quantity("frequency", "Hz", extent.slowest_hz, 1000.0, log=True),
                    Quantity("damping", "1", 1e-3, 2.0, log=True),
                    Quantity("half", unit, 1e-4 * reach, 3.0 * reach, log=True),
                    slowing(),
                ),
                tuple(
                    (f_hz, _DAMPING, gap * reach, slowed * extent.speed[i] / reach)
                    for f_hz, gap, slowed in product(starts_hz, _GAPS, SLOWED)
                ),
                absorbed_by="far below its frequency, with a gap far below the motion: mass",
                told_apart_by="two amplitudes of excitation, up to its frequency",
                contains={LOOSE_MASS: _hung, LOAD: _without_gap},
            )
        )
    return found


def _load(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    q, qd, none = signals.q[:, dof], signals.qd[:, dof], np.zeros(signals.rows)
    frequency_hz, damping, half, slowed = shape
    w = 2.0 * np.pi * frequency_hz
    _, contact = between_stops(q, qd, none, w, damping, half, signals.Ts_s, False, slowed)
    return [on_dof(signals, dof, contact)]


def _without_gap(shape: Sequence[float]) -> tuple[float, ...]:
    frequency_hz, damping, _, slowed = shape
    return frequency_hz, damping, slowed


def _hung(shape: Sequence[float]) -> tuple[float, ...]:
    return tuple(shape[:2])
