"""Estimate force and sensor noise from the measured noise spectra of a loop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from ..prediction.noise_model import Noise
from .output_error_fit import residual
from .residual_spectrum import ResidualSpectrum
from .sampled_response import LinearPlant, continuous_response
from .spectral_lines import PointLines

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_ROUNDS = 8
_LEAST = 1e-6
"""Least share of a noise source: none is exactly zero, for the Kalman filter's sake."""


def measured_noise(
    plant: LinearPlant,
    points: Sequence[PointLines],
    residuals: Sequence[ResidualSpectrum],
    correlations: tuple[Array, Array],
) -> Noise:
    """Return white force and sensor noise that explain the noise spectra of all points.

    In the loop the outputs' noise is S (Q Phi Q^H + R) S^H, with Q the compliance, Phi the force
    density and R the sensors' covariance. Sizes follow by non-negative least squares of the
    outputs' power, weighted by its own expectation (Whittle's likelihood); `correlations` of forces
    (p, p) and outputs (n, n) are known. What the excitation causes, the model's error included,
    is not in these spectra.
    """
    columns, targets = [], []
    for point, found in zip(points, residuals, strict=True):
        _, S, _ = residual(plant, point)
        by_force = S @ continuous_response(plant, point.schedule, point.freq_hz)
        columns.append(np.concatenate([np.abs(by_force) ** 2 / point.Ts_s, np.abs(S) ** 2], axis=2))
        targets.append(np.einsum("fii->fi", found.noise).real)
    A = np.concatenate(columns)
    A, b = A.reshape(-1, A.shape[2]), np.concatenate(targets).ravel()
    weight = 1.0 / b
    for _ in range(_ROUNDS):
        scaled = A * weight[:, None]
        size = np.linalg.norm(scaled, axis=0)
        sizes = nnls(scaled / size, b * weight)[0] / size
        weight = 1.0 / np.maximum(A @ sizes, 1e-3 * b)
    # The size at which a source would be all the noise of some output at some frequency.
    alone = np.min(b[:, None] / np.maximum(A, 1e-300), axis=0)
    sizes = np.maximum(sizes, _LEAST * alone)
    p = correlations[0].shape[0]
    return Noise(*correlations).scaled(sizes[:p], sizes[p:])


def noise_spectrum(plant: LinearPlant, point: PointLines, noise: Noise) -> Complex:
    """Return the covariance (F, n, n) of the outputs' noise in the loop at the point's lines."""
    by_force, by_sensor = _sources(plant, point)
    return np.asarray(
        by_force @ noise.force_density @ by_force.conj().transpose(0, 2, 1)
        + by_sensor @ noise.output_covariance @ by_sensor.conj().transpose(0, 2, 1)
    )


def _sources(plant: LinearPlant, point: PointLines) -> tuple[Complex, Complex]:
    """Return S Q over the root of the period (F, n, p), and S (F, n, n)."""
    _, S, _ = residual(plant, point)
    by_force = S @ continuous_response(plant, point.schedule, point.freq_hz)
    return np.asarray(by_force / np.sqrt(point.Ts_s)), S
