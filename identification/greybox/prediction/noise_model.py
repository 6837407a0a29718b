"""Model white force noise and white measurement noise, and compute their Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from ...covariance_scaling import correlation, scaled
from ...records.record import IdentificationError
from . import filter_kernels
from .discretisation import Motion, process_covariance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Noise:
    """White noise of forces and outputs.

    `force_density` (n, n): two-sided density of generalised forces, N^2/Hz for forces in N.
    `output_covariance` (n, n): of the measurement. The noise of coils and sensors is independent;
    that of wrench and pose is correlated, unless coils and sensors are placed symmetrically.
    """

    force_density: Array
    output_covariance: Array

    @classmethod
    def independent(cls, force_psd: Array, output_variance: Array) -> Noise:
        """Return uncorrelated noise of densities and variances (n,)."""
        return cls(np.diag(force_psd), np.diag(output_variance))

    @property
    def force_psd(self) -> Array:
        """Density (n,) of the force on each DOF."""
        return np.diag(self.force_density)

    @property
    def output_variance(self) -> Array:
        """Variance (n,) of each output."""
        return np.diag(self.output_covariance)

    def scaled(self, force: Array | float = 1.0, output: Array | float = 1.0) -> Noise:
        """Scale densities and variances by factors, (n,) or scalar; correlations stay."""
        return Noise(scaled(self.force_density, force), scaled(self.output_covariance, output))

    def distance(self, other: Noise) -> float:
        """Return the largest difference of log variances."""
        ours, theirs = (
            np.log(np.concatenate([n.force_psd, n.output_variance])) for n in (self, other)
        )
        return float(np.max(np.abs(ours - theirs)))


@dataclass(frozen=True)
class Filter:
    """Kalman filter of a motion: gain (R, 2n, n), innovation covariance (R, n, n), R = 1 or N."""

    gain: Array
    covariance: Array

    def whiten(self, errors: Array) -> Array:
        """Whiten errors (N, n, ...): unit covariance, uncorrelated between samples."""
        whitener = np.linalg.inv(np.linalg.cholesky(self.covariance))
        flat = errors.reshape(len(errors), errors.shape[1], -1)
        if len(whitener) == 1 and flat.shape[2] == 1:
            return np.asarray(errors @ whitener[0].T)
        return np.asarray(whitener @ flat).reshape(errors.shape)

    def log_determinant(self, first: int = 0) -> float:
        """Return the mean log determinant of the innovation covariance from row `first` on."""
        rows = self.covariance if len(self.covariance) == 1 else self.covariance[first:]
        return float(np.mean(np.linalg.slogdet(rows)[1]))


def kalman_filter(model: Motion, noise: Noise) -> Filter:
    """Return the stationary Kalman filter of a fixed motion, or the time-varying one of a schedule.

    Raises IdentificationError if no stationary filter exists for this noise.
    """
    Q = process_covariance(model, noise.force_density)
    R = np.ascontiguousarray(noise.output_covariance)
    n = len(R)
    A, _ = model.continuous()
    Phi = expm(A * model.Ts_s)
    # Solved in units of the noise: metres and radians differ by orders of magnitude.
    unit = np.concatenate([np.sqrt(noise.output_variance)] * 2)
    unit[n:] /= model.Ts_s
    C = np.hstack([np.eye(n), np.zeros((n, n))])
    try:
        P = solve_discrete_are(
            (Phi / unit[:, None] * unit).T,
            C.T,
            Q[0] / unit[:, None] / unit,
            correlation(R),
        )
    except (np.linalg.LinAlgError, ValueError) as error:
        raise IdentificationError(
            f"no stationary Kalman filter exists for this noise ({error})"
        ) from None
    P = P * unit[:, None] * unit
    if model.fixed:
        S = P[:n, :n] + R
        return Filter(np.linalg.solve(S, P[:n, :]).T[None], S[None])
    rows = len(model.K)
    gain, S_all = np.empty((rows, 2 * n, n)), np.empty((rows, n, n))
    filter_kernels.gains_along(
        model.K, model.D, model.scale, np.ascontiguousarray(Q), R, np.ascontiguousarray(P),
        gain, S_all,
    )  # fmt: skip
    return Filter(gain, S_all)
