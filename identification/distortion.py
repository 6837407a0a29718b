"""Nonlinear distortion at lines that were not excited, and whether it is more than chance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate, stats

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class ExcessTest:
    """Whether a level exceeds what noise alone would give, for each of m outputs.

    `ratio` (m,) is the mean over all lines of the measured power over the noise's, 1 without
    distortion; `p_value` (m,) the probability of so large a ratio by chance. nan where nothing
    can be told.
    """

    ratio: Array
    p_value: Array


@dataclass(frozen=True)
class DetectionLines:
    """Output at lines that were not excited, less what the plant's input brings there.

    `level` and `noise` (K, m) in the outputs' units: rms over E experiments of the line's rms, and
    what noise alone leaves of it on average. Without distortion level^2 / noise^2 is distributed
    as F with 2 E and 2 `noise_freedom` degrees of freedom.
    """

    freq_hz: Array
    level: Array
    noise: Array
    experiments: int
    noise_freedom: int

    def test(self) -> ExcessTest:
        """Return whether the output is distorted at these lines."""
        return excess(self.level**2, self.noise**2, self.experiments, self.noise_freedom)


def detection_lines(
    freq_hz: Array, excited_hz: Array, H: Complex, U: Complex, Y: Complex
) -> DetectionLines:
    """Return the levels at freq_hz (K,), between lines excited_hz (F,) where the plant is H.

    U (E, P, K, p) and Y (E, P, K, m) are the spectra of every period there. Feedback turns a
    distorted output into an input of the plant, the answer to which, by H interpolated, is taken
    off again (Pintelon and Schoukens 2012, chapter 4).
    """
    m = H.shape[1]
    if not freq_hz.size:
        nothing = np.zeros((0, m))
        return DetectionLines(freq_hz, nothing, nothing, len(Y), 0)
    between = interpolate.make_interp_spline(excited_hz, H, k=min(3, len(excited_hz) - 1))
    left = Y - np.einsum("kij,epkj->epki", between(freq_hz), U)
    level = np.mean(np.abs(left.mean(axis=1)) ** 2, axis=0)
    noise = np.einsum("kii->ki", noise_of_mean(left)).real
    freedom = Y.shape[0] * (Y.shape[1] - 1)
    return DetectionLines(freq_hz, np.sqrt(level), np.sqrt(noise), len(Y), freedom)


def noise_of_mean(X: Complex) -> Complex:
    """Return the covariance (K, m, m) of the mean over periods of X (E, P, K, m), from its scatter.

    It has E (P - 1) complex degrees of freedom.
    """
    E, P = X.shape[:2]
    scatter = X - X.mean(axis=1, keepdims=True)
    return np.asarray(np.einsum("epki,epkj->kij", scatter, scatter.conj()) / (E * (P - 1) * P))


def transient_test(X: Complex) -> ExcessTest:
    """Return whether the first of P periods of X (E, P, K, m) differs more than the others do."""
    E, P = X.shape[:2]
    first = X[:, 0] - X[:, 1:].mean(axis=1)
    power = np.mean(np.abs(first) ** 2, axis=0) / P  # of noise alone: as much as a mean of P - 1
    if P < 3:
        return excess(power, power, E, 0)
    noise = np.einsum("kii->ki", noise_of_mean(X[:, 1:])).real
    return excess(power, noise, E, E * (P - 2))


def excess(power: Array, noise: Array, freedom: int, noise_freedom: int) -> ExcessTest:
    """Test power (K, m) of K independent lines against that of the noise, both estimated.

    Each ratio follows F with twice as many degrees of freedom as are complex; the mean over lines
    is taken as normal, which needs some ten of them.
    """
    K, m = power.shape
    a, b = 2.0 * freedom, 2.0 * noise_freedom
    if K == 0 or freedom < 1 or noise_freedom <= 2 or np.any(noise <= 0):
        return ExcessTest(np.full(m, np.nan), np.full(m, np.nan))
    chance = stats.f(a, b)
    ratio = np.mean(power / noise, axis=0)
    p_value = stats.norm.sf((ratio - chance.mean()) / (chance.std() / np.sqrt(K)))
    return ExcessTest(np.asarray(ratio / chance.mean()), np.asarray(p_value))
