"""Measure nonlinear distortion at unexcited lines, and test it against noise."""

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
    """A test of measured power against noise power, for each of m outputs.

    `ratio` (m,): measured over noise power, mean over all lines; 1 without distortion. `p_value`
    (m,): probability of such a ratio by chance. Both are nan if the noise is unknown.
    """

    ratio: Array
    p_value: Array


@dataclass(frozen=True)
class DetectionLines:
    """Output at K unexcited lines, without the linear response to the plant input there.

    `level` and `noise` (K, m) in output units: rms of the line over the `experiments` that differ,
    and the rms that noise alone would give. Without distortion, level^2 / noise^2 follows an F
    distribution with 2 `experiments` and 2 `noise_freedom` degrees of freedom.
    """

    freq_hz: Array
    level: Array
    noise: Array
    experiments: int
    noise_freedom: int

    def test(self) -> ExcessTest:
        """Test whether the output is distorted at these lines."""
        return excess(self.level**2, self.noise**2, self.experiments, self.noise_freedom)


def detection_lines(
    freq_hz: Array, excited_hz: Array, H: Complex, U: Complex, Y: Complex, same: Index
) -> DetectionLines:
    """Return the levels at freq_hz (K,), between the lines excited_hz (F,) where the plant is H.

    U (E, P, K, p) and Y (E, P, K, m) are the spectra of every period there; `same` (E,) as in
    mean_over_periods. Feedback turns a distorted output into a plant input; the response to it, by
    interpolated H, is subtracted (Pintelon and Schoukens 2012, chapter 4).
    """
    m = H.shape[1]
    if not freq_hz.size:
        empty = np.zeros((0, m))
        return DetectionLines(freq_hz, empty, empty, len(np.unique(same)), 0)
    between = interpolate.make_interp_spline(excited_hz, H, k=min(3, len(excited_hz) - 1))
    residual = Y - np.einsum("kij,epkj->epki", between(freq_hz), U)
    means = mean_over_periods(residual, same)
    level = np.mean(np.abs(means) ** 2, axis=0)
    noise = np.einsum("kii->ki", noise_of_mean(residual, same)).real
    freedom = Y.shape[0] * Y.shape[1] - len(means)
    return DetectionLines(freq_hz, np.sqrt(level), np.sqrt(noise), len(means), freedom)


def mean_over_periods(X: Complex, same: Index) -> Complex:
    """Return the means (D, ...) of X (E, P, ...) over all periods with the same excitation.

    `same` (E,) numbers the D different excitations from 0. Experiments with one number are
    repetitions; all their periods are averaged.
    """
    means = np.zeros((int(same.max()) + 1, *X.shape[2:]), complex)
    np.add.at(means, same, X.mean(axis=1))
    return np.asarray(means / np.bincount(same).reshape(-1, *[1] * (X.ndim - 2)))


def noise_of_mean(X: Complex, same: Index) -> Complex:
    """Return the noise covariance (K, m, m) of mean_over_periods of X (E, P, K, m), by its scatter.

    It has E P - D complex degrees of freedom. If the numbers of repetitions differ, it is the
    average over the D means.
    """
    E, P = X.shape[:2]
    repeats = np.bincount(same)
    scatter = X - mean_over_periods(X, same)[same][:, None]
    of_period = np.einsum("epki,epkj->kij", scatter, scatter.conj()) / (E * P - len(repeats))
    return np.asarray(of_period * np.mean(1.0 / (P * repeats)))


def transient_test(X: Complex) -> ExcessTest:
    """Test whether the first of P periods of X (E, P, K, m) differs from the others."""
    E, P = X.shape[:2]
    first = X[:, 0] - X[:, 1:].mean(axis=1)
    power = np.mean(np.abs(first) ** 2, axis=0) / P  # noise alone: the variance of a mean of P - 1
    if P < 3:
        return excess(power, power, E, 0)
    noise = np.einsum("kii->ki", noise_of_mean(X[:, 1:], np.arange(E))).real
    return excess(power, noise, E, E * (P - 2))


def excess(power: Array, noise: Array, freedom: int, noise_freedom: int) -> ExcessTest:
    """Test the power (K, m) of K independent lines against the noise power, both estimated.

    Each ratio follows an F distribution with twice the complex degrees of freedom. Fisher's method
    pools the lines: -2 sum log p follows chi^2 with 2 K degrees of freedom. The mean ratio cannot
    serve: with 3 complex degrees of freedom it has no third moment and is far from normal. Fisher's
    sum has nearly the power of a sum of normal scores if all lines are distorted alike, and far
    more if only a few are.
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
