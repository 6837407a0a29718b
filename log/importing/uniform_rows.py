"""Turn the columns of a data file into parts with one complete row in every period."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...config.units import known_unit
from ..errors import LogError
from .gap_filling import FilledPart, GapFiller, runs
from .irregular_times import irregular_error, resample
from .signals_yaml import Column, SignalsFile
from .time_axis import time_axis
from .time_grid import LONGEST_FILLED_ROWS, TimeGrid

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MOST_FILLED_SHARE = 0.05
"""Largest share of rows with filled values."""
LEAST_USED_SHARE = 0.5
"""Smallest share of the rows that the imported parts must hold."""
_MIN_ROWS = 50
_LEAST_OF_LONGEST = 0.1
"""Shortest part that is imported, over the longest one."""
_RATE_TOLERANCE = 0.01
"""Largest relative difference between rate_hz and the rate of the time stamps."""
_MOST_LISTED = 3
_HOUR_S = 3600.0


@dataclass(frozen=True)
class UniformPart:
    """Values (n, C) in consecutive periods.

    `place` counts periods since the first row of the data; row (n,): row in the file, of a missing
    row the row before it.
    """

    place: int
    values: Array
    row: Index


@dataclass(frozen=True)
class UniformRows:
    """Parts of a record, their rate, and remarks on what was changed."""

    rate_hz: float
    parts: tuple[UniformPart, ...]
    remarks: tuple[str, ...] = ()


def uniform_rows(where: str, signals: SignalsFile, columns: Sequence[Array]) -> UniformRows:
    """Return the columns, each (N,), as parts with one complete row in every period.

    Rows are placed by their time stamps, if there are any. Irregular stamps are resampled if
    `signals` requests it. Short runs of missing values (NaN) are filled in; the data are cut at
    longer ones. Columns of the roles time and other may keep missing values.

    Raises:
        LogError: irregular stamps, another rate than `signals` states, or too many missing values.
    """
    values = np.stack(columns, axis=1)
    row = signals.rows.first + np.arange(len(values))
    times = signals.with_role("time")
    if not times:
        assert signals.rate_hz is not None
        return _completed(
            where, signals, UniformRows(signals.rate_hz, (UniformPart(0, values, row),))
        )
    at = [signals.columns.index(column) for column in times]
    named = f"{where}: {times[0].label}"
    factors = [_factor_to_s(column) for column in times]
    units_s = [factor * abs(column.scale) for factor, column in zip(factors, times, strict=True)]
    ranges = [
        unit_s * column.wraps
        for unit_s, column in zip(units_s, times, strict=True)
        if isinstance(column.wraps, float)
    ]
    axis = time_axis(
        named,
        [factor * values[:, i] for factor, i in zip(factors, at, strict=True)],
        [column.label for column in times],
        units_s[0],
        columns=columns,
        first_row=signals.rows.first,
        stated_period_s=None if signals.rate_hz is None else 1.0 / signals.rate_hz,
        stated_range_s=max(ranges, default=None),
    )
    time_s, grid, remarks = axis.time_s, axis.grid, axis.remarks
    values, row = values[axis.kept], row[axis.kept]
    if len(at) == 1:
        values[:, at[0]] = values[0, at[0]] + (time_s - time_s[0]) / factors[0]
    if signals.resample:
        new = resample(named, signals, time_s, values, row)
        parts = tuple(UniformPart(*part) for part in new.parts)
        kept, dropped = _long_parts(parts)
        if not kept:
            raise LogError(
                f"{named}: resample: expected a part of {_MIN_ROWS} rows or more without long "
                f"steps, found parts of at most {max((len(p.row) for p in parts), default=0)} rows"
            )
        return UniformRows(new.rate_hz, kept, (*remarks, *new.remarks, *dropped))
    if not grid.regular:
        raise irregular_error(named, time_s, grid)
    placed = UniformRows(
        _rate_hz(named, signals.rate_hz, grid),
        tuple(_on_grid(values, row, at, grid)),
        (*remarks, *grid.notes(), *_long_gaps(grid, row)),
    )
    return _completed(where, signals, placed)


def _rate_hz(where: str, stated_hz: float | None, grid: TimeGrid) -> float:
    found_hz = 1.0 / grid.period_s
    if stated_hz is None:
        return found_hz
    if abs(stated_hz / found_hz - 1.0) > _RATE_TOLERANCE:
        raise LogError(
            f"{where}: expected a row every {1.0 / stated_hz:.6g} s, as rate_hz: {stated_hz:g} "
            f"says, found one every {grid.period_s:.6g} s ({found_hz:.6g} Hz); leave out rate_hz, "
            "or correct the unit of the time"
        )
    return stated_hz


def _factor_to_s(column: Column) -> float:
    unit = known_unit(column.unit)
    assert unit is not None  # checked by the schema
    return unit.factor


def _on_grid(values: Array, row: Index, times: Sequence[int], grid: TimeGrid) -> list[UniformPart]:
    """Return the rows of each part of the grid, with NaN in missing rows."""
    found = []
    for part in grid.parts:
        place = part.place - part.place[0]
        every = np.arange(place[-1] + 1)
        table = np.full((len(every), values.shape[1]), np.nan)
        table[place] = values[part.first : part.end]
        for at in times:
            table[:, at] = np.interp(every, place, values[part.first : part.end, at])
        before = np.searchsorted(place, every, side="right") - 1
        rows_here = row[part.first : part.end]
        found.append(UniformPart(int(part.place[0]), table, rows_here[before]))
    return found


def _long_gaps(grid: TimeGrid, row: Index) -> list[str]:
    texts, hour = [], ""
    for before, after in pairwise(grid.parts):
        missing = after.place[0] - before.place[-1] - 1
        texts.append(f"{missing} after row {row[before.end - 1]}")
        if abs(missing * grid.period_s - _HOUR_S) < 1.5 * grid.period_s:
            hour = (
                "; one gap lasts 1 h: if the clock was set forward there, as for daylight saving "
                "time, no row is missing"
            )
    if not texts:
        return []
    return [
        f"rows are missing in the time column ({_listed(texts)}), more than {LONGEST_FILLED_ROWS} "
        f"in a row: the data are split there{hour}"
    ]


def _completed(where: str, signals: SignalsFile, data: UniformRows) -> UniformRows:
    """Fill in short runs of missing values, and cut the parts at others."""
    used = [i for i, c in enumerate(signals.columns) if c.role not in ("time", "other")]
    filler = GapFiller([part.values for part in data.parts], used)
    filled = [filler.fill(part.values) for part in data.parts]
    pieces, cuts = [], []
    for part, done in zip(data.parts, filled, strict=True):
        cuts += [_run_of_rows(part.row, *run) for run in runs(done.cut)]
        pieces += [
            UniformPart(part.place + a, done.values[a:b], part.row[a:b]) for a, b in runs(~done.cut)
        ]
    remarks = [*data.remarks, *_filling_remarks(signals, filler, filled)]
    if cuts:
        remarks.append(
            f"values that cannot be filled in are missing ({_listed(cuts)}; more than "
            f"{LONGEST_FILLED_ROWS} in a row, at an end, or in a signal that changes too much from "
            "row to row): the data are cut there"
        )
    rows = sum(len(part.values) for part in data.parts)
    kept, dropped = _long_parts(pieces)
    left = sum(len(part.values) for part in kept)
    filled_rows = sum(int(np.count_nonzero(done.filled.any(axis=1))) for done in filled)
    if left < max(LEAST_USED_SHARE * rows, 1) or filled_rows > MOST_FILLED_SHARE * rows:
        raise _too_many_missing(where, signals, pieces, rows, left, filled_rows, cuts)
    return UniformRows(data.rate_hz, kept, (*remarks, *dropped))


def _filling_remarks(
    signals: SignalsFile, filler: GapFiller, filled: Sequence[FilledPart]
) -> list[str]:
    remarks = []
    counts = np.sum([done.filled.sum(axis=0) for done in filled], axis=0)
    for column in np.flatnonzero(counts).tolist():
        accepted = filler.accepted(column)
        methods = ", ".join(sorted({f.method for f in accepted}))
        error = max(f.error for f in accepted)
        remarks.append(
            f"{counts[column]} missing values of {signals.columns[column].name} filled in "
            f"({methods}; error about {100 * error:.2g} % of its standard deviation)"
        )
    return remarks


def _long_parts(parts: Sequence[UniformPart]) -> tuple[tuple[UniformPart, ...], list[str]]:
    """Return the parts that are long enough to identify from, and a remark on the others."""
    if len(parts) < 2:
        return tuple(parts), []
    sizes = [len(part.values) for part in parts]
    least = max(_MIN_ROWS, _LEAST_OF_LONGEST * max(sizes))
    kept = tuple(part for part, size in zip(parts, sizes, strict=True) if size >= least)
    count = len(sizes) - len(kept)
    if not count:
        return kept, []
    rows = sum(sizes) - sum(len(part.values) for part in kept)
    parts_text = "1 short part" if count == 1 else f"{count} short parts"
    return kept, [f"{parts_text} between missing values, {rows} rows, left out"]


def _too_many_missing(
    where: str,
    signals: SignalsFile,
    parts: Sequence[UniformPart],
    rows: int,
    left: int,
    filled: int,
    cuts: Sequence[str],
) -> LogError:
    remedy = "record again"
    if parts:
        row = max(parts, key=lambda part: len(part.values)).row
        remedy = f"import the longest part alone by rows: {{first: {row[0]}, last: {row[-1]}}}"
    if signals.with_role("time"):
        remedy += ", or interpolate all rows by resample: true"
    places = f" (missing: {_listed(cuts)})" if cuts else ""
    return LogError(
        f"{where}: too many missing values: expected {LEAST_USED_SHARE:.0%} of the rows in parts "
        f"of {_MIN_ROWS} rows or more, and at most {MOST_FILLED_SHARE:.0%} of the rows to fill in; "
        f"found {left} of {rows} rows in such parts{places} and {filled} rows to fill in; {remedy}"
    )


def _run_of_rows(row: Index, begin: int, end: int) -> str:
    """Return rows of a part as text; `row` (n,) repeats the row before missing ones."""
    if begin and row[end - 1] == row[begin - 1]:
        return f"{end - begin} missing after row {row[begin - 1]}"
    return f"row {row[begin]}" if end - begin == 1 else f"rows {row[begin]} to {row[end - 1]}"


def _listed(texts: Sequence[str]) -> str:
    more = f" and {len(texts) - _MOST_LISTED} more" if len(texts) > _MOST_LISTED else ""
    return f"{', '.join(texts[:_MOST_LISTED])}{more}"
