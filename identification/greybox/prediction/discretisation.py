"""Discretise the declared model along a record: fixed matrices, or one set for each period."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from ....model.declared_model import DeclaredModel, ModelError, inverse_mass
from ...records.record import IdentificationError
from ..experiment.experiment_from_log import Experiment
from ..experiment.intersample_input import Hold, moments
from . import filter_kernels

Array = NDArray[np.float64]

_FASTEST = 8.0
"""Largest product of the model's fastest rate and the sampling time."""
_DECAY_TIME_CONSTANTS = 12.0
"""Time constants after which the effect of an input through the lag has decayed to 6e-6."""
_ACCURACY = 1e-12
"""Largest truncation error of the Taylor series over a period, relative to the state."""


@dataclass(frozen=True)
class Motion:
    """A model along an experiment: K, D (R, n, n), B (R, n, p) divided by M, R = 1 or N.

    `mobility` (R, n, n) is the inverse of M. In the first `blind` rows, unknown inputs from before
    the record still act. `drift` (R, J, n): moments of the model's own force over each period,
    divided by M; `scale` (J + 1,) is Ts^j / j!; `inputs` (N, J, p): moments of the input.
    """

    K: Array
    D: Array
    B: Array
    mobility: Array
    drift: Array
    scale: Array
    inputs: Array
    Ts_s: float
    blind: int

    @property
    def fixed(self) -> bool:
        """Whether the matrices are constant over the record."""
        return len(self.K) == 1

    @cached_property
    def flow(self) -> Array:
        """State transition matrix (2n, 2n) of one period, for a fixed motion."""
        return np.asarray(expm(self.continuous()[0] * self.Ts_s))

    @cached_property
    def forcing(self) -> Array:
        """Change of the state (N, 2n) by inputs and drift in each period, for a fixed motion.

        It is sum_j A^j (B m_j + [0, g_j]) with moments m_j of the input and g_j of the drift.
        """
        A, B = self.continuous()
        n, p = len(self.K[0]), B.shape[1]
        power = np.hstack([B, np.vstack([np.zeros((n, n)), np.eye(n)])])
        by_input, constant = [], np.zeros(2 * n)
        for drift in self.drift[0]:
            by_input.append(power[:, :p].T)
            constant += power[:, p:] @ drift
            power = A @ power
        effect = self.inputs.reshape(len(self.inputs), -1) @ np.vstack(by_input)
        return np.asarray(effect + constant)

    @property
    def steady(self) -> Array:
        """Change of the state (2n, n) in a period by a unit of each constant generalised force."""
        A, _ = self.continuous()
        n = len(self.K[0])
        power = np.vstack([np.zeros((n, n)), self.mobility[0]])
        total = np.zeros_like(power)
        for scale in self.scale[1:]:
            total += scale * power
            power = A @ power
        return total

    def rows(self, start: int, stop: int) -> Motion:
        """Return rows start to stop (exclusive), with the inputs interpolated before the cut.

        Interpolated after the cut, they would ring at its ends.
        """
        cut = slice(start, stop)
        drift = self.drift if len(self.drift) == 1 else self.drift[cut]
        if self.fixed:
            return replace(self, inputs=self.inputs[cut], drift=drift)
        return replace(
            self,
            K=self.K[cut],
            D=self.D[cut],
            B=self.B[cut],
            mobility=self.mobility[cut],
            inputs=self.inputs[cut],
            drift=drift,
        )

    def continuous(self, row: int = 0) -> tuple[Array, Array]:
        """Return A (2n, 2n) and B (2n, p) of one period, states [q, q']."""
        n = self.K.shape[1]
        A = np.block([[np.zeros((n, n)), np.eye(n)], [-self.K[row], -self.D[row]]])
        return A, np.vstack([np.zeros((n, self.B.shape[2])), self.B[row]])


def motion(
    model: DeclaredModel, experiment: Experiment, hold: Hold, inputs: Array | None = None
) -> Motion:
    """Discretise `model` along `experiment`; `inputs` are their moments, if known already.

    A constant schedule gives one set of matrices and no drift (a constant force is part of the
    record's unknown offset). A moving one gives matrices in the middle of each period, with the
    model's force linear over the period; a component that never changes (the weight) is left out.

    Raises ModelError for a formula without a value or a singular M, IdentificationError for a model
    too fast for the sampling time.
    """
    Ts_s = experiment.Ts_s
    if experiment.moving:
        begin = dict(experiment.schedule)
        end = {
            name: values if name in experiment.rates else np.append(values[1:], values[-1])
            for name, values in begin.items()
        }
        middle = {name: 0.5 * (begin[name] + end[name]) for name in begin}
        at = model.over(middle)
        force = np.stack([model.moving_force(begin), model.moving_force(end)], axis=2)
    else:
        middle = {name: np.array([values.mean()]) for name, values in experiment.schedule.items()}
        at, force = model.over(middle), np.zeros((1, len(model.dof), 2))
    try:
        mobility = inverse_mass(at.M, middle)
    except ModelError as error:
        raise ModelError(f"record '{experiment.name}': {error}") from None
    K, D, B = mobility @ at.K, mobility @ at.D, mobility @ at.B
    scale = taylor_scale(K, D, Ts_s)
    order = len(scale) - 1
    if inputs is None or inputs.shape[1] != order:
        inputs = input_moments(model, experiment, hold, order)
    drift = np.zeros((len(K), order, len(model.dof)))
    if experiment.moving:
        drift = _drift(mobility @ force, Ts_s, order)
    return Motion(K, D, B, mobility, drift, scale, inputs, Ts_s, _blind_rows(model, experiment))


def input_moments(model: DeclaredModel, experiment: Experiment, hold: Hold, order: int) -> Array:
    """Return the moments (N, order, p) of the experiment's input after delay and lag."""
    values = {**model.values, **model.scheduling}
    delay_s = experiment.delay_cycles * experiment.Ts_s + model.delay(values)
    return moments(
        experiment.u, experiment.Ts_s, order, hold, max(delay_s, 0.0), max(model.lag(values), 0.0)
    )


def _blind_rows(model: DeclaredModel, experiment: Experiment) -> int:
    values = {**model.values, **model.scheduling}
    memory_s = max(model.delay(values), 0.0) + _DECAY_TIME_CONSTANTS * max(model.lag(values), 0.0)
    rows = experiment.delay_cycles + math.ceil(memory_s / experiment.Ts_s) + 1
    return min(rows, len(experiment.y) // 4)


def taylor_scale(K: Array, D: Array, Ts_s: float) -> Array:
    """Return Ts^j / j! (J + 1,), with J for a relative truncation error below 1e-12."""
    # |A Ts| in units in which position and velocity of the fastest motion are equal.
    fastest = math.sqrt(float(np.abs(K).sum(axis=2).max())) + float(np.abs(D).sum(axis=2).max())
    reach, term, order = fastest * Ts_s, 1.0, 0
    if not reach < _FASTEST:
        raise IdentificationError(
            f"the model is too fast for a sampling time of {Ts_s:g} s: expected at most "
            f"{_FASTEST / Ts_s:.3g} rad/s, found {fastest:.3g} rad/s; check rate_hz of the records "
            "and the values of the model"
        )
    while term > _ACCURACY or order < 3:
        order += 1
        term *= reach / order
    return np.array([Ts_s**j / math.factorial(j) for j in range(order + 1)])


def innovations(model: Motion, gain: Array, y: Array, x0: Array) -> Array:
    """Return the innovations (N, n) of y; gain (1 or N, 2n, n), initial state x0 (2n,)."""
    return run_filter(model, gain, y, x0)[0]


def run_filter(model: Motion, gain: Array, y: Array, x0: Array) -> tuple[Array, Array]:
    """Return the innovations (N, n) and the predicted state (2n,) after the last row."""
    out, x = np.empty_like(y), np.array(x0, float)
    if model.fixed:
        filter_kernels.innovations_fixed(model.flow, gain[0], model.forcing[: len(y)], y, x, out)
    else:
        filter_kernels.innovations_along(
            model.K, model.D, model.B, model.drift, gain, model.inputs, model.scale, y, x, out
        )
    return out, x


def process_covariance(model: Motion, density: Array) -> Array:
    """Return Q (R, 2n, 2n) of white generalised forces with two-sided density (n, n) in N^2/Hz.

    Q is computed by Van Loan's method (1978); along a schedule to second order in the sampling
    time, which is more accurate than the noise is known.
    """
    Ts_s, n = model.Ts_s, model.K.shape[1]
    if model.fixed:
        A, _ = model.continuous()
        G = np.vstack([np.zeros((n, n)), model.mobility[0]])
        block = np.block([[-A, G @ density @ G.T], [np.zeros_like(A), A.T]]) * Ts_s
        Phi = expm(block)
        Q = Phi[2 * n :, 2 * n :].T @ Phi[: 2 * n, 2 * n :]
        return np.asarray(0.5 * (Q + Q.T))[None]
    force = model.mobility @ density @ np.swapaxes(model.mobility, 1, 2)
    Q = np.empty((len(force), 2 * n, 2 * n))
    Q[:, n:, n:] = force * Ts_s
    Q[:, :n, n:] = Q[:, n:, :n] = force * (Ts_s**2 / 2)
    Q[:, :n, :n] = force * (Ts_s**3 / 3)
    return Q


def _drift(force: Array, Ts_s: float, order: int) -> Array:
    """Return the moments (N, J, n) of a force (N, n, 2), linear from [..., 0] to [..., 1]."""
    drift = np.empty((len(force), order, force.shape[1]))
    for j in range(order):
        whole = Ts_s ** (j + 1) / math.factorial(j + 1)
        now = Ts_s ** (j + 1) / (math.factorial(j) * (j + 2))
        drift[:, j] = now * force[:, :, 0] + (whole - now) * force[:, :, 1]
    return drift
