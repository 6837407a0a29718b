"""Compute whitened prediction errors of a record, with constant force and start fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ....model.declared_model import DeclaredModel
from ...records.record import IdentificationError
from ..experiment.experiment_from_log import Experiment
from ..experiment.intersample_input import Hold
from . import filter_kernels
from .discretisation import Motion, innovations, motion, run_filter
from .noise_model import Filter, Noise, kalman_filter

Array = NDArray[np.float64]

_DECAYED = 1e-14
"""Share of an initial state's effect in the rows that count below which it is not fitted."""


@dataclass(frozen=True)
class Prediction:
    """One experiment predicted one step ahead.

    errors (N, n): whitened, of unit variance if model and noise are correct. offset (n,): constant
    generalised force not in the model; start (2n,): the state at row 0. unknowns (N, n, 3n): effect
    of a unit of each of these on the errors. A start whose effect has decayed before the errors
    count is zero.
    """

    experiment: Experiment
    motion: Motion
    filter: Filter
    errors: Array
    unknowns: Array
    offset: Array
    start: Array

    @property
    def innovations(self) -> Array:
        """Errors (N, n) in output units; zero in blind rows."""
        lower = np.linalg.cholesky(self.filter.covariance)
        return np.asarray((lower @ self.errors[:, :, None])[:, :, 0])

    @property
    def squares(self) -> float:
        """Sum of the squared errors."""
        return float(np.sum(self.errors**2))

    @property
    def cost(self) -> float:
        """Minus twice the log-likelihood, up to a constant."""
        blind = self.motion.blind  # blind rows have no errors
        return self.squares + (len(self.errors) - blind) * self.filter.log_determinant(blind)


def predict(
    model: DeclaredModel, experiment: Experiment, hold: Hold, by: Noise | Filter
) -> Prediction:
    """Predict the experiment by `model`, with offset and start by least squares.

    `by`: the noise, for its Kalman filter, or a filter.
    """
    at = motion(model, experiment, hold)
    return predict_along(at, experiment, by if isinstance(by, Filter) else kalman_filter(at, by))


def predict_along(at: Motion, experiment: Experiment, kalman: Filter) -> Prediction:
    """Predict the experiment by a filter along a motion, with offset and start fitted."""
    with np.errstate(over="ignore", invalid="ignore"):  # divergence is checked below
        both = kalman.whiten(_errors_and_unknowns(at, kalman, experiment))
    n = both.shape[1]
    in_blind_rows = np.linalg.norm(both[: at.blind, :, 1:].reshape(-1, 3 * n), axis=0)
    both[: at.blind] = 0.0
    errors, unknowns = np.ascontiguousarray(both[:, :, 0]), both[:, :, 1:]
    flat = unknowns.reshape(-1, 3 * n)
    # Effects of offset and start differ by orders of magnitude: scale them before the rank test.
    size = np.linalg.norm(flat, axis=0)
    if not (np.all(np.isfinite(errors)) and np.all(np.isfinite(size))):
        raise IdentificationError(
            f"record '{experiment.name}': the prediction of this model diverges; check its values"
        )
    # The effect of a start that has decayed before the errors count is rounding.
    visible = size > _DECAYED * in_blind_rows
    unknowns[:, :, ~visible] = 0.0
    solution = np.zeros(3 * n)
    columns = np.column_stack([flat[:, visible] / size[visible], errors.reshape(-1)])
    R = np.asarray(np.linalg.qr(columns, mode="r"))  # first: of a tall matrix, half the time
    fitted = np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=1e-12)[0]
    solution[visible] = -fitted / size[visible]
    return Prediction(
        experiment, at, kalman, errors + unknowns @ solution, unknowns, solution[:n], solution[n:]
    )


def errors_of(at: Motion, kalman: Filter, experiment: Experiment, start: Array) -> Array:
    """Return whitened errors (N, n) of a motion from `start` (2n,); zero in blind rows."""
    with np.errstate(over="ignore", invalid="ignore"):  # divergence is checked later
        errors = kalman.whiten(innovations(at, kalman.gain, experiment.y, start))
    errors[: at.blind] = 0.0
    return errors


def settled(at: Motion, offset: Array) -> Motion:
    """Return the motion with a constant generalised force `offset` (n,) added."""
    return replace(at, drift=at.drift + _steady(at, offset))


def _errors_and_unknowns(at: Motion, kalman: Filter, experiment: Experiment) -> Array:
    """Return errors from a zero state and the effects of unknowns (N, n, 1 + 3n), not whitened."""
    n, rows = at.K.shape[1], len(experiment.y)
    out = np.empty((rows, n, 1 + 3 * n))
    if at.fixed:
        filter_kernels.errors_and_unknowns(
            at.flow, kalman.gain[0], at.forcing[:rows], at.steady, experiment.y, out
        )
        return out
    out[:, :, 0] = innovations(at, kalman.gain, experiment.y, np.zeros(2 * n))
    silent = replace(at, B=at.B[:, :, :0], inputs=np.zeros((rows, len(at.scale) - 1, 0)))
    still = replace(silent, drift=np.zeros_like(at.drift))
    zero = np.zeros((rows, n))
    for i in range(n):
        forced = settled(still, np.eye(n)[i])
        out[:, :, 1 + i] = innovations(forced, kalman.gain, zero, np.zeros(2 * n))
    for i in range(2 * n):
        _fill_with_start(still, kalman, np.eye(2 * n)[i], out[:, :, 1 + n + i])
    return out


def _fill_with_start(still: Motion, kalman: Filter, x: Array, out: Array) -> None:
    """Fill `out` (N, n) with the effect of a state `x` (2n,) at row 0, zero once it has decayed.

    Whether it has is asked whenever the number of rows has doubled.
    """
    first, end, largest = 0, filter_kernels.STILL_ROWS, 0.0
    while first < len(out):
        rows = slice(first, min(end, len(out)))
        there = still.rows(rows.start, rows.stop)
        out[rows], x = run_filter(there, kalman.gain[rows], np.zeros_like(out[rows]), x)
        now = float(np.max(np.abs(out[rows])))
        largest = max(largest, now)
        if now <= _DECAYED * largest:
            out[rows.stop :] = 0.0
            return
        first, end = end, 2 * end


def _steady(at: Motion, force: Array) -> Array:
    """Return the moments (R, J, n) of a constant force (n,) over each period, divided by M."""
    return np.asarray(at.scale[1:, None] * (at.mobility @ force)[:, None, :])
