"""Interpolate rows with irregular time stamps to a constant rate."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError
from .interpolation import Method, best_method, interpolate
from .signals_yaml import Column, SignalsFile
from .time_grid import TimeGrid

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_LONG_STEP = 5.0
"""Step that splits the data, over the step that 95 % of the steps do not exceed."""
_MIN_ROWS = 5
_MOST_RATE = 10.0
"""Highest rate to resample to, over the rate of the rows."""
_MOST_ROWS = 20.0
"""Most periods of the new rate for each row: more would be interpolation alone."""
_METHODS: tuple[Method, ...] = ("cubic", "linear")
_DOUBTFUL_ERROR = 0.1
"""Interpolation error, over the standard deviation, above which the rows are too far apart."""


@dataclass(frozen=True)
class Resampled:
    """A record at a constant rate, and remarks on the change.

    parts: for each, the first period, values (n, C) and rows in the file (n,) at or before them.
    """

    rate_hz: float
    parts: tuple[tuple[int, Array, Index], ...]
    remarks: tuple[str, ...]


def irregular_error(where: str, time_s: Array, grid: TimeGrid) -> LogError:
    """Return the error for rows that are no samples at a constant rate."""
    low_s, high_s = np.quantile(np.diff(time_s), [0.05, 0.95])
    return LogError(
        f"{where}: irregular time stamps: expected a step of {grid.period_s:.4g} s with at most "
        f"10 % jitter, found steps of {low_s:.3g} to {high_s:.3g} s (90 % of them); if the rows "
        "were measured at these times, set resample: true in the signals file; if a clock sampled "
        "them and only the stamps are irregular, set rate_hz and give this column the role other"
    )


def resample(
    where: str, signals: SignalsFile, time_s: Array, values: Array, row: Index
) -> Resampled:
    """Return values (N, C), measured at times (N,) in s, at a constant rate.

    `row` (N,) are the rows in the file.

    The rate is `rate_hz`, else that of the short steps, at most twice that of the median step.
    Inputs that are held (zoh) become their mean over each period, which keeps their area; inputs
    with foh are interpolated linearly. All other signals are interpolated by cubic splines or
    linearly, whichever restores rows that are left out more accurately. Steps much longer than the
    others split the data.

    Raises:
        LogError: rows with the same time, too few rows, or a rate far above that of the rows.
    """
    used = [i for i, c in enumerate(signals.columns) if c.role not in ("time", "other")]
    complete = ~np.isnan(values[:, used]).any(axis=1)
    remarks = []
    if not complete.all():
        remarks.append(f"{np.count_nonzero(~complete)} rows with missing values are left out")
    time_s, values, row = time_s[complete] - time_s[0], values[complete], row[complete]
    steps = np.diff(time_s)
    if len(steps) < _MIN_ROWS or not steps.min() > 0.0:
        raise LogError(
            f"{where}: resample: expected {_MIN_ROWS} or more complete rows at different times, "
            f"found {len(time_s)} rows, {np.count_nonzero(steps <= 0.0)} of them at the time of "
            "the row before"
        )
    usual_hz = 1.0 / float(np.median(steps))
    rate_hz = signals.rate_hz or _default_rate_hz(steps)
    if rate_hz > _MOST_RATE * usual_hz:
        raise LogError(
            f"{where}: rate_hz: expected at most {_MOST_RATE:g} times the rate of the rows, "
            f"{usual_hz:.4g} Hz, found {rate_hz:g} Hz"
        )
    limit_s = _LONG_STEP * float(np.quantile(steps, 0.95, method="lower"))
    cuts = np.flatnonzero(steps > limit_s) + 1
    edges = [0, *cuts.tolist(), len(time_s)]
    bounds = [b for b in pairwise(edges) if b[1] - b[0] >= _MIN_ROWS]
    test = slice(*max(bounds, key=lambda b: b[1] - b[0])) if bounds else slice(0, len(time_s))
    methods = {
        i: _method(signals, column, time_s[test], values[test, i])
        for i, column in enumerate(signals.columns)
    }
    parts = []
    periods = sum(time_s[end - 1] - time_s[first] for first, end in bounds) * rate_hz
    if periods > _MOST_ROWS * len(time_s):
        raise LogError(
            f"{where}: resample: expected at most {_MOST_ROWS:g} periods for each row, found "
            f"{periods / len(time_s):.3g} at {rate_hz:g} Hz: most rows are far apart; set a lower "
            "rate_hz, or import the dense rows alone (key rows)"
        )
    for first, end in bounds:
        at = time_s[first:end]
        place = np.arange(np.ceil(at[0] * rate_hz - 1e-6), np.floor(at[-1] * rate_hz + 1e-6))
        columns = [
            _resampled(column, at, values[first:end, i], place, rate_hz, methods[i][0])
            for i, column in enumerate(signals.columns)
        ]
        if len(place):
            before = first + np.searchsorted(at, place / rate_hz, side="right") - 1
            parts.append((int(place[0]), np.stack(columns, axis=1), row[np.maximum(before, first)]))
    remarks += _remarks(signals, rate_hz, usual_hz, steps, methods)
    if len(cuts):
        remarks.append(
            f"{len(cuts)} steps between rows are longer than {limit_s:.3g} s: the data are split "
            "there"
        )
    return Resampled(rate_hz, tuple(parts), tuple(remarks))


def _default_rate_hz(steps: Array) -> float:
    """Return a rate of two digits for steps (N,) in s.

    At the median step's rate, half of the input's changes fall together with others in one period;
    far above it, a fit follows the interpolation instead of the plant.
    """
    rate_hz = min(1.0 / float(np.quantile(steps, 0.05)), 2.0 / float(np.median(steps)))
    return float(f"{rate_hz:.2g}")


def _method(
    signals: SignalsFile, column: Column, time_s: Array, values: Array
) -> tuple[Method | None, float]:
    """Return how a column is interpolated, None for the mean over a period, and the error."""
    if column.role in ("time", "other"):
        return "linear", 0.0
    held = column.role in ("input", "excitation")
    if held and signals.input_hold == "zoh":
        return None, 0.0
    left_out = np.arange(len(values)) % 2 == 1
    left_out[-1] = False
    foh = held and signals.input_hold == "foh"
    return best_method(time_s, values, left_out, _METHODS[1:] if foh else _METHODS)


def _resampled(
    column: Column, at: Array, values: Array, place: Array, rate_hz: float, method: Method | None
) -> Array:
    to = place / rate_hz
    if method is None:
        area = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(at))])
        edges = np.append(to, to[-1:] + 1.0 / rate_hz)
        return np.asarray(np.diff(np.interp(edges, at, area)) * rate_hz)
    known = ~np.isnan(values)
    if column.role == "other" and not known.any():
        return np.full(len(to), np.nan)
    return interpolate(at[known], values[known], to, method)


def _remarks(
    signals: SignalsFile,
    rate_hz: float,
    usual_hz: float,
    steps: Array,
    methods: dict[int, tuple[Method | None, float]],
) -> list[str]:
    low_s, high_s = np.quantile(steps, [0.05, 0.95])
    remarks = [
        f"rows at irregular times (90 % of the steps are {low_s:.3g} to {high_s:.3g} s) are "
        f"resampled to {rate_hz:g} Hz; 95 % intervals of an identification do not include the "
        "interpolation error"
    ]
    for i, column in enumerate(signals.columns):
        method, error = methods[i]
        if method is None:
            remarks.append(f"{column.name}: resampled to the mean of the held input in each period")
        elif column.role not in ("time", "other"):
            doubt = ": too large, the rows are too far apart" if error > _DOUBTFUL_ERROR else ""
            remarks.append(
                f"{column.name}: resampled by {method} interpolation; error below "
                f"{100 * error:.2g} % of its standard deviation (every second row left out){doubt}"
            )
    if 2.0 * rate_hz < usual_hz:
        remarks.append(
            f"the rows are not filtered before they are resampled: parts of the signals above "
            f"{0.5 * rate_hz:g} Hz appear at lower frequencies; leave out rate_hz to keep all"
        )
    return remarks
