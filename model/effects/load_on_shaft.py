"""Load on a soft shaft that no sensor sees: a two-mass drive measured at the motor.

The load hangs on a spring as a mass on a spring does (`flexible`), and its own bearings slow it
down: they act on its speed, not on the deflection of the shaft (Schroeder, *Elektrische Antriebe:
Regelung von Antriebssystemen*, 2015, on two-mass systems). Signature: the resonance and the
antiresonance of a mass on a spring, with the damping of both in another proportion; far below them
the load's bearings damp the motor. With a gap in the shaft it is a load behind a gap.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from .base import Effect, Places, Quantity, Signals, Term, on_dof
from .flexible import DAMPING_START, LOOSE_HZ, LOOSE_MASS, pull_of_mass, resonance
from .operating_range import Extent

LOAD = "flexible_mode.load"
SLOWED = (0.03, 0.2)
"""Start values of the slowing of the load, over the rate of the motion."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return a load on a soft shaft for every DOF; empty for the rig, whose masses hang."""
    if places.beam:
        return []
    return [_on_shaft(places, extent, i) for i in range(len(places.dof))]


def slowing() -> Quantity:
    """Return by how much of its speed the bearings of a load slow it down in a second."""
    return Quantity("slowing", "1/s", 0.01, 1000.0, log=True)


def _on_shaft(places: Places, extent: Extent, i: int) -> Effect:
    rate = extent.speed[i] / extent.reach[i]
    starts_hz = extent.resonance_starts_hz() or LOOSE_HZ
    return Effect(
        LOAD,
        "Load on a soft shaft, in bearings",
        "flexible_mode",
        (places.dof[i],),
        "force = m f, f = w^2 x + 2 zeta w x', x'' = -q'' - f - slowing (q' + x'); "
        "w = 2 pi frequency, zeta = damping",
        (Quantity("m", f"{places.force_unit(i)} s^2/{places.dof_units[i]}", 0.0),),
        partial(_load, dof=i),
        (*resonance(extent.slowest_hz), slowing()),
        tuple((f_hz, DAMPING_START, SLOWED[-1] * rate) for f_hz in starts_hz),
        absorbed_by="far below its frequency: mass and damping",
        told_apart_by="excitation up to its frequency",
        contains={LOOSE_MASS: _without_bearings},
    )


def _load(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    frequency_hz, damping, slowed = shape
    q, qd = signals.q[:, dof], signals.qd[:, dof]
    return [on_dof(signals, dof, pull_of_mass(q, qd, frequency_hz, damping, signals.Ts_s, slowed))]


def _without_bearings(shape: Sequence[float]) -> tuple[float, ...]:
    return tuple(shape[:2])
