"""Find the columns of a data file that hold the time, and their unit; add them up."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...config.units import known_unit
from ..errors import LogError
from .header_units import header_unit, is_time_name, time_unit_in

Array = NDArray[np.float64]

_FIRST_S, _LAST_S = 9.46e8, 4.1e9
"""Seconds from 1970 to 2000 and to 2100: stamps in this range count from 1970."""
_TICKS_OF_1601 = (1.25e17, 1.6e17)
"""100 ns since 1601, as Windows counts."""
_DAYS_OF_1900, _DAYS_OF_0 = (3.0e4, 8.0e4), (7.0e5, 7.7e5)
"""Days as spreadsheets and MATLAB count them, from 1982 to 2119 and from 1916 to 2108."""
_SHORTEST_STEP_S = 1e-5
_UNITS_OF_1970 = (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9))
_RATE_DIFFERENCE = 0.02
"""Relative difference up to which a stated rate tells the unit of the time."""
_RISING = 0.9
"""Least share of steps that do not go back: a clock may begin again."""
_STEADY = 0.5
"""Least share of steps near the median: a clock has equal steps."""
_PRECISE = 1.0 + 1e-9


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


@dataclass(frozen=True)
class NamedColumn:
    """Name and unit of a column, and whether its cells are dates or times of day.

    signal: whether the name says that it is an input or output.
    """

    name: str
    unit: str
    dates: bool
    signal: bool = False


def find_clock(
    columns: Sequence[NamedColumn], values: Sequence[Array], rate_hz: float | None
) -> tuple[ClockColumn, ...]:
    """Return the columns whose sum is the time; empty without a clock.

    Candidates have a unit of time, a name such as timestamp, dates, or are the first of unnamed
    columns. rate_hz: the rate that the file states, or None; it decides on an unknown unit.
    """
    named = [i for i, column in enumerate(columns) if _may_be_time(column)]
    first = [] if named or not columns or not _is_first_clock(columns[0], values[0]) else [0]
    for index in (*named, *first):
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
            if other != index and _is_fraction(columns[index], columns[other])
        ]
        if np.mean(steps > 0.0) < _STEADY:
            # A clock that stands still from row to row counts seconds or days; others the rest.
            fine = _fraction_of(main, parts, values)
            if not fine:
                continue
            return (main, *fine)
        return (main,)
    return ()


def combined_time_s(where: str, parts: Sequence[Array], labels: Sequence[str]) -> Array:
    """Return the sum (N,) of columns in s, relative to the first row.

    Raises LogError if two columns are clocks of their own instead of parts of one.
    """
    steps = [_smallest_step(part) for part in parts]
    order = sorted(range(len(parts)), key=lambda i: -steps[i])
    for coarse, fine in itertools.pairwise(order):
        spread = float(np.nanmax(parts[fine]) - np.nanmin(parts[fine]))
        if spread > steps[coarse] * _PRECISE:
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


def _smallest_step(values: Array) -> float:
    """Return the smallest step between different values; infinite for a constant."""
    steps = np.abs(np.diff(values[~np.isnan(values)]))
    steps = steps[steps > 0.0]
    return float(steps.min()) if len(steps) else np.inf


def _may_be_time(column: NamedColumn) -> bool:
    unit = known_unit(header_unit(column.unit) or column.unit) if column.unit else None
    if unit is not None:
        return unit.si == "s"
    return column.dates or (not column.unit and is_time_name(column.name))


def _is_first_clock(column: NamedColumn, values: Array) -> bool:
    """Return whether a first column without a known unit rises steadily, as a clock does."""
    known = values[~np.isnan(values)]
    if column.signal or len(known) < 3 or (column.unit and header_unit(column.unit) is not None):
        return False
    steps = np.diff(known)
    if not np.all(steps > 0.0) or _counts_rows(known):
        return False
    steady = np.abs(steps - np.median(steps)) < 0.01 * np.median(steps)
    return not column.name or bool(np.mean(steady) > _RISING)


def _counts_rows(values: Array) -> bool:
    """Return whether values are 0, 1, 2, ... or 1, 2, 3, ...: numbers of the rows, no times."""
    return bool(values[0] in (0.0, 1.0) and np.all(np.diff(values) == 1.0))


def _clock(index: int, column: NamedColumn, values: Array, rate_hz: float | None) -> ClockColumn:
    """Return a column with its unit: stated, of a word in its name, or of its values."""
    stated = "s" if column.dates else header_unit(column.unit)
    named = time_unit_in(column.name)
    if stated is not None or named not in (None, "s"):
        return ClockColumn(index, stated or named or "s")
    known = values[~np.isnan(values)]
    since = _epoch(index, float(np.median(known)), float(np.median(np.diff(known))))
    if since is not None:
        return since
    if named is not None:
        return ClockColumn(index, named)
    step = float(np.median(np.diff(known)))
    for unit, factor in _UNITS_OF_1970:
        if rate_hz is not None and abs(step * rate_hz / factor - 1.0) < _RATE_DIFFERENCE:
            return ClockColumn(index, unit, doubt="check: unit, from the rate that the file states")
    whole = bool(np.all(known == np.rint(known)))
    return ClockColumn(index, "s", doubt="check: unit", unknown=whole)


def _epoch(index: int, middle: float, step: float) -> ClockColumn | None:
    """Return the clock of stamps that count from a date; None for others."""
    for unit, factor in _UNITS_OF_1970:
        if _FIRST_S * factor < middle < _LAST_S * factor:
            return ClockColumn(index, unit, doubt=f"check: {unit} since 1970")
    if _TICKS_OF_1601[0] < middle < _TICKS_OF_1601[1]:
        return ClockColumn(index, "s", 1e-7, doubt="check: 100 ns since 1601")
    for days, words in ((_DAYS_OF_1900, "1900"), (_DAYS_OF_0, "year 0")):
        # As seconds, such steps would be those of a radio.
        if days[0] < middle < days[1] and 0.0 < step < _SHORTEST_STEP_S:
            return ClockColumn(index, "d", doubt=f"check: days since {words}")
    return None


def _is_fraction(main: NamedColumn, other: NamedColumn) -> bool:
    """Return whether a second clock may be a part of the first: not two equal units."""
    return other.dates or other.unit != main.unit or other.name != main.name


def _fraction_of(
    main: ClockColumn,
    parts: Sequence[ClockColumn],
    values: Sequence[Array],
) -> tuple[ClockColumn, ...]:
    """Return the columns that make a coarse clock finer, one after the other."""
    chosen = [main]
    coarse_s = _smallest_step(main.seconds(values))
    remaining = list(parts)
    while remaining:
        fitting = [
            part
            for part in remaining
            if np.nanmax(part.seconds(values)) - np.nanmin(part.seconds(values))
            <= coarse_s * _PRECISE
            and np.isfinite(_smallest_step(part.seconds(values)))
        ]
        if not fitting:
            break
        # Of two that say the same, such as ms and ns, the one with the larger steps adds up first.
        best = max(fitting, key=lambda part: _smallest_step(part.seconds(values)))
        chosen.append(best)
        remaining.remove(best)
        total = combined_time_s("", [part.seconds(values) for part in chosen], [""] * len(chosen))
        steps = np.diff(total[~np.isnan(total)])
        if np.mean(steps > 0.0) >= _RISING:
            return tuple(chosen[1:])
        coarse_s = _smallest_step(best.seconds(values))
    return ()
