"""How well a model explains an output, in percent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def nrmse_fit_percent(measured: Array, modelled: Array) -> Array:
    """Return 100 (1 - ||y - yhat|| / ||y - mean(y)||) of each output (m,), for (N, m) arrays.

    100 is a perfect model, 0 no better than the mean, negative worse; nothing is capped. An output
    that never moves gives nan.
    """
    spread = np.linalg.norm(measured - measured.mean(axis=0), axis=0)
    error = np.linalg.norm(measured - modelled, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(spread > 0, 100.0 * (1.0 - error / spread), np.nan))
