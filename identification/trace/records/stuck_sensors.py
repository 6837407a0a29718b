"""Detect sensor readings that are stuck while the platform moves."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, studentized_range

from ..search_options import SearchOptions
from .sensor_white_noise import white_noise

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ROWS = tuple(2**k for k in range(SearchOptions.resolved, 2 * SearchOptions.resolved + 1))
_CHANCE = float(norm.sf(SearchOptions.standard_errors))
_STILL = {rows: float(studentized_range.isf(_CHANCE, rows, np.inf)) for rows in _ROWS}
"""Range of a stuck reading over a number of rows, in noise standard deviations, exceeded as rarely
as three of them by one row. A filtered reading does not stay within it for long while the others
move."""
_LONGEST = max(_STILL)
_SAME = SearchOptions.standard_errors
"""Largest deviation at the ends of a stuck interval, in noise standard deviations."""
_MOVES = SearchOptions.standard_errors
"""Least range expected from the other sensors, over that of a stuck reading."""
_TURNING = _LONGEST
"""Largest number of rows between two stuck intervals that are joined: the motion reverses."""


def stuck_rows(readings: Array, shape: Array) -> Mask | None:
    """Return where readings are stuck (N, S), or None if there is no such row.

    readings (N, S) of sensors with shape (S, n): the other sensors give the expected reading, and
    must agree if any one of them is left out, which might be the faulty one. The first row of a
    stuck interval is still valid and not marked.
    """
    S, n = shape.shape
    if len(readings) < _LONGEST or n + 2 > S:
        return None
    expected = readings @ np.stack([_from_others(shape, s) for s in range(S)], axis=1)
    sd = white_noise(readings)
    count = np.zeros((len(readings) + 1, S), int)
    own, others = _ranges(readings), _ranges(expected)
    for (rows, still), reads, moves in zip(_STILL.items(), own, others, strict=True):
        found = (reads <= still * sd) & (moves >= _MOVES * still * sd)
        count[1 : 1 + len(found)] += found
        count[rows : rows + len(found)] -= found
    stands = np.cumsum(count[:-1], axis=0) > 0
    for s in np.flatnonzero(stands.any(axis=0)).tolist():
        _fit_ends(stands[:, s], readings[:, s], sd[s])
        _join(stands[:, s], readings[:, s], sd[s])
        _confirm(stands[:, s], s, readings, shape, sd[s])
    return stands if stands.any() else None


def _ranges(values: Array) -> Iterator[Array]:
    """Yield the range of values (N, S) over each window of as many rows as _STILL has."""
    highest = lowest = values
    length = 1
    for rows in _STILL:
        while length < rows:  # a window is what two shorter ones cover
            step = min(length, rows - length)
            highest = np.maximum(highest[:-step], highest[step:])
            lowest = np.minimum(lowest[:-step], lowest[step:])
            length += step
        yield highest - lowest


def _from_others(shape: Array, sensor: int, without: int = -1) -> Array:
    """Return the weights (S,) of the other sensors in the expected reading of a sensor."""
    others = [s for s in range(len(shape)) if s not in (sensor, without)]
    weights = np.zeros(len(shape))
    weights[others] = np.linalg.pinv(shape[others]).T @ shape[sensor]
    return weights


def _fit_ends(stands: Mask, reading: Array, noise: float) -> None:
    """Adjust, in place, the begin and end of stuck intervals to the rows with the stuck reading.

    A window may include rows before, and ends if the platform only reverses.
    """
    for first, end in _runs(stands):
        kept = np.median(reading[first:end])
        off = np.abs(reading[first - 1 : end + _LONGEST] - kept) > _SAME * noise
        own = end - first + 1
        stands[first : first + int(np.argmin(off[:own]))] = False
        left = np.flatnonzero(off[own:])
        stands[end : end + (int(left[0]) if len(left) else _LONGEST)] = True


def _join(stands: Mask, reading: Array, noise: float) -> None:
    """Join, in place, stuck intervals between which the reading stays within its noise."""
    for (_, end), (first, _) in pairwise(_runs(stands)):
        between = reading[end - 1 : first + 1]
        if first - end <= _TURNING and np.ptp(between) <= _STILL[_LONGEST] * noise:
            stands[end:first] = True


def _confirm(stands: Mask, sensor: int, readings: Array, shape: Array, noise: float) -> None:
    """Remove, in place, intervals that drift, or whose expected motion depends on one sensor."""
    others = [s for s in range(len(shape)) if s != sensor]
    ways = np.stack([_from_others(shape, sensor, other) for other in others], axis=1)
    for first, end in _runs(stands):
        expected = readings[first - 1 : end] @ ways
        drifts = np.ptp(readings[first:end, sensor]) > _STILL[_LONGEST] * noise
        if drifts or np.ptp(expected, axis=0).min() < _MOVES * min(_STILL.values()) * noise:
            stands[first:end] = False


def _runs(mask: Mask) -> list[tuple[int, int]]:
    """Return first and end (exclusive) of each run of true rows."""
    edges = np.flatnonzero(np.diff(np.r_[0, mask, 0]))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]
