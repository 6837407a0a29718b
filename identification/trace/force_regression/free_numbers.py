"""The free numbers of a model as one vector: parameters, then amplitudes and shapes of effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Placed, Quantity
from .force_record import ForceModel

Array = NDArray[np.float64]
Shape = tuple[float, ...]


def numbers(point: ForceModel) -> Array:
    """Return all numbers of a model (F + effects'): parameters, then amplitudes and shapes."""
    placed = [v for p in point.placed for v in (*p.amplitudes, *p.shape)]
    return np.concatenate([point.values, np.array(placed)])


def numbers_of(placed: Placed) -> int:
    """Return the number of an effect's amplitudes and shape parameters."""
    return len(placed.amplitudes) + len(placed.shape)


def way(begin: ForceModel, point: ForceModel) -> Array:
    """Return the change of all free numbers, parameters in their scale."""
    parts = [(point.values - begin.values) / point.parameters.scale]
    for old, new in zip(begin.placed, point.placed, strict=True):
        parts.append(np.subtract([*new.amplitudes, *new.shape], [*old.amplitudes, *old.shape]))
    return np.concatenate(parts)


def shapes_beside(q: Quantity, shape: Shape, i: int) -> tuple[Shape, Shape, float]:
    """Return the shapes below and above, within the bounds, and their distance."""
    step = 1e-3 * abs(shape[i]) if q.log else 1e-5 * (q.high - q.low)
    low, high = list(shape), list(shape)
    low[i], high[i] = max(low[i] - step, q.low), min(high[i] + step, q.high)
    return tuple(low), tuple(high), high[i] - low[i]


def room(point: ForceModel) -> tuple[Array, Array]:
    """Return how far each free number may move down and up; at a bound a little, to be free."""
    free, values = point.parameters, point.values
    low = list((free.low - values) / free.scale)
    high = list((free.high - values) / free.scale)
    for p in point.placed:
        for q, value in zip(
            (*p.effect.amplitudes, *p.effect.shape), (*p.amplitudes, *p.shape), strict=True
        ):
            down, up = q.low - value, q.high - value
            if q.log:  # a long step in a logarithm is none that a line describes
                down, up = max(down, -0.5 * value), min(up, value)
            low.append(down)
            high.append(up)
    least = np.finfo(float).eps
    return np.minimum(low, -least), np.maximum(high, least)


def moved_by(point: ForceModel, step: Array) -> ForceModel:
    """Return the point moved by a step of all free numbers."""
    free = point.parameters
    count = len(free.names)
    values = np.clip(point.values + step[:count] * free.scale, free.low, free.high)
    placed, at = [], count
    for p in point.placed:
        numbers = np.array([*p.amplitudes, *p.shape]) + step[at : at + numbers_of(p)]
        quantities = (*p.effect.amplitudes, *p.effect.shape)
        numbers = np.clip(numbers, [q.low for q in quantities], [q.high for q in quantities])
        split = len(p.amplitudes)
        placed.append(p.with_values(numbers[split:].tolist(), numbers[:split].tolist()))
        at += numbers_of(p)
    return replace(point.with_values(values), placed=tuple(placed))
