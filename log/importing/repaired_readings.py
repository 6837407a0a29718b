"""Unwrap signals and leave out values that are no readings, each with a remark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError
from .outlying_values import Outliers, find_outliers, lone_extremes
from .signals_yaml import Column, SignalsFile
from .wrapped_values import Wrap, find_wrap, unwrapped

Array = NDArray[np.float64]

_MOST_LISTED = 5
_SUDDEN = ("input", "excitation", "reference")
"""Roles of signals that a person or a program sets: they may change suddenly by design."""
_NEARBY = 3
"""Rows before a spike in which a change of an input may cause it."""


@dataclass(frozen=True)
class Readings:
    """Columns (N,), NaN where a value is missing or no reading, and remarks on the changes."""

    values: list[Array]
    remarks: tuple[str, ...]


def repaired(where: str, signals: SignalsFile, columns: Sequence[Array]) -> Readings:
    """Return the columns in the units of the file, continuous and without outliers.

    A wrapped output is unwrapped if the range of its jumps is a usual one or stated. Codes for
    missing values and single spikes become NaN, which the import fills in or cuts out.

    Raises:
        LogError: an output jumps by a range that is neither usual nor stated.
    """
    numbers = [v for v in signals.missing if not isinstance(v, str)]
    values, remarks, spikes = [], [], {}
    for column, read in zip(signals.columns, columns, strict=True):
        value = read.copy()
        stated = np.isin(value, numbers)
        if stated.any():
            value[stated] = np.nan
            remarks.append(
                f"{column.name}: {np.count_nonzero(stated)} values listed in missing are left out"
            )
        if column.role == "time":
            values.append(_continued_clock(column, value, remarks))
            continue
        found = find_outliers(value, sudden=True)
        value = _without(column, signals, value, found, remarks)
        value, wrapped = _without_wraps(where, signals, column, value, remarks)
        if column.role not in (*_SUDDEN, "other"):
            spikes[len(values)] = find_outliers(value, sudden=False)
        elif column.role in _SUDDEN and not wrapped:
            remarks += _extremes(column, signals, value)
        values.append(value)
    inputs = [v for c, v in zip(signals.columns, values, strict=True) if c.role in _SUDDEN]
    for index, found in spikes.items():
        caused = [row for row in found.rows if _caused(row, found, inputs)]
        if caused:
            found.spikes[caused] = False
            at = _listed([str(signals.rows.first + row) for row in caused])
            remarks.append(
                f"{signals.columns[index].name} has spikes that begin where an input jumps (row "
                f"{at}); they are kept"
            )
        values[index] = _without(signals.columns[index], signals, values[index], found, remarks)
    return Readings(values, tuple(remarks))


def _without(
    column: Column, signals: SignalsFile, values: Array, found: Outliers, remarks: list[str]
) -> Array:
    """Return values without outliers, unless the column keeps them; tell in either case."""
    if not len(found.rows):
        return values
    kinds = [
        (found.codes, "values that mean 'no reading'", "codes"),
        (found.spikes, "values far from those before and after", "spikes"),
    ]
    for mask, words, _ in kinds:
        rows = np.flatnonzero(mask)
        if not len(rows):
            continue
        at = _listed([f"{values[row]:.6g} in row {signals.rows.first + row}" for row in rows])
        if column.outliers == "keep":
            remarks.append(f"{column.name}: {len(rows)} {words} ({at}) are kept (outliers: keep)")
            continue
        remarks.append(
            f"{column.name}: {len(rows)} {words} ({at}) are left out as missing; to keep them, set "
            "outliers: keep for this column"
        )
    if column.outliers == "keep":
        return values
    values = values.copy()
    values[found.rows] = np.nan
    return values


def _without_wraps(
    where: str, signals: SignalsFile, column: Column, values: Array, remarks: list[str]
) -> tuple[Array, bool]:
    """Return values without jumps by the range of an angle or counter, and whether it had any."""
    if column.wraps == "none":
        return values, False
    if column.wraps is not None:
        found = unwrapped(values, column.wraps)
        jumps = np.count_nonzero(np.abs(np.diff(found - values)) > 0.5 * column.wraps)
        remarks.append(
            f"{column.name}: unwrapped at {jumps} jumps by {column.wraps:.10g} (wraps in the "
            "signals file)"
        )
        return found, True
    wrap = find_wrap(values)
    if wrap is None:
        return values, False
    rows = _listed([str(signals.rows.first + row) for row in wrap.rows])
    if column.role in ("input", "excitation", "other") or (
        column.role == "reference" and wrap.range is None
    ):
        if column.role != "other":
            remarks.append(
                f"{column.name} jumps by {wrap.estimate:.6g} at {len(wrap.rows)} rows ({rows}), as "
                "a saw-tooth or a wrapped angle does; it is kept as it is. If it is wrapped, set "
                "wraps for this column"
            )
        return values, True
    if wrap.range is None and len(wrap.rows) == 1:
        remarks.append(
            f"{column.name} jumps once, by {wrap.estimate:.6g} in row {rows}; it is kept. If the "
            "sensor was set to zero there, import the rows before and after alone (key rows)"
        )
        return values, True
    if wrap.range is None:
        raise _unknown_range(where, column, wrap, rows)
    remarks.append(
        f"{column.name} begins again after a range of {wrap.range:.6g}, as an angle or a counter "
        f"does: unwrapped at {len(wrap.rows)} rows ({rows}); to keep the jumps, set wraps: none "
        "for this column"
    )
    return unwrapped(values, wrap.range), True


def _continued_clock(column: Column, values: Array, remarks: list[str]) -> Array:
    """Return stamps (N,) that go on where a clock with a stated range goes back."""
    if column.wraps is None or column.wraps == "none":
        return values
    known = ~np.isnan(values)
    steps = np.diff(values[known], prepend=values[known][:1])
    found = values.copy()
    found[known] += column.wraps * np.cumsum(steps < 0.0)
    remarks.append(
        f"{column.name}: the clock goes on at {np.count_nonzero(steps < 0.0)} steps back, by "
        f"{column.wraps:.10g} each (wraps in the signals file)"
    )
    return found


def _unknown_range(where: str, column: Column, wrap: Wrap, rows: str) -> LogError:
    return LogError(
        f"{where}: {column.label}: expected a signal without jumps, found {len(wrap.rows)} jumps "
        f"by {wrap.estimate:.6g} +- {wrap.error:.2g} (rows {rows}), as an angle or a counter makes "
        "at the end of its range; set wraps: RANGE for this column, in the values of the file, or "
        "wraps: none if the signal jumps"
    )


def _extremes(column: Column, signals: SignalsFile, values: Array) -> list[str]:
    """Return a remark on values of a signal that may jump, far beyond all others."""
    rows = lone_extremes(values)
    if not len(rows) or len(rows) > _MOST_LISTED:
        return []
    at = _listed([f"{values[row]:.6g} in row {signals.rows.first + row}" for row in rows])
    return [
        f"{column.name}: {at}: far beyond all other values; it is kept. If it is no pulse but a "
        f"wrong value, list it in missing"
    ]


def _caused(row: int, found: Outliers, inputs: Sequence[Array]) -> bool:
    """Return whether a spike follows a change of an input that is rare: a pulse, no noise."""
    count = np.count_nonzero(found.spikes)
    for values in inputs:
        change = np.abs(np.diff(values))
        near = change[max(row - _NEARBY, 0) : row + 1]
        if not len(near) or not np.nanmax(np.append(near, 0.0)) > 0.0:
            continue
        if np.count_nonzero(change >= 0.5 * np.nanmax(near)) <= 3 * count:
            return True
    return False


def _listed(texts: Sequence[str]) -> str:
    more = f" and {len(texts) - _MOST_LISTED} more" if len(texts) > _MOST_LISTED else ""
    return f"{', '.join(texts[:_MOST_LISTED])}{more}"
