"""Unwrap signals and leave out values that are no readings, each with a remark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from ..errors import LogError
from .outlying_values import Spikes, find_codes, find_spikes, lone_level
from .signals_yaml import Column, SignalsFile
from .wrapped_values import Wrap, excursions, find_wrap, unwrapped

Array = NDArray[np.float64]

_MOST_LISTED = 5
_SET = ("input", "excitation", "reference")
"""Roles of signals that a person or a program sets: they may change suddenly by design."""
_KEEP, _MASK = "outliers: keep", "if they are wrong, set outliers: mask for this column"
_AFTER = 3
"""Most rows from a change of an input to a jump of an output that it causes."""
_MOST_AFTER = 0.1
"""Largest share of rows soon after such a change: of more, a jump follows one by chance."""


@dataclass(frozen=True)
class Readings:
    """Columns (N,), NaN where a value is missing or no reading, and remarks on the changes."""

    values: list[Array]
    remarks: tuple[str, ...]


def repaired(where: str, signals: SignalsFile, columns: Sequence[Array]) -> Readings:
    """Return the columns in the units of the file, continuous and without outliers.

    A wrapped output is unwrapped if the range of its jumps is a usual one or stated. Codes for
    missing values and spikes that are certain become NaN, which the import fills in or cuts out.

    Raises:
        LogError: an output jumps by a range that is neither usual nor stated.
    """
    remarks: list[str] = []
    values = [
        _with_codes_left_out(column, signals, read.copy(), remarks)
        for column, read in zip(signals.columns, columns, strict=True)
    ]
    inputs = [v for c, v in zip(signals.columns, values, strict=True) if c.role in _SET[:2]]
    ranges: set[float] = set()
    order = sorted(range(len(values)), key=lambda i: signals.columns[i].role == "reference")
    for i in order:  # references follow the outputs
        column = signals.columns[i]
        if column.role == "time":
            continue
        read = values[i]
        values[i], wrapped = _without_wraps(where, signals, column, read, inputs, ranges, remarks)
        if column.role == "other" or (wrapped and column.role in _SET):
            continue
        values[i] = _without_spikes(column, signals, values[i], read, inputs, remarks)
    return Readings(values, tuple(remarks))


def _with_codes_left_out(
    column: Column, signals: SignalsFile, values: Array, remarks: list[str]
) -> Array:
    """Return values with NaN for those that mean that there is no reading."""
    stated = np.isin(values, [v for v in signals.missing if not isinstance(v, str)])
    if stated.any():
        values[stated] = np.nan
        remarks.append(
            f"{column.name}: {np.count_nonzero(stated)} values listed in missing are left out"
        )
    codes = find_codes(values, levels=column.role in _SET)
    words, kept = "values that mean no reading", _KEEP if column.outliers == "keep" else ""
    return _left_out(column, signals, values, codes, words, kept, remarks)


def _without_spikes(
    column: Column,
    signals: SignalsFile,
    values: Array,
    read: Array,
    inputs: Sequence[Array],
    remarks: list[str],
) -> Array:
    """Return values without certain spikes, unless an input caused them or they are to be kept.

    `read` are the values of the file. All spikes are left out if the column says so.
    """
    level = lone_level(values) if column.role == "output" else None
    if level is not None:
        rows = np.flatnonzero(values == level)
        remarks.append(
            f"{column.name}: {read[rows[0]]:.6g} in {len(rows)} rows, from row "
            f"{signals.rows.first + rows[0]} on, far from all other values, is kept; if it means "
            f"no reading, set missing: [{read[rows[0]]:.6g}] in the signals file"
        )
    spikes, none = find_spikes(values), np.zeros(len(values), bool)
    reason = "the signal itself jumps as far elsewhere"
    if column.role in _SET:
        spikes, reason = Spikes(none, spikes.certain), "it may jump by design"
    elif _caused(np.flatnonzero(spikes.certain), inputs):
        spikes = Spikes(none, spikes.certain | spikes.doubtful)
        reason = "an input or the signal itself jumps as far"
    found = read.copy()
    for mask, kept in ((spikes.certain, ""), (spikes.doubtful, f"{reason}; {_MASK}")):
        why = {"keep": _KEEP, "mask": ""}.get(column.outliers or "", kept)
        words = "values far from those before and after"
        found = _left_out(column, signals, found, mask, words, why, remarks)
    return np.where(np.isnan(found), np.nan, values)


def _left_out(
    column: Column,
    signals: SignalsFile,
    values: Array,
    mask: NDArray[np.bool_],
    words: str,
    kept: str,
    remarks: list[str],
) -> Array:
    """Return values with NaN in a mask, unless there is a reason to keep them; tell in any case."""
    rows = np.flatnonzero(mask)
    if not len(rows):
        return values
    at = _listed([f"{values[row]:.6g} in row {signals.rows.first + row}" for row in rows])
    found = f"{column.name}: {len(rows)} {words} ({at})"
    if kept:
        remarks.append(f"{found} are kept ({kept})")
        return values
    remarks.append(
        f"{found} are left out as missing; to keep them, set outliers: keep for this column"
    )
    return np.where(mask, np.nan, values)


def _without_wraps(
    where: str,
    signals: SignalsFile,
    column: Column,
    values: Array,
    inputs: Sequence[Array],
    ranges: set[float],
    remarks: list[str],
) -> tuple[Array, bool]:
    """Return values without jumps by the range of an angle or counter, and whether it had any.

    `ranges` are those of outputs that are unwrapped, in the logged unit. A reference is unwrapped
    beside such an output only: alone, it may be a saw-tooth.
    """
    wrap = find_wrap(values) if column.wraps is None else None
    if isinstance(column.wraps, float):
        found = unwrapped(values, column.wraps, excursions(values, column.wraps))
        jumps = np.count_nonzero(np.abs(np.diff(found - values)) > 0.5 * column.wraps)
        remarks.append(
            f"{column.name}: unwrapped at {jumps} jumps by {column.wraps:.10g} (wraps in the "
            "signals file)"
        )
        return found, True
    if wrap is None:
        return values, False
    rows = _listed([str(signals.rows.first + row) for row in wrap.rows])
    logged = round((wrap.range or 0.0) * abs(column.scale), 9)
    count = f"at {len(wrap.rows)} rows ({rows})"
    if column.role not in ("output", "reference") or (
        column.role == "reference" and logged not in ranges
    ):
        note = (
            f"jumps by {wrap.estimate:.6g} {count}, as a saw-tooth or a wrapped angle does; it is "
            "kept as it is. If it is wrapped, set wraps for this column"
        )
    elif _caused(wrap.rows, inputs):
        note = f"jumps by {wrap.estimate:.6g} where an input jumps, {count}; it is kept"
    elif wrap.range is not None:
        ranges.add(logged)
        values = unwrapped(values, wrap.range, wrap.apart)
        note = (
            f"begins again after a range of {wrap.range:.6g}, as an angle or a counter does: "
            f"unwrapped {count}; to keep the jumps, set wraps: none for this column"
        )
    elif len(wrap.rows) == 1:
        note = (
            f"jumps once, by {wrap.estimate:.6g} in row {rows}; it is kept. If the sensor was set "
            "to zero there, import the rows before and after alone (key rows)"
        )
    else:
        raise _unknown_range(where, column, wrap, rows)
    if column.role != "other":
        remarks.append(f"{column.name} {note}")
    return values, True


def _unknown_range(where: str, column: Column, wrap: Wrap, rows: str) -> LogError:
    return LogError(
        f"{where}: {column.label}: expected a signal without jumps, found {len(wrap.rows)} jumps "
        f"by {wrap.estimate:.6g} +- {wrap.error:.2g} (rows {rows}), as an angle or a counter makes "
        "at the end of its range; set wraps: RANGE for this column, in the values of the file, or "
        "wraps: none if the signal jumps"
    )


def _caused(rows: Sequence[int] | NDArray[np.int64], inputs: Sequence[Array]) -> bool:
    """Return whether most jumps of an output begin soon after changes of an input that are rare."""
    for values in inputs if len(rows) else ():
        change = np.nan_to_num(np.abs(np.diff(values, prepend=values[:1])))
        soon = maximum_filter1d(change, _AFTER + 1, origin=_AFTER // 2, mode="constant")
        at = np.sort(soon[rows])
        usual = at[len(at) // 4]  # three quarters of the rows follow a change of this size
        if usual > 0.0 and np.mean(soon >= 0.5 * usual) <= _MOST_AFTER:
            return True
    return False


def _listed(texts: Sequence[str]) -> str:
    more = f" and {len(texts) - _MOST_LISTED} more" if len(texts) > _MOST_LISTED else ""
    return f"{', '.join(texts[:_MOST_LISTED])}{more}"
