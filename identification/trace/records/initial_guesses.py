"""Estimate initial guesses for the search: spectral lines, resonances, and the range of motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from ....model.effects.operating_range import Extent
from .effect_signals import trajectory
from .record_from_log import TraceRecord
from .resonances import resonances

Array = NDArray[np.float64]

_MOST_TONES = 5
_STANDS_OUT = 50.0
"""Least power of a line over the mean around it; a resonance of the loop stays below."""
_AROUND = np.array([1.0] * 13 + [0.0] * 5 + [1.0] * 13)
_NEAR = np.array([1.0] * 5 + [0.0] * 5 + [1.0] * 5)
"""Bins around a line for the mean, without the nearest ones, into which the window leaks."""
_LOWEST_HZ = 1.0
_APART_HZ = 0.5
_SETTLE_S = 1.0


def extent(records: Sequence[TraceRecord]) -> Extent:
    """Return the records' range of motion, the lines in still ones, and the resonances."""
    signals = [trajectory(r, r.experiment.y, r.coil, 0.0) for r in records]
    return Extent.measured(signals, tones(records), resonances(records))


def tones(records: Sequence[TraceRecord]) -> tuple[float, ...]:
    """Return frequencies (Hz) of lines in the readings of still records, the strongest first."""
    found: list[tuple[float, float]] = []
    for record in records:
        if record.still:
            found += _lines(record)
    found.sort(reverse=True)
    chosen: list[float] = []
    for _, f_hz in found:
        if all(abs(f_hz - other) > _APART_HZ for other in chosen):
            chosen.append(f_hz)
    return tuple(chosen[:_MOST_TONES])


def _lines(record: TraceRecord) -> list[tuple[float, float]]:
    Ts_s = record.experiment.Ts_s
    rows = record.gap[round(_SETTLE_S / Ts_s) :]
    if len(rows) < 4 * len(_AROUND):
        return []
    rows = rows - rows.mean(axis=0)
    window = np.hanning(len(rows))[:, None]
    spectra = np.abs(np.fft.rfft(rows * window, axis=0)) ** 2
    step_hz = 1 / (len(rows) * Ts_s)
    lines = []
    # Each sensor alone, as one may be disturbed; and all together, for small lines.
    for power in (*spectra.T, spectra.sum(axis=1)):
        # A resonance is wider than a line: it also fills the nearer bins.
        level = np.maximum(
            *(convolve1d(power, bins / bins.sum(), mode="reflect") for bins in (_AROUND, _NEAR))
        )
        stands = power / np.maximum(level, 1e-300)
        first, last = round(_LOWEST_HZ / step_hz), len(power) - len(_AROUND)
        for k in (np.flatnonzero(stands[first:last] > _STANDS_OUT) + first).tolist():
            if power[k] < max(power[k - 1], power[k + 1]):
                continue
            # Three amplitudes under a Hann window give the frequency between the bins.
            left, middle, right = np.sqrt(power[k - 1 : k + 2])
            offset = 2.0 * (right - left) / (left + 2 * middle + right)
            lines.append((float(stands[k]), (k + float(np.clip(offset, -0.5, 0.5))) * step_hz))
    return lines
