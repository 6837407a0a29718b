"""Predict a record several rows ahead from measured outputs, for loops with an unknown controller.

An unstable or integrating plant drifts away in a simulation from its recorded input. A prediction
over a short horizon, corrected by every measurement through the model's Kalman filter, does not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ....model.declared_model import DeclaredModel
from ..experiment.experiment_from_log import Experiment
from ..experiment.intersample_input import Hold
from .discretisation import motion
from .noise_model import Noise, kalman_filter
from .prediction_errors import predict_along, settled

Array = NDArray[np.float64]

_HALF = 0.5
"""Autocorrelation of an output at the horizon."""
_LONGEST_SHARE = 0.05
"""Longest horizon, as a share of the record."""


def horizon_rows(model: DeclaredModel, experiment: Experiment, hold: Hold) -> int:
    """Return the rows after which the autocorrelation of every output is below one half.

    A shorter horizon is easy to predict from the last value alone. It is at least 2, at most a
    twentieth of the record, and at most a time constant of an unstable model.
    """
    y, at = experiment.y, motion(model, experiment, hold)
    longest = max(int(_LONGEST_SHARE * len(y)), 2)
    growth = float(np.log(np.abs(np.linalg.eigvals(at.flow)).max())) if at.fixed else 0.0
    if growth * longest > 1.0:
        longest = max(int(1.0 / growth), 2)
    centred = y - y.mean(axis=0)
    power = np.maximum(np.sum(centred**2, axis=0), np.finfo(float).tiny)
    for lag in range(2, longest):
        if np.all(np.sum(centred[lag:] * centred[:-lag], axis=0) < _HALF * power):
            return lag
    return longest


def predict_ahead(
    model: DeclaredModel, experiment: Experiment, hold: Hold, noise: Noise, rows: int
) -> Array:
    """Return the outputs (N, n) predicted `rows` rows ahead; nan in the first rows.

    Row k is predicted from the outputs up to row k - `rows` and from the recorded input; along a
    moving schedule always from the row before. Constant force and initial state are fitted to the
    whole record. Raises IdentificationError as predict_along does.
    """
    at = motion(model, experiment, hold)
    kalman = kalman_filter(at, noise)
    known = predict_along(at, experiment, kalman)
    if not at.fixed:
        return np.asarray(experiment.y - known.innovations)
    at = settled(at, known.offset)
    N, n = experiment.y.shape
    flow, forcing, gain = at.flow, at.forcing, kalman.gain[0]
    states, x = np.empty((N, 2 * n)), known.start.copy()
    for k in range(N):
        states[k] = x + gain @ (experiment.y[k] - x[:n])
        x = flow @ states[k] + forcing[k]
    ahead = states[: N - rows]
    for step in range(rows):
        ahead = ahead @ flow.T + forcing[step : N - rows + step]
    out = np.full((N, n), np.nan)
    out[rows:] = ahead[:, :n]
    return out
