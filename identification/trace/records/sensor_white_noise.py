"""Estimate the white noise of sensors from the spectrum above the platform's motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_MEDIAN_OF_CHI2 = np.log(2.0)
"""Ratio of median to mean of a periodogram."""
_QUIET_FROM = 0.5
"""Sensor noise is read above this share of the Nyquist frequency."""


def white_noise(readings: Array) -> Array:
    """Return the standard deviation (S,) of the white noise of readings (N, S), in their unit.

    It is the median over the upper half of the frequencies, above the platform's motion.
    """
    window = np.hanning(len(readings))[:, None]
    power = np.abs(np.fft.rfft(readings * window, axis=0)) ** 2 / np.sum(window**2)
    quiet = power[round(_QUIET_FROM * len(power)) :]
    return np.asarray(np.sqrt(np.median(quiet, axis=0) / _MEDIAN_OF_CHI2))
