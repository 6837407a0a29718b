"""State the covariance of a refitted model's parameters, for result.json."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...config.model import ModelConfig
from ..covariance_scaling import scaled

Array = NDArray[np.float64]


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
    return {"parameters": kept, "matrix": scaled(correlations[np.ix_(pick, pick)], deviation**2)}
