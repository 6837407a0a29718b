"""Measure how late devices answer: heights after a coil's command, the drives after a setpoint.

A delay is the time by which an answer lags on average, a transport delay and half of the answer's
rise together: the area between command and answer over the size of the answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Delay:
    """A delay in s with its standard deviation."""

    mean_s: float
    sd_s: float


@dataclass(frozen=True)
class Swings:
    """Areas (n,) in s times the unit of the answer, and its sizes (n,), of n steps of a command."""

    area: Array
    size: Array


def swings(answers: Array, before: Array, period_s: float) -> Swings:
    """Return the swings of answers (n, h) to n steps; h samples, the first one at the step.

    before (n,): mean answer before each step. The second half of the samples counts as settled.
    """
    settling = answers.shape[1] // 2
    after = answers[:, settling:].mean(axis=1)
    area = period_s * (answers[:, :settling] - after[:, None]).sum(axis=1)
    return Swings(area, before - after)


def delay_of_swings(found: Sequence[Swings]) -> Delay:
    """Return the common delay of swings, each weighted by its size."""
    area, size = (
        np.concatenate([getattr(part, name) for part in found]) for name in ("area", "size")
    )
    total = float(size @ size)
    mean = float(area @ size) / total
    left = size * (area - mean * size)
    return Delay(mean, float(np.sqrt(left @ left)) / total)


def delay_of_moves(setpoints: Sequence[Array]) -> Delay:
    """Return how late drives follow moves, each (n, 3): position and velocity set, and measured."""
    each = np.array([v @ (at - found) / (v @ v) for at, v, found in (s.T for s in setpoints)])
    return Delay(float(each.mean()), float(each.std(ddof=1) / np.sqrt(len(each))))
