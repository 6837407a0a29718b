"""Find the columns of a data file that hold the time, and their unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...config.units import known_unit
from .columns_of_file import FileColumn
from .header_units import header_unit, is_time_name, time_unit_in
from .time_axis import PRECISE, combined_time_s, smallest_step

Array = NDArray[np.float64]

_FIRST_S, _LAST_S = 9.46e8, 4.1e9
"""Seconds from 1970 to 2000 and to 2100: stamps in this range count from 1970."""
_TICKS_OF_1601 = (1.25e17, 1.6e17)
"""100 ns since 1601, as Windows counts."""
_DAYS_OF_1900, _DAYS_OF_0 = (3.0e4, 8.0e4), (7.0e5, 7.7e5)
"""Days as spreadsheets and MATLAB count them, from 1982 to 2119 and from 1916 to 2108."""
_SHORTEST_STEP_S = 1e-5
TIME_UNITS = (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9))
"""Usual units of time, and how many make a second."""
_RATE_DIFFERENCE = 0.02
"""Relative difference up to which a stated rate tells the unit of the time."""
_RISING = 0.9
"""Least share of steps that do not go back: a clock may begin again."""
_STEADY = 0.5
"""Least share of steps near the median: a clock has equal steps."""


@dataclass(frozen=True)
class ClockColumn:
    """A column with the time, or a part of it: its index, unit and factor to this unit.

    doubt: what to check; "" if the file states the unit. unknown: the unit is not known.
    """

    index: int
    unit: str
    scale: float = 1.0
    doubt: str = ""
    unknown: bool = False

    @property
    def unit_s(self) -> float:
        """The unit of the file's values, in s."""
        known = known_unit(self.unit)
        assert known is not None
        return known.factor * self.scale

    def seconds(self, values: Sequence[Array]) -> Array:
        """Return the column in s, of all columns of the file."""
        return self.unit_s * values[self.index]


def find_clock(
    columns: Sequence[FileColumn],
    values: Sequence[Array],
    rate_hz: float | None,
    *,
    first_is_signal: bool,
) -> tuple[ClockColumn, ...]:
    """Return the columns whose sum is the time; empty without a clock.

    Candidates have a unit of time, a name such as timestamp, dates, or are the first of unnamed
    columns. rate_hz: the rate that the file states, or None; it decides on an unknown unit.
    first_is_signal: whether the name of the first column says that it is an input or output.
    """
    named = [i for i, column in enumerate(columns) if _may_be_time(column)]
    if not (named or first_is_signal) and columns and _is_first_clock(columns[0], values[0]):
        named = [0]
    for index in named:
        known = values[index][~np.isnan(values[index])]
        if len(known) < 3:
            continue
        steps = np.diff(known)
        if np.mean(steps >= 0.0) < _RISING:
            continue
        main = _clock(index, columns[index], known, rate_hz)
        parts = [
            _clock(other, columns[other], values[other], None)
            for other in named
            if other != index
            and not np.isnan(values[other]).all()  # nor empty
            and _is_fraction(columns[index], columns[other])
        ]
        if np.mean(steps > 0.0) < _STEADY:
            # A clock that stands still from row to row counts seconds or days; others the rest.
            fine = _fraction_of(main, parts, values)
            if not fine:
                continue
            return (main, *fine)
        return (main,)
    return ()


def _may_be_time(column: FileColumn) -> bool:
    unit = known_unit(header_unit(column.unit) or column.unit) if column.unit else None
    if unit is not None:
        return unit.si == "s"
    return column.dates or (not column.unit and is_time_name(column.label))


def _is_first_clock(column: FileColumn, values: Array) -> bool:
    """Return whether a first column without a known unit rises steadily, as a clock does."""
    known = values[~np.isnan(values)]
    if len(known) < 3 or (column.unit and header_unit(column.unit) is not None):
        return False
    steps = np.diff(known)
    if not np.all(steps > 0.0) or _counts_rows(known):
        return False
    steady = np.abs(steps - np.median(steps)) < 0.01 * np.median(steps)
    return not column.label or bool(np.mean(steady) > _RISING)


def _counts_rows(values: Array) -> bool:
    """Return whether values are 0, 1, 2, ... or 1, 2, 3, ...: numbers of the rows, no times."""
    return bool(values[0] in (0.0, 1.0) and np.all(np.diff(values) == 1.0))


def _clock(index: int, column: FileColumn, values: Array, rate_hz: float | None) -> ClockColumn:
    """Return a column with its unit: stated, of a word in its name, or of its values."""
    stated = "s" if column.dates else header_unit(column.unit)
    named = time_unit_in(column.label)
    if stated is not None or named not in (None, "s"):
        return ClockColumn(index, stated or named or "s")
    known = values[~np.isnan(values)]
    since = _epoch(index, float(np.median(known)), float(np.median(np.diff(known))))
    if since is not None:
        return since
    if named is not None:
        return ClockColumn(index, named)
    step = float(np.median(np.diff(known)))
    for unit, factor in TIME_UNITS:
        if rate_hz is not None and abs(step * rate_hz / factor - 1.0) < _RATE_DIFFERENCE:
            return ClockColumn(index, unit, doubt="check: unit, from the rate that the file states")
    whole = bool(np.all(known == np.rint(known)))
    return ClockColumn(index, "s", doubt="check: unit", unknown=whole)


def _epoch(index: int, middle: float, step: float) -> ClockColumn | None:
    """Return the clock of stamps that count from a date; None for others."""
    for unit, factor in TIME_UNITS:
        if _FIRST_S * factor < middle < _LAST_S * factor:
            return ClockColumn(index, unit, doubt=f"check: {unit} since 1970")
    if _TICKS_OF_1601[0] < middle < _TICKS_OF_1601[1]:
        return ClockColumn(index, "s", 1e-7, doubt="check: 100 ns since 1601")
    for days, words in ((_DAYS_OF_1900, "1900"), (_DAYS_OF_0, "year 0")):
        # As seconds, such steps would be those of a radio.
        if days[0] < middle < days[1] and 0.0 < step < _SHORTEST_STEP_S:
            return ClockColumn(index, "d", doubt=f"check: days since {words}")
    return None


def _is_fraction(main: FileColumn, other: FileColumn) -> bool:
    """Return whether a second clock may be a part of the first: not two equal units."""
    return other.dates or other.unit != main.unit or other.label != main.label


def _fraction_of(
    main: ClockColumn,
    parts: Sequence[ClockColumn],
    values: Sequence[Array],
) -> tuple[ClockColumn, ...]:
    """Return the columns that make a coarse clock finer, one after the other."""
    chosen = [main]
    coarse_s = smallest_step(main.seconds(values))
    remaining = list(parts)
    while remaining:
        fitting = [
            part
            for part in remaining
            if np.nanmax(part.seconds(values)) - np.nanmin(part.seconds(values))
            <= coarse_s * PRECISE
            and np.isfinite(smallest_step(part.seconds(values)))
        ]
        if not fitting:
            break
        # Of two that say the same, such as ms and ns, the one with the larger steps adds up first.
        best = max(fitting, key=lambda part: smallest_step(part.seconds(values)))
        chosen.append(best)
        remaining.remove(best)
        total = combined_time_s("", [part.seconds(values) for part in chosen], [""] * len(chosen))
        steps = np.diff(total[~np.isnan(total)])
        if np.mean(steps > 0.0) >= _RISING:
            return tuple(chosen[1:])
        coarse_s = smallest_step(best.seconds(values))
    return ()
