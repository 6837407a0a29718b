"""What disturbs a record: white forces and white measurement noise, their size and their filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from ..records.record import IdentificationError
from . import filter_kernels
from .covariance import correlation, scaled
from .discretisation import Motion, process_covariance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Noise:
    """White noise: `force_density` (n, n), two-sided, of generalised forces, N^2/Hz where forces
    are in N; `output_covariance` (n, n) of what is measured.

    Noise of single coils and sensors is independent from one to the next; of the wrench and the
    pose that they make up it is not, unless their places are balanced around the middle.
    """

    force_density: Array
    output_covariance: Array

    @classmethod
    def independent(cls, force_psd: Array, output_variance: Array) -> Noise:
        """Return noise of densities and variances (n,) that has nothing in common between DOF."""
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
        """Return noise of so many times the densities and variances, (n,) or all alike.

        Correlations stay as they are.
        """
        return Noise(scaled(self.force_density, force), scaled(self.output_covariance, output))

    def distance(self, other: Noise) -> float:
        """Return the largest change of a variance between two, as a logarithm."""
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
        """Return errors (N, n, ...) with unit covariance, uncorrelated from sample to sample."""
        whitener = np.linalg.inv(np.linalg.cholesky(self.covariance))
        flat = errors.reshape(len(errors), errors.shape[1], -1)
        if len(whitener) == 1 and flat.shape[2] == 1:
            return np.asarray(errors @ whitener[0].T)
        return np.asarray(whitener @ flat).reshape(errors.shape)

    def log_determinant(self, first: int = 0) -> float:
        """Return the mean from row `first` on of ln of the innovation covariance's determinant."""
        rows = self.covariance if len(self.covariance) == 1 else self.covariance[first:]
        return float(np.mean(np.linalg.slogdet(rows)[1]))


def kalman_filter(model: Motion, noise: Noise) -> Filter:
    """Return the stationary filter of a fixed motion, the running one of a motion on a schedule.

    Raises IdentificationError where the noise leaves no stationary filter.
    """
    Q = process_covariance(model, noise.force_density)
    R = np.ascontiguousarray(noise.output_covariance)
    n = len(R)
    A, _ = model.continuous()
    Phi = expm(A * model.Ts_s)
    # Metres and radians differ by orders: the Riccati equation is solved in units of the noise.
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
        raise IdentificationError(f"no Kalman filter for this noise: {error}") from None
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
