"""Judge the readings of a platform that rests on its stops: noise, dead channels, mains pick-up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_MAINS_HZ = (50.0, 60.0)
_HARMONICS = 5
_END_SHARE = 0.1
"""Share of readings at one end: noise of two steps of a converter or more has a hundredth there."""
_LEAST_FRESH = 20
_TIMES_THE_NOISE = 20.0
"""Power of a line over that of white noise of the same level, from which it counts: of a hundred
bins of noise alone none reaches it in 99.99 % of the records (exponential distribution)."""


@dataclass(frozen=True)
class Resting:
    """Of each sensor (S,): mean and standard deviation in m, whether it is clipped.

    mains_m (S,): amplitude of the mains' lines together, 0 where there are none. mains_hz: their
    fundamental.
    """

    mean_m: Array
    sd_m: Array
    clipped: NDArray[np.bool_]
    mains_m: Array
    mains_hz: float


def resting(gap_m: Array, rate_hz: float) -> Resting:
    """Return what readings (n, S) at rest say of each sensor."""
    n = len(gap_m)
    away = gap_m - gap_m.mean(axis=0)
    spectrum = np.abs(np.fft.rfft(away * np.hanning(n)[:, None], axis=0)) ** 2
    freq_hz = np.fft.rfftfreq(n, 1.0 / rate_hz)
    level = np.maximum(np.median(spectrum, axis=0) / np.log(2.0), 1e-300)
    best, best_hz, best_power = np.zeros(gap_m.shape[1]), 0.0, 0.0
    for mains_hz in _MAINS_HZ:
        power = np.zeros(gap_m.shape[1])
        for harmonic in range(1, _HARMONICS + 1):
            if harmonic * mains_hz >= freq_hz[-1]:
                break
            at = int(np.argmin(np.abs(freq_hz - harmonic * mains_hz)))
            line = spectrum[max(at - 1, 0) : at + 2].max(axis=0)
            power += np.where(line > _TIMES_THE_NOISE * level, line, 0.0)
        if power.sum() > best_power:
            best, best_hz, best_power = power, mains_hz, float(power.sum())
    # Amplitude of a sine of that power behind a Hann window, whose mean is 1/2.
    amplitude = np.where(clipped(gap_m), 0.0, 2.0 * np.sqrt(best) / (0.5 * n))
    return Resting(gap_m.mean(axis=0), gap_m.std(axis=0), clipped(gap_m), amplitude, best_hz)


def clipped(gap_m: Array) -> NDArray[np.bool_]:
    """Return which sensors (S,) rest at an end of their range, wholly or for a part of the time.

    Their largest or smallest reading is far more frequent than that of noise. Rows that repeat all
    readings are missing ones.
    """
    fresh = np.append(True, np.any(np.diff(gap_m, axis=0) != 0.0, axis=1))
    gap_m = gap_m[fresh] if fresh.sum() >= _LEAST_FRESH else gap_m
    at_end = [(gap_m == end).mean(axis=0) for end in (gap_m.min(axis=0), gap_m.max(axis=0))]
    return np.asarray(np.maximum(*at_end) > _END_SHARE)
