"""Compute the trajectory along which effects are evaluated, filtered or simulated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d
from scipy.signal import savgol_coeffs

from ....model.effects.base import Signals
from ...greybox.prediction.discretisation import Motion, innovations
from ...greybox.prediction.noise_model import Filter
from ...greybox.prediction.prediction_errors import settled
from .record_from_log import TraceRecord

Array = NDArray[np.float64]


def measured_signals(
    record: TraceRecord, at: Motion, y: Array, kalman: Filter, lag_s: float
) -> Signals:
    """Return the trajectory of a record from poses y (N, n), filtered along its motion.

    `at` includes the forces of the effects found so far; y is corrected for sensor effects.
    """
    gain = kalman.gain
    start = np.concatenate([y[0], np.zeros_like(y[0])])
    at = settled(at, _mean_force(at, y))
    error = innovations(at, gain, y, start)
    n = y.shape[1]
    q = y - error + products(gain[:, :n], error)
    return trajectory(record, q, record.coil, lag_s)


def _mean_force(at: Motion, y: Array) -> Array:
    """Return the constant force (n,) that balances the mean pose.

    Without it the weight alone would bias the filter by tens of micrometres.
    """
    acting = products(at.B, at.inputs[:, 0] / at.Ts_s) + at.drift[:, 0] / at.Ts_s
    left = products(at.K, y) - acting
    return np.linalg.solve(at.mobility.mean(axis=0), left.mean(axis=0))


def products(matrices: Array, vectors: Array) -> Array:
    """Return the products (N, n) of matrices (N, n, m), or one for all rows, and vectors (N, m)."""
    if len(matrices) == 1:  # many times as fast
        return np.asarray(vectors @ matrices[0].T)
    return np.asarray(np.einsum("nij,nj->ni", matrices, vectors))


def trajectory(record: TraceRecord, q: Array, coil: Array, lag_s: float) -> Signals:
    """Return the signals of a record with poses q (N, n) and coil commands (N, C)."""
    Ts_s = record.experiment.Ts_s
    qd = rate(q, Ts_s)
    beam, rotor = record.beam, record.rotor
    return Signals(
        Ts_s,
        record.time_s,
        q,
        qd,
        rate(qd, Ts_s),
        coil,
        beam[:, 0],
        beam[:, 1],
        beam[:, 2],
        rotor[:, 0],
        rotor[:, 1],
        rotor[:, 2],
        record.experiment.delay_cycles,
        record.places,
        lag_s,
        stuck=record.stuck,
    )


def rate(values: Array, Ts_s: float, around: int = 2) -> Array:
    """Return the derivative of samples (N, n) by central differences over `around` rows on either
    side, of twice that order; at the ends of second order."""
    order = 2 * around
    weights = savgol_coeffs(order + 1, order, deriv=1, delta=Ts_s, use="dot")
    found = np.gradient(values, Ts_s, axis=0)
    inner = slice(around, len(values) - around)
    found[inner] = correlate1d(values, weights, axis=0)[inner]
    return np.asarray(found)
