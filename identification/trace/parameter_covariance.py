"""The covariance of a refitted model's parameters, as result.json states it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...config.model import ModelConfig

Array = NDArray[np.float64]


def correlations_of(covariance: Array) -> Array:
    """Return the correlations (P, P); those of a number without variance are 0."""
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    known = deviation > 0.0
    scale = np.where(known, deviation, 1.0)
    correlation = np.where(np.outer(known, known), covariance / np.outer(scale, scale), 0.0)
    np.fill_diagonal(correlation, 1.0)
    return np.asarray(np.clip(correlation, -1.0, 1.0))


def parameter_covariance(
    model: ModelConfig, names: list[str], correlations: Array
) -> dict[str, Any]:
    """Return names (P,) and covariance (P, P), in SI units, of the parameters with an error.

    `correlations` are those of `names`, which may be followed by others. The variances are those
    of the stated standard errors.
    """
    errors = {name: p.se for name, p in model.parameters.items() if p.se}
    pick = [i for i, name in enumerate(names) if name in errors]
    kept = [names[i] for i in pick]
    deviation = np.array([errors[name] for name in kept])
    matrix = correlations[np.ix_(pick, pick)] * np.outer(deviation, deviation)
    return {"parameters": kept, "matrix": matrix}
