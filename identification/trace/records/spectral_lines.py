"""Find spectral lines in still records: frequencies of mains, fans and pumps.

The strongest line is found first; all lines found so far are fitted together with it and
subtracted, and the rest is searched again (CLEAN, Hogbom, Astron. Astrophys. Suppl. 15 (1974) 417;
together: Li and Stoica, IEEE Trans. Signal Processing 44 (1996) 281). So two lines are told apart
from about one and a half over the length of a record on. A resonance that noise excites is no line:
after the subtraction of some sinusoids most of its power is left.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.signal import get_window

from ...rounding import DIFFERENCE, ROUNDING, TINY
from ..search_options import SearchOptions
from .record_from_log import TraceRecord

Array = NDArray[np.float64]

MOST_LINES = SearchOptions.most_effects
_STANDS_OUT = SearchOptions().least_squares
"""Power of a line over the mean power around it: noise reaches that in one of 10^15 bins."""
_AROUND = SearchOptions.at_a_time // SearchOptions.resolved + 1
"""Bins around a line, of which the median tells the mean power; some of them may be lines."""
_NEAR = 2 * SearchOptions.resolved
"""Bins on either side of a line in which little may be left after the subtraction."""
_LEFT = SearchOptions.least_gain
"""Share of the power near a line that may be left: a tenth; of a resonance most is."""
_RESONANCE = 0.5**0.5
"""Share of the power near its highest bin that a resonance keeps: of two equal lines half stays."""
_IMPERFECT = SearchOptions().inexact
"""Share of the power near a line that an imperfect sinusoid leaves: less is no other line."""
HANN_BINS = float(get_window("hann", _AROUND) @ get_window("hann", _AROUND) / _AROUND * 2.0**2)
"""Bins of a Hann window for each independent one, from which on two lines are told apart: its mean
is a half."""
_LOWEST_HZ = 1.0
_SETTLE_S = 1.0


def spectral_lines(records: Sequence[TraceRecord]) -> tuple[float, ...]:
    """Return frequencies (Hz) of lines in the readings of still records, the strongest first."""
    found: list[tuple[float, float, float]] = []
    for record in records:
        if record.still:
            found += _lines(record)
    found.sort(reverse=True)
    chosen: list[float] = []
    for _, f_hz, step_hz in found:
        if all(abs(f_hz - other) > step_hz for other in chosen):
            chosen.append(f_hz)
    return tuple(chosen[:MOST_LINES])


def lines_of(x: Array, Ts_s: float) -> list[tuple[float, float]]:
    """Return power over that around, and frequency (Hz), of each line of a signal (N,)."""
    time_s: Array = Ts_s * np.arange(len(x), dtype=np.float64)
    rest = before = x - float(x.mean())
    step_hz = 1.0 / (len(x) * Ts_s)
    bins, at_first = np.arange(len(x) // 2 + 1), _power(before)
    lines: list[float] = []
    strengths: list[float] = []
    while len(lines) < MOST_LINES:
        power = _power(rest)
        level = median_filter(power, _AROUND, mode="reflect") / np.log(2.0)
        stands = power / np.maximum(level, TINY)
        stands[: round(_LOWEST_HZ / step_hz)] = 0.0
        stands[-1] = 0.0
        for f_hz in lines:
            away = np.abs(bins - f_hz / step_hz)
            near = away < _NEAR
            little = power < _IMPERFECT * at_first[near].max()
            stands[(away < HANN_BINS) | (near & little)] = 0.0
        k = int(np.argmax(stands))
        if stands[k] < _STANDS_OUT or not 0 < k < len(power) - 1:
            break
        # Three amplitudes under a Hann window give the frequency between the bins.
        left, middle, right = np.sqrt(power[k - 1 : k + 2])
        offset = 2.0 * (right - left) / (left + 2.0 * middle + right)
        lines.append((k + float(np.clip(offset, -0.5, 0.5))) * step_hz)
        strengths.append(float(stands[k]))
        lines, rest = _fitted(before, time_s, lines, step_hz)
        around = slice(max(k - _NEAR, 0), k + _NEAR + 1)
        if _power(rest)[around].sum() > _RESONANCE * power[around].sum():
            break
    last = _power(rest)
    pure = []
    for f_hz, stands_out in zip(lines, strengths, strict=True):
        k = round(f_hz / step_hz)
        near = slice(max(k - _NEAR, 0), k + _NEAR + 1)
        if last[near].sum() < _LEFT * at_first[near].sum():
            pure.append((stands_out, f_hz))
    return pure


def tonal(x: Array, Ts_s: float) -> bool:
    """Return whether most of the power of a signal (N,) is in lines."""
    if not np.ptp(x):
        return False
    power = _power(x - float(x.mean()))
    level = median_filter(power, _AROUND, mode="reflect") / np.log(2.0)
    lines = power > _STANDS_OUT * np.maximum(level, ROUNDING * power.max())
    lines[: max(round(_LOWEST_HZ * len(x) * Ts_s), 1)] = False
    return bool(power[lines].sum() > 0.5 * power.sum())


def _lines(record: TraceRecord) -> list[tuple[float, float, float]]:
    """Return power over that around, frequency, and resolution of each line of a record.

    Each sensor is searched alone, as one may be disturbed, and each DOF.
    """
    Ts_s = record.experiment.Ts_s
    rows = record.gap[round(_SETTLE_S / Ts_s) :]
    if len(rows) < 2 * _AROUND:
        return []
    found = []
    for x in np.column_stack([rows, rows @ record.places.decoupling.T]).T:
        found += [(stands, f_hz, 1.0 / (len(x) * Ts_s)) for stands, f_hz in lines_of(x, Ts_s)]
    return found


def _power(x: Array) -> Array:
    return np.asarray(np.abs(np.fft.rfft(x * np.hanning(len(x)))) ** 2)


def _fitted(
    x: Array, time_s: Array, lines: Sequence[float], step_hz: float
) -> tuple[list[float], Array]:
    """Fit sinusoids together, frequencies too (Gauss-Newton); return these and the rest."""
    f = np.array(lines)
    rest = x
    for _ in range(SearchOptions.steps):
        angle = 2.0 * np.pi * np.outer(time_s, f)
        columns = np.hstack([np.cos(angle), np.sin(angle), np.ones((len(x), 1))])
        coefficients, *_ = np.linalg.lstsq(columns, x, rcond=None)
        rest = x - columns @ coefficients
        a, b = coefficients[: len(f)], coefficients[len(f) : 2 * len(f)]
        slope = 2.0 * np.pi * time_s[:, None] * (b * np.cos(angle) - a * np.sin(angle))
        step, *_ = np.linalg.lstsq(np.hstack([slope, columns]), rest, rcond=None)
        moved = np.clip(step[: len(f)], -0.5 * step_hz, 0.5 * step_hz)
        if np.abs(moved).max() < DIFFERENCE * step_hz:
            break
        f = f + moved
    return f.tolist(), rest
