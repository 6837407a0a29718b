"""Interpolate rows with irregular time stamps to a constant rate."""

from __future__ import annotations

from collections.abc import Sequence
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


@dataclass(frozen=True)
class _Samples:
    """Times (n,) in s and values (n,) of one column, and where its long steps cut them."""

    at: Array
    values: Array
    limit_s: float
    bounds: tuple[tuple[int, int], ...]

    @property
    def longest(self) -> slice:
        """Rows of the longest part."""
        return slice(*max(self.bounds, key=lambda bound: bound[1] - bound[0]))

    def around(self, begin_s: float, end_s: float) -> slice:
        """Return the rows of the part that holds the times from begin to end."""
        inside = [b for b in self.bounds if self.at[b[0]] <= begin_s and end_s <= self.at[b[1] - 1]]
        return slice(*inside[0]) if inside else slice(None)


def resample(
    where: str, signals: SignalsFile, time_s: Array, values: Array, row: Index
) -> Resampled:
    """Return values (N, C), measured at times (N,) in s, at a constant rate.

    `row` (N,) are the rows in the file. Each column has the times of the rows in which it has a
    value: several messages of a bus, each with times of its own, may be in one file.

    The rate is `rate_hz`, else that of the short steps of the fastest column, at most twice that of
    its median step. Inputs that are held (zoh) become their mean over each period, which keeps
    their area; inputs with foh are interpolated linearly. All other signals are interpolated by
    cubic splines or linearly, whichever restores rows that are left out more accurately. Steps much
    longer than the others of a column split the data.

    Raises:
        LogError: rows with the same time, too few rows, or most rows would be interpolation.
    """
    time_s = time_s - time_s[0]
    used = [i for i, c in enumerate(signals.columns) if c.role not in ("time", "other")]
    samples = {
        i: _samples(f"{where}: resample: {signals.columns[i].name}", time_s, values[:, i])
        for i in used
    }
    steps = min((np.diff(each.at) for each in samples.values()), key=np.median)
    usual_hz = 1.0 / float(np.median(steps))
    rate_hz = signals.rate_hz or _default_rate_hz(steps)
    spans = _common_spans(tuple(samples.values()))
    periods = sum(end - begin for begin, end in spans) * rate_hz
    if periods > _MOST_ROWS * len(time_s):
        raise LogError(
            f"{where}: rate_hz: expected at most {_MOST_ROWS:g} periods for each row, found "
            f"{periods / len(time_s):.3g} at {rate_hz:g} Hz (the median step is that of "
            f"{usual_hz:.4g} Hz): set a lower rate_hz, or import dense rows alone (key rows)"
        )
    methods = {i: _method(signals, signals.columns[i], each) for i, each in samples.items()}
    parts = []
    for begin, end in spans:
        place = np.arange(np.ceil(begin * rate_hz - 1e-6), np.floor(end * rate_hz + 1e-6) + 1.0)
        to = place / rate_hz
        table = np.empty((len(to), values.shape[1]))
        for i in range(values.shape[1]):
            if i in samples:
                near = samples[i].around(begin, end)
                at, known = samples[i].at[near], samples[i].values[near]
                table[:, i] = _resampled(at, known, to, rate_hz, methods[i][0])
            else:
                known = ~np.isnan(values[:, i])
                table[:, i] = (
                    np.interp(to, time_s[known], values[known, i]) if known.any() else np.nan
                )
        before = np.searchsorted(time_s, to, side="right") - 1
        parts.append((int(place[0]), table, row[np.maximum(before, 0)]))
    remarks = _remarks(signals, rate_hz, usual_hz, steps, methods)
    for i, each in samples.items():
        name, lost = signals.columns[i].name, len(time_s) - len(each.at)
        if lost:
            remarks.append(f"{name}: {lost} of {len(time_s)} rows have no value of it")
        if len(each.bounds) > 1:
            remarks.append(
                f"{name}: {len(each.bounds) - 1} steps between rows are longer than "
                f"{each.limit_s:.3g} s: the data are split there"
            )
    return Resampled(rate_hz, tuple(parts), tuple(remarks))


def _samples(where: str, time_s: Array, values: Array) -> _Samples:
    known = ~np.isnan(values)
    at, steps = time_s[known], np.diff(time_s[known])
    if len(steps) < _MIN_ROWS or not steps.min() > 0.0:
        raise LogError(
            f"{where}: expected values in {_MIN_ROWS} or more rows at different times, found "
            f"{len(at)} rows, {np.count_nonzero(steps <= 0.0)} of them at the time of the row "
            "before"
        )
    limit_s = _LONG_STEP * float(np.quantile(steps, 0.95, method="lower"))
    edges = [0, *(np.flatnonzero(steps > limit_s) + 1).tolist(), len(at)]
    return _Samples(at, values[known], limit_s, tuple(pairwise(edges)))


def _common_spans(samples: Sequence[_Samples]) -> list[tuple[float, float]]:
    """Return begin and end in s of the times without a long step of any column."""
    spans = [(-np.inf, np.inf)]
    for each in samples:
        own = [
            (each.at[first], each.at[end - 1])
            for first, end in each.bounds
            if end - first >= _MIN_ROWS
        ]
        both = [(max(a, c), min(b, d)) for a, b in spans for c, d in own]
        spans = [(float(begin), float(end)) for begin, end in both if begin < end]
    return spans


def _default_rate_hz(steps: Array) -> float:
    """Return a rate of two digits for steps (N,) in s.

    At the median step's rate, half of the input's changes fall together with others in one period;
    far above it, a fit follows the interpolation instead of the plant.
    """
    rate_hz = min(1.0 / float(np.quantile(steps, 0.05)), 2.0 / float(np.median(steps)))
    return float(f"{rate_hz:.2g}")


def _method(signals: SignalsFile, column: Column, samples: _Samples) -> tuple[Method | None, float]:
    """Return how a column is interpolated, None for the mean over a period, and the error."""
    held = column.role in ("input", "excitation")
    if held and signals.input_hold == "zoh":
        return None, 0.0
    values = samples.values[samples.longest]
    left_out = np.arange(len(values)) % 2 == 1
    left_out[-1] = False
    foh = held and signals.input_hold == "foh"
    methods = _METHODS[1:] if foh else _METHODS
    return best_method(samples.at[samples.longest], values, left_out, methods)


def _resampled(at: Array, values: Array, to: Array, rate_hz: float, method: Method | None) -> Array:
    if method is not None:
        return interpolate(at, values, to, method)
    # The last value is held as well.
    at = np.append(at, at[-1] + 1.0 / rate_hz)
    area = np.concatenate([[0.0], np.cumsum(values * np.diff(at))])
    edges = np.append(to, to[-1:] + 1.0 / rate_hz)
    return np.asarray(np.diff(np.interp(edges, at, area)) * rate_hz)


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
    for i, (method, error) in methods.items():
        column = signals.columns[i]
        if method is None:
            remarks.append(f"{column.name}: resampled to the mean of the held input in each period")
        else:
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
