"""Estimate noise variances by maximum likelihood, for a given model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from ...records.record import IdentificationError
from ..experiment.experiment_from_log import Experiment
from .discretisation import Motion
from .noise_model import Noise, kalman_filter
from .prediction_errors import predict_along

Array = NDArray[np.float64]

_INVALID_COST = 1e9


def estimate_noise(
    motions: Sequence[Motion], experiments: Sequence[Experiment], first: Noise
) -> Noise:
    """Estimate the noise by maximum likelihood of the innovations; `first` gives the correlations.

    Constant forces and initial states are refitted for every noise: those fitted with large noise
    are inaccurate, and their errors would count as noise when the noise is small.
    """
    n = len(first.output_variance)

    def cost(log_sizes: Array) -> float:
        noise = first.scaled(np.exp(log_sizes[:n]), np.exp(log_sizes[n:]))
        try:
            total = sum(
                predict_along(at, e, kalman_filter(at, noise)).cost
                for at, e in zip(motions, experiments, strict=True)
            )
        except IdentificationError:
            return _INVALID_COST
        return total / sum(len(e.y) for e in experiments)

    found = minimize(
        cost,
        np.zeros(2 * n),
        method="L-BFGS-B",
        bounds=[(-12.0, 12.0)] * (2 * n),
        options={"maxiter": 40, "eps": 1e-4, "ftol": 1e-7},
    )
    sizes = np.exp(found.x)
    return first.scaled(sizes[:n], sizes[n:])
