"""Fill in short runs of missing values on a uniform time grid, and cut the data at longer ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .interpolation import Method, best_method, interpolate
from .time_grid import LONGEST_FILLED_ROWS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MOST_FILL_ERROR = 0.1
"""Largest error of filled values, over the signal's standard deviation. Missing values of a signal
that changes more from row to row, such as white noise, cut the data."""
_METHODS: tuple[Method, ...] = ("cubic", "linear", "previous value")
_TEST_DISTANCE = 20
"""Rows between two runs of known values that are left out to measure the error."""
_AROUND = 3
"""Known rows that a run of left-out values needs on both sides."""


@dataclass(frozen=True)
class Filling:
    """How runs of one length are filled in one column; error: over the standard deviation."""

    method: Method
    error: float


@dataclass(frozen=True)
class FilledPart:
    """Values (N, C) without missing ones in the used columns, except in rows that are `cut` (N,).

    filled (N, C): which values were filled in.
    """

    values: Array
    cut: Mask
    filled: Mask


class GapFiller:
    """Fill columns of parts (N, C) of one record; NaN is a missing value.

    The error of a method is measured on the longest part: known values are left out in runs as long
    as the missing ones.
    """

    def __init__(self, parts: Sequence[Array], used: Sequence[int]) -> None:
        self._test = max(parts, key=len)
        self._used = used
        # By column and length of the run; None for runs that cannot be tested.
        self._fillings: dict[tuple[int, int], Filling | None] = {}

    def fill(self, values: Array) -> FilledPart:
        """Return a part with short runs of missing values filled in."""
        values = values.copy()
        missing, cut = np.isnan(values), np.zeros(len(values), bool)
        filled = np.zeros(values.shape, bool)
        at = np.arange(len(values), dtype=np.float64)
        for column in self._used:
            known = ~missing[:, column]
            for begin, end in runs(missing[:, column]):
                filling = self._filling(column, end - begin)
                inside = begin > 0 and end < len(values)
                if filling is None or filling.error > MOST_FILL_ERROR or not inside:
                    cut[begin:end] = True
                    continue
                near = known.copy()
                near[: max(begin - 100, 0)] = near[end + 100 :] = False
                values[begin:end, column] = interpolate(
                    at[near], values[near, column], at[begin:end], filling.method
                )
                filled[begin:end, column] = True
        return FilledPart(values, cut, filled & ~cut[:, None])

    def accepted(self, column: int) -> list[Filling]:
        """Return how runs in a column are filled, for all lengths of runs."""
        return [
            filling
            for (of, _), filling in self._fillings.items()
            if of == column and filling is not None and filling.error <= MOST_FILL_ERROR
        ]

    def _filling(self, column: int, length: int) -> Filling | None:
        if length > LONGEST_FILLED_ROWS:
            return None
        if (column, length) not in self._fillings:
            self._fillings[column, length] = _measured(self._test[:, column], length)
        return self._fillings[column, length]


def runs(mask: Mask) -> list[tuple[int, int]]:
    """Return begin and end (exclusive) of every run of true rows (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _measured(values: Array, length: int) -> Filling | None:
    """Return the best method for runs of `length` rows; None without known rows to test it."""
    known = ~np.isnan(values)
    left_out = np.zeros(len(values), bool)
    for begin in range(_AROUND, len(values) - length - _AROUND, length + _TEST_DISTANCE):
        around = slice(begin - _AROUND, begin + length + _AROUND)
        left_out[begin : begin + length] = known[around].all()
    if not left_out.any():
        return None
    at = np.flatnonzero(known).astype(np.float64)
    return Filling(*best_method(at, values[known], left_out[known], _METHODS))
