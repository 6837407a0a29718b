"""Compute the fit of a model to measured outputs, in percent (NRMSE)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def nrmse_fit_percent(measured: Array, modelled: Array) -> Array:
    """Return 100 (1 - ||y - yhat|| / ||y - mean(y)||) for each output (m,) of (N, m) arrays.

    100 is a perfect model, 0 is as good as the mean, negative is worse. A constant output gives
    nan.
    """
    spread = np.linalg.norm(measured - measured.mean(axis=0), axis=0)
    error = np.linalg.norm(measured - modelled, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(spread > 0, 100.0 * (1.0 - error / spread), np.nan))
