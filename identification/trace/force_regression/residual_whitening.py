"""Weigh frequencies by the inverse of the residual's spectrum, for all signals alike.

The spectrum is that of what the richest free form leaves: measurement noise and everything that no
effect of the table can be. It is estimated once and then held, so that the squared errors of all
models are comparable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import ceil

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal import welch

from ...rounding import ROUNDING
from ..search_options import SearchOptions

Array = NDArray[np.float64]

SEGMENTS = SearchOptions.resolved
"""Lengths of a segment in the shortest record; segments overlap by half."""
_LEAST_ROWS = SEGMENTS**2


@dataclass(frozen=True)
class Whitening:
    """Power density (F, n) of the residual at freq_hz (F,), and the limit of the band in Hz."""

    freq_hz: Array
    density: Array
    cutoff_hz: float
    _weights: dict[tuple[int, float], Array] = field(default_factory=dict, repr=False)

    @property
    def flat(self) -> bool:
        """Whether all frequencies have one weight."""
        return bool(np.all(self.density == self.density[0]))

    def apply(self, values: Array, row_s: float) -> Array:
        """Return signals (..., rows, n) with the spectrum divided by the residual's, no phase.

        The residual's sum of squares is then about the number of independent rows in the band.
        """
        if self.flat:
            return np.asarray(values * np.sqrt(2.0 * row_s / self.density[0]))
        rows = values.shape[-2]
        memory_s = 1.0 / float(self.freq_hz[1] - self.freq_hz[0])  # of weights of this resolution
        before = min(rows - 1, ceil(memory_s / row_s))
        length = next_fast_len(rows + 2 * before, real=True)
        head = 2.0 * values[..., :1, :] - values[..., before:0:-1, :]
        tail = 2.0 * values[..., -1:, :] - values[..., -2 : -2 - before : -1, :]
        whole = np.concatenate([head, values, tail], axis=-2)
        weight = self._weight(length, row_s)
        found = irfft(rfft(whole, length, axis=-2) * weight, length, axis=-2)
        return np.asarray(found[..., before : before + rows, :])

    def squared_at(self, freq_hz: Array) -> Array:
        """Return the inverse density (F, n) at frequencies in Hz, by which powers are weighed."""
        inside = np.minimum(freq_hz, self.cutoff_hz)
        logs = [np.interp(inside, self.freq_hz, np.log(d)) for d in self.density.T]
        return np.asarray(np.exp(-np.stack(logs, axis=1)))

    def _weight(self, length: int, row_s: float) -> Array:
        """Return the weights (F, n) of a spectrum of `length` rows."""
        if (length, row_s) not in self._weights:
            weight = np.sqrt(2.0 * row_s * self.squared_at(rfftfreq(length, row_s)))
            self._weights[length, row_s] = weight
        return self._weights[length, row_s]


def whitening_of(residuals: Sequence[Array], row_s: Sequence[float], cutoff_hz: float) -> Whitening:
    """Return the weights for residuals (rows, n) of records with `row_s` between their rows."""
    shortest = min(len(r) * s for r, s in zip(residuals, row_s, strict=True))
    spectra = []
    for r, s in zip(residuals, row_s, strict=True):
        segment = max(int(shortest / s) // SEGMENTS, _LEAST_ROWS)
        spectra.append(welch(r, 1 / s, nperseg=min(segment, len(r)), axis=0))
    freq_hz = spectra[0][0]
    seconds = np.array([len(r) * s for r, s in zip(residuals, row_s, strict=True)])
    density = np.zeros_like(spectra[0][1])
    for share, (own_hz, own) in zip(seconds / seconds.sum(), spectra, strict=True):
        columns = [np.interp(freq_hz, own_hz, column) for column in own.T]
        density += share * np.stack(columns, axis=1)
    inside = (freq_hz > 0.0) & (freq_hz <= cutoff_hz)
    smooth = _smoothed(density[inside])
    most = smooth.max(axis=0)
    least = np.where(most > 0.0, ROUNDING * most, 1.0)  # a residual of zeros has no spectrum
    return Whitening(freq_hz[inside], np.maximum(smooth, least), cutoff_hz)


def _smoothed(density: Array) -> Array:
    """Return the mean of each value and its two neighbours."""
    padded = np.vstack([density[:1], density, density[-1:]])
    return np.asarray(np.mean([padded[:-2], padded[1:-1], padded[2:]], axis=0))
