"""Continue clocks that begin again, as at midnight; leave out rows that were written twice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_DAYS_S = (43_200.0, 86_400.0)
_TIMER_BITS = (16, 24, 30, 31, 32, 48, 64)
_TICKS_S = (1.0, 1e-3, 1e-6, 1e-7, 1e-9)
_LONGEST_STEP = 6.0
"""Most periods between the rows before and after a restart."""
_FAR = 10.0
"""Least step back, in periods, of rows that are not out of order."""
_MOSTLY = 0.9
"""Least share of regular steps after sorting, if rows are out of order."""
_UNSORTED = 0.01
"""Least share of steps back in rows that are not sorted."""


def written_once(columns: Sequence[Array], times: Sequence[Array]) -> Index:
    """Return the rows of columns, each (N,), without those that repeat an earlier one.

    All rows are returned if one of `times`, each (N,), increases from row to row already, or none
    does without the repeated ones.
    """

    def increase(rows: Index | slice) -> bool:
        return any(bool(np.all(np.diff(time[rows]) > 0.0)) for time in times)

    every = np.arange(len(columns[0]))
    if increase(slice(None)):
        return every
    table = np.ascontiguousarray(np.stack(columns, axis=1))
    _, first = np.unique(table.view(f"V{table.strides[0]}"), return_index=True)
    rows = np.sort(first)
    return rows if increase(rows) else every


def continuous_time(
    where: str, time_s: Array, row: Index, unit_s: float, stated_range_s: float | None = None
) -> tuple[Array, list[str]]:
    """Return times (N,) in s that go on where the clock began again, and remarks.

    `row` (N,) are rows in the file, unit_s the unit of the file's stamps in s. A step back by 12 h
    or 24 h, or by the range of a timer, is an overflow; each step back is one of stated_range_s if
    that is given.

    Raises:
        LogError: the time goes back for another reason; names the remedy.
    """
    remarks: list[str] = []
    steps = np.diff(time_s)
    back = np.flatnonzero(steps < 0.0)
    forward = steps[steps > 0.0]
    if not len(back):
        return time_s, remarks
    if len(back) > len(forward):
        raise LogError(
            f"{where}: expected times that increase from row to row, found times that decrease; "
            "reverse the order of the rows"
        )
    period_s = float(np.median(forward))
    range_s = stated_range_s or _clock_range(time_s, back, period_s, unit_s)
    if range_s is None:
        raise _goes_back(where, time_s, row, back, period_s, unit_s)
    turns = np.zeros(len(time_s))
    turns[back + 1] = range_s
    count = "" if len(back) == 1 else f" and {len(back) - 1} more"
    remarks.append(
        f"the clock begins again after {_duration(range_s)} (row {row[back[0] + 1]}{count}); the "
        "time goes on there"
    )
    return time_s + np.cumsum(turns), remarks


def _clock_range(time_s: Array, back: Index, period_s: float, unit_s: float) -> float | None:
    """Return the usual range of a clock that turns all steps back into steps of few periods.

    All stamps of such a clock lie within its range. If each step leads to the first stamp, records
    follow each other: None.
    """
    again = np.abs(time_s[back + 1] - time_s[0]) < 0.5 * period_s
    if again.all():
        return None
    timers = {2.0**bits * tick for bits in _TIMER_BITS for tick in (unit_s, *_TICKS_S)}
    for range_s in sorted({*_DAYS_S, *timers}):
        step = range_s + np.diff(time_s)[back]
        if np.ptp(time_s) <= range_s and np.all((step > 0.0) & (step < _LONGEST_STEP * period_s)):
            return range_s
    return None


def _goes_back(
    where: str, time_s: Array, row: Index, back: Index, period_s: float, unit_s: float
) -> LogError:
    """Return the error for a clock that goes back, with the remedy for its kind."""
    step_s, at = -np.diff(time_s)[back], row[back[0] + 1]
    found = f"a step back by {step_s[0]:.6g} s in row {at}"
    ordered = np.diff(np.sort(time_s))
    alone = f"rows: {{first: {row[0]}, last: {row[back[0]]}}} and rows: {{first: {at}}}"
    several = f"import each alone ({alone}{', ...' if len(back) > 1 else ''})"
    again = bool(np.all(np.abs(time_s[back + 1] - time_s[0]) < 0.5 * period_s))
    regular = np.mean(np.abs(ordered - period_s) < 0.2 * period_s) > _MOSTLY
    range_s = step_s + period_s
    if again:
        found = f"times that begin again at {time_s[0]:.6g} s in row {at}"
        remedy = f"if records follow each other, {several}"
    elif len(back) > _UNSORTED * len(time_s) and (regular or step_s.max() < _FAR * period_s):
        remedy = "sort the rows by their time"
    else:
        remedy = (
            f"if records follow each other, {several}; if the clock was set back while all rows "
            "were sampled regularly, set rate_hz and give this column the role other"
        )
        if np.all(np.abs(range_s - np.median(range_s)) < 0.5 * period_s):
            value = float(np.median(range_s)) / unit_s
            remedy += f", or set wraps: {value:.10g} for this column, which adds it at each step"
    more = f" and in {len(back) - 1} more rows" if len(back) > 1 else ""
    return LogError(
        f"{where}: expected times that increase from row to row, found {found}{more}; {remedy}"
    )


def _duration(seconds: float) -> str:
    return f"{seconds / 3600.0:g} h" if seconds in _DAYS_S else f"{seconds:.10g} s"
