"""Compute the fit of a model to measured outputs in percent (NRMSE), and compare two errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCKS = 8
"""Blocks in time from which the standard error of a difference is estimated."""


def nrmse_fit_percent(measured: Array, modelled: Array) -> Array:
    """Return 100 (1 - ||y - yhat|| / ||y - mean(y)||) for each output (m,) of (N, m) arrays.

    100 is a perfect model, 0 is as good as the mean, negative is worse. A constant output gives
    nan.
    """
    spread = np.linalg.norm(measured - measured.mean(axis=0), axis=0)
    error = np.linalg.norm(measured - modelled, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(spread > 0, 100.0 * (1.0 - error / spread), np.nan))


def larger_by_chance(ours: Array, theirs: Array) -> bool:
    """Return whether the mean square of errors (N,) exceeds that of others by chance at most.

    That is by no more than two standard errors, from blocks of time; no excess is chance, too.
    """
    squares = ((e - e.mean()) ** 2 for e in (ours, theirs))
    worse = np.array([part.mean() for part in np.array_split(np.subtract(*squares), BLOCKS)])
    return bool(worse.mean() <= 2.0 * worse.std(ddof=1) / np.sqrt(BLOCKS))
