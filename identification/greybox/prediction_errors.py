"""Prediction errors of one record: whitened, with its constant forces and its start fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...model.declared_model import DeclaredModel
from ..records.record import IdentificationError
from . import filter_kernels
from .discretisation import Motion, innovations, motion
from .experiment import Experiment
from .intersample_input import Hold
from .noise_model import Filter, Noise, kalman_filter

Array = NDArray[np.float64]

_FORGOTTEN = 1e-14
"""Of what a start adds to all rows, what it adds to those that count, at which it tells nothing."""


@dataclass(frozen=True)
class Prediction:
    """One experiment predicted one step ahead.

    errors (N, n): whitened, of unit variance where model and noise hold. offset (n,): constant
    generalised force that the model does not account for; start (2n,): the state at row 0.
    unknowns (N, n, 3n): what a unit of each of these adds to the errors. A start that the filter
    has forgotten before errors count adds nothing, and is zero.
    """

    experiment: Experiment
    motion: Motion
    filter: Filter
    errors: Array
    unknowns: Array
    offset: Array
    start: Array

    @property
    def squares(self) -> float:
        """Sum of the squared errors."""
        return float(np.sum(self.errors**2))

    @property
    def cost(self) -> float:
        """Minus twice the log-likelihood, but for a constant."""
        blind = self.motion.blind  # rows without errors say nothing of their size either
        return self.squares + (len(self.errors) - blind) * self.filter.log_determinant(blind)


def predict(
    model: DeclaredModel, experiment: Experiment, hold: Hold, by: Noise | Filter
) -> Prediction:
    """Return the experiment predicted by `model`, its offset and start by least squares.

    `by`: the noise, whose Kalman filter predicts, or a filter as it is.
    """
    at = motion(model, experiment, hold)
    return predict_along(at, experiment, by if isinstance(by, Filter) else kalman_filter(at, by))


def predict_along(at: Motion, experiment: Experiment, kalman: Filter) -> Prediction:
    """Return the experiment predicted by a filter along a motion, offset and start fitted."""
    with np.errstate(over="ignore", invalid="ignore"):  # a model that runs away is told apart below
        both = kalman.whiten(_errors_and_unknowns(at, kalman, experiment))
    n = both.shape[1]
    unseen = np.linalg.norm(both[: at.blind, :, 1:].reshape(-1, 3 * n), axis=0)
    both[: at.blind] = 0.0
    errors, unknowns = np.ascontiguousarray(both[:, :, 0]), both[:, :, 1:]
    flat = unknowns.reshape(-1, 3 * n)
    # Offsets and start differ by orders in what they move: scale before deciding what is singular.
    size = np.linalg.norm(flat, axis=0)
    if not (np.all(np.isfinite(errors)) and np.all(np.isfinite(size))):
        raise IdentificationError(f"record '{experiment.name}': this model runs away")
    # Of a start that the filter has forgotten when errors begin nothing is left but rounding.
    seen = size > _FORGOTTEN * unseen
    unknowns[:, :, ~seen] = 0.0
    solution = np.zeros(3 * n)
    fitted = np.linalg.lstsq(flat[:, seen] / size[seen], errors.reshape(-1), rcond=1e-12)[0]
    solution[seen] = -fitted / size[seen]
    return Prediction(
        experiment, at, kalman, errors + unknowns @ solution, unknowns, solution[:n], solution[n:]
    )


def errors_of(at: Motion, kalman: Filter, experiment: Experiment, start: Array) -> Array:
    """Return whitened errors (N, n) of a motion from `start` (2n,), none in blind rows."""
    with np.errstate(over="ignore", invalid="ignore"):  # a model that runs away is told apart later
        errors = kalman.whiten(innovations(at, kalman.gain, experiment.y, start))
    errors[: at.blind] = 0.0
    return errors


def settled(at: Motion, offset: Array) -> Motion:
    """Return a motion with a constant generalised force `offset` (n,) among its forces."""
    return replace(at, drift=at.drift + _steady(at, offset))


def _errors_and_unknowns(at: Motion, kalman: Filter, experiment: Experiment) -> Array:
    """Return errors (N, n, 1 + 3n) from a state of zero, not whitened, then what unknowns add."""
    n, rows = at.K.shape[1], len(experiment.y)
    out = np.empty((rows, n, 1 + 3 * n))
    if at.fixed:
        filter_kernels.errors_and_unknowns(
            at.flow, kalman.gain[0], at.forcing[:rows], at.steady, experiment.y, out
        )
        return out
    out[:, :, 0] = innovations(at, kalman.gain, experiment.y, np.zeros(2 * n))
    silent = replace(at, inputs=np.zeros((rows, len(at.scale) - 1, at.B.shape[2])))
    still = replace(silent, drift=np.zeros_like(at.drift))
    zero = np.zeros((rows, n))
    for i in range(n):
        forced = settled(still, np.eye(n)[i])
        out[:, :, 1 + i] = innovations(forced, kalman.gain, zero, np.zeros(2 * n))
    for i in range(2 * n):
        out[:, :, 1 + n + i] = innovations(still, kalman.gain, zero, np.eye(2 * n)[i])
    return out


def _steady(at: Motion, force: Array) -> Array:
    """Return moments (R, J, n) of a constant force (n,) over each period, divided by M."""
    return np.asarray(at.scale[1:, None] * (at.mobility @ force)[:, None, :])
