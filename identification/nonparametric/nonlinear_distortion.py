"""Nonlinear distortion at lines that were not excited, and whether it is more than chance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate, stats

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Index = NDArray[np.intp]


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

    `level` and `noise` (K, m) in the outputs' units: rms of the line's rms over `experiments` that
    differ, and what noise alone leaves of it on average. Without distortion level^2 / noise^2 is
    distributed as F with 2 `experiments` and 2 `noise_freedom` degrees of freedom.
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
    freq_hz: Array, excited_hz: Array, H: Complex, U: Complex, Y: Complex, same: Index
) -> DetectionLines:
    """Return the levels at freq_hz (K,), between lines excited_hz (F,) where the plant is H.

    U (E, P, K, p) and Y (E, P, K, m) are the spectra of every period there, `same` (E,) as in
    mean_over_periods. Feedback turns a distorted output into an input of the plant, the answer to
    which, by H interpolated, is taken off again (Pintelon and Schoukens 2012, chapter 4).
    """
    m = H.shape[1]
    if not freq_hz.size:
        nothing = np.zeros((0, m))
        return DetectionLines(freq_hz, nothing, nothing, len(np.unique(same)), 0)
    between = interpolate.make_interp_spline(excited_hz, H, k=min(3, len(excited_hz) - 1))
    left = Y - np.einsum("kij,epkj->epki", between(freq_hz), U)
    means = mean_over_periods(left, same)
    level = np.mean(np.abs(means) ** 2, axis=0)
    noise = np.einsum("kii->ki", noise_of_mean(left, same)).real
    freedom = Y.shape[0] * Y.shape[1] - len(means)
    return DetectionLines(freq_hz, np.sqrt(level), np.sqrt(noise), len(means), freedom)


def mean_over_periods(X: Complex, same: Index) -> Complex:
    """Return the means (D, ...) over all periods of X (E, P, ...) that played the same.

    `same` (E,) numbers the D experiments that differ from 0 on: those of one number repeat one
    another, and all their periods are periods of one experiment.
    """
    means = np.zeros((int(same.max()) + 1, *X.shape[2:]), complex)
    np.add.at(means, same, X.mean(axis=1))
    return np.asarray(means / np.bincount(same).reshape(-1, *[1] * (X.ndim - 2)))


def noise_of_mean(X: Complex, same: Index) -> Complex:
    """Return the covariance (K, m, m) of mean_over_periods of X (E, P, K, m), from X's scatter.

    It has E P - D complex degrees of freedom. Where some experiments were repeated more often than
    others it is the average over the D means.
    """
    E, P = X.shape[:2]
    repeats = np.bincount(same)
    scatter = X - mean_over_periods(X, same)[same][:, None]
    of_period = np.einsum("epki,epkj->kij", scatter, scatter.conj()) / (E * P - len(repeats))
    return np.asarray(of_period * np.mean(1.0 / (P * repeats)))


def transient_test(X: Complex) -> ExcessTest:
    """Return whether the first of P periods of X (E, P, K, m) differs more than the others do."""
    E, P = X.shape[:2]
    first = X[:, 0] - X[:, 1:].mean(axis=1)
    power = np.mean(np.abs(first) ** 2, axis=0) / P  # of noise alone: as much as a mean of P - 1
    if P < 3:
        return excess(power, power, E, 0)
    noise = np.einsum("kii->ki", noise_of_mean(X[:, 1:], np.arange(E))).real
    return excess(power, noise, E, E * (P - 2))


def excess(power: Array, noise: Array, freedom: int, noise_freedom: int) -> ExcessTest:
    """Test power (K, m) of K independent lines against that of the noise, both estimated.

    Each ratio follows F with twice as many degrees of freedom as are complex, exactly; the lines'
    probabilities are pooled as Fisher does: -2 sum log p is distributed as chi^2 with 2 K degrees
    of freedom. The mean ratio is not: with 3 complex degrees of freedom it has no third moment,
    and is far from normal with any number of lines. Fisher's sum loses little to a sum of normal
    scores where distortion is the same at all lines, and sees a few strong ones far better.
    """
    K, m = power.shape
    a, b = 2.0 * freedom, 2.0 * noise_freedom
    if K == 0 or freedom < 1 or noise_freedom <= 2 or np.any(noise <= 0):
        return ExcessTest(np.full(m, np.nan), np.full(m, np.nan))
    chance = stats.f(a, b)
    each = np.maximum(chance.sf(power / noise), np.finfo(float).tiny)  # its logarithm is finite
    p_value = stats.chi2.sf(-2.0 * np.log(each).sum(axis=0), 2 * K)
    ratio = np.mean(power / noise, axis=0) / chance.mean()
    return ExcessTest(np.asarray(ratio), np.asarray(p_value))
