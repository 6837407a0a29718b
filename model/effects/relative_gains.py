"""The gain of each coil, and of each sensor, relative to the mean of its kind.

Coils and sensors of one kind differ by some per cent. Their mean is a matter of units: a factor on
all coils is one on masses, damping and stiffness, and only a known mass tells; a factor on all
sensors is told by a known force or length alone. So the gains of a kind are given by their
deviations from the mean, whose sum is zero: the last one is minus the sum of the others. They are
declared in a model file, and fitted with it; a trace that finds the gain of one coil or sensor
needs none of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term
from .point_force_conversion import forces

_MOST = 0.5
"""Bound of a deviation: beyond, the channel is broken rather than weaker."""
COIL_GAINS, SENSOR_GAINS = "coil_gain.relative", "sensor_gain.relative"


def relative_gains(places: Places) -> list[Effect]:
    """Return the relative gains of all coils, and those of all sensors, of a plant with several."""
    found = []
    if places.coils > len(places.dof):
        found.append(
            Effect(
                COIL_GAINS, places.worded("Gains of the coils relative to their mean"),
                "coil_gain", places.actuators, "force_i = (1 + gain_i) F_i, sum of gain_i = 0",
                _deviations(places.coils), partial(_coil_gains, count=places.coils),
                told_apart_by=places.worded("excitation of the coils one by one"),
            )
        )  # fmt: skip
    if places.sensors > len(places.dof):
        found.append(
            Effect(
                SENSOR_GAINS, "Gains of the sensors relative to their mean", "sensor_gain",
                tuple(f"sensor:{s}" for s in range(places.sensors)),
                "reading_i = (1 + gain_i) h_i, sum of gain_i = 0",
                _deviations(places.sensors), partial(_sensor_gains, count=places.sensors),
                told_apart_by="excitation of all DOFs",
            )
        )  # fmt: skip
    return found


def _deviations(count: int) -> tuple[Quantity, ...]:
    return tuple(Quantity(f"gain_{i}", "1", -_MOST, _MOST) for i in range(count - 1))


def _coil_gains(signals: Signals, _shape: Sequence[float], *, count: int) -> list[Term]:
    terms = []
    for c in range(count - 1):
        both = [c, count - 1]
        F = signals.coil[:, both] * np.array([1.0, -1.0])
        terms.append(Term(held=forces(F, signals.places.coil_shape[both])))
    return terms


def _sensor_gains(signals: Signals, _shape: Sequence[float], *, count: int) -> list[Term]:
    terms, last = [], signals.gap(count - 1)
    for s in range(count - 1):
        gap = np.zeros((signals.rows, count))
        gap[:, s], gap[:, -1] = signals.gap(s), -last
        terms.append(Term(gap=gap))
    return terms
