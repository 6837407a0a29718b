"""Detect random vibration: a random force with the same density in still and excited records.

Ground vibration has no predictable phase, so neither a known effect nor a free form explains it. It
is noise above that of coils and sensors, in a frequency band. Its signature is an equal density of
the residual force in still and in excited records; effects of the motion vanish in still records.
Sensor faults also look like forces on several DOF, but they show in the readings' non-rigid part.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...rounding import TINY
from ..linearised.linearisation_point import WorkingPoint
from ..records.record_from_log import TraceRecord
from ..records.spectral_lines import HANN_BINS
from ..search_options import SearchOptions
from .force_residual import (
    FADE_S,
    WORST,
    density,
    false_density,
    missing,
    noise_density,
    third_octaves,
)

Array = NDArray[np.float64]

_LOUD = 2.0
"""Least ratio of density to noise in a band, averaged over a third of an octave."""
_BEYOND_CHANCE = 1.0 / SearchOptions.least_gain
"""Least power in standard deviations of chance: what matters of it is told."""
_ALIKE = 2.0
"""Largest ratio of its power in still and in excited records."""
_LOWEST_HZ = 0.5
_OUTSIDE = 0.5 * SearchOptions.least_gain
_ENDS = 1.0 + SearchOptions.least_gain
"""Rows left out at both ends of a record, over those of the fade."""


@dataclass(frozen=True)
class RandomVibration:
    """A random force on one DOF: its rms with standard error, in the DOF's unit of force.

    band_hz: band of the middle 90 % of its power. statistic: power above noise in held-out records,
    in standard deviations of chance.
    """

    dof: int
    band_hz: tuple[float, float]
    rms: float
    se: float
    statistic: float

    @property
    def density(self) -> float:
        """Its two-sided density if its power were spread evenly over the band."""
        low, high = self.band_hz
        return self.rms**2 / (2.0 * (high - low))


@dataclass(frozen=True)
class ForceSpectrum:
    """One-sided densities (F, n) of a record's residual force and of noise alone, at freq_hz (F,).

    `averages`: number of independent spectra in the mean.
    """

    freq_hz: Array
    psd: Array
    noise: Array
    averages: float
    still: bool


def force_spectrum(point: WorkingPoint, record: TraceRecord) -> ForceSpectrum:
    """Return the spectrum of a record's residual force at the working point."""
    lacking = missing(point, record)
    Ts_s = record.experiment.Ts_s
    ends = min(round(_ENDS * FADE_S / Ts_s), record.rows // SearchOptions.resolved)
    whole = lacking.force[ends : record.rows - ends]
    freq_hz, psd = density(whole, Ts_s)
    averages = max(len(whole) * Ts_s * (freq_hz[1] - freq_hz[0]), 1.0)
    noise = noise_density(point, lacking.here, freq_hz)
    noise += false_density(point, lacking.here, lacking.reading[ends : record.rows - ends])
    return ForceSpectrum(freq_hz, psd, noise, averages, record.still)


def shaking(
    fitted: Sequence[ForceSpectrum], kept: Sequence[ForceSpectrum]
) -> tuple[RandomVibration, ...]:
    """Return the random force on each DOF that is in the `fitted` and in the `kept` records.

    Still records among the fitted ones are required. Only records with the most frequent sampling
    rate of the still ones are used.
    """
    grids = Counter((len(s.freq_hz), _step_hz(s)) for s in fitted if s.still)
    if not grids:
        return ()
    grid = max(grids, key=lambda g: (grids[g], g))
    fitted, kept = (
        [s for s in part if (len(s.freq_hz), _step_hz(s)) == grid] for part in (fitted, kept)
    )
    still = [s for s in fitted if s.still]
    moving = [s for s in fitted if not s.still]
    if not still or not kept:
        return ()
    found = [_of_dof(i, still, moving, kept) for i in range(still[0].psd.shape[1])]
    return tuple(s for s in found if s is not None)


def _step_hz(spectrum: ForceSpectrum) -> float:
    return float(f"{spectrum.freq_hz[1] - spectrum.freq_hz[0]:.6g}")


def _of_dof(
    dof: int,
    still: Sequence[ForceSpectrum],
    moving: Sequence[ForceSpectrum],
    kept: Sequence[ForceSpectrum],
) -> RandomVibration | None:
    band = _band(dof, still)
    if band is None:
        return None
    test = [s for s in kept if s.still] or kept
    if min(_statistic(dof, band, part) for part in (still, test)) < _BEYOND_CHANCE:
        return None
    power = _power(dof, band, still)
    for part in (moving, kept):
        if part and not 1 / _ALIKE < _power(dof, band, part) / power < _ALIKE:
            return None
    everything = [*still, *moving, *kept]
    rms = float(np.sqrt(_power(dof, band, everything)))
    se = 0.5 * _power_error(dof, band, everything) / rms
    return RandomVibration(
        dof, _middle(dof, band, everything), rms, se, _statistic(dof, band, test)
    )


def _band(dof: int, spectra: Sequence[ForceSpectrum]) -> NDArray[np.bool_] | None:
    """Return the band (F,) above the noise that has most power."""
    freq_hz = spectra[0].freq_hz
    psd, noise = (_mean(dof, spectra, part) for part in ("psd", "noise"))
    loud = third_octaves((psd / noise)[:, None], freq_hz)[:, 0] > _LOUD
    loud &= (freq_hz > _LOWEST_HZ) & (noise < WORST * noise.min())
    edges = np.flatnonzero(np.diff(np.concatenate([[0], loud.astype(np.int8), [0]])))
    runs = [slice(a, b) for a, b in edges.reshape(-1, 2).tolist()]
    if not runs:
        return None
    best = max(runs, key=lambda run: float(np.sum(psd[run] - noise[run])))
    band = np.zeros(len(freq_hz), bool)
    band[best] = True
    return band


def _statistic(dof: int, band: NDArray[np.bool_], spectra: Sequence[ForceSpectrum]) -> float:
    """Return the power above noise in a band, in standard deviations of chance."""
    ratio = _mean(dof, spectra, "psd")[band] / _mean(dof, spectra, "noise")[band]
    count = sum(s.averages for s in spectra) * max(band.sum() / HANN_BINS, 1.0)
    return float((ratio.mean() - 1.0) * np.sqrt(count))


def _power(dof: int, band: NDArray[np.bool_], spectra: Sequence[ForceSpectrum]) -> float:
    step_hz = float(spectra[0].freq_hz[1] - spectra[0].freq_hz[0])
    beyond = _mean(dof, spectra, "psd")[band] - _mean(dof, spectra, "noise")[band]
    return float(max(beyond.sum() * step_hz, TINY))


def _power_error(dof: int, band: NDArray[np.bool_], spectra: Sequence[ForceSpectrum]) -> float:
    """Return the standard error of `_power`, with independent bins and the noise included."""
    step_hz = float(spectra[0].freq_hz[1] - spectra[0].freq_hz[0])
    squares = float(np.sum(_mean(dof, spectra, "psd")[band] ** 2))
    return step_hz * float(np.sqrt(HANN_BINS * squares / sum(s.averages for s in spectra)))


def _middle(
    dof: int, band: NDArray[np.bool_], spectra: Sequence[ForceSpectrum]
) -> tuple[float, float]:
    beyond = _mean(dof, spectra, "psd")[band] - _mean(dof, spectra, "noise")[band]
    share = np.cumsum(np.maximum(beyond, 0.0))
    low, high = np.interp([_OUTSIDE, 1 - _OUTSIDE], share / share[-1], spectra[0].freq_hz[band])
    return float(low), float(high)


def _mean(dof: int, spectra: Sequence[ForceSpectrum], part: str) -> Array:
    weights = [s.averages for s in spectra]
    return np.average([getattr(s, part)[:, dof] for s in spectra], axis=0, weights=weights)
