"""Estimate force and sensor noise from the measured noise spectra of a loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from ..covariance_scaling import scaled
from ..records.record import IdentificationError
from .loop_plant import LoopPlant
from .output_errors import residual
from .residual_spectrum import ResidualSpectrum
from .spectral_lines import PointLines

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_ROUNDS = 8
_ROUNDING = 1e-20
_LEAST = 1e-6
"""Least share of a noise source: none is exactly zero, for the Kalman filter's sake."""


class NoiseSources(Protocol):
    """White noise: two-sided density (p, p) of forces, N^2/Hz, and covariance (n, n) of outputs."""

    @property
    def force_density(self) -> Array: ...  # noqa: D102

    @property
    def output_covariance(self) -> Array: ...  # noqa: D102


@dataclass(frozen=True)
class LoopNoise:
    """The noise sources that a loop shows."""

    force_density: Array
    output_covariance: Array


def measured_noise(
    plant: LoopPlant,
    points: Sequence[PointLines],
    residuals: Sequence[ResidualSpectrum],
    correlations: tuple[Array, Array],
) -> LoopNoise:
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
        by_force = S @ plant.compliance(point)
        columns.append(np.concatenate([np.abs(by_force) ** 2 / point.Ts_s, np.abs(S) ** 2], axis=2))
        targets.append(np.einsum("fii->fi", found.noise).real)
    A = np.concatenate(columns)
    A, b = A.reshape(-1, A.shape[2]), np.concatenate(targets).ravel()
    if not np.max(b) > 0.0:
        raise IdentificationError("expected noise in the records, found that they have none at all")
    b = np.maximum(b, _ROUNDING * np.max(b))
    weight = 1.0 / b
    for _ in range(_ROUNDS):
        weighted = A * weight[:, None]
        size = np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)
        sizes = nnls(weighted / size, b * weight)[0] / size
        weight = 1.0 / np.maximum(A @ sizes, 1e-3 * b)
    # The size at which a source would be all the noise of some output at some frequency.
    alone = np.min(b[:, None] / np.maximum(A, 1e-300), axis=0)
    sizes = np.maximum(sizes, _LEAST * alone)
    p = correlations[0].shape[0]
    return LoopNoise(scaled(correlations[0], sizes[:p]), scaled(correlations[1], sizes[p:]))


def noise_spectrum(plant: LoopPlant, point: PointLines, noise: NoiseSources) -> Complex:
    """Return the covariance (F, n, n) of the outputs' noise in the loop at the point's lines."""
    _, S, _ = residual(plant, point)
    by_force = S @ plant.compliance(point) / np.sqrt(point.Ts_s)
    return np.asarray(
        by_force @ noise.force_density @ by_force.conj().transpose(0, 2, 1)
        + S @ noise.output_covariance @ S.conj().transpose(0, 2, 1)
    )
