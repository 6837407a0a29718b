"""The free numbers of a model as one vector: parameters, then amplitudes and shapes of effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Placed, Quantity
from ...rounding import DIFFERENCE, ROUNDING
from .force_record import ForceModel

Array = NDArray[np.float64]
Shape = tuple[float, ...]


def numbers(point: ForceModel) -> Array:
    """Return all free numbers of a model (F + effects'): parameters, then those of effects."""
    parts = [_free(p, p.values) for p in point.placed]
    return np.concatenate([point.values, *parts])


def numbers_of(placed: Placed) -> int:
    """Return the number of an effect's free amplitudes and shape parameters."""
    return int(placed.freedom.shape[1])


def amplitudes_of(placed: Placed) -> int:
    """Return how many of an effect's free numbers, the first ones, are amplitudes."""
    return int(placed.freedom[: len(placed.amplitudes)].any(axis=0).sum())


def by_value(placed: Placed, of_numbers: Array, held: float) -> Array:
    """Return what is known of an effect's free numbers (numbers,) for all of its values (values,).

    held: the same of a value that is not free.
    """
    free = placed.freedom
    if not free.size:  # all values are held
        return np.full(len(free), held)
    return np.asarray(np.where(free.any(axis=1), of_numbers[np.argmax(free, axis=1)], held))


def _free(placed: Placed, values: Sequence[float]) -> Array:
    """Return the free ones of an effect's values."""
    return np.asarray(np.array(values)[np.argmax(placed.freedom, axis=0)])


def at_limits(point: ForceModel) -> list[tuple[str, str, float]]:
    """Return the parameters that a fit left at a limit of their range: name, which limit, and its
    value. A fit comes as near to a limit as rounding lets it."""
    free, found = point.parameters, []
    near = np.sqrt(np.finfo(float).eps) * free.scale
    for i, name in enumerate(free.names):
        for word, limit in (("lower", free.low[i]), ("upper", free.high[i])):
            if abs(point.values[i] - limit) <= near[i]:
                found.append((name, word, float(limit)))
    return found


def way(begin: ForceModel, point: ForceModel) -> Array:
    """Return the change of all free numbers, parameters in their scale."""
    parts = [(point.values - begin.values) / point.parameters.scale]
    for old, new in zip(begin.placed, point.placed, strict=True):
        parts.append(_free(new, new.values) - _free(new, old.values))
    return np.concatenate(parts)


def shapes_beside(q: Quantity, shape: Shape, i: int) -> tuple[Shape, Shape, float]:
    """Return the shapes below and above, within the bounds, and their distance."""
    step = q.difference * abs(shape[i]) if q.log else DIFFERENCE * (q.high - q.low)
    low, high = list(shape), list(shape)
    low[i], high[i] = max(low[i] - step, q.low), min(high[i] + step, q.high)
    return tuple(low), tuple(high), high[i] - low[i]


def room(point: ForceModel) -> tuple[Array, Array]:
    """Return how far each free number may move down and up; at a bound a little, to be free."""
    free, values = point.parameters, point.values
    low = list((free.low - values) / free.scale)
    high = list((free.high - values) / free.scale)
    for p in point.placed:
        downs, ups = [], []
        for q, value in zip(p.quantities, p.values, strict=True):
            down, up = q.low - value, q.high - value
            if q.log:  # a long step in a logarithm is none that a line describes
                down, up = max(down, -0.5 * value), min(up, value)
            downs.append(down)
            ups.append(up)
        changed = p.freedom.T > 0.0
        low += [max(np.array(downs)[of]) for of in changed]
        high += [min(np.array(ups)[of]) for of in changed]
    least = np.finfo(float).eps
    return np.minimum(low, -least), np.maximum(high, least)


def moved_by(point: ForceModel, step: Array) -> ForceModel:
    """Return the point moved by a step of all free numbers."""
    free = point.parameters
    count = len(free.names)
    parameters = np.clip(point.values + step[:count] * free.scale, free.low, free.high)
    placed, at = [], count
    for p in point.placed:
        values = np.array(p.values) + p.freedom @ step[at : at + numbers_of(p)]
        values = np.clip(values, [q.low for q in p.quantities], [q.high for q in p.quantities])
        split = len(p.amplitudes)
        placed.append(p.with_values(values[split:].tolist(), values[:split].tolist()))
        at += numbers_of(p)
    return replace(point.with_values(parameters), placed=tuple(placed))


def silent_numbers(point: ForceModel, size: Array, power: float) -> NDArray[np.bool_]:
    """Return which free numbers of a model change no force at all (K,), but for rounding.

    size (K,): norms of their columns; those of parameters are in their scale. power: sum of squares
    of the forces that set the scale.
    """
    values = np.abs(numbers(point))
    values[: len(point.values)] = 1.0
    return np.asarray(size * np.where(values > 0.0, values, 1.0) <= ROUNDING * np.sqrt(power))
