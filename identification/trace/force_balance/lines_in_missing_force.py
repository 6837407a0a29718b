"""Find spectral lines in the force that a model lacks: of unbalance, fans, pumps, ground vibration.

Records of other rigs have no still part. A vibration goes on through all of them with one frequency
and phase; the harmonics of a nonlinear plant do so only if its inputs are lines themselves.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import zoom_fft

from ..records.spectral_lines import MOST_LINES, lines_of, tonal
from ..search_options import SearchOptions
from .force_record import ForceModel, ForceRecord

Array = NDArray[np.float64]

_FINE = 2.0 * SearchOptions.resolved
"""Steps of a frequency over the inverse of the time of all records."""
_MOST_STEPS = SearchOptions.at_a_time**2
_COHERENT = 0.5
"""Share of the power of a line in each record that one phase must explain in all of them."""


def missing_lines(point: ForceModel, records: Sequence[ForceRecord]) -> tuple[float, ...]:
    """Return frequencies (Hz) of lines in the missing force of a model, the strongest first.

    None are if an input consists of lines: what the plant makes of them has lines, too.
    """
    if any(tonal(u, r.band.Ts_s) for r in records for u in r.signals.coil.T):
        return ()
    parts = [r.varying(r.missing_force(point)) for r in records]
    times = [r.signals.time_s[r.band.kept] for r in records]
    found = sorted(
        (
            (stands, f_hz, 1.0 / (len(x) * r.band.row_s))
            for r, part in zip(records, parts, strict=True)
            for x in part.T
            for stands, f_hz in lines_of(x, r.band.row_s)
        ),
        reverse=True,
    )
    chosen: list[float] = []
    for _, f_hz, step_hz in found:
        if len(chosen) < MOST_LINES and all(abs(f_hz - other) > step_hz for other in chosen):
            joint = _joint(f_hz, step_hz, parts, times)
            if joint is not None:
                chosen.append(joint)
    return tuple(chosen)


def _joint(
    f_hz: float, step_hz: float, parts: Sequence[Array], times: Sequence[Array]
) -> float | None:
    """Return the frequency near a line's that explains most with one phase in all records; None if
    it explains little of what a phase for each record does."""
    span_s = max(float(t[-1]) for t in times) - min(float(t[0]) for t in times)
    steps = min(int(2.0 * step_hz * _FINE * span_s) + 1, _MOST_STEPS)
    tried = f_hz + np.linspace(-step_hz, step_hz, steps)
    sums = [_spectrum(part, t, tried) for t, part in zip(times, parts, strict=True)]
    rows = np.array([len(t) for t in times])
    whole = np.sum(np.abs(np.sum(sums, axis=0)) ** 2, axis=1) / rows.sum()
    each = sum(np.sum(np.abs(s) ** 2, axis=1).max() / n for s, n in zip(sums, rows, strict=True))
    best = int(np.argmax(whole))
    return float(tried[best]) if whole[best] > _COHERENT * each else None


def _spectrum(values: Array, time_s: Array, freq_hz: Array) -> NDArray[np.complex128]:
    """Return the Fourier sums (F, n) of values (rows, n), at even times and frequencies in Hz."""
    rate_hz, ends = 1.0 / (time_s[1] - time_s[0]), freq_hz[[0, -1]]
    found = zoom_fft(values, ends, len(freq_hz), fs=rate_hz, endpoint=True, axis=0)
    return np.asarray(np.exp(-2j * np.pi * freq_hz * time_s[0])[:, None] * found)
