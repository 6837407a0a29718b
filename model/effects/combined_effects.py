"""Combine effects: what several of them add to a plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .actuator_chain import in_chain
from .base import Array, Placed, Signals, Term, total


def together(placed: Sequence[Placed], signals: Signals) -> Term:
    """Return the sum of effects, those of an actuator one behind the other.

    A scale error of all readings counts for the others' readings, and arms that differ for the
    heights and torques of the others.
    """
    scales = [p for p in placed if p.effect.scales_readings]
    arms = [p for p in placed if p.effect.sensor_arms or p.effect.coil_arms]
    common = {id(p) for p in (*scales, *arms)}
    there = with_sensor_arms(arms, signals)
    passed, _ = in_chain([p for p in placed if id(p) not in common], there)
    found = total([p.term(reaching) for p, reaching in passed])
    if arms and found.held is not None:
        errors = [(p.effect.coil_arms, p.amplitudes[0]) for p in arms]
        longer = 1.0 + _by_dof(errors, found.held.shape[1])
        found = replace(found, held=longer * found.held)
    found = total([found, *(p.term(signals) for p in arms)])
    if scales and found.gap is not None:
        factor = float(np.prod([1.0 + p.amplitudes[0] for p in scales]))
        found = replace(found, gap=factor * found.gap)
    return total([found, *(p.term(signals) for p in scales)])


def with_sensor_arms(placed: Sequence[Placed], signals: Signals) -> Signals:
    """Return the signals with heights where the sensors stand by what was found of their arms."""
    errors = [(p.effect.sensor_arms, p.amplitudes[0]) for p in placed if p.effect.sensor_arms]
    if not errors:
        return signals
    return replace(signals, sensor_arms=tuple(_by_dof(errors, signals.q.shape[1]).tolist()))


def _by_dof(errors: Sequence[tuple[tuple[int, ...], float]], count: int) -> Array:
    """Return relative errors of arms by DOF (n,), of (DOF, error) of each effect."""
    arms = np.zeros(count)
    for dof, error in errors:
        arms[list(dof)] += error
    return arms
