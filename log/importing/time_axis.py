"""Make one time axis of the time columns of a file, and place its rows on a grid."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError
from .clock_restarts import continuous_time, written_once
from .time_grid import TimeGrid, fit_grid

Array = NDArray[np.float64]

_LARGE_STAMP_S = 1e8
_LEAST_STAMPS = 3
_FAR = 10.0
"""Least distance of a wrong time stamp from those beside it, in periods."""
_MOST_WRONG = 0.01
"""Largest share of wrong time stamps."""
PRECISE = 1.0 + 1e-9
"""Factor on a step within which another clock counts between two of its stamps."""


@dataclass(frozen=True)
class TimeAxis:
    """Times (n,) in s of the rows that have one, and the grid on which these are.

    kept (n,): indices of these rows among the N rows of the columns.
    """

    time_s: Array
    kept: NDArray[np.int64]
    grid: TimeGrid
    remarks: tuple[str, ...]


def time_axis(
    where: str,
    parts_s: Sequence[Array],
    labels: Sequence[str],
    unit_s: float,
    *,
    columns: Sequence[Array] = (),
    first_row: int = 0,
    stated_period_s: float | None = None,
    stated_range_s: float | None = None,
) -> TimeAxis:
    """Return the axis that time columns `parts_s`, each (N,) in s, add up to.

    unit_s: unit of the file's stamps. columns: all columns, each (N,), in which rows that were
    written twice are equal. first_row: row in the file of the first one. stated_period_s,
    stated_range_s: the period and the range of the clock as the user states them.

    Raises:
        LogError: two clocks, fewer than three times, or times that do not increase.
    """
    parts_s = [_near_zero(part) for part in parts_s]
    time_s = combined_time_s(where, parts_s, labels) if len(parts_s) > 1 else parts_s[0]
    time_s, remarks = _with_stamps_between(time_s, first_row)
    kept = np.flatnonzero(~np.isnan(time_s))
    if len(kept) < len(time_s):
        remarks.append(f"{len(time_s) - len(kept)} rows without a time are left out")
    once = written_once([time_s[kept], *(column[kept] for column in columns)], [time_s[kept]])
    if len(once) < len(kept):
        remarks.append(f"{len(kept) - len(once)} rows that repeat an earlier row are left out")
        kept = kept[once]
    row = first_row + kept
    time_s, more = continuous_time(where, time_s[kept], row, unit_s, stated_range_s)
    grid = fit_grid(where, time_s, row, stated_period_s)
    return TimeAxis(time_s, kept, grid, (*remarks, *more))


def _with_stamps_between(time_s: Array, first_row: int) -> tuple[Array, list[str]]:
    """Return times (N,) with those of rows whose place their neighbours leave no doubt of.

    Such a row has no stamp, or one far outside those beside it, and the stamps around leave room
    for the rows between them.
    """
    found = time_s.copy()
    before, at, after = time_s[:-2], time_s[1:-1], time_s[2:]
    known = np.flatnonzero(~np.isnan(time_s))
    if len(known) < _LEAST_STAMPS:
        return time_s, []
    period_s = float(np.median(np.abs(np.diff(time_s[known]) / np.diff(known))))
    between = np.abs(after - before - 2.0 * period_s) < 0.5 * period_s
    wrong = between & (np.maximum(before - at, at - after) > _FAR * period_s)
    if np.count_nonzero(wrong) <= max(1.0, _MOST_WRONG * len(time_s)):
        found[1:-1][wrong] = np.nan
    known = np.flatnonzero(~np.isnan(found))
    rows, steps = np.diff(known), np.diff(found[known])
    fits = (rows > 1) & (np.abs(steps - rows * period_s) < 0.5 * period_s)
    place = np.concatenate(
        [np.arange(known[i] + 1, known[i + 1]) for i in np.flatnonzero(fits)] or [known[:0]]
    )
    found[place] = np.interp(place, known, found[known])
    if not len(place):
        return found, []
    listed = ", ".join(
        f"row {first_row + i}" + ("" if np.isnan(time_s[i]) else f" ({time_s[i]:.6g} s)")
        for i in place[:3]
    )
    more = f" and {len(place) - 3} more" if len(place) > 3 else ""
    return found, [f"wrong or missing time stamps replaced by those between: {listed}{more}"]


def combined_time_s(where: str, parts: Sequence[Array], labels: Sequence[str]) -> Array:
    """Return the sum (N,) of columns in s, relative to the first row.

    Raises LogError if two columns are clocks of their own instead of parts of one.
    """
    steps = [smallest_step(part) for part in parts]
    order = sorted(range(len(parts)), key=lambda i: -steps[i])
    for coarse, fine in itertools.pairwise(order):
        spread = float(np.nanmax(parts[fine]) - np.nanmin(parts[fine]))
        if spread > steps[coarse] * PRECISE:
            raise LogError(
                f"{where}: expected columns of role time that add up, such as seconds and "
                f"nanoseconds, found two clocks: {labels[coarse]} and {labels[fine]}; give one of "
                "them the role other"
            )
    found = np.zeros(len(parts[0]))
    for part in parts:
        known = part[~np.isnan(part)]
        found += part - (known[0] if len(known) else 0.0)
    return found


def smallest_step(values: Array) -> float:
    """Return the smallest step between different values; infinite for a constant."""
    steps = np.abs(np.diff(values[~np.isnan(values)]))
    steps = steps[steps > 0.0]
    return float(steps.min()) if len(steps) else np.inf


def _near_zero(stamps_s: Array) -> Array:
    """Return stamps since 1970, or as large, from the first row: differences lose no digits."""
    known = stamps_s[~np.isnan(stamps_s)]
    return stamps_s - known[0] if len(known) and abs(known[0]) > _LARGE_STAMP_S else stamps_s
