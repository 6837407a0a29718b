"""Readings that stand still while the platform moves: nothing was measured there."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from .sensor_white_noise import white_noise

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_STILL = {10: 6.0, 16: 6.3, 32: 6.7, 64: 7.1, 128: 7.4, 256: 7.8}
"""Range of a reading that stands for so many rows, in standard deviations of its noise: what one in
a thousand exceeds. A filter does not keep a reading in there for long while others move."""
_LONGEST = max(_STILL)
_SAME = 3.0
"""How far a reading may be off that of a stand at either end of it, likewise."""
_MOVES = 20.0
"""Range of what the other sensors say of that place, likewise."""
_TURNING = 200
"""Rows between two stands at one height that are one: the platform turned back in between."""


def standing(readings: Array, shape: Array) -> Mask | None:
    """Return where a sensor's reading stands still (N, S), or None where none does.

    readings (N, S) of sensors that see shape (S, n) of the pose: what one of them should show, the
    others say, and still do without any one of them, which might be the one that is wrong. The row
    in which a reading comes to a stand is true yet, and not among them.
    """
    S, n = shape.shape
    if len(readings) < _LONGEST or n + 2 > S:
        return None
    expected = readings @ np.stack([_from_others(shape, s) for s in range(S)], axis=1)
    sd = white_noise(readings)
    count = np.zeros((len(readings) + 1, S), int)
    for rows, still in _STILL.items():
        found = (_range(readings, rows) <= still * sd) & (_range(expected, rows) >= _MOVES * sd)
        count[1 : 1 + len(found)] += found
        count[rows : rows + len(found)] -= found
    stands = np.cumsum(count[:-1], axis=0) > 0
    for s in np.flatnonzero(stands.any(axis=0)).tolist():
        _fit_ends(stands[:, s], readings[:, s], sd[s])
        _join(stands[:, s], readings[:, s], sd[s])
        _confirm(stands[:, s], s, readings, shape, sd[s])
    return stands if stands.any() else None


def _range(values: Array, rows: int) -> Array:
    """Return the range of values (N, S) over so many rows, from each on that has them."""
    from_row = slice(rows // 2, rows // 2 + len(values) - rows + 1)
    highest, lowest = maximum_filter1d(values, rows, axis=0), minimum_filter1d(values, rows, axis=0)
    return np.asarray((highest - lowest)[from_row])


def _from_others(shape: Array, sensor: int, without: int = -1) -> Array:
    """Return weights (S,) of the readings in what a sensor should show, by the others."""
    others = [s for s in range(len(shape)) if s not in (sensor, without)]
    weights = np.zeros(len(shape))
    weights[others] = np.linalg.pinv(shape[others]).T @ shape[sensor]
    return weights


def _fit_ends(stands: Mask, reading: Array, noise: float) -> None:
    """Let stands, in place, begin after the reading that they keep, and last as long as it stays.

    A window may hold rows before, and ends where the platform only turns back.
    """
    for first, end in _runs(stands):
        kept = np.median(reading[first:end])
        off = np.abs(reading[first - 1 : end + _LONGEST] - kept) > _SAME * noise
        own = end - first + 1
        stands[first : first + int(np.argmin(off[:own]))] = False
        left = np.flatnonzero(off[own:])
        stands[end : end + (int(left[0]) if len(left) else _LONGEST)] = True


def _join(stands: Mask, reading: Array, noise: float) -> None:
    """Make one stand, in place, of those between which the reading never left its noise."""
    for (_, end), (first, _) in pairwise(_runs(stands)):
        between = reading[end - 1 : first + 1]
        if first - end <= _TURNING and np.ptp(between) <= _STILL[_LONGEST] * noise:
            stands[end:first] = True


def _confirm(stands: Mask, sensor: int, readings: Array, shape: Array, noise: float) -> None:
    """Strike out, in place, what drifts away, and what only one of the other sensors speaks for."""
    others = [s for s in range(len(shape)) if s != sensor]
    ways = np.stack([_from_others(shape, sensor, other) for other in others], axis=1)
    for first, end in _runs(stands):
        expected = readings[first - 1 : end] @ ways
        drifts = np.ptp(readings[first:end, sensor]) > _STILL[_LONGEST] * noise
        if drifts or np.ptp(expected, axis=0).min() < _MOVES * noise:
            stands[first:end] = False


def _runs(mask: Mask) -> list[tuple[int, int]]:
    """Return first and end of each run of true rows."""
    edges = np.flatnonzero(np.diff(np.r_[0, mask, 0]))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]
